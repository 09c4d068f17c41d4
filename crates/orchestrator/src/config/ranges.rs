//! What values parameters may have.

use std::fmt;

/// The values that a number may take; infinities and NaN never.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Range {
    /// Any number.
    Any,
    /// Above zero.
    Positive,
    /// Zero or more.
    NotNegative,
    /// Zero to one.
    Share,
    /// Above zero, at most one.
    PositiveShare,
    /// From this on.
    From(f64),
    /// From one to the other.
    Within(f64, f64),
}

impl Range {
    fn holds(self, value: f64) -> bool {
        value.is_finite()
            && match self {
                Self::Any => true,
                Self::Positive => value > 0.0,
                Self::NotNegative => value >= 0.0,
                Self::Share => (0.0..=1.0).contains(&value),
                Self::PositiveShare => value > 0.0 && value <= 1.0,
                Self::From(least) => value >= least,
                Self::Within(least, most) => (least..=most).contains(&value),
            }
    }
}

impl fmt::Display for Range {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => formatter.write_str("a number"),
            Self::Positive => formatter.write_str("above 0"),
            Self::NotNegative => formatter.write_str("0 or more"),
            Self::Share => formatter.write_str("0 to 1"),
            Self::PositiveShare => formatter.write_str("above 0, at most 1"),
            Self::From(least) => write!(formatter, "{least} or more"),
            Self::Within(least, most) => write!(formatter, "{least} to {most}"),
        }
    }
}

/// Keys, or their ends, with the values allowed; the longest that fits counts.
const RANGES: &[(&str, Range)] = &[
    ("features.max_features", Range::Within(1.0, 1e6)),
    ("features.max_side", Range::Within(32.0, 32_768.0)),
    ("features.enlargement", Range::Within(1.0, 4.0)),
    ("features.contrast_threshold", Range::Positive),
    ("features.min_features", Range::NotNegative),
    ("features.edge_threshold", Range::Positive),
    ("features.octave_layers", Range::Within(1.0, 10.0)),
    ("features.sigma_px", Range::Within(0.5, 10.0)),
    ("features.even_share", Range::Share),
    ("features.nadir_cone_deg", Range::Within(0.0, 90.0)),
    ("simulated_tilt", Range::Within(1.0, 8.0)),
    ("features.faint_tilt", Range::Within(1.0, 8.0)),
    ("pairs.exhaustive_up_to", Range::NotNegative),
    ("pairs.window", Range::NotNegative),
    ("pairs.nearest", Range::NotNegative),
    ("pairs.alike", Range::NotNegative),
    ("matching.max_distance", Range::Within(1e-6, std::f64::consts::SQRT_2 + 1e-9)),
    ("matching.screen_features", Range::NotNegative),
    ("matching.screen_matches", Range::NotNegative),
    ("matching.simulate_below", Range::NotNegative),
    ("ratio", Range::PositiveShare),
    ("two_view.min_inliers", Range::From(6.0)),
    ("two_view.min_parallax_deg", Range::Within(0.0, 180.0)),
    ("two_view.max_iterations", Range::Within(50.0, 1e9)),
    ("two_view.max_upright_iterations", Range::Within(50.0, 1e9)),
    ("two_view.max_tilted_iterations", Range::Within(50.0, 1e9)),
    ("two_view.max_rotation_misfit", Range::From(1.0)),
    ("two_view.max_geometries", Range::From(1.0)),
    ("max_error_sigma", Range::Positive),
    ("max_error_sigmas", Range::Positive),
    ("share", Range::Share),
    ("recall", Range::Share),
    ("loss_sigma", Range::Positive),
    ("sfm.min_triangulation_angle_deg", Range::Within(0.0, 90.0)),
    ("sfm.min_initial_points", Range::From(5.0)),
    ("sfm.min_initial_parallax_deg", Range::Within(0.0, 180.0)),
    ("sfm.max_initial_pairs", Range::From(1.0)),
    ("sfm.min_registration_inliers", Range::From(4.0)),
    ("sfm.min_confirmed_inliers", Range::From(1.0)),
    ("sfm.min_visibility_coverage", Range::Share),
    ("sfm.min_visible_points", Range::NotNegative),
    ("sfm.min_turn_matches", Range::From(3.0)),
    ("sfm.max_pair_rotation_deg", Range::Within(0.0, 180.0)),
    ("sfm.min_pair_agreement", Range::Share),
    ("sfm.max_pose_hypotheses", Range::From(1.0)),
    ("sfm.local_bundle_images", Range::NotNegative),
    ("sfm.global_bundle_growth", Range::From(1.0)),
    ("alignment.spacing", Range::Positive),
    ("alignment.max_shift_sigma", Range::Positive),
    ("alignment.noise_floor_px", Range::NotNegative),
    ("alignment.noise_factor", Range::Positive),
    ("alignment.max_iterations", Range::From(1.0)),
    ("alignment.patch.radius", Range::Within(2.0, 50.0)),
    ("alignment.patch.max_iterations", Range::From(1.0)),
    ("alignment.patch.min_correlation", Range::Share),
    ("alignment.patch.max_distortion", Range::Positive),
    ("quality.max_rotation_deg", Range::Within(0.0, 180.0)),
    ("quality.min_shared_view", Range::Share),
    ("quality.min_expected_points", Range::NotNegative),
    ("quality.min_image_points", Range::NotNegative),
    ("georegistration.gps_sigma_m", Range::Positive),
    ("georegistration.height_factor", Range::Positive),
    ("index.exact_below", Range::NotNegative),
    ("index.recall_queries", Range::From(1.0)),
    ("index.max_candidates", Range::From(2.0)),
    ("index.seed", Range::NotNegative),
    ("single.covisible_images", Range::NotNegative),
    ("single.max_samples", Range::From(50.0)),
    ("guided.radius_px", Range::Positive),
    ("guided.max_view_angle_rad", Range::Within(0.0, std::f64::consts::PI)),
    ("guided.max_scale_factor", Range::From(1.0)),
    ("guided.slack", Range::From(1.0)),
    ("verdict.min_inliers", Range::From(4.0)),
    ("verdict.min_cells", Range::Within(0.0, 64.0)),
    ("verdict.max_log10_false_alarms", Range::Any),
    ("verdict.max_runner_up", Range::NotNegative),
    ("verdict.max_center_sigma", Range::Positive),
    ("verdict.max_rotation_sigma_rad", Range::Positive),
    ("verdict.min_link", Range::NotNegative),
    ("camset.drift_px", Range::NotNegative),
    ("camset.rounds", Range::NotNegative),
    ("camset.views.max_images", Range::NotNegative),
    ("camset.views.min_inliers", Range::From(6.0)),
    ("growth.min_photos", Range::From(2.0)),
    ("growth.min_parallax_deg", Range::Within(0.0, 180.0)),
    ("growth.max_point_sigma", Range::Positive),
];

/// The range of a key: that of the longest end of it that ends at a `.` or `_`.
fn range_of(key: &str) -> Option<Range> {
    let fits = |end: &str| {
        key.strip_suffix(end).is_some_and(|start| start.is_empty() || start.ends_with(['.', '_']))
    };
    RANGES.iter().filter(|(end, _)| fits(end)).max_by_key(|(end, _)| end.len()).map(|&(_, range)| range)
}

/// Every number in a table that is out of its range: its key, and what is wrong in words.
pub(super) fn violations(table: &toml::Table) -> Vec<(String, String)> {
    let mut found = Vec::new();
    visit(table, "", &mut |key, value| {
        if let Some(range) = range_of(key).filter(|range| !range.holds(value)) {
            found.push((key.to_owned(), format!("`{key}` is {value}, expected {range}")));
        }
    });
    found
}

fn visit(table: &toml::Table, prefix: &str, each: &mut impl FnMut(&str, f64)) {
    for (name, value) in table {
        let key = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        match value {
            toml::Value::Table(inner) => visit(inner, &key, each),
            toml::Value::Integer(number) => each(&key, *number as f64),
            toml::Value::Float(number) => each(&key, *number),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Config;
    use super::*;

    #[test]
    fn every_number_has_a_range_that_holds_its_default() {
        let table = toml::Table::try_from(Config::default()).unwrap();
        let mut keys = 0;
        visit(&table, "", &mut |key, value| {
            let range = range_of(key).unwrap_or_else(|| panic!("`{key}` has no range"));
            assert!(range.holds(value), "`{key}` is {value}, expected {range}");
            keys += 1;
        });
        assert!(keys > 80, "{keys}");
        assert_eq!(violations(&table), []);
    }

    #[test]
    fn the_longest_end_that_is_a_whole_word_counts() {
        assert_eq!(range_of("camset.reverse_ratio"), Some(Range::PositiveShare));
        assert_eq!(range_of("two_view.max_error_sigma"), Some(Range::Positive));
        assert_eq!(range_of("photos.simulated_tilt"), Some(Range::Within(1.0, 8.0)));
        assert_eq!(range_of("sfm.aspectratio"), None);
    }
}
