//! The benchmark harness: data sets with truth in; figures, a page and a comparison with the baseline out.

mod auc;
mod baseline;
mod calibration;
mod compare;
mod figures;
mod harness;
mod html;
mod metrics;
mod reference;
mod registry;
mod run;
mod tables;

pub use auc::{AUC_THRESHOLDS_DEG, auc_percent};
pub use baseline::{Baseline, Delta, Judgement};
pub use calibration::{Calibration, NormalizedError};
pub use compare::{Comparison, Frame, comparison_table};
pub use figures::{Alignment, Bounds, Errors, PoseError, SceneFigures, Spread};
pub use harness::{Harness, HarnessRun, about};
pub use html::{figures_section, html_report};
pub use metrics::{MetricKind, Metrics, Repeated, metrics_of};
pub use reference::JointReference;
pub use registry::{Availability, DatasetEntry, ParameterSet, Registry, TruthKind, checksum_of};
pub use run::{BenchGps, BenchOptions, DatasetFigures, MethodFigures, SetFigures, bench_dataset};
pub use tables::{errors_csv, markdown_tables};
