//! The benchmark harness: a data set with truth in, figures out.

mod auc;
mod figures;
mod run;
mod tables;

pub use auc::{AUC_THRESHOLDS_DEG, auc_percent};
pub use figures::{Alignment, Bounds, Errors, PoseError, SceneFigures, Spread};
pub use run::{BenchGps, BenchOptions, DatasetFigures, MethodFigures, SetFigures, bench_dataset};
pub use tables::{errors_csv, markdown_tables};
