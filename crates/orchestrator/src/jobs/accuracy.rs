//! How well the poses of a model are known, in words.

use nalgebra::Vector3;
use setloc_sfm::{ImageId, ModelErrors, PoseDeviation, Reconstruction, listed};

/// Deviation of a centre, as a share of the distance to the nearest other one, from which on it is warned of. Of 33 models of
/// rendered floors those that were right had at most 0.007, panoramas 0.2–8 m off mostly 0.03 and more.
const WEAK: f64 = 0.02;
/// As much is not known at all.
const UNKNOWN: f64 = 1.0;
/// Images that are named where a warning is of many.
const MAX_NAMED: usize = 8;

/// How well each image's pose is known.
pub(super) struct Accuracy {
    images: Vec<Known>,
}

struct Known {
    image: ImageId,
    sigma: PoseDeviation,
    /// Deviation of the centre over the distance to the nearest other one, or half of what that is in the median.
    share: f64,
}

impl Accuracy {
    /// That of a model by what it may be off; `None` of fewer than two images.
    pub fn of_model(model: &Reconstruction, errors: &ModelErrors) -> Option<Self> {
        let center = |image: ImageId| Some(model.images.get(image.index())?.world_from_camera?.translation);
        let centers: Vec<(ImageId, Vector3<f64>)> =
            model.registered().filter_map(|image| Some((image, center(image)?))).collect();
        let nearest = |&(image, center): &(ImageId, Vector3<f64>)| {
            let others = centers.iter().filter(|(other, _)| *other != image);
            others.map(|(_, other)| (other - center).norm()).min_by(f64::total_cmp)
        };
        let steps: Vec<f64> = centers.iter().filter_map(nearest).collect();
        let mut sorted = steps.clone();
        sorted.sort_by(f64::total_cmp);
        // Some are of one place.
        let least = sorted.get(sorted.len() / 2)? / 2.0;
        let known = |(&(image, _), step): (&(ImageId, _), &f64)| {
            let sigma = errors.deviation(model, image)?;
            Some(Known { image, sigma, share: sigma.center / step.max(least) })
        };
        let images: Vec<Known> = centers.iter().zip(&steps).filter_map(known).collect();
        (images.len() >= 2).then_some(Self { images })
    }

    /// The medians, and the image that is known least.
    pub fn note(&self, model: &Reconstruction, unit: &str) -> Option<String> {
        let mut known: Vec<&Known> = self.images.iter().filter(|known| known.share < UNKNOWN).collect();
        known.sort_by(|a, b| a.sigma.rotation_rad.total_cmp(&b.sigma.rotation_rad));
        let degrees = known.get(known.len() / 2)?.sigma.rotation_rad.to_degrees();
        known.sort_by(|a, b| a.sigma.center.total_cmp(&b.sigma.center));
        let (median, most) = (known.get(known.len() / 2)?, known.last()?);
        Some(format!(
            "relative to each other poses are known to {}{unit} and {degrees:.3}° (one sigma, medians; {} to {}{unit}), \
             unless the model is folded",
            significant(median.sigma.center),
            model.images[most.image.index()].name,
            significant(most.sigma.center)
        ))
    }

    /// The images whose places are hardly held, or by what contradicts itself.
    pub fn warning(&self, model: &Reconstruction) -> Option<String> {
        // What is no number is not known either.
        let mut weak: Vec<&Known> = self.images.iter().filter(|known| !(known.share <= WEAK)).collect();
        weak.sort_by(|a, b| b.share.total_cmp(&a.share));
        let named = weak.iter().map(|known| {
            let name = &model.images[known.image.index()].name;
            if known.share < UNKNOWN {
                format!("{name} (± {:.0} %)", 100.0 * known.share)
            } else {
                name.clone() + " (not at all)"
            }
        });
        (!weak.is_empty()).then(|| {
            format!(
                "what holds these images is weak or contradicts itself, and they may be misplaced (one sigma, of the distance to \
                 the nearest other): {}",
                listed(&named.collect::<Vec<_>>(), MAX_NAMED)
            )
        })
    }
}

/// Two digits of a length that may have any unit.
fn significant(length: f64) -> String {
    let digits = if length > 0.0 { (1.0 - length.log10().floor()).clamp(0.0, 9.0) } else { 0.0 };
    format!("{length:.*}", digits as usize)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use setloc_sfm::{CameraId, ReconstructionImage, Rigid};

    use super::*;

    /// Three images a unit apart, of which draws move the last by `off` and the others by a thousandth.
    fn accuracy(off: f64) -> (Reconstruction, Accuracy) {
        let pose =
            |at: usize, by: f64| Rigid::new(UnitQuaternion::identity(), Vector3::new(at as f64, by, 0.0));
        let image = |at: usize| ReconstructionImage {
            name: ["a", "b", "c"][at].to_owned(),
            camera: CameraId(0),
            world_from_camera: Some(pose(at, 0.0)),
        };
        let model = Reconstruction { images: (0..3).map(image).collect(), ..Reconstruction::default() };
        let draw = |sign: f64| {
            [0.001, 0.001, off].iter().enumerate().map(|(at, by)| Some(pose(at, by * sign))).collect()
        };
        let errors =
            ModelErrors::new(0.0, (0..16).map(|at| draw(if at % 2 == 0 { 1.0 } else { -1.0 })).collect());
        let accuracy = Accuracy::of_model(&model, &errors).unwrap();
        (model, accuracy)
    }

    #[test]
    fn what_is_hardly_held_is_named() {
        let warning = |off| {
            let (model, accuracy) = accuracy(off);
            accuracy.warning(&model)
        };
        let note = |off, unit| {
            let (model, accuracy) = accuracy(off);
            accuracy.note(&model, unit).unwrap()
        };
        assert_eq!(warning(0.002), None);
        assert!(note(0.002, " m").contains("known to 0.0012 m and 0.000°"));
        assert!(note(0.002, " m").contains("c to 0.0023 m"));
        assert!(warning(0.05).unwrap().ends_with(": c (± 6 %)"));
        for nowhere in [1e9, f64::INFINITY, f64::NAN] {
            assert!(warning(nowhere).unwrap().ends_with(": c (not at all)"), "{nowhere}");
            assert!(note(nowhere, "").contains("b to 0.0012"), "{nowhere}");
        }
    }

    #[test]
    fn lengths_have_two_digits() {
        assert_eq!(
            [0.0, 0.001_234, 0.0996, 1.26, 127.0].map(significant),
            ["0", "0.0012", "0.100", "1.3", "127"]
        );
    }
}
