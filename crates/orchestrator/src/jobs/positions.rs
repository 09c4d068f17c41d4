//! What measured positions tell of a component's place, and how well they fix it.

use nalgebra::Vector2;
use setloc_sfm::{
    GeoregisterParams, Georegistration, ImageId, MeasuredPosition, MeasuredPositions, Reconstruction,
    georegister,
};

use super::model::image_of_place_holder;

/// Positions from which on their own deviations tell how well they fix a frame.
const MIN_POSITIONS: usize = 3;

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

/// How well some positions fix a frame.
///
/// Of positions at distances rᵢ from their middle, each off by σ in either direction, scale and heading have the
/// deviation σ / √Σrᵢ², and the middle σ / √n: what all are off together is in neither.
struct Fixed {
    /// How many agree with each other.
    count: usize,
    /// Metres round their middle within which they mostly are.
    within_m: f64,
    /// σ, and what follows from it; `None` where no more are than fix the frame.
    deviations: Option<Deviations>,
}

struct Deviations {
    noise_m: f64,
    /// Of the scale, as a share of it, and of the heading in radians.
    scale: f64,
    middle_m: f64,
}

impl Fixed {
    fn by(fixes: &[Fix]) -> Self {
        let used: Vec<&Fix> = fixes.iter().filter(|fix| fix.agrees).collect();
        let count = used.len().max(1) as f64;
        let middle = used.iter().map(|fix| fix.center).sum::<Vector2<f64>>() / count;
        let spread = used.iter().map(|fix| (fix.center - middle).norm_squared()).sum::<f64>().sqrt();
        let deviations = (used.len() >= MIN_POSITIONS).then(|| {
            // Of the two coordinates of each, four go into scale, heading and place.
            let freedom = (2 * used.len() - 4) as f64;
            let noise_m = (used.iter().map(|fix| fix.offset_m.powi(2)).sum::<f64>() / freedom).sqrt();
            Deviations { noise_m, scale: noise_m / spread, middle_m: noise_m / count.sqrt() }
        });
        Self { count: used.len(), within_m: 2.0 * spread / count.sqrt(), deviations }
    }
}

/// How many of `listed` images have positions, how far off these are, and how well they fix the frame.
pub(super) fn note(fixes: &[Fix], listed: usize) -> String {
    let mut metres: Vec<f64> = fixes.iter().map(|fix| fix.offset_m).collect();
    metres.sort_by(f64::total_cmp);
    let median = metres.get(metres.len() / 2).copied().unwrap_or_default();
    let positions = format!("positions: {} of {listed} images, median deviation {median:.2} m", fixes.len());
    match Fixed::by(fixes).deviations {
        Some(Deviations { scale, middle_m, .. }) => format!(
            "{positions}; if each is off by its own they fix scale to ± {:.2} %, heading to ± {:.2}° and place to ± \
             {middle_m:.2} m (one sigma)",
            100.0 * scale,
            scale.to_degrees()
        ),
        None => positions,
    }
}

/// Says that few positions, or such as lie close together for their noise, fix scale and heading.
pub(super) fn warning(fixes: &[Fix]) -> Option<String> {
    let Fixed { count, within_m, deviations } = Fixed::by(fixes);
    let Some(Deviations { noise_m, scale, .. }) = deviations else {
        return Some(format!(
            "{count} measured positions within {within_m:.1} m fix scale and heading, and nothing tells how far these are off"
        ));
    };
    (scale > POOR).then(|| {
        format!(
            "{count} measured positions within {within_m:.1} m fix scale and heading to ± {:.0} % and {:.0}° only: they are off by {noise_m:.1} m",
            100.0 * scale,
            scale.to_degrees()
        )
    })
}

#[cfg(test)]
mod tests {
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

    #[test]
    fn few_positions_and_noisy_ones_close_together_are_warned_of() {
        let said = |count, offset_m| warning(&row(count, offset_m));
        assert!(said(2, 0.0).unwrap().starts_with("2 measured positions within 2.0 m fix scale and heading"));
        let poor = said(3, 0.5).unwrap();
        assert!(poor.contains("within 3.3 m fix scale and heading to ± 22 % and 12° only"), "{poor}");
        assert!(poor.ends_with("they are off by 0.6 m"), "{poor}");
        assert_eq!(said(3, 0.02), None);
        assert_eq!(said(20, 0.5), None);
        let mut fixes = row(5, 0.1);
        assert_eq!(
            note(&fixes, 8),
            "positions: 5 of 8 images, median deviation 0.10 m; if each is off by its own they fix scale to ± 1.44 %, \
             heading to ± 0.83° and place to ± 0.04 m (one sigma)"
        );
        assert_eq!(note(&fixes[..2], 8), "positions: 2 of 8 images, median deviation 0.10 m");
        // Those that contradict the others fix nothing.
        fixes.iter_mut().skip(2).for_each(|fix| fix.agrees = false);
        assert!(warning(&fixes).unwrap().starts_with("2 measured positions"));
    }
}
