//! What a joint refinement moves, and what it holds it by.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector3};
use setloc_features::Camera;
use setloc_sfm::bundle::{CameraPrior, IntrinsicsFreedom, LengthRatio};
use setloc_sfm::{ImageId, Place, PointId, Rigid, WallSight};

use crate::SceneMatch;
use crate::stretch::PhotoStretch;

/// Cameras from which on photos may have zooms of any focal length, and the photos to each that speak for fewer.
const MANY_CAMERAS: usize = 4;
const MANY_PHOTOS: usize = 3;

/// Photos, their cameras and the local points between them, all in the scene's frame.
#[derive(Debug, Clone)]
pub(crate) struct JointModel {
    pub cameras: Vec<JointCamera>,
    pub photos: Vec<JointPhoto>,
    pub points: Vec<Vector3<f64>>,
    /// Lengths of baselines that the points do not tell, between slots of photos.
    pub lengths: Vec<([usize; 3], LengthRatio)>,
    /// What directions of photos of known intrinsics differ by from these.
    pub stretch: PhotoStretch,
}

/// A camera of a joint model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct JointCamera {
    pub camera: Camera,
    pub known: KnownOfCamera,
}

/// What is known of a camera beside what the adjustment finds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum KnownOfCamera {
    /// Its intrinsics: they stay.
    Intrinsics,
    /// Nothing but what holds for usual photos.
    Usual,
    /// That it differs from this one by little.
    Alike(Camera),
    /// Its distortion and principal point: they stay. Of the focal length nothing.
    Distortion,
    /// Nothing but what holds for usual photos, of which it may be a part.
    Cut,
    /// The same, and its distortion: it stays.
    CutDistortion,
    /// Its intrinsics but for the focal lengths, which are near this one's.
    AllButFocal(Camera),
}

impl JointCamera {
    #[cfg(test)]
    pub fn new(camera: Camera, is_known: bool) -> Self {
        Self { camera, known: if is_known { KnownOfCamera::Intrinsics } else { KnownOfCamera::Usual } }
    }

    pub fn is_known(&self) -> bool {
        self.known == KnownOfCamera::Intrinsics
    }

    pub fn freedom(&self) -> IntrinsicsFreedom {
        match self.known {
            KnownOfCamera::Intrinsics => IntrinsicsFreedom::FIXED,
            KnownOfCamera::Usual | KnownOfCamera::Cut | KnownOfCamera::Alike(_) => IntrinsicsFreedom::FREE,
            KnownOfCamera::CutDistortion => {
                IntrinsicsFreedom { distortion: false, ..IntrinsicsFreedom::FREE }
            }
            KnownOfCamera::Distortion | KnownOfCamera::AllButFocal(_) => {
                IntrinsicsFreedom { focal: true, ..IntrinsicsFreedom::FIXED }
            }
        }
    }

    /// `None` for panoramas, which have nothing to estimate.
    pub fn prior(&self, index: u32) -> Option<CameraPrior> {
        match &self.known {
            KnownOfCamera::Alike(alike) => CameraPrior::alike(index, alike),
            KnownOfCamera::AllButFocal(near) => Some(CameraPrior::told(index, near)),
            KnownOfCamera::Cut | KnownOfCamera::CutDistortion => {
                CameraPrior::of_cut_photo(index, &self.camera)
            }
            KnownOfCamera::Intrinsics | KnownOfCamera::Usual | KnownOfCamera::Distortion => {
                CameraPrior::of_usual_photo(index, &self.camera)
            }
        }
    }
}

impl JointModel {
    pub fn camera_of(&self, slot: usize) -> &Camera {
        &self.cameras[self.photos[slot].camera].camera
    }

    /// Gives photos that share a camera which is not known one each, alike the one that they have, where hardly two photos have
    /// one: a zoom has any focal length, and those that are not told apart need not be one.
    pub fn give_own_cameras_where_many(&mut self) {
        let mut photos_of: BTreeMap<usize, usize> = BTreeMap::new();
        for photo in &self.photos {
            if self.cameras[photo.camera].known == KnownOfCamera::Usual {
                *photos_of.entry(photo.camera).or_default() += 1;
            }
        }
        let photos: usize = photos_of.values().sum();
        if photos_of.len() < MANY_CAMERAS || photos >= MANY_PHOTOS * photos_of.len() {
            return;
        }
        photos_of.retain(|_, photos| *photos > 1);
        for photo in self.photos.iter_mut().filter(|photo| photos_of.contains_key(&photo.camera)) {
            let camera = self.cameras[photo.camera].camera.clone();
            photo.camera = self.cameras.len();
            self.cameras.push(JointCamera { known: KnownOfCamera::Alike(camera.clone()), camera });
        }
        // No photo has them any more: nothing to estimate.
        for camera in photos_of.into_keys() {
            self.cameras[camera].known = KnownOfCamera::Intrinsics;
        }
    }
}

/// One photo of a joint model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct JointPhoto {
    /// Index into [`JointModel::cameras`].
    pub camera: usize,
    pub world_from_camera: Rigid,
    /// Slot of the first photo that was taken from the same centre (its own when there is no other).
    ///
    /// Photos of one standpoint keep their turns and move together: what they share tells nothing of their distance.
    pub standpoint: usize,
}

/// A place in a photo where it shows a local point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sighting {
    /// Slot of the photo.
    pub photo: usize,
    /// The keypoint, where one belongs to the point.
    pub feature: Option<u32>,
    /// The place, in pixels, with its standard deviation against the other places of the point.
    pub place: Place,
    /// Standard deviation of a keypoint of the point in this photo, in pixels.
    pub keypoint_noise_px: f64,
}

/// What photos see.
#[derive(Debug, Clone, Default)]
pub(crate) struct JointObservations {
    /// Scene points that each photo sees by a keypoint.
    pub direct: Vec<Vec<SceneMatch>>,
    /// Aligned local points that are scene points. Keypoints that they hold do not count in `direct` again.
    pub tied: Vec<TiedPoint>,
    /// Free local points, by their index, and where they are seen.
    pub tracks: Vec<(usize, Sighting)>,
    /// Free local points, by their index, and where images of the scene show them.
    pub views: Vec<(usize, SceneView)>,
    /// Spots of the scene's walls.
    pub walls: Vec<WallSight>,
}

/// A place in an image of the scene.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SceneView {
    pub image: ImageId,
    pub place: Place,
}

/// A local point that is a scene point.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TiedPoint {
    pub scene: PointId,
    /// Where the photos show it.
    pub seen: Vec<Sighting>,
    /// Covariance of the spot that they show about the scene's, in the scene's frame.
    pub spot: Matrix3<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::World;

    #[test]
    fn photos_of_many_unknown_cameras_get_focal_lengths_of_their_own() {
        let world = World::chain(1, 0.0, 33);
        let focal_lengths = [700.0, 800.0, 900.0, 1000.0, 1100.0];
        let camera = |focal: f64| world.camera.with_focal_times(focal / world.camera.focal_length());
        let of_photos = |cameras: &[usize]| {
            let photo =
                |&camera: &usize| JointPhoto { camera, world_from_camera: Rigid::identity(), standpoint: 0 };
            let known = |(at, focal)| JointCamera::new(camera(focal), at == 0);
            let mut model = JointModel {
                cameras: focal_lengths.into_iter().enumerate().map(known).collect(),
                photos: cameras.iter().map(photo).collect(),
                points: Vec::new(),
                lengths: Vec::new(),
                stretch: PhotoStretch::default(),
            };
            model.give_own_cameras_where_many();
            (model.photos.iter().map(|photo| photo.camera).collect::<Vec<_>>(), model.cameras)
        };
        let (photos, cameras) = of_photos(&[0, 1, 0, 2, 3, 4, 1]);
        assert_eq!(photos, [0, 5, 0, 2, 3, 4, 6]);
        let known: Vec<KnownOfCamera> = cameras.iter().map(|camera| camera.known.clone()).collect();
        let alike = || KnownOfCamera::Alike(camera(800.0));
        let (intrinsics, usual) = (KnownOfCamera::Intrinsics, KnownOfCamera::Usual);
        let (own, none) = ([alike(), alike()], [intrinsics.clone(), intrinsics]);
        assert_eq!(known, [&none[..], &[usual.clone(), usual.clone(), usual], &own].concat());
        assert_eq!(cameras[6].camera, camera(800.0));
        let (prior, usual) =
            (cameras[6].prior(6).unwrap(), CameraPrior::of_usual_photo(6, &camera(800.0)).unwrap());
        assert_eq!((prior.parameters[0].value, prior.parameters[0].sigma), (800.0, 8.0));
        assert_eq!(prior.parameters[2..], usual.parameters[2..]);
        // Of three cameras, or with three photos to each, they keep them.
        for kept in [&[1, 2, 3, 1][..], &[1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4], &[0, 0, 0, 0]] {
            assert_eq!(of_photos(kept).0, kept);
        }
        let two_to_each = [1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3];
        assert_ne!(of_photos(&two_to_each).0, two_to_each);
    }
}
