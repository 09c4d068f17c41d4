//! What the images of a model see in common, and what they ought to.

use rayon::prelude::*;

use crate::{
    ImageId, Reconstruction,
    visibility::{FARTHEST_SAME_VIEW, is_in_image, is_same_view},
};

/// What one image sees of what another one does.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct CommonView {
    /// Its points that the other sees, too.
    pub shared: usize,
    /// Its points that the other ought to see, as it has them in plain view from nearly the same place.
    pub expected: usize,
}

/// The same for each two images of a model that have anything of it.
///
/// Only cameras near an image are asked for what they ought to see of its points, and only pairs that share or ought to share something
/// are kept: in a street both grow as the images do.
pub(crate) struct CommonViews {
    /// By image, the others of which it sees something; ascending.
    rows: Vec<Vec<(ImageId, CommonView)>>,
    /// By image.
    points_of: Vec<usize>,
}

impl CommonViews {
    /// Those of the registered images of a model.
    pub fn of(model: &Reconstruction) -> Self {
        let images = model.images.len();
        let mut points_of = vec![Vec::new(); images];
        for (at, point) in model.points.iter().enumerate() {
            for seen in &point.track {
                points_of[seen.image.index()].push(at);
            }
        }
        let row = |image: usize| -> Vec<(ImageId, CommonView)> { row_of(model, image, &points_of[image]) };
        let rows = (0..images).into_par_iter().map(row).collect();
        Self { rows, points_of: points_of.iter().map(Vec::len).collect() }
    }

    /// What `image` sees of what `other` does.
    pub fn between(&self, image: ImageId, other: ImageId) -> CommonView {
        let row = &self.rows[image.index()];
        row.binary_search_by_key(&other, |&(of, _)| of).map_or_else(|_| CommonView::default(), |at| row[at].1)
    }

    /// Points that both see.
    pub fn shared(&self, first: ImageId, second: ImageId) -> usize {
        self.between(first, second).shared
    }

    /// Observations of points in an image.
    pub fn points_of(&self, image: ImageId) -> usize {
        self.points_of[image.index()]
    }

    /// The most points that an image shares with any other.
    pub fn most_shared(&self, image: ImageId) -> usize {
        self.rows[image.index()].iter().map(|(_, view)| view.shared).max().unwrap_or(0)
    }

    /// The pairs that share points, the first before the second, with these points.
    pub fn sharing(&self) -> impl Iterator<Item = (ImageId, ImageId, usize)> + '_ {
        let pairs = self.pairs();
        pairs
            .filter(|(first, second, view)| first < second && view.shared > 0)
            .map(|(first, second, view)| (first, second, view.shared.max(self.shared(second, first))))
    }

    /// The pairs of which one ought to see something of the other, each once, the first before the second; ascending.
    pub fn expecting(&self) -> Vec<(ImageId, ImageId)> {
        let expecting = self.pairs().filter(|(.., view)| view.expected > 0);
        let mut pairs: Vec<(ImageId, ImageId)> =
            expecting.map(|(a, b, _)| if a < b { (a, b) } else { (b, a) }).collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    }

    fn pairs(&self) -> impl Iterator<Item = (ImageId, ImageId, CommonView)> + '_ {
        let images = (0_u32..).map(ImageId);
        let rows = images.zip(&self.rows);
        rows.flat_map(|(image, row)| row.iter().map(move |&(other, view)| (image, other, view)))
    }
}

/// What an image that sees these points sees of what the others do.
fn row_of(model: &Reconstruction, image: usize, points: &[usize]) -> Vec<(ImageId, CommonView)> {
    let Some(pose) = &model.images[image].world_from_camera else { return Vec::new() };
    let center = pose.translation;
    let mut others: Vec<(f64, ImageId)> = (model.registered())
        .filter(|other| other.index() != image)
        .filter_map(|other| {
            let pose = model.images[other.index()].world_from_camera?;
            Some(((pose.translation - center).norm(), other))
        })
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0));
    let is_in_image = |other: ImageId, position| {
        model.images[other.index()]
            .world_from_camera
            .is_some_and(|pose| is_in_image(model.camera_of(other), &pose.inverse_transform_point(position)))
    };
    let mut views = vec![CommonView::default(); model.images.len()];
    let mut sees = vec![false; model.images.len()];
    for point in points.iter().map(|&at| &model.points[at]) {
        for seen in &point.track {
            let other = seen.image.index();
            if other != image && !std::mem::replace(&mut sees[other], true) {
                views[other].shared += 1;
            }
        }
        for seen in &point.track {
            sees[seen.image.index()] = false;
        }
        let reach = FARTHEST_SAME_VIEW * (point.position - center).norm();
        let near = others.partition_point(|&(distance, _)| distance <= reach);
        for &(_, other) in &others[..near] {
            let other_center = model.images[other.index()].world_from_camera.map(|pose| pose.translation);
            let is_expected = other_center
                .is_some_and(|other| is_same_view(&point.position, &center, &other))
                && is_in_image(other, &point.position);
            views[other.index()].expected += usize::from(is_expected);
        }
    }
    let views = views.into_iter().enumerate().filter(|(_, view)| *view != CommonView::default());
    views.map(|(other, view)| (ImageId(other as u32), view)).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rand::Rng;
    use setloc_features::{Camera, CameraModel};

    use super::*;
    use crate::{CameraId, Observation, ReconstructionImage, ReconstructionPoint, Rigid, synthetic::seeded};

    /// By asking each camera for each point.
    #[test]
    fn cameras_that_are_too_far_to_see_the_same_are_not_missed() {
        let mut rng = seeded("common views");
        let pinhole = Camera {
            model: CameraModel::Pinhole,
            width: 800,
            height: 600,
            params: vec![500.0, 500.0, 400.0, 300.0],
        };
        let mut model = Reconstruction {
            cameras: vec![Camera::equirectangular(800, 400), pinhole],
            ..Reconstruction::default()
        };
        for at in 0..40_u32 {
            let center = Vector3::from_fn(|_, _| rng.random_range(-6.0..6.0));
            let turn = UnitQuaternion::from_euler_angles(0.1, f64::from(at), 0.2);
            model.images.push(ReconstructionImage {
                name: at.to_string(),
                camera: CameraId(u32::from(at % 3 == 0)),
                world_from_camera: (at % 7 != 0).then(|| Rigid::new(turn, center)),
            });
        }
        for feature in 0..300 {
            let seen_by = |_| ImageId(rng.random_range(0..40));
            let mut images = std::array::from_fn::<_, 4, _>(seen_by).to_vec();
            images.sort_unstable();
            images.dedup();
            images.retain(|image| model.images[image.index()].world_from_camera.is_some());
            model.points.push(ReconstructionPoint {
                position: Vector3::from_fn(|_, _| rng.random_range(-20.0..20.0)),
                track: images.into_iter().map(|image| Observation { image, feature }).collect(),
                color: [0; 3],
                error_sigma: 0.0,
                aligned: None,
                covariance: None,
            });
        }
        let views = CommonViews::of(&model);
        let mut expected_of_all = 0;
        for first in model.registered() {
            for second in model.registered().filter(|&second| second != first) {
                let sees =
                    |point: &ReconstructionPoint, image| point.track.iter().any(|seen| seen.image == image);
                let pose =
                    |image: ImageId| model.images[image.index()].world_from_camera.expect("registered");
                let ought_to_see = |point: &&ReconstructionPoint| {
                    is_same_view(&point.position, &pose(first).translation, &pose(second).translation)
                        && is_in_image(
                            model.camera_of(second),
                            &pose(second).inverse_transform_point(&point.position),
                        )
                };
                let seen = || model.points.iter().filter(|point| sees(point, first));
                let shared = seen().filter(|point| sees(point, second)).count();
                let expected = seen().filter(ought_to_see).count();
                assert_eq!(
                    views.between(first, second),
                    CommonView { shared, expected },
                    "{first:?} {second:?}"
                );
                assert_eq!(views.shared(second, first), shared);
                expected_of_all += expected;
            }
        }
        assert!(expected_of_all > 1000, "{expected_of_all}");
        let sharing: usize = views.sharing().map(|(.., points)| points).sum();
        assert!(sharing > 500 && views.sharing().all(|(first, second, _)| first < second), "{sharing}");
        assert!(
            views.expecting().is_sorted() && views.expecting().iter().all(|(first, second)| first < second)
        );
    }
}
