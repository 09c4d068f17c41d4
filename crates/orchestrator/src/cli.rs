//! The command line: typed arguments in, exit code out.

mod args;
mod batch;
mod bench;
mod build;
mod cache;
mod compare;
mod demo;
mod export;
mod import;
mod locate;
mod outputs;
mod report;
mod status;

use std::io::{self, ErrorKind};
use std::process::ExitCode;

use crate::error::{Hinted, Interrupted};
use crate::print;
use args::Command;

/// What a command came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Answer {
    /// Done.
    Done,
    /// It ran, but the answer is negative: not localized, not registered.
    Negative,
}

/// Exit code of a run that was stopped, as shells have it for SIGINT.
pub const STOPPED: u8 = 130;

/// Runs the program: exit code 0 done, 1 negative answer, 2 error, 130 stopped.
pub fn main() -> ExitCode {
    let cli = match args::parse(std::env::args_os()) {
        Ok(cli) => cli,
        Err(error) => error.exit(),
    };
    match dispatch(&cli.command) {
        Ok(Answer::Done) => ExitCode::SUCCESS,
        Ok(Answer::Negative) => ExitCode::from(1),
        Err(error) if error.is::<Interrupted>() => {
            print::note(&error.to_string());
            ExitCode::from(STOPPED)
        }
        Err(error) => {
            show(&error);
            ExitCode::from(2)
        }
    }
}

fn dispatch(command: &Command) -> anyhow::Result<Answer> {
    match command {
        Command::Demo(args) => demo::run(args),
        Command::Build(args) => build::run(args),
        Command::Plan(args) => build::plan(args),
        Command::Locate(args) => locate::run(args),
        Command::Bench(args) => bench::run(args),
        Command::Compare(args) => compare::run(args),
        Command::Batch(args) => batch::run(args),
        Command::Report(args) => report::run(args),
        Command::Status(args) => status::run(args),
        Command::Export(args) => export::run(args),
        Command::Import(args) => import::run(args),
        Command::Explain(args) => cache::explain(args),
        Command::Cache(args) => cache::run(args),
    }
}

/// The chain of causes, one a line, and the hints.
fn show(error: &anyhow::Error) {
    let mut last = String::new();
    for (at, cause) in error.chain().enumerate() {
        let text = cause.to_string();
        if text != last {
            print::note(&format!("{}{text}", if at == 0 { "error: " } else { "  caused by: " }));
        }
        last = text;
    }
    let hints: Vec<&str> =
        error.chain().filter_map(|cause| cause.downcast_ref::<Hinted>()).map(Hinted::hint).collect();
    for hint in &hints {
        print::note(&format!("hint: {hint}"));
    }
    let is_missing = |cause: &(dyn std::error::Error + 'static)| {
        cause.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == ErrorKind::NotFound)
    };
    if hints.is_empty() && error.chain().any(is_missing) {
        let here = std::env::current_dir().unwrap_or_default();
        print::note(&format!("hint: check the path; a relative one starts in {}", here.display()));
    }
}
