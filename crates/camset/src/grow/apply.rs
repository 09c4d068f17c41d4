//! The scene with what it grows by.

use nalgebra::Vector3;
use setloc_features::ImageFeatures;
use setloc_index::{IndexGrowth, IndexParams, Row, SceneIndex};
use setloc_sfm::{
    CameraId, ImageId, Observation, PointId, Reconstruction, ReconstructionImage, ReconstructionPoint,
};

use super::{Growth, GrowthPhoto};
use crate::{GrownImage, Scene};

/// A scene that has grown.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GrownScene {
    /// The model: images and points that it had keep their ids.
    pub reconstruction: Reconstruction,
    /// Its index.
    pub index: SceneIndex,
    /// All images that are photos which it has grown by.
    pub grown: Vec<GrownImage>,
}

impl Growth {
    /// The scene with this; `features` and `names` are those of [`Growth::photos`], in their order.
    ///
    /// Points that it had stay where they are, and as well known.
    pub fn apply(
        &self,
        scene: &Scene<'_>,
        features: &[&ImageFeatures],
        names: &[&str],
        params: &IndexParams,
    ) -> GrownScene {
        let mut model = scene.reconstruction.clone();
        let first = model.images.len() as u32;
        self.list_in(&mut model, names);
        let images = || (first..).map(ImageId).zip(&self.photos);
        let mut grown = scene.grown.to_vec();
        for (image, photo) in images() {
            model.images[image.index()].world_from_camera = Some(photo.world_from_camera);
            let GrowthPhoto { covariance, depth, .. } = *photo;
            grown.push(GrownImage { image, covariance, depth });
            for found in &photo.seen {
                let Some(point) = model.points.get_mut(found.point.index()) else { continue };
                let known = || scene.index.position_covariance(found.point).cast();
                point.covariance = Some(point.covariance.unwrap_or_else(known));
                point.track.push(Observation { image, feature: found.feature });
            }
        }
        let seen =
            |&(slot, feature): &(usize, u32)| Observation { image: ImageId(first + slot as u32), feature };
        model.points.extend(self.points.iter().map(|point| ReconstructionPoint {
            position: point.position,
            color: point.color,
            error_sigma: point.error_sigma,
            covariance: Some(point.covariance.cast()),
            track: point.track.iter().map(seen).collect(),
            aligned: None,
        }));
        let index = self.index(scene, features, first, params);
        GrownScene { reconstruction: model, index, grown }
    }

    /// Lists the photos in another model of the same images, which they are no part of.
    pub fn list_in(&self, model: &mut Reconstruction, names: &[&str]) {
        for (photo, name) in self.photos.iter().zip(names) {
            let camera =
                model.cameras.iter().position(|camera| *camera == photo.camera).unwrap_or_else(|| {
                    model.cameras.push(photo.camera.clone());
                    model.cameras.len() - 1
                });
            let (name, camera) = ((*name).to_owned(), CameraId(camera as u32));
            model.images.push(ReconstructionImage { name, camera, world_from_camera: None });
        }
    }

    fn index(
        &self,
        scene: &Scene<'_>,
        features: &[&ImageFeatures],
        first: u32,
        params: &IndexParams,
    ) -> SceneIndex {
        let images: Vec<NewImage<'_>> = (first..)
            .map(ImageId)
            .zip(self.photos.iter().zip(features))
            .map(|(id, (photo, features))| NewImage { id, photo, features })
            .collect();
        let mut rows = Vec::new();
        for image in &images {
            let known = image.photo.seen.iter();
            rows.extend(known.filter_map(|found| {
                image.row(found.point, &scene.index.position(found.point), found.feature)
            }));
        }
        for (id, point) in (scene.index.point_count() as u32..).map(PointId).zip(&self.points) {
            let track = point.track.iter();
            rows.extend(
                track.filter_map(|&(slot, feature)| images.get(slot)?.row(id, &point.position, feature)),
            );
        }
        let centers: Vec<_> =
            images.iter().map(|image| Some(image.photo.world_from_camera.translation)).collect();
        let points: Vec<_> = self.points.iter().map(|p| (p.position, p.covariance.cast())).collect();
        scene.index.extended(params, &IndexGrowth { centers: &centers, points: &points, rows: &rows })
    }
}

/// A photo as an image of the scene.
struct NewImage<'a> {
    id: ImageId,
    photo: &'a GrowthPhoto,
    features: &'a ImageFeatures,
}

impl<'a> NewImage<'a> {
    /// An observation and its descriptor, where there is such a feature.
    fn row(&self, point: PointId, position: &Vector3<f64>, feature: u32) -> Option<(Row, &'a [u8])> {
        let keypoint = self.features.keypoints.get(feature as usize)?;
        let angle = self.photo.camera.pixel_angle(&keypoint.pixel()).unwrap_or(0.0);
        let distance = (position - self.photo.world_from_camera.translation).norm();
        let row = Row { point, image: self.id, extent: (f64::from(keypoint.size) * angle * distance) as f32 };
        Some((row, self.features.descriptor(feature as usize)))
    }
}
