use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use anyhow::Result;

use super::Answer;
use super::args::{CacheArgs, CacheCommand, ExplainArgs};
use crate::error::Hinted;
use crate::print;
use crate::store::Store;

/// A store that is there already: a mistyped folder must not be made.
pub fn existing(folder: &Path) -> Result<Store> {
    if folder.join("objects").is_dir() {
        return Ok(Store::at(folder));
    }
    let message = format!("{} is no store of results", folder.display());
    Err(Hinted::error(
        message,
        "name it with --cache DIR or SETLOC_CACHE; `build` makes `.setloc-cache` beside its output",
    ))
}

/// `setloc cache`
pub fn run(args: &CacheArgs) -> Result<Answer> {
    let store = existing(&args.cache)?;
    match args.command {
        CacheCommand::Ls => {
            let summary = store.summary()?;
            for (kind, (count, bytes)) in &summary.kinds {
                print::data(&format!("{kind}\t{count}\t{}", mebibytes(*bytes)))?;
            }
            print::data(&format!("all objects\t\t{}", mebibytes(summary.bytes)))?;
            if summary.orphans > 0 {
                print::data(&format!(
                    "{} objects belong to no job; `setloc cache gc` removes them",
                    summary.orphans
                ))?;
            }
            if summary.unfinished > 0 {
                print::data(&format!(
                    "{} files are being written, or were left by a killed run; `setloc cache gc` removes old ones",
                    summary.unfinished
                ))?;
            }
        }
        CacheCommand::Gc { max, min_age } => {
            let removed = store.collect_garbage(max, Duration::from_mins(min_age))?;
            print::data(&format!("removed {} files, {}", removed.files, mebibytes(removed.bytes)))?;
            if let Some(left) = removed.too_young {
                print::data(&format!(
                    "{} are left, more than --max: what is younger than {min_age} minutes stays (--min-age)",
                    mebibytes(left)
                ))?;
            }
        }
        CacheCommand::Verify => {
            let damaged = store.verify()?;
            for name in &damaged {
                print::data(&format!("damaged, removed: {name}"))?;
            }
            print::data(&format!("{} damaged objects", damaged.len()))?;
            return Ok(if damaged.is_empty() { Answer::Done } else { Answer::Negative });
        }
    }
    Ok(Answer::Done)
}

pub fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

/// `setloc explain`
pub fn explain(args: &ExplainArgs) -> Result<Answer> {
    let store = existing(&args.cache)?;
    let mut found = false;
    for (run, record) in store.runs()? {
        for (label, key) in record.jobs.iter().filter(|(label, _)| label.contains(&args.job)) {
            found = true;
            let now = store.record(*key);
            let before = record.previous.get(label).and_then(|key| store.record(*key));
            let text = match (now, before) {
                (Some(_), _) if record.previous.get(label) == Some(key) => "nothing changed".to_owned(),
                (Some(now), Some(before)) => now.fingerprint.changes_since(&before.fingerprint).join("; "),
                (Some(_), None) if record.previous.is_empty() => "the first run".to_owned(),
                (Some(_), None) => "was not in the run before".to_owned(),
                (None, _) => "its fingerprint is no longer kept".to_owned(),
            };
            print::data(&format!("{run}: {label}: {text}"))?;
        }
    }
    if found {
        return Ok(Answer::Done);
    }
    let labels: Vec<String> = store.runs()?.into_values().flat_map(|run| run.jobs.into_keys()).collect();
    let kinds: BTreeSet<&str> = labels.iter().filter_map(|label| Some(label.split_once(' ')?.0)).collect();
    let hint = if kinds.is_empty() {
        "no run has come to its end with this store (--cache)".to_owned()
    } else {
        let kinds: Vec<&str> = kinds.into_iter().collect();
        format!("name a kind of job ({}), an image, or both, as `{}`", kinds.join(", "), labels[0])
    };
    Err(Hinted::error(format!("no job of the last runs is named like `{}`", args.job), hint))
}
