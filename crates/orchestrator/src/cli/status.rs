use anyhow::Result;

use super::Answer;
use super::args::StatusArgs;
use super::cache::{existing, mebibytes};
use crate::clock;
use crate::print;
use crate::store::{RunRecord, Store};

/// `setloc status`
pub fn run(args: &StatusArgs) -> Result<Answer> {
    let store = existing(&args.cache)?;
    let summary = store.summary()?;
    let results: usize = summary.kinds.values().map(|(count, _)| count).sum();
    print::data(&format!("{results} results, {} in {}", mebibytes(summary.bytes), store.root().display()))?;
    for (kind, (count, bytes)) in &summary.kinds {
        print::data(&format!("  {kind}\t{count}\t{}", mebibytes(*bytes)))?;
    }
    let mut runs: Vec<RunRecord> = store.runs()?.into_values().collect();
    let ended = |run: &RunRecord| run.last.as_ref().map_or(0, |last| last.ended_unix_s);
    runs.sort_by(|a, b| ended(b).cmp(&ended(a)).then_with(|| a.name.cmp(&b.name)));
    for run in &runs {
        for line in describe(&store, run) {
            print::data(&line)?;
        }
    }
    Ok(Answer::Done)
}

/// What the last run of a name did, and what of it is still here.
fn describe(store: &Store, run: &RunRecord) -> Vec<String> {
    let mut lines = Vec::new();
    match &run.last {
        Some(last) => {
            let ago = duration(clock::unix_secs().saturating_sub(last.ended_unix_s));
            let (ran, stored, failed) = (last.ran, last.stored, last.failed.len());
            lines.push(format!(
                "{}: {ago} ago, {ran} jobs ran, {stored} were stored, {failed} failed",
                run.name
            ));
            lines.extend(last.failed.iter().map(|(job, reason)| format!("  failed {job}: {reason}")));
        }
        None => lines.push(format!("{}: never came to its end", run.name)),
    }
    let gone = run.jobs.values().filter(|key| store.lookup(**key).is_none()).count();
    if gone > 0 {
        lines.push(format!("  {gone} of its {} results are no longer stored", run.jobs.len()));
    }
    if !run.unfinished.is_empty() {
        lines.push(format!(
            "  stopped since, with {} results: the same command continues",
            run.unfinished.len()
        ));
    }
    lines
}

/// A time for people.
fn duration(seconds: u64) -> String {
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        7200..172_800 => format!("{} h", seconds / 3600),
        _ => format!("{} days", seconds / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_the_unit_that_fits() {
        assert_eq!([5, 300, 7200, 400_000].map(duration), ["5 s", "5 min", "2 h", "4 days"]);
    }
}
