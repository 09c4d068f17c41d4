//! Solves a problem of the benchmark "Bundle Adjustment in the Large" and says cost and time.
//!
//! `cargo run --release -p setloc-sfm --example bal -- problem-16-22106-pre.txt`

use std::error::Error;
use std::io::Write;
use std::time::Instant;

use setloc_sfm::bundle::BundleParams;
use setloc_sfm::bundle::bal::BalProblem;

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: bal PROBLEM.txt")?;
    let mut problem: BalProblem = std::fs::read_to_string(&path)?.parse()?;
    let start = Instant::now();
    let report = problem.solve(&BundleParams::default());
    let elapsed = start.elapsed().as_secs_f64();
    writeln!(
        std::io::stdout(),
        "{} cameras, {} points, {} observations: cost {:.6e} -> {:.6e}, {} iterations, {:?}, {elapsed:.3} s, {} threads",
        problem.cameras.len(),
        problem.points.len(),
        report.observations,
        report.initial_cost,
        report.final_cost,
        report.iterations,
        report.termination,
        rayon::current_num_threads(),
    )?;
    Ok(())
}
