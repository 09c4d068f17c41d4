//! One photo in all components of a scene, and which component's answer stands.

use setloc_features::ImageFeatures;

use crate::jackknife::deviation;
use crate::single::locate_with_nearest;
use crate::{
    AnywhereLocalization, NearestAnywhere, PhotoLocalization, QueryPhoto, Scene, SingleParams, Verdict,
    VerdictParams,
};

/// Bound on the squared deviation of two poses in what both covariances state: χ² of six degrees of freedom at 99.9 %.
const SAME_PLACE: f64 = 22.5;

/// The scene points nearest to each feature of a photo in each component.
pub fn nearest_anywhere(components: &[Scene<'_>], features: &ImageFeatures) -> NearestAnywhere {
    let nearest = |scene: &Scene<'_>| scene.index.nearest_points(&features.descriptors);
    NearestAnywhere { components: components.iter().map(nearest).collect() }
}

/// Localizes one photo alone in each component, and takes the answer of the one that says most.
///
/// `components` has at least one, the largest first, and `nearest` is what [`nearest_anywhere`] finds in them. Where another
/// component supports another place nearly as well, the answer is *uncertain*, as it is where two places of one component do.
pub fn locate_single_anywhere(
    params: &SingleParams,
    components: &[Scene<'_>],
    photo: &QueryPhoto<'_>,
    nearest: &NearestAnywhere,
    seed: u64,
) -> AnywhereLocalization {
    let found: Vec<_> = (components.iter().zip(&nearest.components))
        .map(|(scene, nearest)| locate_with_nearest(params, scene, photo, nearest, seed))
        .collect();
    let seen: Vec<_> = found.iter().map(|found| [(0, found.photo.inliers)]).collect();
    let candidates: Vec<Candidate<'_>> = (found.iter().zip(components).zip(&seen))
        .map(|((found, scene), seen)| Candidate { answer: &found.photo, is_placed: scene.is_placed, seen })
        .collect();
    let answer = choose(&params.verdict, &candidates).map(|(_, answer)| answer);
    let photo = answer.unwrap_or_else(|| {
        PhotoLocalization::not_localized(photo, 0, "the scene has no images to find it by")
    });
    AnywhereLocalization { photo, components: found }
}

/// What one component says of a photo.
pub(crate) struct Candidate<'a> {
    pub answer: &'a PhotoLocalization,
    /// As of the component's [`Scene`].
    pub is_placed: bool,
    /// Scene points that the photo, and the photos placed with it, see, by photo in ascending order.
    pub seen: &'a [(usize, usize)],
}

impl Candidate<'_> {
    fn support(&self) -> usize {
        self.seen.iter().map(|&(_, points)| points).sum()
    }

    /// Support by the photos that support another answer, too, each at most as much as it supports that.
    ///
    /// Photos that lead from one component to another support each by others, and both are right.
    fn support_against(&self, other: &Self) -> usize {
        let of_other = |photo: usize| {
            let at = other.seen.binary_search_by_key(&photo, |&(photo, _)| photo);
            at.map_or(0, |at| other.seen[at].1)
        };
        self.seen.iter().map(|&(photo, points)| points.min(of_other(photo))).sum()
    }

    /// Whether both say the same place, in one frame and as well as either is known.
    fn agrees(&self, other: &Self) -> bool {
        let pose = |candidate: &Self| {
            let answer = candidate.answer;
            candidate.is_placed.then_some(answer.world_from_camera?).zip(answer.covariance)
        };
        let (Some((own, of_own)), Some((theirs, of_theirs))) = (pose(self), pose(other)) else {
            return false;
        };
        let Some(information) = (of_own + of_theirs).try_inverse() else { return false };
        let apart = deviation(&own, &theirs);
        apart.dot(&(information * apart)) <= SAME_PLACE
    }
}

/// The candidate of the best verdict, of equals that of most support, of equals the first, with its answer; `None` of
/// none.
///
/// The answer is in doubt where another candidate has another place, and support that would be another pose's within
/// one component ([`VerdictParams::max_runner_up`]).
pub(crate) fn choose(
    params: &VerdictParams,
    candidates: &[Candidate<'_>],
) -> Option<(usize, PhotoLocalization)> {
    let rank = |at: usize| {
        let candidate = &candidates[at];
        (candidate.answer.verdict.rank(), candidate.support(), std::cmp::Reverse(at))
    };
    let at = (0..candidates.len()).max_by_key(|&at| rank(at))?;
    let best = &candidates[at];
    let mut answer = best.answer.clone();
    if answer.world_from_camera.is_none() {
        return Some((at, answer));
    }
    let support = best.support();
    let rivals = candidates.iter().enumerate().filter_map(|(other, rival)| {
        let against = rival.support_against(best);
        let is_elsewhere = rival.answer.world_from_camera.is_some() && !rival.agrees(best);
        (other != at && is_elsewhere && is_rival(params, against, support)).then_some((against, rival))
    });
    if let Some((against, rival)) = rivals.max_by_key(|(against, _)| *against) {
        answer.verdict = Verdict::Uncertain;
        answer.reasons.push(format!(
            "components {} and {} both have a pose for it, supported by {support} and {against} matches (do they look alike?)",
            answer.component + 1,
            rival.answer.component + 1
        ));
    }
    Some((at, answer))
}

/// Whether the support of another pose leaves one in doubt.
pub(crate) fn is_rival(params: &VerdictParams, rival: usize, support: usize) -> bool {
    rival as f64 > params.max_runner_up * support as f64 && rival >= params.min_inliers / 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locate_single;
    use crate::synthetic::{Place, World};

    fn locate(components: &[Scene<'_>], photo: &QueryPhoto<'_>) -> PhotoLocalization {
        let nearest = nearest_anywhere(components, photo.features);
        locate_single_anywhere(&SingleParams::default(), components, photo, &nearest, 3).photo
    }

    #[test]
    fn a_photo_of_the_second_component_is_localized_there() {
        let (other, world) = (World::chain(2, 0.2, 31), World::chain(2, 0.2, 32));
        let second = Scene { component: 1, ..world.scene() };
        let alone = locate_single(&SingleParams::default(), &second, &world.queries()[0], 3).answer.photo;
        let found = locate(&[other.scene(), second], &world.queries()[0]);
        assert_eq!((found.verdict, found.component), (Verdict::Localized, 1), "{found:#?}");
        assert_eq!(found, alone);
        let found = locate(&[other.scene(), second], &other.queries()[0]);
        assert_eq!((found.verdict, found.component), (Verdict::Localized, 0));
    }

    #[test]
    fn components_that_look_alike_leave_a_photo_uncertain() {
        let world = World::chain(2, 0.2, 33);
        let twins = |is_placed| [0, 1].map(|component| Scene { component, is_placed, ..world.scene() });
        let found = locate(&twins(false), &world.queries()[0]);
        assert_eq!((found.verdict, found.component), (Verdict::Uncertain, 0), "{found:#?}");
        assert!(found.reasons.iter().any(|reason| reason.contains("components 1 and 2")), "{found:#?}");
        // In one frame both say the same.
        let found = locate(&twins(true), &world.queries()[0]);
        assert_eq!((found.verdict, found.component), (Verdict::Localized, 0), "{found:#?}");
    }

    #[test]
    fn a_photo_of_another_place_is_localized_in_no_component() {
        let worlds = [34, 35].map(|seed| World::chain(2, 0.2, seed));
        let components = [0, 1].map(|component| Scene { component, ..worlds[component].scene() });
        let elsewhere = World::chain_in(&Place::street(3500, 34).shuffled(1), 2, 0.2, 36);
        for photo in &elsewhere.queries() {
            assert_eq!(locate(&components, photo).verdict, Verdict::NotLocalized);
        }
        let photo = &elsewhere.queries()[0];
        assert_eq!(locate(&[], photo).verdict, Verdict::NotLocalized);
    }

    #[test]
    fn what_other_photos_support_is_no_rival() {
        let world = World::chain(1, 0.2, 37);
        let answer = |component| {
            let scene = Scene { component, ..world.scene() };
            locate_single(&SingleParams::default(), &scene, &world.queries()[0], 3).answer.photo
        };
        let answers = [answer(0), answer(1)];
        let verdict = |seen: [&[(usize, usize)]; 2]| {
            let candidate = |at: usize| Candidate { answer: &answers[at], is_placed: false, seen: seen[at] };
            let (at, answer) = choose(&VerdictParams::default(), &[candidate(0), candidate(1)]).unwrap();
            (at, answer.verdict)
        };
        assert_eq!(verdict([&[(0, 200)], &[(0, 90)]]), (0, Verdict::Localized));
        assert_eq!(verdict([&[(0, 200)], &[(0, 110)]]), (0, Verdict::Uncertain));
        assert_eq!(verdict([&[(0, 200)], &[(0, 210)]]), (1, Verdict::Uncertain));
        assert_eq!(verdict([&[(0, 200), (1, 5)], &[(0, 5), (1, 220)]]), (1, Verdict::Localized));
    }
}
