//! Poses round corners by the pixels of the ground.
//!
//! Round a corner two photos often share a far wall and the paving between them. Of paving a detector finds nothing that
//! matches (stones look alike, and at a grazing angle one is a pixel high), but its pixels correlate where they are laid
//! over one another rightly, to within centimetres. So patches of the first photo's lower part are sought in the second
//! as the ground bends them, over all that the pair's covariance allows ([`sight`]); each is found in many places, and
//! the pose is what most patches agree on ([`corner`]). Which plane the ground is follows from photos whose poses points
//! tell ([`floor`]). Where nothing else tells how long the step is, the ground alone may ([`open`]).

mod corner;
pub(crate) mod floor;
mod open;
pub(crate) mod sight;

pub use open::register_by_ground;

use std::collections::BTreeMap;
use std::sync::Arc;

use setloc_features::{ImagePyramid, PatchParams};

use self::{corner::Sharpened, floor::Floor, sight::View};
use crate::{BaselineLength, ImageId, Reconstruction, Rigid, StepPose};

/// How patches of the ground are aligned: at a grazing angle little of them is sharp.
pub(crate) const PATCH: PatchParams =
    PatchParams { radius: 7, max_iterations: 10, min_correlation: 0.65, max_distortion: 0.5 };
/// Correlation at the first look below which a patch is not followed.
const MIN_FIRST: f64 = 0.35;

/// Sharpens the poses of pairs whose length no common points tell ([`Reconstruction::lengths`]), where both photos show
/// the ground that other photos of the component show too; those of panoramas stay as they are. Returns how many it sharpened.
///
/// `load` gives the pixels of an image and is called at most once for each image and length. Equal inputs give
/// equal results on any number of threads.
///
/// # Errors
/// The first of `load`; the component is unchanged then.
pub fn sharpen_lengths<E>(
    component: &mut Reconstruction,
    load: impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E>,
) -> Result<usize, E> {
    let sharpened: Result<Vec<_>, E> =
        component.lengths.iter().map(|length| Corner::new(component, length, &load)).collect();
    let sharpened: Vec<Option<BaselineLength>> =
        sharpened?.into_iter().map(|corner| corner?.sharpened()).collect();
    for (length, better) in component.lengths.iter_mut().zip(&sharpened) {
        *length = better.unwrap_or(*length);
    }
    Ok(sharpened.iter().flatten().count())
}

/// A pair whose length no common points tell, and the photos before it.
struct Corner<'a> {
    length: &'a BaselineLength,
    /// Length of the reference baseline.
    baseline: f64,
    views: BTreeMap<ImageId, View<'a>>,
    /// Photos before the corner that share points.
    known: Vec<[ImageId; 2]>,
}

impl<'a> Corner<'a> {
    fn new<E>(
        component: &'a Reconstruction,
        length: &'a BaselineLength,
        load: &impl Fn(ImageId) -> Result<Arc<ImagePyramid>, E>,
    ) -> Result<Option<Self>, E> {
        if component.camera_of(length.to).is_panoramic() {
            return Ok(None);
        }
        let pose = |image: ImageId| component.images[image.index()].world_from_camera;
        let Some([from, reference]) = pose(length.from).zip(pose(length.reference)).map(<[Rigid; 2]>::from)
        else {
            return Ok(None);
        };
        let known = floor::pairs(component, length);
        let mut views = BTreeMap::new();
        for image in known.iter().flatten().copied().chain([length.from, length.to]) {
            // The last photo may have no pose yet, and what it has is not used.
            let of_view = if image == length.to { Some(from) } else { pose(image) };
            let Some(world_from_camera) = of_view.filter(|_| !views.contains_key(&image)) else { continue };
            let camera = component.camera_of(image);
            views.insert(image, View { camera, world_from_camera, pyramid: load(image)? });
        }
        let baseline = (from.translation - reference.translation).norm();
        Ok(Some(Self { length, baseline, views, known }))
    }

    fn sharpened(&self) -> Option<BaselineLength> {
        let found = self.by_ground(|sought| match &self.length.either {
            Some(poses) => one_of(poses, sought),
            None => sought(&self.length.step()),
        })?;
        let BaselineLength { reference, from, to, votes, .. } = *self.length;
        BaselineLength::of_step([reference, from, to], &found.pose, self.baseline, votes + found.patches)
    }

    /// What is chosen where the ground may be sought at a pose.
    fn by_ground(
        &self,
        choose: impl FnOnce(&dyn Fn(&StepPose) -> Option<Sharpened>) -> Option<Sharpened>,
    ) -> Option<Sharpened> {
        let [from, to] = [self.views.get(&self.length.from)?, self.views.get(&self.length.to)?];
        let pairs: Vec<[&View<'_>; 2]> = (self.known.iter())
            .filter_map(|[first, second]| Some([self.views.get(first)?, self.views.get(second)?]))
            .collect();
        let floor = Floor::find(&pairs, from, self.baseline)?;
        choose(&|pose| corner::find([from, to], &pose.scaled(self.baseline), &floor))
    }
}

/// The pose that the ground tells from the other; `None` where it tells neither, or both.
fn one_of(poses: &[StepPose; 2], sought: impl Fn(&StepPose) -> Option<Sharpened>) -> Option<Sharpened> {
    if !poses.iter().all(corner::is_known) {
        return None;
    }
    let [first, second] = [0, 1].map(|at| sought(&poses[at]));
    let likeness = |found: &Option<Sharpened>| found.as_ref().map_or(0.0, |found| found.likeness);
    let (best, other) = if likeness(&second) > likeness(&first) { (second, first) } else { (first, second) };
    best.filter(|best| best.decides_against(other.as_ref()))
}
