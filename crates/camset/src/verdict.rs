//! From evidence to one word, with the reasons.

use nalgebra::Matrix6;

use crate::{Verdict, VerdictParams};

/// What speaks for and against one pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Evidence {
    /// Matches that were tried, before any guided matching.
    pub matches: usize,
    /// How many of them agree with the pose.
    pub inliers: usize,
    /// Size of the minimal sample.
    pub sample: usize,
    /// log₁₀ of the expected number of equally good poses among random matches.
    pub log10_false_alarms: f64,
    /// Occupied cells of the 8 × 8 over the image (the most of any photo, for a set).
    pub cells: usize,
    /// Support of the best pose that is distinct from this one.
    pub runner_up: usize,
    /// What that is worth as a share of what supports this one: the ground counts for less.
    pub runner_up_share: f64,
    /// How many of the inliers lie elsewhere than on the ground.
    pub off_ground: usize,
    /// Matches that guided matching shows beside them, where few agree and these stand out.
    pub shown: usize,
}

/// Fewest inliers elsewhere than on the ground: three give a pose, one more would contradict a wrong one.
pub(crate) const MIN_OFF_GROUND: usize = 4;

/// Decides on the evidence for a pose alone: is it the right one?
pub(crate) fn judge_support(
    params: &VerdictParams,
    evidence: &Evidence,
    reasons: &mut Vec<String>,
) -> Verdict {
    let Evidence {
        matches,
        inliers,
        log10_false_alarms,
        cells,
        runner_up,
        runner_up_share,
        off_ground,
        shown,
        ..
    } = *evidence;
    reasons.push(format!("{inliers} of {matches} matches to the scene agree on the pose"));
    if shown > 0 {
        reasons.push(format!("guided matching shows {shown}, by far more than poses aside do"));
    }
    if inliers.max(shown) < params.min_inliers {
        reasons.push(format!("a pose needs at least {} agreeing matches", params.min_inliers));
        return Verdict::NotLocalized;
    }
    let mut verdict = Verdict::Localized;
    let mut doubt = |reason: String| {
        reasons.push(reason);
        verdict = Verdict::Uncertain;
    };
    if !(log10_false_alarms <= params.max_log10_false_alarms) {
        doubt(format!(
            "random matches would agree as well (log10 of expected false alarms {log10_false_alarms:.1})"
        ));
    }
    if cells < params.min_cells {
        doubt(format!("the agreeing matches lie in {cells} of 64 parts of the image only"));
    }
    if !(runner_up_share <= params.max_runner_up) && runner_up >= params.min_inliers / 2 {
        doubt(format!("another pose is supported by {runner_up} matches (repeated structure?)"));
    }
    if off_ground < MIN_OFF_GROUND {
        doubt(format!("all but {off_ground} of them lie on the ground, which may repeat itself"));
    }
    verdict
}

/// Decides on the precision of a pose: is it good enough to be used? `depth` is the distance to what the photo sees.
pub(crate) fn judge_precision(
    params: &VerdictParams,
    covariance: Option<&Matrix6<f64>>,
    depth: f64,
    reasons: &mut Vec<String>,
) -> Verdict {
    let Some(covariance) = covariance else {
        reasons.push("the observations do not determine all directions of the pose".to_owned());
        return Verdict::Uncertain;
    };
    let (rotation, center) = standard_deviations(covariance);
    let mut verdict = Verdict::Localized;
    if !(rotation <= params.max_rotation_sigma_rad) {
        reasons.push(format!("the rotation is known to {:.1}° only", rotation.to_degrees()));
        verdict = Verdict::Uncertain;
    }
    if !(center <= params.max_center_sigma * depth) {
        let share = match 100.0 * center / depth {
            share if share.is_finite() => format!("{share:.0} % of the viewing distance"),
            _ => "and how far off what it sees is, nothing tells".to_owned(),
        };
        reasons.push(format!("the centre is known to {center:.3} units only, {share}"));
        verdict = Verdict::Uncertain;
    }
    verdict
}

/// Largest standard deviations of a pose: rotation in radians, centre in scene units.
pub(crate) fn standard_deviations(covariance: &Matrix6<f64>) -> (f64, f64) {
    let worst = |start: usize| {
        let block = covariance.fixed_view::<3, 3>(start, start).into_owned();
        if block.iter().all(|value| value.is_finite()) {
            block.symmetric_eigenvalues().max().max(0.0).sqrt()
        } else {
            f64::INFINITY
        }
    };
    (worst(0), worst(3))
}

/// The more doubtful of two verdicts.
pub(crate) fn weaker(a: Verdict, b: Verdict) -> Verdict {
    match (a, b) {
        (Verdict::NotLocalized, _) | (_, Verdict::NotLocalized) => Verdict::NotLocalized,
        (Verdict::Uncertain, _) | (_, Verdict::Uncertain) => Verdict::Uncertain,
        _ => Verdict::Localized,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> Evidence {
        Evidence {
            matches: 100,
            inliers: 40,
            sample: 3,
            log10_false_alarms: -60.0,
            cells: 20,
            runner_up: 4,
            runner_up_share: 0.1,
            off_ground: 30,
            shown: 0,
        }
    }

    fn judge(evidence: &Evidence) -> Verdict {
        judge_support(&VerdictParams::default(), evidence, &mut Vec::new())
    }

    #[test]
    fn each_doubt_alone_keeps_a_pose_from_being_localized() {
        assert_eq!(judge(&good()), Verdict::Localized);
        assert_eq!(judge(&Evidence { inliers: 11, ..good() }), Verdict::NotLocalized);
        assert_eq!(judge(&Evidence { inliers: 11, shown: 11, ..good() }), Verdict::NotLocalized);
        assert_eq!(judge(&Evidence { inliers: 8, shown: 12, ..good() }), Verdict::Localized);
        assert_eq!(judge(&Evidence { log10_false_alarms: -1.0, ..good() }), Verdict::Uncertain);
        assert_eq!(judge(&Evidence { log10_false_alarms: f64::NAN, ..good() }), Verdict::Uncertain);
        assert_eq!(judge(&Evidence { cells: 2, ..good() }), Verdict::Uncertain);
        assert_eq!(judge(&Evidence { runner_up: 30, runner_up_share: 0.75, ..good() }), Verdict::Uncertain);
        assert_eq!(judge(&Evidence { off_ground: 3, ..good() }), Verdict::Uncertain);
    }

    #[test]
    fn an_imprecise_or_undetermined_pose_is_uncertain() {
        let params = VerdictParams::default();
        let judge = |covariance: Option<Matrix6<f64>>| {
            judge_precision(&params, covariance.as_ref(), 10.0, &mut Vec::new())
        };
        assert_eq!(judge(Some(Matrix6::identity() * 1e-5)), Verdict::Localized);
        assert_eq!(judge(Some(Matrix6::identity())), Verdict::Uncertain);
        assert_eq!(judge(Some(Matrix6::repeat(f64::NAN))), Verdict::Uncertain);
        assert_eq!(judge(None), Verdict::Uncertain);
    }

    #[test]
    fn a_centre_is_not_known_well_enough_where_nothing_tells_how_far_off_things_are() {
        let params = VerdictParams::default();
        let covariance = Matrix6::identity() * 1e-8;
        let judged = |depth: f64| {
            let mut reasons = Vec::new();
            (judge_precision(&params, Some(&covariance), depth, &mut reasons), reasons.join("; "))
        };
        assert_eq!(judged(1.0), (Verdict::Localized, String::new()));
        let (verdict, reasons) = judged(0.004);
        assert_eq!(verdict, Verdict::Uncertain);
        assert!(reasons.contains("2 % of the viewing distance"), "{reasons}");
        let (verdict, reasons) = judged(0.0);
        assert_eq!(verdict, Verdict::Uncertain);
        assert!(reasons.contains("nothing tells") && !reasons.contains('%'), "{reasons}");
    }
}
