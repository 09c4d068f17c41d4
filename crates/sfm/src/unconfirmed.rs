//! Models that nothing but one pair of images tells.

use nalgebra::Vector3;

use crate::{ImageId, Reconstruction, ReconstructionPoint, direction};

/// Directions in which two panoramas share points, of each cell up to five, below which these may be of two things that look alike. Of
/// wrong pairs of rendered floors and streets nine tenths have less than 53, the most spread two 82 and 148. Of 16 models of two
/// panoramas in eight real tours three or four were wrong, at 13 (a poster that hangs twice), 19 (a bathroom of each floor) and 76 (their
/// corridors); those in the open that are right had 20–154, rooms seen through a door 18–40.
const MIN_SPREAD: usize = 80;

/// Two panoramas that make a model by themselves, of what is in few directions about them.
///
/// A third image would show whether they stand in one place: a poster may hang in two rooms, and floors of one house look alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnconfirmedPair {
    /// First image.
    pub first: ImageId,
    /// Second image.
    pub second: ImageId,
    /// Points that hold them together.
    pub points: usize,
}

impl UnconfirmedPair {
    /// The two images of a component, if it has no more and these share points in few directions.
    ///
    /// Photos are not judged: what they show is in few directions in any case.
    pub fn of(component: &Reconstruction) -> Option<Self> {
        let registered: Vec<ImageId> = component.registered().take(3).collect();
        let &[first, second] = &registered[..] else { return None };
        if ![first, second].iter().all(|image| component.camera_of(*image).is_panoramic()) {
            return None;
        }
        let seen_by = |image: ImageId, point: &ReconstructionPoint| -> Option<Vector3<f64>> {
            let pose = component.images[image.index()].world_from_camera?;
            let is_seen = point.track.iter().any(|seen| seen.image == image);
            is_seen.then(|| pose.inverse_transform_point(&point.position))
        };
        let shared: Vec<[Vector3<f64>; 2]> = (component.points.iter())
            .filter_map(|point| Some([seen_by(first, point)?, seen_by(second, point)?]))
            .collect();
        let spread = |of: usize| direction::spread(shared.iter().map(|bearings| &bearings[of]));
        (spread(0).min(spread(1)) < MIN_SPREAD).then_some(Self { first, second, points: shared.len() })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use setloc_features::Camera;

    use super::*;
    use crate::{CameraId, Observation, ReconstructionImage, Rigid};

    /// Panoramas a metre apart, all of which see points ten metres off, in a sector so many degrees wide.
    fn panoramas(images: u32, sector_deg: f64, camera: Camera) -> Reconstruction {
        let image = |x: u32| ReconstructionImage {
            name: format!("{x}.jpg"),
            camera: CameraId(0),
            world_from_camera: Some(Rigid::new(
                UnitQuaternion::identity(),
                Vector3::new(f64::from(x), 0.0, 0.0),
            )),
        };
        let point = |feature: u32| {
            let angle = sector_deg.to_radians() * f64::from(feature) / 400.0;
            let height = f64::from(feature % 20) - 10.0;
            ReconstructionPoint {
                position: Vector3::new(10.0 * angle.sin(), height, 10.0 * angle.cos()),
                color: [0; 3],
                error_sigma: 0.0,
                covariance: None,
                track: (0..images).map(|image| Observation { image: ImageId(image), feature }).collect(),
                aligned: None,
            }
        };
        Reconstruction {
            cameras: vec![camera],
            images: (0..images).map(image).collect(),
            points: (0..400).map(point).collect(),
            ..Reconstruction::default()
        }
    }

    #[test]
    fn two_panoramas_that_share_a_poster_are_not_confirmed_by_however_many_points() {
        let panorama = || Camera::equirectangular(4096, 2048);
        let poster = UnconfirmedPair::of(&panoramas(2, 20.0, panorama()));
        assert_eq!(poster, Some(UnconfirmedPair { first: ImageId(0), second: ImageId(1), points: 400 }));
        let all_round = UnconfirmedPair::of(&panoramas(2, 360.0, panorama()));
        assert_eq!(all_round, None);
        let with_a_third = UnconfirmedPair::of(&panoramas(3, 20.0, panorama()));
        assert_eq!(with_a_third, None);
        let photos = UnconfirmedPair::of(&panoramas(2, 20.0, Camera::from_focal_guess(1600, 1200, 1250.0)));
        assert_eq!(photos, None);
    }
}
