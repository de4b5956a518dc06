//! The whole `cc4dgs` command with the plug-ins of `sway` and `half-floats` beside its own.

use half_floats as _;
use sway as _;

/// As in the `cc4dgs` program: training frees and allocates large buffers all the time; the system allocators give the memory back too eagerly.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    cc4dgs_cli::run(std::env::args_os())
}
