//! Photos of a set that were cut from the sides of larger pictures, each in its own way.
//!
//! Photos of one size are taken for one camera's, whose principal point is about in the middle. Where each was cut from a larger
//! picture, or is a frame of a video that was steadied, its own turn and step aside make up for that: a local model holds together and fits
//! the scene, metres off. A photo that is localized alone, or that shows clearly more of the scene as a part of a larger picture, tells that
//! it was cut. Where the others were cut is not known then.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use setloc_features::Calibration;
use setloc_sfm::listed;

use super::{Answer, Remark};
use crate::{PhotoLocalization, QueryPhoto, Verdict, single::off_centre};

/// Photos of one size from which on they are taken for one camera's, cut alike or not at all.
const MIN_OF_SIZE: usize = 3;

/// Which photos of a set may be one camera's by their sizes in pixels: those of one size, and all those of a size that few have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Size(Option<[u32; 2]>);

impl Size {
    /// That of the photo with this index.
    pub fn of(photos: &[QueryPhoto<'_>], at: usize) -> Self {
        let size = |photo: &QueryPhoto<'_>| [photo.camera.width, photo.camera.height];
        let own = size(&photos[at]);
        let alike = photos.iter().filter(|photo| size(photo) == own).count();
        Self((alike >= MIN_OF_SIZE).then_some(own))
    }
}

/// Photos of sizes that few have that have to show it; one may be the only one that somebody cut.
const MIN_CUT: usize = 2;
/// How far from where it is a principal point may be sought, in longer sides: alone, and beside a set. Ten photos alone were right to
/// 0.003; beside sets some were 0.05 off.
const CENTER_ERRORS: [f64; 2] = [0.015, 0.05];
/// Names that one sentence lists.
const MOST_NAMED: usize = 3;

/// A photo that shows that it was cut.
struct Witness {
    photo: usize,
    /// From the middle to the principal point, in longer sides.
    aside: Vector2<f64>,
    is_alone: bool,
}

impl Witness {
    /// Whether both cannot have been cut alike.
    fn contradicts(&self, other: &Self) -> bool {
        let error = |witness: &Self| CENTER_ERRORS[usize::from(!witness.is_alone)];
        (self.aside - other.aside).amax() > error(self) + error(other)
    }
}

/// Whether photos of a size were not cut alike, by those that show that they were cut, and by how many are localized alone and show
/// that they were not.
fn are_cut_apart(size: Size, witnesses: &[&Witness], num_whole: usize) -> bool {
    if size.0.is_some() {
        witnesses.iter().any(|one| witnesses.iter().any(|other| one.contradicts(other)))
    } else {
        witnesses.len() >= num_whole.max(MIN_CUT)
    }
}

/// Makes photos uncertain that may have been cut as others of the set were, by what each shows alone (`alone`, one entry a photo).
///
/// Photos of another size stay as they are, unless either has a size of its own, and so do photos that were all cut alike: they have a
/// camera in common. What a photo alone says stands, where its camera was sought with nothing told.
pub(super) fn doubt_beside_cut(answer: &mut Answer, photos: &[QueryPhoto<'_>], alone: &[&PhotoLocalization]) {
    let is_open =
        |at: usize| photos[at].calibration != Calibration::Known && !photos[at].camera.is_panoramic();
    let is_sought_alone =
        |at: usize| photos[at].calibration == Calibration::Guessed && alone[at].verdict == Verdict::Localized;
    let witness = |photo: usize| {
        let by_itself = is_sought_alone(photo).then(|| off_centre(&alone[photo].camera)).flatten();
        let aside = by_itself.or(answer.cut[photo])?;
        Some(Witness { photo, aside, is_alone: by_itself.is_some() })
    };
    let witnesses: Vec<Witness> = (0..alone.len()).filter(|&at| is_open(at)).filter_map(witness).collect();
    let sizes: Vec<Size> = (0..photos.len()).map(|at| Size::of(photos, at)).collect();
    let mut by_size: BTreeMap<Size, Vec<&Witness>> = BTreeMap::new();
    for witness in &witnesses {
        by_size.entry(sizes[witness.photo]).or_default().push(witness);
    }
    by_size.retain(|size, witnesses| {
        let is_whole = |at: &usize| {
            sizes[*at] == *size
                && is_open(*at)
                && is_sought_alone(*at)
                && off_centre(&alone[*at].camera).is_none()
        };
        are_cut_apart(*size, witnesses, (0..alone.len()).filter(is_whole).count())
    });
    for witness in witnesses.iter().filter(|witness| !witness.is_alone) {
        for photo in [&mut answer.set.refined[witness.photo], &mut answer.set.rigid[witness.photo]] {
            photo.doubt(
                "its matches show clearly more of the scene if it was cut from the side of a larger picture"
                    .to_owned(),
            );
        }
    }
    let cut: Vec<usize> = (witnesses.iter().map(|witness| witness.photo))
        .filter(|&photo| by_size.contains_key(&sizes[photo]))
        .collect();
    if cut.is_empty() {
        return;
    }
    let names: Vec<&str> = cut.iter().map(|&at| photos[at].name).collect();
    let shown_by = listed(&names, MOST_NAMED);
    for at in (0..alone.len()).filter(|&at| is_open(at) && by_size.contains_key(&sizes[at])) {
        if is_sought_alone(at) {
            let mut own = alone[at].clone();
            own.reasons.push(format!("photos of its set were cut from larger pictures, as {shown_by} show: its place is that of the photo alone"));
            answer.elsewhere[at] = false;
            answer.set.refined[at] = own;
        } else {
            answer.set.refined[at].doubt(format!(
                "photos of its set were cut from larger pictures, as {shown_by} show: where it was cut is not known"
            ));
        }
        answer.set.rigid[at].doubt("photos of its set were cut from larger pictures".to_owned());
    }
    answer.set.cut = names.into_iter().map(str::to_owned).collect();
    answer.remarks.push(Remark {
        members: cut,
        is_refusal: false,
        text: format!(
            "{shown_by}: cut from larger pictures, so that photos of its size are not one camera's; tell each its camera (cameras.json), or \
             take pictures as the camera made them"
        ),
    });
}

#[cfg(test)]
mod tests {
    use setloc_features::{Camera, ImageFeatures};

    use super::*;
    use crate::SetLocalization;

    const WIDTHS: [u32; 6] = [1200, 1200, 1200, 1600, 900, 1000];

    fn photo(at: usize, verdict: Verdict) -> PhotoLocalization {
        PhotoLocalization {
            name: at.to_string(),
            camera: Camera::from_focal_guess(WIDTHS[at], 900, 1000.0),
            component: 0,
            world_from_camera: None,
            covariance: None,
            inliers: 30,
            verdict,
            reasons: Vec::new(),
        }
    }

    fn moved_aside(mut photo: PhotoLocalization, share: f64) -> PhotoLocalization {
        photo.camera.params[1] += share * f64::from(photo.camera.width);
        photo
    }

    /// What a set that is localized says of six photos: three of one size, one of another size that is told its camera, two of a size of their
    /// own.
    fn doubted(alone: &[PhotoLocalization; 6], aside: [f64; 6]) -> SetLocalization {
        let cameras = WIDTHS.map(|width| Camera::from_focal_guess(width, 900, 1000.0));
        let (names, features) = (["0", "1", "2", "3", "4", "5"], ImageFeatures::default());
        let query = |at: usize| QueryPhoto {
            name: names[at],
            camera: &cameras[at],
            calibration: if at == 3 { Calibration::Known } else { Calibration::Guessed },
            features: &features,
        };
        let photos: Vec<QueryPhoto<'_>> = (0..6).map(query).collect();
        let of_set: Vec<PhotoLocalization> = (0..6).map(|at| photo(at, Verdict::Localized)).collect();
        let set = SetLocalization { rigid: of_set.clone(), refined: of_set, ..SetLocalization::default() };
        let cut = aside.iter().map(|&x| (x != 0.0).then(|| Vector2::new(x, 0.0))).collect();
        let mut answer = Answer { set, elsewhere: vec![true; 6], cut, ..Answer::default() };
        doubt_beside_cut(&mut answer, &photos, &alone.each_ref());
        answer.finished()
    }

    fn verdicts(photos: &[PhotoLocalization]) -> String {
        photos.iter().map(|photo| format!("{:?}", photo.verdict).remove(0)).collect()
    }

    fn all_uncertain() -> [PhotoLocalization; 6] {
        std::array::from_fn(|at| photo(at, Verdict::Uncertain))
    }

    #[test]
    fn photos_of_a_size_of_which_two_were_cut_apart_stay_localized_alone_only() {
        let none = doubted(&all_uncertain(), [0.0; 6]);
        assert_eq!((&*verdicts(&none.refined), none.cut.len()), ("LLLLLL", 0));
        let two_alone = |shares: [f64; 2]| {
            let mut alone = all_uncertain();
            for (at, share) in shares.into_iter().enumerate() {
                alone[at] = moved_aside(photo(at, Verdict::Localized), share);
            }
            alone
        };
        let alone = two_alone([0.1, -0.1]);
        let found = doubted(&alone, [0.0; 6]);
        assert_eq!((&*verdicts(&found.refined), &*verdicts(&found.rigid)), ("LLULLL", "UUULLL"));
        assert_eq!(
            (&found.refined[0].camera, &*found.cut),
            (&alone[0].camera, &["0", "1"].map(str::to_owned)[..])
        );
        assert!(!found.contradicted.contains(&"0".to_owned()), "{:?}", found.contradicted);
        let says =
            |photo: &PhotoLocalization, what: &str| photo.reasons.iter().any(|reason| reason.contains(what));
        assert!(says(&found.refined[2], "as 0, 1 show"), "{:?}", found.refined[2]);
        assert_eq!(found.advice.iter().filter(|text| text.contains("cut from larger pictures")).count(), 1);
        // All cut alike have one camera, and a usual lens has its principal point within two percent of the middle.
        for shares in [[0.1, 0.1], [0.015, -0.015], [0.1, 0.0]] {
            assert_eq!(verdicts(&doubted(&two_alone(shares), [0.0; 6]).refined), "LLLLLL", "{shares:?}");
        }
    }

    #[test]
    fn photos_show_it_beside_their_set_too() {
        let beside = |aside: [f64; 6]| verdicts(&doubted(&all_uncertain(), aside).refined);
        // Each by itself; where they contradict each other all of their size.
        assert_eq!(beside([0.1, 0.0, 0.08, 0.0, 0.0, 0.0]), "ULULLL");
        assert_eq!(beside([0.1, 0.0, -0.1, 0.0, 0.0, 0.0]), "UUULLL");
        // Of sizes that few have nobody expects to be cut alike; a camera that is told stays.
        assert_eq!(beside([0.0, 0.0, 0.0, 0.1, 0.1, 0.1]), "LLLLUU");
        assert_eq!(beside([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]), "LLLLUL");
        let mut alone = all_uncertain();
        alone[4] = moved_aside(photo(4, Verdict::Localized), 0.1);
        assert_eq!(verdicts(&doubted(&alone, [0.0; 6]).refined), "LLLLLL");
        let found = doubted(&alone, [0.0, 0.0, 0.0, 0.0, 0.0, 0.1]);
        assert_eq!((&*verdicts(&found.refined), &*found.cut), ("LLLLLU", &["4", "5"].map(str::to_owned)[..]));
    }
}
