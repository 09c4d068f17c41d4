use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use setloc_features::{Camera, CameraModel};

use crate::bvh::Hierarchy;
use crate::dataset::PHOTO_SET;
use crate::error::TownError;
use crate::geometry::{Hit, Part, Ray};
use crate::layout::{Standpoint, panorama_way, photo_way, solids};
use crate::light::Light;
use crate::params::TownParams;

/// Index of the ground among the solids of a hit.
pub(crate) const GROUND: u32 = u32::MAX;

/// One image of the town: its name, camera and true pose.
#[derive(Debug, Clone)]
pub struct View {
    /// Path in the data set, `panoramas/pano_000.jpg` or `queries/<set>/img_00.jpg`.
    pub name: String,
    /// The camera that takes it.
    pub camera: Camera,
    /// Rotation part of `world_from_camera`: camera frame x right, y down, z forward; world frame east, north, up.
    pub rotation_world_from_camera: UnitQuaternion<f64>,
    /// Centre of projection in the world frame in metres.
    pub center_in_world: Vector3<f64>,
    pub(crate) light: Light,
}

/// The town: its solids and its views.
///
/// ```
/// use setloc_town::{Town, TownParams};
///
/// let town = Town::new(&TownParams { panorama_width: 64, photo_width: 64, ..TownParams::default() })?;
/// let view = town.render(0)?;
/// assert_eq!((view.width, view.height, view.rgb.len()), (64, 32, 64 * 32 * 3));
/// # Ok::<(), setloc_town::TownError>(())
/// ```
#[derive(Debug)]
pub struct Town {
    pub(crate) params: TownParams,
    pub(crate) hierarchy: Hierarchy,
    views: Vec<View>,
}

impl Town {
    /// Builds the town and the poses of all its views; renders nothing.
    ///
    /// # Errors
    /// [`TownError::InvalidParameter`] when a parameter is out of range.
    pub fn new(params: &TownParams) -> Result<Self, TownError> {
        params.validate()?;
        let (panoramas, photos) = (panorama_way(params), photo_way(params));
        let standpoints: Vec<Standpoint> = panoramas.iter().chain(&photos).copied().collect();
        let hierarchy = Hierarchy::new(&solids(params, &standpoints));
        let panorama_camera = Camera::equirectangular(params.panorama_width, params.panorama_width / 2);
        let photo_camera = photo_camera(params.photo_width);
        panorama_camera.validate()?;
        photo_camera.validate()?;
        let views = (panoramas.iter().enumerate())
            .map(|(k, s)| view(format!("panoramas/pano_{k:03}.jpg"), &panorama_camera, s, Light::afternoon()))
            .chain(photos.iter().enumerate().map(|(k, s)| {
                view(format!("queries/{PHOTO_SET}/img_{k:02}.jpg"), &photo_camera, s, Light::morning())
            }))
            .collect();
        Ok(Self { params: params.clone(), hierarchy, views })
    }

    /// All views: panoramas in route order, then the photos, the target last.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// Distance in metres from `origin` along the unit vector `direction` to the first surface, `None` for the sky.
    ///
    /// Both are in the world frame; `origin` is outside every solid.
    pub fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        self.first_hit(&Ray::new(*origin, *direction)).map(|hit| hit.distance)
    }

    /// Whether a point on a surface is seen from a place (both world frame, metres), up to a millimetre.
    pub fn visible(&self, point: &Vector3<f64>, from: &Vector3<f64>) -> bool {
        let offset = point - from;
        let distance = offset.norm();
        self.hit(from, &(offset / distance)).is_none_or(|first| first > distance - 1e-3)
    }

    pub(crate) fn first_hit(&self, ray: &Ray) -> Option<Hit> {
        let ground = -ray.origin.z * ray.inverse.z;
        let limit = if ground > 0.0 { ground } else { f64::INFINITY };
        self.hierarchy.intersect(ray, limit, false).or_else(|| {
            limit.is_finite().then_some(Hit {
                distance: ground,
                normal: Vector3::z(),
                solid: GROUND,
                part: Part::Face(5),
            })
        })
    }
}

/// A 75° lens with mild distortion and a principal point a little off the middle.
fn photo_camera(width: u32) -> Camera {
    let (w, height) = (f64::from(width), width / 4 * 3);
    let params = vec![0.65 * w, 0.65 * w, 0.503 * w, 0.372 * w, -0.06, 0.02, 0.0, 0.0];
    Camera { model: CameraModel::Opencv, width, height, params }
}

fn view(name: String, camera: &Camera, standpoint: &Standpoint, light: Light) -> View {
    let ((sin_h, cos_h), (sin_p, cos_p)) = (standpoint.heading.sin_cos(), standpoint.pitch.sin_cos());
    let forward = Vector3::new(sin_h * cos_p, cos_h * cos_p, sin_p);
    let right = Vector3::new(cos_h, -sin_h, 0.0);
    let level = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), standpoint.roll);
    let rotation = Rotation3::from_matrix_unchecked(level) * roll;
    View {
        name,
        camera: camera.clone(),
        rotation_world_from_camera: UnitQuaternion::from_rotation_matrix(&rotation),
        center_in_world: standpoint.center,
        light,
    }
}
