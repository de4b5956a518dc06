//! The `cc4dgs` command. A program of your own that links more plug-ins needs no more than this, see `cc4dgs::run`.

/// Frees and allocations of a training run are many and large; the system allocators give the memory back too eagerly.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    cc4dgs::run(std::env::args_os())
}
