use std::path::{Path, PathBuf};

use anyhow::Result;
use serde_json::json;

use super::Answer;
use super::args::CompareArgs;
use super::build::write_json;
use super::outputs::{refuse_folder, refuse_input};
use crate::bench::{Comparison, Frame, comparison_table};
use crate::error::Hinted;
use crate::import::{NamedPoses, read_poses};
use crate::print;

/// `setloc compare`
pub fn run(args: &CompareArgs) -> Result<Answer> {
    if let Some(output) = &args.output {
        refuse_folder("-o", output, "comparison.json")?;
        refuse_input(args.poses.iter().chain([&args.truth]).map(PathBuf::as_path), output)?;
    }
    let truth = read_poses(&args.truth)?;
    let frame = match &args.align_by {
        Some(prefix) => Frame::AlignedBy(prefix.clone()),
        None if args.no_align => Frame::Same,
        None => Frame::Aligned,
    };
    if let Some(prefix) = &args.align_by {
        let aligning = truth.poses.keys().filter(|name| name.starts_with(prefix.as_str())).count();
        if aligning == 0 || aligning == truth.poses.len() {
            let message = format!(
                "{aligning} of {} true names begin with `{prefix}`, and the others are to be judged by them",
                truth.poses.len()
            );
            let first = truth.poses.keys().next().map_or_else(String::new, |name| format!(", as `{name}`"));
            return Err(Hinted::error(
                message,
                format!("--align-by names the beginning of some names{first}"),
            ));
        }
    }
    let mut comparisons = Vec::new();
    for path in &args.poses {
        let mut poses = read_poses(path)?;
        if frame == Frame::Same {
            poses = in_true_frame(path, poses, &truth);
        }
        let found = Comparison::of(&path.display().to_string(), &poses.poses, &truth.poses, &frame);
        if found.unknown == poses.poses.len() {
            let first = |names: Option<&String>| names.cloned().unwrap_or_default();
            return Err(Hinted::error(
                format!("{} and {} name no image alike", path.display(), args.truth.display()),
                format!(
                    "one has `{}`, the other `{}`: names are alike where one ends in the other",
                    first(poses.poses.keys().next()),
                    first(truth.poses.keys().next())
                ),
            ));
        }
        warn(path, &found);
        comparisons.push(found);
    }
    print::data(comparison_table(&comparisons).trim_end())?;
    if let Some(output) = &args.output {
        write_json(output, &json!({ "comparisons": comparisons }))?;
        print::note(&format!("wrote {}", output.display()));
    }
    Ok(Answer::Done)
}

/// The poses east, north, up of the truth's origin where they and the truth state one; as they are where not.
fn in_true_frame(path: &Path, poses: NamedPoses, truth: &NamedPoses) -> NamedPoses {
    let Some((moved, distance_m)) = poses.in_frame_of(truth) else { return poses };
    let path = path.display();
    if distance_m > 0.0 {
        print::note(&format!("{path}: brought to the truth's geo_origin, {distance_m:.2} m from its own"));
    }
    let has_altitude = |poses: &NamedPoses| poses.origin.is_some_and(|origin| origin.alt_m.is_some());
    if has_altitude(&poses) != has_altitude(truth) {
        print::note(&format!(
            "warning: {path}: it and the truth do not both have an altitude, and their origins are taken to be at one height"
        ));
    }
    moved
}

/// What the table does not show.
fn warn(path: &Path, found: &Comparison) {
    let path = path.display();
    if found.unknown > 0 {
        print::note(&format!(
            "warning: {path}: the truth tells nothing of {} images, or of two names one",
            found.unknown
        ));
    }
    if found.registered == 0 {
        print::note(&format!("warning: {path}: none of its poses is of an image that is judged"));
    }
    if found.scale.is_none() {
        print::note(&format!("warning: {path}: too few images to align by, so nothing is told of errors"));
    }
}
