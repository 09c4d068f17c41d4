use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Vector3};
use serde::Serialize;
use setloc_features::ImageFeatures;
use setloc_sfm::{Observation, Reconstruction, ReconstructionPoint, Rigid, Similarity, nearest_rotation};

use super::NormalizedError;
use crate::export::error_px;

/// One image's error against truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseError {
    /// Distance of the centres in metres, after alignment.
    pub position_m: f64,
    /// Angle between the orientations in degrees, after alignment.
    pub rotation_deg: f64,
}

/// Errors by image name.
pub type Errors = BTreeMap<String, PoseError>;

/// Spread of a scene's errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Half of them are below.
    pub median: f64,
    /// Arithmetic mean.
    pub mean: f64,
    /// The largest.
    pub max: f64,
}

/// Spread of a set's errors, as the paper's table has it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bounds {
    /// The smallest.
    pub min: f64,
    /// Half of them are below.
    pub median: f64,
    /// The largest.
    pub max: f64,
    /// Arithmetic mean.
    pub mean: f64,
}

impl Bounds {
    /// Of some values, `None` of none.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        let (min, max) = (*values.first()?, *values.last()?);
        let n = values.len();
        let median = f64::midpoint(values[(n - 1) / 2], values[n / 2]);
        Some(Self { min, median, max, mean: values.iter().sum::<f64>() / n as f64 })
    }
}

impl From<Bounds> for Spread {
    fn from(bounds: Bounds) -> Self {
        Self { median: bounds.median, mean: bounds.mean, max: bounds.max }
    }
}

/// How the scene's frame lies in the truth's.
#[derive(Debug, Clone)]
pub struct Alignment {
    truth_from_scene: Similarity,
    /// By centres and rotations alike.
    by_poses: Similarity,
    /// Images that it leaves out, as they are misplaced.
    misplaced: Vec<String>,
}

impl Alignment {
    /// Of poses that are in the truth's frame.
    pub fn none() -> Self {
        let same = Similarity::identity();
        Self { truth_from_scene: same, by_poses: same, misplaced: Vec::new() }
    }

    /// Units of the truth in one of the scene.
    pub fn scale(&self) -> f64 {
        self.truth_from_scene.scale
    }

    /// Images farther than a twentieth of the true extent from where most others say that they are. One in a wrong place
    /// would move what least squares make of all, and with it the error of every photo.
    pub fn misplaced(&self) -> &[String] {
        &self.misplaced
    }

    /// Least squares over the centres of the images that both know, without those that are misplaced; `None` with fewer
    /// than 3 or all in one line.
    pub fn of_centres(estimated: &BTreeMap<String, Rigid>, truth: &BTreeMap<String, Rigid>) -> Option<Self> {
        Self::over_centres(common(estimated, truth))
    }

    fn over_centres(mut common: Vec<Compared<'_>>) -> Option<Self> {
        let misplaced = set_misplaced_aside(&mut common);
        let truth_from_scene = by_centres(&common)?;
        let by_poses = by_poses(&common).unwrap_or(truth_from_scene);
        Some(Self { truth_from_scene, by_poses, misplaced })
    }

    /// Of a component of few images: over the centres where they spread in two directions, else over centres and
    /// rotations alike, for which two images are enough.
    pub fn of_component(
        estimated: &BTreeMap<String, Rigid>,
        truth: &BTreeMap<String, Rigid>,
    ) -> Option<Self> {
        let mut common = common(estimated, truth);
        let centers: Vec<_> = common.iter().map(|image| image.own.translation).collect();
        if spread_sideways(&centers) >= MIN_SIDEWAYS {
            return Self::over_centres(common);
        }
        let misplaced = set_misplaced_aside(&mut common);
        let by_poses = by_poses(&common)?;
        Some(Self { truth_from_scene: by_poses, by_poses, misplaced })
    }

    /// The error of a pose.
    pub fn error(&self, estimated: &Rigid, truth: &Rigid) -> PoseError {
        let aligned = self.truth_from_scene.transform_pose(estimated);
        PoseError {
            position_m: (aligned.translation - truth.translation).norm(),
            rotation_deg: aligned.rotation.angle_to(&truth.rotation).to_degrees(),
        }
    }

    /// The same error in what the pose's covariance (rotation in the camera's frame, then centre in the scene's)
    /// states; `None` without a positive definite one.
    ///
    /// The scene is aligned by its images' centres and rotations alike: those of a street lie nearly on a line, about
    /// which their centres' errors alone would turn it (by 0.5° on rendered streets of 3 to 10 panoramas). What is left of
    /// the alignment's own error counts as the pose's.
    pub fn normalized_error(
        &self,
        estimated: &Rigid,
        covariance: &Matrix6<f64>,
        truth: &Rigid,
    ) -> Option<NormalizedError> {
        let truth = self.by_poses.inverse().transform_pose(truth);
        let rotation = (estimated.rotation.inverse() * truth.rotation).scaled_axis();
        NormalizedError::of(&rotation, &(truth.translation - estimated.translation), covariance)
    }
}

/// Least share of their length by which centres spread sideways to tell the roll about it.
const MIN_SIDEWAYS: f64 = 0.1;

/// How far points spread across the direction in which they spread most, as a share of that; 0 where they do not spread.
fn spread_sideways(points: &[Vector3<f64>]) -> f64 {
    let mean = points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let moments: Matrix3<f64> = points.iter().map(|p| (p - mean) * (p - mean).transpose()).sum();
    let mut squares = moments.symmetric_eigenvalues().map(|square| square.max(0.0));
    squares.as_mut_slice().sort_by(f64::total_cmp);
    if squares[2] > 0.0 { (squares[1] / squares[2]).sqrt() } else { 0.0 }
}

/// Largest distance between the centres of some poses, 0 of none.
pub(super) fn extent<'p>(poses: impl Iterator<Item = &'p Rigid>) -> f64 {
    let centers: Vec<Vector3<f64>> = poses.map(|pose| pose.translation).collect();
    centers.iter().flat_map(|a| centers.iter().map(move |b| (a - b).norm())).fold(0.0, f64::max)
}

/// A pose in the scene and the true one.
struct Compared<'a> {
    name: &'a str,
    own: &'a Rigid,
    true_: &'a Rigid,
}

fn common<'a>(
    estimated: &'a BTreeMap<String, Rigid>,
    truth: &'a BTreeMap<String, Rigid>,
) -> Vec<Compared<'a>> {
    estimated.iter().filter_map(|(name, own)| Some(Compared { name, own, true_: truth.get(name)? })).collect()
}

/// Share of the true extent from where it belongs beyond which an image is misplaced.
const MISPLACED: f64 = 0.05;
/// Most comparisons of an image with a similarity that one image and its distance to another give.
const MOST_COMPARISONS: usize = 10_000_000;

/// Takes out the images that are misplaced, and names them.
///
/// Where all are near where least squares of all have them, none is. Otherwise one image's pose and its distance to
/// another tell a similarity; of these the one counts by which most are near.
fn set_misplaced_aside(common: &mut Vec<Compared<'_>>) -> Vec<String> {
    let extent = extent(common.iter().map(|image| image.true_));
    let is_near = |image: &Compared<'_>, truth_from_scene: &Similarity| {
        let found = truth_from_scene.transform_point(&image.own.translation);
        (found - image.true_.translation).norm() <= MISPLACED * extent
    };
    let of_all = by_centres(common).or_else(|| by_poses(common));
    if of_all.is_none_or(|of_all| common.iter().all(|image| is_near(image, &of_all))) {
        return Vec::new();
    }
    let of_two = |a: &Compared<'_>, b: &Compared<'_>| {
        let length = (a.own.translation - b.own.translation).norm();
        let rotation = a.true_.rotation * a.own.rotation.inverse();
        let scale = (a.true_.translation - b.true_.translation).norm() / length;
        let translation = a.true_.translation - rotation * a.own.translation * scale;
        (length > 0.0 && scale > 0.0).then_some(Similarity { scale, rotation, translation })
    };
    let count = common.len();
    let step = (count.pow(3) / MOST_COMPARISONS).max(1);
    let of_two = |pair: usize| of_two(&common[pair / count], &common[pair % count]);
    let near = |truth_from_scene: &Similarity| -> Vec<bool> {
        common.iter().map(|image| is_near(image, truth_from_scene)).collect()
    };
    let by_most = (0..count * count)
        .step_by(step)
        .filter_map(of_two)
        .map(|of_two| near(&of_two))
        // Of several the first.
        .reduce(|most, next| if counted(&next) > counted(&most) { next } else { most });
    let Some(is_placed) = by_most.filter(|is_placed| counted(is_placed) >= MIN_PLACED) else {
        return Vec::new();
    };
    let misplaced = common.iter().zip(&is_placed).filter(|(_, is_placed)| !**is_placed);
    let misplaced = misplaced.map(|(image, _)| image.name.to_owned()).collect();
    let mut is_placed = is_placed.into_iter();
    common.retain(|_| is_placed.next().unwrap_or(true));
    misplaced
}

/// Images that must agree on where they are before others count as misplaced.
const MIN_PLACED: usize = 3;

fn counted(which: &[bool]) -> usize {
    which.iter().filter(|is_one| **is_one).count()
}

fn by_centres(common: &[Compared<'_>]) -> Option<Similarity> {
    let (source, target): (Vec<_>, Vec<_>) =
        common.iter().map(|image| (image.own.translation, image.true_.translation)).unzip();
    Similarity::from_point_pairs(&source, &target)
}

/// The similarity of least squares over centres, in units of their extent, and rotations, in radians.
fn by_poses(common: &[Compared<'_>]) -> Option<Similarity> {
    let count = common.len() as f64;
    let middle = |of: fn(&Compared<'_>) -> Vector3<f64>| common.iter().map(of).sum::<Vector3<f64>>() / count;
    let (own, true_) = (middle(|image| image.own.translation), middle(|image| image.true_.translation));
    let offsets =
        || common.iter().map(|image| (image.own.translation - own, image.true_.translation - true_));
    let extents = offsets().fold([0.0; 2], |[a, b], (of_own, of_true)| {
        [a + of_own.norm_squared() / count, b + of_true.norm_squared() / count]
    });
    let [own_extent, true_extent] = extents.map(f64::sqrt);
    let by_centers: Matrix3<f64> =
        offsets().map(|(of_own, of_true)| of_true * of_own.transpose()).sum::<Matrix3<f64>>()
            / (own_extent * true_extent);
    // A rotation by the angle a moves three axes by 2a² together, a centre one extent away by a².
    let rotations = common.iter().map(|image| image.true_.rotation * image.own.rotation.inverse());
    let by_rotations: Matrix3<f64> =
        rotations.map(|turn| turn.to_rotation_matrix().into_inner()).sum::<Matrix3<f64>>() * 0.5;
    let rotation = nearest_rotation(by_centers + by_rotations)?;
    let along: f64 = offsets().map(|(of_own, of_true)| of_true.dot(&(rotation * of_own))).sum();
    let scale = along / (count * own_extent * own_extent);
    let usable = scale.is_finite() && scale > 0.0;
    usable.then(|| Similarity { scale, rotation, translation: true_ - rotation * own * scale })
}

/// Rotation errors in degrees when the world's rotation is taken from the rotations themselves (chordal mean).
///
/// Free of the error that a poorly spread set of centres gives the alignment.
pub fn own_rotation_errors_deg(
    estimated: &BTreeMap<String, Rigid>,
    truth: &BTreeMap<String, Rigid>,
) -> Vec<f64> {
    let pairs: Vec<_> = estimated
        .iter()
        .filter_map(|(name, pose)| Some((pose.rotation, truth.get(name)?.rotation)))
        .collect();
    let sum: Matrix3<f64> =
        pairs.iter().map(|(own, true_)| (true_ * own.inverse()).to_rotation_matrix().into_inner()).sum();
    let Some(truth_from_scene) = nearest_rotation(sum) else { return Vec::new() };
    pairs.iter().map(|(own, true_)| (truth_from_scene * own).angle_to(true_).to_degrees()).collect()
}

/// Figures of a scene, in the schema of `results.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneFigures {
    /// Image files given.
    pub images: usize,
    /// Images in the largest component.
    pub registered: usize,
    /// Number of components.
    pub components: usize,
    /// Images of the largest component in a wrong place: more than a twentieth of the extent from where the alignment of
    /// all others has them. Their errors count with the others.
    pub misplaced: usize,
    /// Points of the largest component.
    pub points: usize,
    /// Observations of the largest component.
    pub observations: usize,
    /// Mean angle between observed and predicted ray, in pixels of the image there.
    pub mean_angular_error_px: Option<f64>,
    /// Centre errors after alignment.
    pub position_m: Option<Spread>,
    /// Rotation errors after alignment by centres.
    pub rotation_deg: Option<Spread>,
    /// Rotation errors after alignment by rotations.
    pub rotation_own_deg: Option<Spread>,
    /// What the scene states its centres may be off, one sigma of all directions together, in units of the truth.
    pub position_sigma_m: Option<Spread>,
    /// The same of rotations.
    pub rotation_sigma_deg: Option<Spread>,
    /// AUC of relative poses in percent, by threshold in degrees.
    pub auc: Option<BTreeMap<String, f64>>,
}

/// Mean angular residual of a model in pixels.
pub fn mean_angular_error_px(
    model: &Reconstruction,
    features: &BTreeMap<String, std::sync::Arc<ImageFeatures>>,
) -> Option<f64> {
    let of_image: Vec<_> = model.images.iter().map(|image| features.get(&image.name)).collect();
    let error = |observation: &Observation, position: &Vector3<f64>| {
        let keypoint = of_image[observation.image.index()]?.keypoints.get(observation.feature as usize)?;
        error_px(model, observation.image, keypoint, position)
    };
    let of_point = |point: &ReconstructionPoint| -> Vec<f64> {
        point.track.iter().filter_map(|observation| error(observation, &point.position)).collect()
    };
    let (mut sum, mut count) = (0.0, 0_usize);
    for value in model.points.iter().flat_map(of_point) {
        sum += value;
        count += 1;
    }
    (count > 0).then(|| sum / count as f64)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    #[test]
    fn bounds_are_those_of_the_values() {
        let bounds = Bounds::of([3.0, 1.0, 2.0, 10.0]).unwrap();
        assert_eq!((bounds.min, bounds.median, bounds.max, bounds.mean), (1.0, 2.5, 10.0, 4.0));
        assert!(Bounds::of([]).is_none());
    }

    #[test]
    fn the_calibration_s_alignment_does_not_roll_about_a_line_of_centres() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2);
        let mapped = Similarity { scale: 2.0, rotation: turn, translation: Vector3::new(4.0, 5.0, 6.0) };
        let pose = |x: f64, off: f64| {
            let rotation = UnitQuaternion::from_euler_angles(0.1 * x, 0.2, -x);
            Rigid::new(rotation, Vector3::new(x, 0.0, off))
        };
        // Two millimetres on either side of the line say that it lies the other way round.
        let offs = [0.002, -0.002, 0.002, -0.002];
        let named = |off: fn(f64) -> f64| -> BTreeMap<String, Rigid> {
            (0..4).map(|i| (i.to_string(), pose(f64::from(i as u8) * 5.0, off(offs[i])))).collect()
        };
        let (estimated, exact) = (named(|off| off), named(|off| -off));
        let truth: BTreeMap<String, Rigid> =
            exact.iter().map(|(name, pose)| (name.clone(), mapped.transform_pose(pose))).collect();
        let alignment = Alignment::of_centres(&estimated, &truth).unwrap();
        assert!(alignment.error(&estimated["0"], &truth["0"]).rotation_deg > 90.0);
        let covariance = Matrix6::identity() * 1e-6;
        let error = alignment.normalized_error(&estimated["0"], &covariance, &truth["0"]).unwrap();
        // Four millimetres, of which the alignment takes a part.
        assert!(error.rotation < 0.1 && (0.5..6.0).contains(&error.position), "{error:?}");
    }

    #[test]
    fn two_images_align_a_component_and_one_does_not() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2);
        let mapped = Similarity { scale: 2.5, rotation: turn, translation: Vector3::new(4.0, 5.0, 6.0) };
        let pose = |x: f64| {
            let rotation = UnitQuaternion::from_euler_angles(0.1 * x, 0.2, -x);
            Rigid::new(rotation, Vector3::new(x, 0.3 * x, 0.0))
        };
        let named = |count: u8| -> BTreeMap<String, Rigid> {
            (0..count).map(|i| (i.to_string(), pose(f64::from(i)))).collect()
        };
        let truth: BTreeMap<String, Rigid> =
            named(4).iter().map(|(name, pose)| (name.clone(), mapped.transform_pose(pose))).collect();
        for count in [2, 3] {
            let estimated = named(count);
            let alignment = Alignment::of_component(&estimated, &truth).unwrap();
            let error = alignment.error(&pose(3.0), &truth["3"]);
            assert!(error.position_m < 1e-9 && error.rotation_deg < 1e-5, "{error:?}");
        }
        assert!(Alignment::of_component(&named(1), &truth).is_none());
        assert!(Alignment::of_component(&named(0), &truth).is_none());
        let together = named(2).keys().map(|name| (name.clone(), pose(1.0))).collect();
        assert!(Alignment::of_component(&together, &truth).is_none());
    }

    #[test]
    fn images_in_a_wrong_place_do_not_move_the_others() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.8, 1.2);
        let mapped = Similarity { scale: 2.5, rotation: turn, translation: Vector3::new(4.0, 5.0, 6.0) };
        let pose = |x: u32| {
            let x = f64::from(x);
            Rigid::new(
                UnitQuaternion::from_euler_angles(0.1 * x, 0.2, -x),
                Vector3::new(x, x * x / 10.0, 0.0),
            )
        };
        let estimated: BTreeMap<String, Rigid> = (0..10).map(|at| (at.to_string(), pose(at))).collect();
        let truth = |wrong: &[&str], by: f64| -> BTreeMap<String, Rigid> {
            let moved = |name: &str, pose: &Rigid| {
                let mut pose = mapped.transform_pose(pose);
                if wrong.contains(&name) {
                    pose.translation.z += by;
                }
                pose
            };
            estimated.iter().map(|(name, pose)| (name.clone(), moved(name, pose))).collect()
        };
        let far = truth(&["2", "7", "8"], 9.0);
        let alignment = Alignment::of_centres(&estimated, &far).unwrap();
        assert_eq!(alignment.misplaced(), ["2", "7", "8"]);
        let error = |name: &str| alignment.error(&estimated[name], &far[name]);
        assert!(error("3").position_m < 1e-9 && (error("7").position_m - 9.0).abs() < 1e-9);
        let normalized = alignment.normalized_error(&estimated["3"], &Matrix6::identity(), &far["3"]);
        assert!(normalized.unwrap().position < 1e-12);
        // A little off is an error as any other.
        let near = Alignment::of_centres(&estimated, &truth(&["2"], 0.3)).unwrap();
        assert!(near.misplaced().is_empty());
        assert!(near.error(&estimated["3"], &truth(&[], 0.0)["3"]).position_m > 0.005);
    }

    #[test]
    fn own_rotation_alignment_removes_a_turned_world() {
        let turn = UnitQuaternion::from_euler_angles(0.4, -0.2, 1.0);
        let pose = |i: u32| {
            Rigid::new(UnitQuaternion::from_euler_angles(0.0, 0.3 * f64::from(i), 0.1), Vector3::zeros())
        };
        let truth: BTreeMap<_, _> = (0..5).map(|i| (i.to_string(), pose(i))).collect();
        let moved = truth
            .iter()
            .map(|(name, p)| (name.clone(), Rigid::new(turn * p.rotation, p.translation)))
            .collect();
        assert!(own_rotation_errors_deg(&moved, &truth).iter().all(|error| *error < 1e-6));
    }
}
