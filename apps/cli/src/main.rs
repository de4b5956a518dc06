//! The `cc4dgs` command. A program of your own that links more plug-ins needs no more than this, see `cc4dgs_cli::run`.

/// Training frees and allocates large buffers all the time; the system allocators give the memory back too eagerly.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    cc4dgs_cli::run(std::env::args_os())
}
