//! What measured positions tell of a component's place, and how well they fix it.

use nalgebra::Vector2;
use setloc_sfm::{
    FrameErrors, GeoregisterParams, Georegistration, ImageId, MeasuredPosition, MeasuredPositions,
    Reconstruction, georegister,
};

use super::model::image_of_place_holder;

/// Standard deviation of the scale, as a share of it, and of the heading, in radians, from which on they are called poor.
const POOR: f64 = 0.05;

/// Contradicting positions, a quarter of all at least, that cast doubt on a model.
const MANY_APART: usize = 3;

/// What was measured of some images' positions.
#[derive(Debug, Clone)]
pub(super) struct Measurements {
    pub params: GeoregisterParams,
    /// By image, as models' images are numbered by their names' place holders.
    pub positions: Vec<Option<MeasuredPosition>>,
    pub seed: u64,
}

impl Measurements {
    pub fn is_empty(&self) -> bool {
        self.positions.iter().all(Option::is_none)
    }

    /// The positions by a component's own numbers of its images.
    fn by_image(&self, component: &Reconstruction) -> Vec<Option<MeasuredPosition>> {
        let images = component.images.iter();
        images.map(|image| *self.positions.get(image_of_place_holder(&image.name)?)?).collect()
    }

    /// Moves a component into the measured frame, when positions were given and fix it.
    pub fn place(&self, component: &mut Reconstruction) -> Option<Georegistration> {
        if self.is_empty() {
            return None;
        }
        let upright: Vec<bool> = component
            .images
            .iter()
            .map(|image| component.cameras[image.camera.index()].is_panoramic())
            .collect();
        let measured = self.by_image(component);
        let placed = georegister(&self.params, component, &measured, &upright, self.seed)?;
        component.transform(&placed.enu_from_world);
        Some(placed)
    }

    /// The positions as part of a component's adjustment, where they have placed it.
    pub fn for_adjustment(
        &self,
        component: &Reconstruction,
        placed: Option<&Georegistration>,
    ) -> Option<MeasuredPositions> {
        placed.map(|_| MeasuredPositions { params: self.params.clone(), by_image: self.by_image(component) })
    }

    /// Says where the positions do not fix a component's place, or contradict it.
    pub fn warnings(&self, component: &Reconstruction, placed: Option<&Georegistration>) -> Vec<String> {
        if self.is_empty() {
            return Vec::new();
        }
        let Some(placed) = placed else {
            return vec![
                "the measured positions do not fix where the model lies: it keeps its own frame".to_owned(),
            ];
        };
        let name = |image: ImageId| component.images[image.index()].name.as_str();
        let apart = placed.residuals.iter().filter(|(.., agrees)| !agrees);
        let apart: Vec<(&str, f64)> = apart.map(|&(image, distance, _)| (name(image), distance)).collect();
        contradicted_positions(&apart, placed.residuals.len())
    }
}

/// Says which of `count` measured positions disagree with a model, by how many metres; where many do, that it may be the
/// model that is wrong.
fn contradicted_positions(apart: &[(&str, f64)], count: usize) -> Vec<String> {
    if apart.len() < MANY_APART || 4 * apart.len() < count {
        let unused = |(name, metres): &(&str, f64)| {
            format!("the measured position of {name} is {metres:.1} m off and hardly counts")
        };
        return apart.iter().map(unused).collect();
    }
    let each: Vec<String> = apart.iter().map(|(name, metres)| format!("{name} ({metres:.1} m)")).collect();
    vec![format!(
        "{} of {count} measured positions contradict the model and hardly count: it is folded, as where buildings repeat, or they are wrong: {}",
        apart.len(),
        each.join(", ")
    )]
}

/// An image of a placed component whose position was measured.
pub(super) struct Fix {
    /// East and north.
    center: Vector2<f64>,
    /// Horizontal distance to the measurement.
    offset_m: f64,
    /// Whether the measurement agrees with the others, and so counts.
    agrees: bool,
}

/// The measured images of a placed component, whose images are named by their places in `positions`.
pub(super) fn fixes(
    component: &Reconstruction,
    placed: &Georegistration,
    positions: &[Option<MeasuredPosition>],
) -> Vec<Fix> {
    let fix = |&(image, _, agrees): &(ImageId, f64, bool)| {
        let image = &component.images[image.index()];
        let measured = (*positions.get(image_of_place_holder(&image.name)?)?)?;
        let center = image.world_from_camera?.translation.xy();
        Some(Fix { center, offset_m: (center - measured.enu.xy()).norm(), agrees })
    };
    placed.residuals.iter().filter_map(fix).collect()
}

/// How many of `listed` images have positions, how far off these are, and how well they fix the frame.
pub(super) fn note(fixes: &[Fix], errors: Option<&FrameErrors>, listed: usize) -> String {
    let mut metres: Vec<f64> = fixes.iter().map(|fix| fix.offset_m).collect();
    metres.sort_by(f64::total_cmp);
    let median = metres.get(metres.len() / 2).copied().unwrap_or_default();
    let positions = format!("positions: {} of {listed} images, median deviation {median:.2} m", fixes.len());
    match errors {
        Some(errors) => format!("{positions}; {}", how_fixed(errors)),
        None => positions,
    }
}

/// How well measured positions fix a frame, in words.
pub fn how_fixed(errors: &FrameErrors) -> String {
    format!(
        "if each is off by its own they fix scale to ± {:.2} %, heading to ± {:.2}° and place to ± {:.2} m (one sigma)",
        100.0 * errors.scale(),
        errors.heading_rad().to_degrees(),
        errors.place_m()
    )
}

/// Says that few positions, or such as lie close together for their noise, fix scale and heading.
pub(super) fn warning(fixes: &[Fix], errors: Option<&FrameErrors>) -> Option<String> {
    let used: Vec<&Fix> = fixes.iter().filter(|fix| fix.agrees).collect();
    let (count, within_m) = (used.len(), within_m(&used));
    let Some(errors) = errors else {
        return Some(format!(
            "{count} measured positions within {within_m:.1} m fix scale and heading, and nothing tells how far these are off"
        ));
    };
    (errors.scale().max(errors.heading_rad()) > POOR).then(|| {
        format!(
            "{count} measured positions within {within_m:.1} m fix scale and heading to ± {:.0} % and {:.0}° only: they are off by {:.1} m",
            100.0 * errors.scale(),
            errors.heading_rad().to_degrees(),
            errors.noise_m
        )
    })
}

/// Metres round their middle within which positions mostly are.
fn within_m(fixes: &[&Fix]) -> f64 {
    let count = fixes.len().max(1) as f64;
    let middle = fixes.iter().map(|fix| fix.center).sum::<Vector2<f64>>() / count;
    let squares = fixes.iter().map(|fix| (fix.center - middle).norm_squared()).sum::<f64>();
    2.0 * (squares / count).sqrt()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix4, Vector3};

    use super::*;

    /// Images in a row, two metres apart.
    fn row(count: u32, offset_m: f64) -> Vec<Fix> {
        let fix = |at| Fix { center: Vector2::new(2.0 * f64::from(at), 7.0), offset_m, agrees: true };
        (0..count).map(fix).collect()
    }

    #[test]
    fn many_positions_that_contradict_a_model_cast_doubt_on_it() {
        let apart = [("a", 12.0), ("b", 16.06), ("c", 8.0)];
        let few = contradicted_positions(&apart[..2], 4);
        assert_eq!(few.len(), 2);
        assert_eq!(few[1], "the measured position of b is 16.1 m off and hardly counts");
        assert_eq!(contradicted_positions(&apart, 13).len(), 3);
        let many = contradicted_positions(&apart, 12);
        assert_eq!(many.len(), 1);
        assert!(many[0].starts_with("3 of 12 measured positions contradict the model"), "{many:?}");
        assert!(many[0].ends_with("a (12.0 m), b (16.1 m), c (8.0 m)"), "{many:?}");
        assert!(contradicted_positions(&[], 5).is_empty());
    }

    /// What they may be off as a whole.
    fn errors(place_m: f64, scale: f64, noise_m: f64) -> FrameErrors {
        FrameErrors {
            middle: Vector3::zeros(),
            noise_m,
            shift: Vector3::repeat(place_m * place_m),
            turn_and_scale: Matrix4::identity() * scale * scale,
        }
    }

    #[test]
    fn few_positions_and_noisy_ones_close_together_are_warned_of() {
        let few = warning(&row(2, 0.0), None).unwrap();
        assert!(few.starts_with("2 measured positions within 2.0 m fix scale and heading"), "{few}");
        let poor = warning(&row(3, 0.5), Some(&errors(0.4, 0.217, 0.61))).unwrap();
        assert!(poor.contains("within 3.3 m fix scale and heading to ± 22 % and 12° only"), "{poor}");
        assert!(poor.ends_with("they are off by 0.6 m"), "{poor}");
        assert_eq!(warning(&row(3, 0.02), Some(&errors(0.01, 0.01, 0.02))), None);
        let mut fixes = row(5, 0.1);
        assert_eq!(
            note(&fixes, Some(&errors(0.04, 0.0144, 0.1)), 8),
            "positions: 5 of 8 images, median deviation 0.10 m; if each is off by its own they fix scale to ± 1.44 %, \
             heading to ± 0.83° and place to ± 0.04 m (one sigma)"
        );
        assert_eq!(note(&fixes[..2], None, 8), "positions: 2 of 8 images, median deviation 0.10 m");
        // Those that contradict the others fix nothing.
        fixes.iter_mut().skip(2).for_each(|fix| fix.agrees = false);
        assert!(warning(&fixes, None).unwrap().starts_with("2 measured positions"));
    }
}
