//! Poses that other programs give, or we, against the truth: the same figures for each.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use setloc_sfm::Rigid;

use super::{AUC_THRESHOLDS_DEG, Alignment, Bounds, Errors, auc_percent};
use crate::text::add;

/// Errors of centre and rotation up to which an image counts, as on visuallocalization.net (Sattler et al., "Benchmarking 6DOF
/// Outdoor Visual Localization in Changing Conditions", CVPR 2018): units of the truth, degrees.
const RECALLS: [(f64, f64); 3] = [(0.25, 2.0), (0.5, 5.0), (5.0, 10.0)];

/// How poses lie in the truth's frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Frame {
    /// By the similarity that brings centres nearest to the true ones.
    Aligned,
    /// By that of the images whose true name starts so; the others are judged.
    AlignedBy(String),
    /// As they are: they are in it.
    Same,
}

/// Figures of one program's poses.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// Whose.
    pub name: String,
    /// Images that are judged: those that the truth tells, but for those that only align.
    pub images: usize,
    /// Those with a pose.
    pub registered: usize,
    /// Poses of images that the truth does not tell, or of which two names tell.
    pub unknown: usize,
    /// Images of those that align, more than a twentieth of the extent from where the others have them.
    pub misplaced: usize,
    /// Units of the truth in one of these poses; `None` where nothing aligns them.
    pub scale: Option<f64>,
    /// Centre errors of registered images, in units of the truth.
    pub position: Option<Bounds>,
    /// Their rotation errors.
    pub rotation_deg: Option<Bounds>,
    /// Share of all judged images within an error of centre and rotation, in percent, by these errors.
    pub recall: BTreeMap<String, f64>,
    /// AUC of relative poses in percent, by threshold in degrees; empty where a single image is judged.
    pub auc: BTreeMap<String, f64>,
    /// By true name.
    pub errors: Errors,
}

impl Comparison {
    /// Compares poses with the truth.
    ///
    /// An image has the true name that is its own, or the only one that ends in it or that it ends in, in whole folders and files, or
    /// that has the same file in the same folder.
    pub fn of(
        name: &str,
        poses: &BTreeMap<String, Rigid>,
        truth: &BTreeMap<String, Rigid>,
        frame: &Frame,
    ) -> Self {
        let (poses, unknown) = by_true_names(poses, truth);
        let aligns = |name: &String| match frame {
            Frame::Aligned => true,
            Frame::AlignedBy(prefix) => name.starts_with(prefix.as_str()),
            Frame::Same => false,
        };
        let of_aligning: BTreeMap<String, Rigid> =
            poses.iter().filter(|(name, _)| aligns(name)).map(|(name, pose)| (name.clone(), *pose)).collect();
        let alignment = match frame {
            Frame::Same => Some(Alignment::none()),
            Frame::Aligned | Frame::AlignedBy(_) => Alignment::of_component(&of_aligning, truth),
        };
        let judged: BTreeMap<String, Rigid> = truth
            .iter()
            .filter(|(name, _)| !matches!(frame, Frame::AlignedBy(_)) || !aligns(name))
            .map(|(name, pose)| (name.clone(), *pose))
            .collect();
        let error = |(name, pose): (&String, &Rigid)| {
            Some((name.clone(), alignment.as_ref()?.error(pose, judged.get(name)?)))
        };
        let errors: Errors = poses.iter().filter_map(error).collect();
        let within = |(position, rotation): (f64, f64)| {
            let is_within =
                errors.values().filter(|e| e.position_m <= position && e.rotation_deg <= rotation);
            (recall_name(position, rotation), 100.0 * is_within.count() as f64 / judged.len().max(1) as f64)
        };
        let areas = auc_percent(&poses, &judged).into_iter().flatten();
        Self {
            name: name.to_owned(),
            images: judged.len(),
            registered: judged.keys().filter(|name| poses.contains_key(*name)).count(),
            unknown,
            misplaced: alignment.as_ref().map_or(0, |alignment| alignment.misplaced().len()),
            scale: alignment.as_ref().map(Alignment::scale),
            position: Bounds::of(errors.values().map(|error| error.position_m)),
            rotation_deg: Bounds::of(errors.values().map(|error| error.rotation_deg)),
            recall: RECALLS.into_iter().map(within).collect(),
            auc: AUC_THRESHOLDS_DEG.iter().map(f64::to_string).zip(areas).collect(),
            errors,
        }
    }
}

fn recall_name(position: f64, rotation: f64) -> String {
    format!("{position}, {rotation}°")
}

/// Poses by their true names, and how many have none.
fn by_true_names(
    poses: &BTreeMap<String, Rigid>,
    truth: &BTreeMap<String, Rigid>,
) -> (BTreeMap<String, Rigid>, usize) {
    let file = |name: &str| name.rsplit('/').next().unwrap_or_default().to_owned();
    let mut of_file: BTreeMap<String, Vec<&String>> = BTreeMap::new();
    for name in truth.keys() {
        of_file.entry(file(name)).or_default().push(name);
    }
    let ends_in = |whole: &str, end: &str| whole.strip_suffix(end).is_some_and(|rest| rest.ends_with('/'));
    let true_name = |name: &String| {
        if truth.contains_key(name) {
            return Some(name.clone());
        }
        let alike = of_file.get(&file(name)).into_iter().flatten();
        let mut alike = alike.filter(|other| {
            ends_in(other, name)
                || ends_in(name, other)
                || in_folder(name).is_some_and(|at| ends_in(other, at))
        });
        alike.next().filter(|_| alike.next().is_none()).map(|name| (*name).clone())
    };
    let mut named: BTreeMap<String, Rigid> = BTreeMap::new();
    let mut twice: BTreeSet<String> = BTreeSet::new();
    for (name, pose) in poses.iter().filter_map(|(name, pose)| Some((true_name(name)?, pose))) {
        if named.insert(name.clone(), *pose).is_some() {
            twice.insert(name);
        }
    }
    named.retain(|name, _| !twice.contains(name));
    let unknown = poses.len() - named.len();
    (named, unknown)
}

/// The name with its last folder only; `None` without any.
fn in_folder(name: &str) -> Option<&str> {
    let (folder, _) = name.rsplit_once('/')?;
    Some(&name[folder.rfind('/').map_or(0, |at| at + 1)..])
}

/// A table of several programs' figures in Markdown.
pub fn comparison_table(comparisons: &[Comparison]) -> String {
    let mut text = String::from(
        "| poses | registered | misplaced | position median, mean, max | rotation ° median, mean, max |",
    );
    for (position, rotation) in RECALLS {
        add(&mut text, format_args!(" ≤ {} |", recall_name(position, rotation)));
    }
    for threshold in AUC_THRESHOLDS_DEG {
        add(&mut text, format_args!(" AUC {threshold}° |"));
    }
    text += "\n|---|---|---|---|---|";
    text += &"---|".repeat(RECALLS.len() + AUC_THRESHOLDS_DEG.len());
    text.push('\n');
    for of_one in comparisons {
        let Comparison { name, images, registered, misplaced, .. } = of_one;
        add(&mut text, format_args!("| {name} | {registered}/{images} | {misplaced} |"));
        for bounds in [of_one.position, of_one.rotation_deg] {
            match bounds {
                Some(Bounds { median, mean, max, .. }) => {
                    add(&mut text, format_args!(" {median:.4}, {mean:.4}, {max:.4} |"));
                }
                None => text += " - |",
            }
        }
        let recalls =
            RECALLS.iter().map(|(position, rotation)| of_one.recall.get(&recall_name(*position, *rotation)));
        let areas = AUC_THRESHOLDS_DEG.iter().map(|threshold| of_one.auc.get(&threshold.to_string()));
        for percent in recalls.chain(areas) {
            match percent {
                Some(percent) => add(&mut text, format_args!(" {percent:.1} |")),
                None => text += " - |",
            }
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use setloc_sfm::Similarity;

    use super::*;

    fn truth() -> BTreeMap<String, Rigid> {
        let pose = |at: u32| {
            let x = f64::from(at);
            Rigid::new(UnitQuaternion::from_euler_angles(0.1 * x, 0.0, 0.3), Vector3::new(x, x * x, 0.0))
        };
        let scene = (0..4).map(|at| (format!("panoramas/{at}.jpg"), pose(at)));
        scene.chain((0..2).map(|at| (format!("queries/a/{at}.jpg"), pose(at + 4)))).collect()
    }

    fn moved(poses: &BTreeMap<String, Rigid>) -> BTreeMap<String, Rigid> {
        let rotation = UnitQuaternion::from_euler_angles(1.0, 2.0, 3.0);
        let similarity = Similarity { scale: 2.0, rotation, translation: Vector3::new(1.0, 2.0, 3.0) };
        poses.iter().map(|(name, pose)| (name.clone(), similarity.transform_pose(pose))).collect()
    }

    #[test]
    fn the_right_poses_have_no_errors_in_any_frame() {
        let truth = truth();
        let aligned = Comparison::of("a", &moved(&truth), &truth, &Frame::Aligned);
        assert_eq!((aligned.images, aligned.registered, aligned.unknown), (6, 6, 0));
        assert!(
            aligned.position.unwrap().max < 1e-9 && aligned.rotation_deg.unwrap().max < 1e-5,
            "{aligned:?}"
        );
        assert!((aligned.scale.unwrap() - 0.5).abs() < 1e-9 && aligned.auc["0.1"] > 99.9);
        assert_eq!(aligned.recall["0.25, 2°"], 100.0);
        let same = Comparison::of("a", &truth, &truth, &Frame::Same);
        assert!(same.position.unwrap().max < 1e-12);
        assert!(Comparison::of("a", &moved(&truth), &truth, &Frame::Same).position.unwrap().median > 1.0);
    }

    #[test]
    fn photos_are_judged_as_the_panoramas_lie() {
        let truth = truth();
        let mut poses = moved(&truth);
        poses.get_mut("queries/a/1.jpg").unwrap().translation.x += 2.0;
        let found = Comparison::of("a", &poses, &truth, &Frame::AlignedBy("panoramas/".to_owned()));
        assert_eq!((found.images, found.registered), (2, 2));
        let error = |name: &str| found.errors[name].position_m;
        assert!(error("queries/a/0.jpg") < 1e-9 && (error("queries/a/1.jpg") - 1.0).abs() < 1e-9);
        assert_eq!(found.recall["0.25, 2°"], 50.0);
        assert_eq!(found.recall["5, 10°"], 100.0);
    }

    #[test]
    fn images_are_known_by_the_end_of_their_names() {
        let truth = truth();
        let named = |names: &[&str]| -> BTreeMap<String, Rigid> {
            names.iter().map(|name| ((*name).to_owned(), truth["panoramas/3.jpg"])).collect()
        };
        let known = |names: &[&str]| {
            let (poses, unknown) = by_true_names(&named(names), &truth);
            (poses.into_keys().collect::<Vec<_>>(), unknown)
        };
        assert_eq!(
            known(&["3.jpg", "x/queries/a/1.jpg"]),
            (vec!["panoramas/3.jpg".to_owned(), "queries/a/1.jpg".to_owned()], 0)
        );
        assert_eq!(known(&["grown-1/a/1.jpg", "b/1.jpg"]), (vec!["queries/a/1.jpg".to_owned()], 1));
        // Two images end in the first, none in the second, and two names are of one.
        assert_eq!(known(&["0.jpg", "13.jpg", "3.jpg", "panoramas/3.jpg"]), (vec![], 4));
    }

    fn one_of(poses: &BTreeMap<String, Rigid>) -> BTreeMap<String, Rigid> {
        poses.iter().take(1).map(|(name, pose)| (name.clone(), *pose)).collect()
    }

    #[test]
    fn what_cannot_be_aligned_has_no_errors() {
        let truth = truth();
        let found = Comparison::of("a", &one_of(&truth), &truth, &Frame::Aligned);
        assert_eq!((found.registered, found.position, found.scale), (1, None, None));
        let table = comparison_table(&[found]);
        assert!(table.contains("| a | 1/6 | 0 | - | - | 0.0 |"), "{table}");
        // A single image that is judged has no relative pose.
        let judged = Comparison::of("a", &truth, &one_of(&truth), &Frame::Same);
        let table = comparison_table(&[judged]);
        assert!(table.ends_with("| 100.0 | 100.0 | 100.0 | - | - | - | - | - |\n"), "{table}");
    }
}
