//! Who listens to a run: the terminal, a JSON-lines log and the report.

mod console;
mod json_log;
mod report;

pub use console::Console;
pub use json_log::JsonLog;
pub use report::{RunReport, StageReport};
