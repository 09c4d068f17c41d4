//! A full disk and a store that cannot be written.
//!
//! Each test mounts a file system of its own in a namespace of its own, as any user may on most Linux systems; where
//! that is not allowed it says so and passes.

use std::path::Path;
use std::process::{Command, Output};

use crate::common::{said, town};

/// Runs a shell script in which `setloc` is the program and `store/` a file system of its own.
fn with_small_disk(folder: &Path, size: &str, script: &str) -> Option<Output> {
    std::fs::create_dir(folder.join("store")).unwrap();
    let mount = format!("mount -t tmpfs -o size={size} tmpfs store");
    let shell = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--user", "--map-root-user", "--mount", "sh", "-c", script]).current_dir(folder);
        command.env("SETLOC", env!("CARGO_BIN_EXE_setloc")).env("SETLOC_CACHE", "store").output()
    };
    if !shell(&mount).is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: this system does not let a test mount a file system");
        return None;
    }
    let build = r#"build() { "$SETLOC" build town/panoramas -o s.setloc && code=0 || code=$?; echo "exit code $code" >&2; }"#;
    Some(shell(&format!("set -e\n{mount}\n{build}\n{script}")).unwrap())
}

#[test]
fn a_full_disk_is_named_and_after_making_space_the_build_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let script = "build; echo SPACE >&2; mount -o remount,size=200m store; build";
    let Some(output) = with_small_disk(folder.path(), "1600k", script) else { return };
    let text = said(&output);
    let (full, after) = text.split_once("SPACE").unwrap();
    assert!(full.contains("error: cannot write store/") && full.contains("No space left"), "{text}");
    assert!(full.matches("cannot keep the result").count() <= 1, "{text}");
    assert!(full.contains("hint: make space") && full.contains("exit code 2"), "{text}");
    assert!(after.contains("exit code 0"), "{text}");
    // What was written before the disk was full is used.
    assert!(after.contains("from cache") && !after.contains(" 0 came from the cache"), "{text}");
}

#[test]
fn a_read_only_store_is_named_but_enough_when_nothing_is_to_be_done() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let script = "build; mount -o remount,ro store; echo AGAIN >&2; build; rm s.setloc; build
        echo ELSEWHERE >&2; $SETLOC build town/panoramas -o t.setloc; ls t.setloc t/report.json >&2
        echo CHANGED >&2; rm \"$(ls -d town/panoramas/* | head -n 1)\"; build";
    let Some(output) = with_small_disk(folder.path(), "200m", script) else { return };
    let text = said(&output);
    let (_, rest) = text.split_once("AGAIN").unwrap();
    let (again, rest) = rest.split_once("ELSEWHERE").unwrap();
    let (elsewhere, changed) = rest.split_once("CHANGED").unwrap();
    assert_eq!(again.matches("0 jobs ran").count(), 2, "{text}");
    assert_eq!(again.matches("exit code 0").count(), 2, "{text}");
    // All is in the store but how the run is called.
    let warning = "warning: `build t.setloc` is not remembered for `plan`, `explain` and `cache gc`: cannot write store/";
    assert!(elsewhere.contains(warning) && elsewhere.contains("t/report.json\n"), "{text}");
    assert!(elsewhere.matches("error:").count() == 0, "{text}");
    assert_eq!(changed.matches("warning: cannot keep the result").count(), 1, "{text}");
    assert!(changed.contains("error: cannot write store/") && changed.contains("Read-only"), "{text}");
    assert!(changed.contains("hint: choose a writable folder") && changed.contains("exit code 2"), "{text}");
}

#[test]
fn photos_are_located_in_a_scene_on_a_disk_that_cannot_be_written() {
    let folder = tempfile::tempdir().unwrap();
    town(folder.path());
    let script = "build; cp s.setloc store/t.setloc; mount -o remount,ro store; unset SETLOC_CACHE
        $SETLOC locate store/t.setloc town/queries/lane -o out/lane --mode single || echo \"exit code $?\" >&2
        ls out/lane/poses.json out/.setloc-cache >&2";
    let Some(output) = with_small_disk(folder.path(), "200m", script) else { return };
    let text = said(&output);
    let note = "note: store/.setloc-cache cannot be written: results are kept in out/.setloc-cache";
    assert!(text.contains(note) && !text.contains("exit code 2"), "{text}");
    assert!(text.contains("out/lane/poses.json\n") && text.contains("objects"), "{text}");
}
