//! The `setloc` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    setloc_orchestrator::cli::main()
}
