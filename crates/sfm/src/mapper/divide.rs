//! Images that were given as ones of one camera and are of several.
//!
//! Photos of one size that tell nothing of their camera count as one camera's. A surveillance camera's picture among a
//! phone's, or a zoom in between, bends the model: poses and points make up for a wrong focal length, and few residuals stand
//! out. Given a camera of its own each image shows its own focal length, and the images that it shares points with agree
//! with it clearly better. Images of one camera gain next to nothing by that (at most 1.2 % of the cost in real photos).

use super::{
    MapperInput, MapperParams,
    adjust::{Scope, adjust, tells_camera},
    model::Model,
};
use setloc_features::Calibration;

use crate::{CameraId, ImageId, Reconstruction};

/// The share of the cost that cameras of their own have to leave for the images to be of several.
const MAX_COST: f64 = 0.95;
/// The same of the points that one image sees, which tell of one other camera among many images of one.
const MAX_IMAGE_COST: f64 = 0.85;
/// What these points must cost for that: of little, little is a large share.
const MIN_IMAGE_COST: f64 = 30.0;
/// How far the focal length of such an image must be from the others', as a share.
const MIN_FOCAL_CHANGE: f64 = 0.03;
/// Images of a camera that show whether they share it.
const MIN_IMAGES: usize = 3;
/// How much focal lengths may differ that are tried as one, as a share, in the order tried.
const SPREADS: [f64; 4] = [0.08, 0.04, 0.02, 0.01];
/// What a camera more has to take from the cost of images that do not share one, and as a share of it: of photos that do it
/// takes half of that, where several zooms are taken for one a merged one costs twice as much.
const CAMERA_COST: f64 = 5.0;
const CAMERA_SHARE: f64 = 0.004;
/// Of more images of one camera this many are given their own at first; most unknowns of cameras are no sparse ones.
const MOST_ASKED: usize = 60;

/// What a component says of cameras that images were given as one.
pub(super) struct Division<'a> {
    /// The input with other cameras for images that cannot share the ones they have, or can; `None` when nothing changes.
    ///
    /// The most common camera of images that were given as one keeps its place; images that the component lacks have one of
    /// their own then. Further cameras are at the end of the list.
    pub input: Option<MapperInput<'a>>,
    /// Bare guesses that their images seem not to share: the model may as well be bent by the guess, which is to be mended
    /// first.
    pub doubtful: Vec<CameraId>,
}

/// Asks a component whether images share the cameras that they were given, unless these are known.
///
/// Cameras that were estimated are asked for as well: most photos may have told them, and one of another zoom not.
/// `given` is what was asked for; `component` has been made of `used`, which shares cameras the same way or has been divided
/// already.
pub(super) fn divide<'a>(
    params: &MapperParams,
    given: &MapperInput<'a>,
    used: &MapperInput<'a>,
    component: &Reconstruction,
) -> Division<'a> {
    let mut divided = given.clone();
    let mut doubtful = Vec::new();
    for (camera, guess) in given.cameras.iter().enumerate() {
        let is_of_camera = |image: &ImageId| given.camera_index(*image) == camera;
        let images: Vec<ImageId> = component.registered().filter(is_of_camera).collect();
        let is_known = given.calibrations[camera] == Calibration::Known;
        if is_known || guess.is_panoramic() || images.len() < MIN_IMAGES {
            continue;
        }
        let trial = Trial { params, used, component, images };
        if guess.is_bare_guess() {
            if trial.better_apart().is_some() {
                doubtful.push(CameraId(camera as u32));
            }
            continue;
        }
        let groups = trial.groups();
        let Some((_, others)) = groups.split_first().filter(|(_, others)| !others.is_empty()) else {
            continue;
        };
        let absent = (0..given.images.len() as u32).map(ImageId);
        let absent = absent.filter(|image| is_of_camera(image) && !trial.images.contains(image));
        let absent = absent.map(|image| vec![image]);
        for group in others.iter().cloned().chain(absent) {
            give_camera(&mut divided, &group);
        }
    }
    let shares_alike = sharing(&divided) == sharing(used);
    Division { input: (!shares_alike).then_some(divided), doubtful }
}

/// Gives images one further camera, begun with the one that they have.
fn give_camera(input: &mut MapperInput<'_>, images: &[ImageId]) {
    let Some(first) = images.first() else { return };
    let before = input.camera_index(*first);
    let camera = CameraId(input.cameras.len() as u32);
    input.cameras.push(input.cameras[before].clone());
    input.calibrations.push(Calibration::Guessed);
    for image in images {
        input.images[image.index()].camera = camera;
    }
}

/// For each image the first that has its camera.
fn sharing(input: &MapperInput<'_>) -> Vec<Option<usize>> {
    let first_with = |camera| input.images.iter().position(|image| image.camera == camera);
    input.images.iter().map(|image| first_with(image.camera)).collect()
}

/// The images of a component that were given one camera.
struct Trial<'a, 'b> {
    params: &'b MapperParams,
    used: &'b MapperInput<'a>,
    component: &'b Reconstruction,
    images: Vec<ImageId>,
}

/// The component as adjusted with some sharing of cameras.
struct Fit {
    component: Reconstruction,
    cost: f64,
    /// What the images add to it, as in [`Trial::images`].
    images: Vec<ImageFit>,
}

struct ImageFit {
    /// The cost of all observations of the points that the image sees.
    cost: f64,
    focal: f64,
    /// Whether the image would tell a camera of its own.
    is_told: bool,
}

impl Fit {
    /// Whether it explains the component about as well as a fit in which images have cameras of their own.
    fn is_as_good_as(&self, own: &Self) -> bool {
        let disagrees = |(shared, own): (&ImageFit, &ImageFit)| {
            shared.cost >= MIN_IMAGE_COST
                && own.cost < MAX_IMAGE_COST * shared.cost
                && (own.focal / shared.focal).ln().abs() > MIN_FOCAL_CHANGE
                && own.is_told
        };
        own.cost >= MAX_COST * self.cost && !self.images.iter().zip(&own.images).any(disagrees)
    }
}

impl Trial<'_, '_> {
    /// The fit in which images have cameras of their own, or [`MOST_ASKED`] of more do, where that explains the component
    /// better than one camera.
    fn better_apart(&self) -> Option<Fit> {
        let step = self.images.len().div_ceil(MOST_ASKED);
        let asked = self.images.iter().step_by(step).map(|image| vec![*image]);
        let rest = self.images.iter().enumerate().filter(|(at, _)| at % step != 0).map(|(_, image)| *image);
        let groups: Vec<Vec<ImageId>> = asked.chain([rest.collect()]).collect();
        let apart = self.fit(&groups, self.component);
        (!self.fit(&self.together(), self.component).is_as_good_as(&apart)).then_some(apart)
    }

    fn together(&self) -> Vec<Vec<ImageId>> {
        vec![self.images.clone()]
    }

    /// The images that share a camera each, the largest group first: as few groups as explain the component.
    fn groups(&self) -> Vec<Vec<ImageId>> {
        let Some(apart) = self.better_apart() else { return self.together() };
        let alone: Vec<Vec<ImageId>> = self.images.iter().map(|&image| vec![image]).collect();
        let own = if alone.len() > MOST_ASKED { self.fit(&alone, self.component) } else { apart };
        let focal: Vec<f64> = own.images.iter().map(|image| image.focal).collect();
        let a_camera = CAMERA_COST.max(CAMERA_SHARE * own.cost);
        let mut best = (own.cost + a_camera * alone.len() as f64, alone);
        for spread in SPREADS {
            let groups: Vec<_> = grouped(&focal, spread).iter().map(|group| self.these(group)).collect();
            let fit = self.fit(&groups, &own.component);
            let cost = fit.cost + a_camera * groups.len() as f64;
            if cost < best.0 && fit.is_as_good_as(&own) {
                best = (cost, groups);
            }
        }
        best.1
    }

    fn these(&self, places: &[usize]) -> Vec<ImageId> {
        places.iter().map(|&at| self.images[at]).collect()
    }

    /// The component, begun with the cameras it has, with one for each of these groups of the images.
    fn fit(&self, groups: &[Vec<ImageId>], begun: &Reconstruction) -> Fit {
        let mut input = self.used.clone();
        for group in groups {
            give_camera(&mut input, group);
        }
        let mut component = begun.clone();
        component.cameras.clone_from(&input.cameras);
        let mut seen: Vec<usize> = vec![0; component.images.len()];
        for observation in component.points.iter().flat_map(|point| &point.track) {
            seen[observation.image.index()] += 1;
        }
        // Of images that are to share one, that of who sees most is begun with.
        let mut images: Vec<ImageId> = begun.registered().collect();
        images.sort_by_key(|image| seen[image.index()]);
        for image in images {
            let camera = input.images[image.index()].camera;
            component.images[image.index()].camera = camera;
            component.cameras[camera.index()].clone_from(begun.camera_of(image));
        }
        let mut model = Model::of_component(&input, &component);
        let scope = Scope::global(&model);
        let cost = adjust(&mut model, &self.params.bundle(30), &scope).final_cost;
        let cost_about = |image: ImageId| -> f64 {
            let points = model.observations_of(image).into_iter().filter_map(|(_, id)| model.point(id));
            let errors = points.flat_map(|point| {
                point.track.iter().filter_map(|seen| model.error_sigma(*seen, &point.position))
            });
            errors.map(|error| (error * error).ln_1p() / 2.0).sum()
        };
        let image_fit = |&image: &ImageId| ImageFit {
            cost: cost_about(image),
            focal: model.cameras[input.camera_index(image)].focal_length(),
            is_told: tells_camera(&model, &[image]),
        };
        let images = self.images.iter().map(image_fit).collect();
        Fit { component: model.into_reconstruction(), cost, images }
    }
}

/// Places of values, those in one group that differ by no more than a share, largest group first.
fn grouped(values: &[f64], spread: f64) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
    let mut groups: Vec<Vec<usize>> = order.into_iter().map(|at| vec![at]).collect();
    loop {
        let width = |at: usize| {
            let (low, high) = (groups[at].first(), groups[at + 1].last());
            low.zip(high).map_or(f64::INFINITY, |(&low, &high)| (values[high] / values[low]).ln())
        };
        let closest = (0..groups.len().saturating_sub(1)).min_by(|a, b| width(*a).total_cmp(&width(*b)));
        let Some(at) = closest.filter(|at| width(*at) <= spread) else { break };
        let next = groups.remove(at + 1);
        groups[at].extend(next);
    }
    for group in &mut groups {
        group.sort_unstable();
    }
    groups.sort_by_key(|group| (std::cmp::Reverse(group.len()), group.first().copied()));
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_that_differ_by_little_are_one_group_and_the_largest_comes_first() {
        let focal = [1500.0, 1000.0, 1010.0, 1495.0, 990.0, 1200.0];
        assert_eq!(grouped(&focal, 0.04), [vec![1, 2, 4], vec![0, 3], vec![5]]);
        assert_eq!(grouped(&focal, 0.001).len(), 6);
        // No group is wider than that, however close each value is to the next.
        assert!(grouped(&[1000.0, 1030.0, 1060.0, 1090.0], 0.04).iter().all(|group| group.len() == 2));
        assert_eq!(grouped(&[], 0.04), Vec::<Vec<usize>>::new());
    }

    #[test]
    fn a_fit_is_worse_where_one_image_is_far_better_by_itself_with_another_focal_length() {
        let image = |cost, focal| ImageFit { cost, focal, is_told: true };
        let fit = |cost, images| Fit { component: Reconstruction::default(), cost, images };
        let shared = fit(1000.0, vec![image(500.0, 1000.0), image(100.0, 1000.0)]);
        let is_as_good =
            |cost, last: ImageFit| shared.is_as_good_as(&fit(cost, vec![image(490.0, 1001.0), last]));
        assert!(is_as_good(990.0, image(95.0, 1200.0)));
        assert!(is_as_good(990.0, image(60.0, 1010.0)));
        assert!(is_as_good(990.0, ImageFit { is_told: false, ..image(60.0, 1200.0) }));
        assert!(!is_as_good(990.0, image(60.0, 1200.0)));
        assert!(!is_as_good(900.0, image(95.0, 1000.0)));
    }
}
