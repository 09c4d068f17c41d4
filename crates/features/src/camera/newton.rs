//! Inversion of curves that grow.

/// Steps after which the last place is taken.
const MAX_ITERATIONS: usize = 100;

/// The place between `low` and `high` where a growing curve has `value`, by Newton from `start` kept inside the bracket.
pub(super) fn invert_growing(
    value: f64,
    curve: impl Fn(f64) -> f64,
    slope: impl Fn(f64) -> f64,
    [mut low, mut high]: [f64; 2],
    start: f64,
) -> f64 {
    let mut place = start;
    for _ in 0..MAX_ITERATIONS {
        let residual = curve(place) - value;
        if residual > 0.0 {
            high = place;
        } else {
            low = place;
        }
        let newton = place - residual / slope(place);
        let next = if (low..=high).contains(&newton) { newton } else { f64::midpoint(low, high) };
        if (next - place).abs() <= 2.0 * f64::EPSILON * place {
            return next;
        }
        place = next;
    }
    place
}
