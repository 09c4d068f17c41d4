//! Stopped by Ctrl-C, killed at any moment: nothing finished is lost, and the end is that of an undisturbed run.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::common::{files_below, logged, program, said, setloc, town};

/// Starts a build in `folder`, ends it by `signal` after `delay`; whether it was still running then.
fn build_and_signal(folder: &Path, panoramas: &str, signal: &str, delay: Duration) -> Option<i32> {
    let mut command = program(folder, &["build", panoramas, "-o", "s.setloc"]);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let begun = Instant::now();
    while begun.elapsed() < delay && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    // The shell's own `kill`: small systems have no such program.
    let send = format!("kill -s {signal} {}", child.id());
    std::process::Command::new("sh").args(["-c", &send]).stderr(Stdio::null()).status().unwrap();
    child.wait().unwrap().code()
}

/// All outputs of a build by name, but for logs, times and what a kill left half written under a temporary name.
fn outputs(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let timed = |path: &Path| {
        let name = path.file_name().unwrap().to_string_lossy();
        name == "report.json" || name == "run.jsonl" || name.starts_with(".writing-")
    };
    files_below(folder)
        .into_iter()
        .filter(|path| !timed(path) && !path.components().any(|part| part.as_os_str() == ".setloc-cache"))
        .map(|path| (path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap()))
        .collect()
}

#[test]
fn exports_that_a_killed_run_left_old_are_written_again() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let build = |settings: &[&str]| {
        let arguments = [&["build", "town/panoramas", "-o", "s.setloc"], settings].concat();
        assert_eq!(setloc(folder.path(), &arguments).status.code(), Some(0));
    };
    let poses = folder.path().join("s/poses.json");
    build(&[]);
    let old = std::fs::read(&poses).unwrap();
    let old_report = std::fs::read(folder.path().join("s/report.json")).unwrap();
    build(&["--set", "sfm.loss_sigma=1.5"]);
    let new = std::fs::read(&poses).unwrap();
    assert_ne!(old, new);
    // As if the run had been killed between the scene and its exports.
    std::fs::write(&poses, &old).unwrap();
    std::fs::write(folder.path().join("s/report.json"), old_report).unwrap();
    build(&["--set", "sfm.loss_sigma=1.5"]);
    assert_eq!(std::fs::read(&poses).unwrap(), new);
}

/// Hashes of all results in the store: the names of its objects, and those in its records.
fn results(folder: &Path) -> BTreeSet<String> {
    let objects = files_below(&folder.join(".setloc-cache/objects"));
    let names = objects.iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned());
    let mut results: BTreeSet<String> = names.filter(|name| !name.starts_with('.')).collect();
    for path in files_below(&folder.join(".setloc-cache/keys")) {
        if path.extension().is_some_and(|ending| ending == "jsonl") {
            let text = std::fs::read_to_string(path).unwrap();
            let records = text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
            results.extend(records.map(|record| record["output"].as_str().unwrap().to_owned()));
        }
    }
    results
}

#[test]
fn ctrl_c_ends_with_130_and_the_next_run_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let log = folder.path().join("s/run.jsonl");
    let mut before = BTreeSet::new();
    let mut stopped = false;
    // How long to wait depends on the machine: try until one stop has hit the middle.
    for delay_ms in [150, 300, 600, 75, 40, 1200, 20] {
        let code = build_and_signal(folder.path(), "town/panoramas", "INT", Duration::from_millis(delay_ms));
        let finished: BTreeSet<String> = logged(&log, "finished").into_iter().collect();
        if code == Some(130) && !finished.is_empty() {
            before = finished;
            stopped = true;
            break;
        }
        std::fs::remove_dir_all(folder.path().join(".setloc-cache")).unwrap();
    }
    assert!(stopped, "no stop hit a running build");
    // What was done survives a garbage collection in between.
    let collected = setloc(folder.path(), &["cache", "gc", "--min-age", "0"]);
    assert!(collected.status.success(), "{}", said(&collected));
    let output = setloc(folder.path(), &["build", "town/panoramas", "-o", "s.setloc"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let after: BTreeSet<String> = logged(&log, "finished").into_iter().collect();
    assert!(after.is_disjoint(&before), "done twice: {:?}", after.intersection(&before));
}

/// Until `SETLOC_KILLS` kills (3 unless told) have hit a running build of `SETLOC_KILL_DATA` (a small town unless told): see `scripts/kill-test`.
#[test]
fn kill_9_at_any_moment_loses_no_finished_job_and_changes_no_byte() {
    let wanted: u32 = std::env::var("SETLOC_KILLS").map_or(3, |text| text.parse().unwrap());
    let sources = tempfile::tempdir().unwrap();
    let panoramas = match std::env::var("SETLOC_KILL_DATA") {
        Ok(path) => std::fs::canonicalize(path).unwrap().join("panoramas"),
        Err(_) => town(sources.path()).join("panoramas"),
    };
    let panoramas = panoramas.to_str().unwrap();
    let build = ["build", panoramas, "-o", "s.setloc"];
    let undisturbed = tempfile::tempdir().unwrap();
    let begun = Instant::now();
    let output = setloc(undisturbed.path(), &build);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let whole_ms = begun.elapsed().as_millis() as u64;
    let (mut state, mut killed, mut kept, mut trial) = (0x2545_f491_u64, 0, 0, 0);
    while killed < wanted {
        trial += 1;
        assert!(trial <= 10 * wanted, "only {killed} of {trial} kills hit a running build");
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("s/run.jsonl");
        let mut finished = Vec::new();
        for _ in 0..2 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let delay = Duration::from_millis((state >> 33) % whole_ms);
            // A run killed before it begins its log would leave that of the run before to be counted twice.
            let _ = std::fs::remove_file(&log);
            killed += u32::from(build_and_signal(folder.path(), panoramas, "KILL", delay).is_none());
            finished.extend(logged(&log, "finished"));
        }
        kept += finished.len();
        let _ = std::fs::remove_file(&log);
        let output = setloc(folder.path(), &build);
        assert_eq!(output.status.code(), Some(0), "trial {trial}: {}", said(&output));
        finished.extend(logged(&log, "finished"));
        let distinct: BTreeSet<&String> = finished.iter().collect();
        assert_eq!(distinct.len(), finished.len(), "trial {trial}: a finished job was done again");
        assert_eq!(results(folder.path()), results(undisturbed.path()), "trial {trial}");
        let (own, expected) = (outputs(folder.path()), outputs(undisturbed.path()));
        let differ: Vec<&PathBuf> =
            own.keys().chain(expected.keys()).filter(|path| own.get(*path) != expected.get(*path)).collect();
        assert!(differ.is_empty(), "trial {trial}: other bytes in {differ:?}");
        let verified = setloc(folder.path(), &["cache", "verify"]);
        assert_eq!(verified.status.code(), Some(0), "trial {trial}: {}", said(&verified));
    }
    eprintln!(
        "{trial} builds, {killed} kills hit a running build, {kept} jobs finished before them; whole: {whole_ms} ms"
    );
}

#[test]
fn a_benchmark_goes_on_with_what_a_killed_one_has_left() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let bench = |more: &[&str]| {
        let output = setloc(folder.path(), &[&["bench", "town", "-o", "out"], more].concat());
        assert_eq!(output.status.code(), Some(0), "{}", said(&output));
        said(&output)
    };
    bench(&["--cache", "out/.bench-cache-left"]);
    let text = bench(&[]);
    assert!(
        text.contains("note: results of a run that came to no end are used (out/.bench-cache-left)"),
        "{text}"
    );
    assert_eq!(logged(&folder.path().join("out/run.jsonl"), "finished"), [""; 0]);
    assert!(!folder.path().join("out/.bench-cache-left").exists());
}

#[test]
fn exports_that_are_lost_or_damaged_are_written_again() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let build = || {
        let output = setloc(folder.path(), &["build", "town/panoramas", "-o", "s.setloc"]);
        assert_eq!(output.status.code(), Some(0), "{}", said(&output));
        said(&output)
    };
    build();
    let whole = outputs(folder.path());
    assert!(build().contains("s.setloc is up to date: nothing changed"));
    for name in ["points.ply", "top_view.png", "colmap/images.bin"] {
        std::fs::remove_file(folder.path().join("s").join(name)).unwrap();
        assert!(build().contains("wrote s.setloc and s/"), "{name}");
    }
    // Of the same length.
    let poses = folder.path().join("s/poses.json");
    let damaged = std::fs::read_to_string(&poses).unwrap().replacen('0', "1", 1);
    std::fs::write(&poses, damaged).unwrap();
    assert!(build().contains("wrote s.setloc and s/"));
    assert!(outputs(folder.path()) == whole);
}
