//! What measured positions tell of a component's place, and how well they fix it.

use nalgebra::Vector2;
use setloc_sfm::{Georegistration, ImageId, MeasuredPosition, Reconstruction};

use super::model::image_of_place_holder;

/// Positions from which on their own deviations tell how well they fix a frame.
const MIN_POSITIONS: usize = 3;

/// Standard deviation of the scale, as a share of it, and of the heading, in radians, from which on they are called poor.
const POOR: f64 = 0.05;

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

/// How many of `listed` images have positions, and how far off these are.
pub(super) fn note(fixes: &[Fix], listed: usize) -> String {
    let mut metres: Vec<f64> = fixes.iter().map(|fix| fix.offset_m).collect();
    metres.sort_by(f64::total_cmp);
    let median = metres.get(metres.len() / 2).copied().unwrap_or_default();
    format!("positions: {} of {listed} images, median deviation {median:.2} m", fixes.len())
}

/// Says that few positions, or such as lie close together for their noise, fix scale and heading.
///
/// Of positions at distances rᵢ from their middle, each off by σ in either direction, scale and heading have the
/// deviation σ / √Σrᵢ².
pub(super) fn warning(fixes: &[Fix]) -> Option<String> {
    let used: Vec<&Fix> = fixes.iter().filter(|fix| fix.agrees).collect();
    let middle = used.iter().map(|fix| fix.center).sum::<Vector2<f64>>() / used.len().max(1) as f64;
    let spread = used.iter().map(|fix| (fix.center - middle).norm_squared()).sum::<f64>().sqrt();
    let within = 2.0 * spread / (used.len().max(1) as f64).sqrt();
    if used.len() < MIN_POSITIONS {
        return Some(format!(
            "{} measured positions within {within:.1} m fix scale and heading, and nothing tells how far these are off",
            used.len()
        ));
    }
    // Of the two coordinates of each, four go into scale, heading and place.
    let freedom = (2 * used.len() - 4) as f64;
    let noise = (used.iter().map(|fix| fix.offset_m.powi(2)).sum::<f64>() / freedom).sqrt();
    let deviation = noise / spread;
    (deviation > POOR).then(|| {
        format!(
            "{} measured positions within {within:.1} m fix scale and heading to ± {:.0} % and {:.0}° only: they are off by {noise:.1} m",
            used.len(),
            100.0 * deviation,
            deviation.to_degrees()
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
    fn few_positions_and_noisy_ones_close_together_are_warned_of() {
        let said = |count, offset_m| warning(&row(count, offset_m));
        assert!(said(2, 0.0).unwrap().starts_with("2 measured positions within 2.0 m fix scale and heading"));
        let poor = said(3, 0.5).unwrap();
        assert!(poor.contains("within 3.3 m fix scale and heading to ± 22 % and 12° only"), "{poor}");
        assert!(poor.ends_with("they are off by 0.6 m"), "{poor}");
        assert_eq!(said(3, 0.02), None);
        assert_eq!(said(20, 0.5), None);
        let mut fixes = row(5, 0.1);
        assert_eq!(note(&fixes, 8), "positions: 5 of 8 images, median deviation 0.10 m");
        // Those that contradict the others fix nothing.
        fixes.iter_mut().skip(2).for_each(|fix| fix.agrees = false);
        assert!(warning(&fixes).unwrap().starts_with("2 measured positions"));
    }
}
