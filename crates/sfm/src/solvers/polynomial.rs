use super::Solutions;

/// Bisections of the unit interval after which two roots count as one.
const MAX_BISECTIONS: u32 = 30;
/// Newton steps that end a root.
const MAX_NEWTON: u32 = 60;

/// Binomial coefficients C(n, k) for n below 16.
const BINOMIALS: [[f64; 16]; 16] = {
    let mut table = [[0.0; 16]; 16];
    let mut n = 0;
    while n < 16 {
        table[n][0] = 1.0;
        let mut k = 1;
        while k <= n {
            table[n][k] = table[n - 1][k - 1] + table[n - 1][k];
            k += 1;
        }
        n += 1;
    }
    table
};

#[inline]
fn evaluate<const N: usize>(f: &[f64; N], degree: usize, x: f64) -> (f64, f64) {
    let (mut value, mut slope) = (f[degree], 0.0);
    for k in (0..degree).rev() {
        slope = slope * x + value;
        value = value * x + f[k];
    }
    (value, slope)
}

/// The root between `low` and `high` where the values differ in sign: Newton, bisection when it leaves the bracket.
fn bracketed_newton<const N: usize>(
    f: &[f64; N],
    degree: usize,
    (mut low, mut high): (f64, f64),
    (at_low, at_high): (f64, f64),
) -> f64 {
    let low_negative = at_low < 0.0;
    let secant = low + (high - low) * at_low / (at_low - at_high);
    let mut x = if secant > low && secant < high { secant } else { 0.5 * (low + high) };
    for _ in 0..MAX_NEWTON {
        let (value, slope) = evaluate(f, degree, x);
        if value == 0.0 {
            return x;
        }
        if (value < 0.0) == low_negative {
            low = x;
        } else {
            high = x;
        }
        let mut next = x - value / slope;
        if !(next >= low && next <= high) {
            next = 0.5 * (low + high);
        }
        if (next - x).abs() <= 2.0 * f64::EPSILON * (next.abs() + 1e-3) {
            return next;
        }
        x = next;
    }
    x
}

/// Sign changes of a sequence; zero counts as positive, so that a root on a border belongs to one side.
#[inline]
fn changes(sequence: &[f64]) -> u32 {
    let mut changes = 0;
    let mut negative = sequence[0] < 0.0;
    for value in &sequence[1..] {
        changes += u32::from((*value < 0.0) != negative);
        negative = *value < 0.0;
    }
    changes
}

/// An interval of \[0, 1\] with the Bernstein coefficients of the polynomial on it.
#[derive(Clone, Copy)]
struct Interval<const N: usize> {
    coefficients: [f64; N],
    low: f64,
    width: f64,
    depth: u32,
    changes: u32,
}

/// Calls `found` with each root of `f` in \[0, 1\].
fn roots_in_unit_interval<const N: usize>(f: &[f64; N], degree: usize, mut found: impl FnMut(f64)) {
    let mut coefficients = [0.0; N];
    for k in 0..=degree {
        coefficients[k] = f[k] / BINOMIALS[degree][k];
    }
    for step in 0..degree {
        for k in (step + 1..=degree).rev() {
            coefficients[k] += coefficients[k - 1];
        }
    }
    let count = changes(&coefficients[..=degree]);
    let whole = Interval { coefficients, low: 0.0, width: 1.0, depth: 0, changes: count };
    // Subdivision never adds sign changes and intervals without any are not kept: at most N wait, but for rounding.
    let mut stack = [whole; N];
    let mut top = usize::from(count > 0);
    while top > 0 {
        top -= 1;
        let interval = stack[top];
        if interval.changes == 1 {
            let ends = (interval.coefficients[0], interval.coefficients[degree]);
            found(bracketed_newton(f, degree, (interval.low, interval.low + interval.width), ends));
            continue;
        }
        if interval.depth == MAX_BISECTIONS || top + 2 > N {
            found(interval.low + 0.5 * interval.width);
            continue;
        }
        // De Casteljau at the middle.
        let mut right = interval.coefficients;
        let mut left = [0.0; N];
        left[0] = right[0];
        for step in 1..=degree {
            for k in 0..=degree - step {
                right[k] = 0.5 * (right[k] + right[k + 1]);
            }
            left[step] = right[0];
        }
        let (width, depth) = (0.5 * interval.width, interval.depth + 1);
        for (coefficients, low) in [(right, interval.low + width), (left, interval.low)] {
            let changes = changes(&coefficients[..=degree]);
            if changes > 0 {
                stack[top] = Interval { coefficients, low, width, depth, changes };
                top += 1;
            }
        }
    }
}

/// Real roots of Σ coefficients\[k\]·xᵏ, ascending, without multiplicity.
///
/// Descartes' rule of signs on the Bernstein form isolates them (J. M. Lane, R. F. Riesenfeld, "Bounds on a polynomial",
/// BIT 1981), on \[−1, 1\] for the polynomial and for its reverse, so that neither small nor large roots cost accuracy;
/// safeguarded Newton finishes. Unlike Sturm's chain nothing is divided, so close and scattered roots are equally safe.
/// Negligible leading coefficients are dropped. Pairs that differ by less than about 1e-9, real or complex, may be
/// returned as one. At most `N` − 1 roots; `N` is at most 16.
pub fn real_roots<const N: usize>(coefficients: &[f64; N]) -> Solutions<f64, N> {
    const { assert!(N <= 16) };
    let mut roots = Solutions::default();
    let largest = coefficients.iter().fold(0.0_f64, |m, c| m.max(c.abs()));
    if !(largest > 0.0) || !largest.is_finite() {
        return roots;
    }
    let Some(degree) = coefficients.iter().rposition(|c| c.abs() > 1e-18 * largest) else {
        return roots;
    };
    if degree == 0 {
        return roots;
    }
    for sign in [1.0, -1.0] {
        let mut f = *coefficients;
        if sign < 0.0 {
            for value in f.iter_mut().skip(1).step_by(2) {
                *value = -*value;
            }
        }
        if changes(&f[..=degree]) == 0 {
            continue;
        }
        roots_in_unit_interval(&f, degree, |root| {
            roots.push(sign * root);
        });
        f[..=degree].reverse();
        roots_in_unit_interval(&f, degree, |root| {
            if root > 0.0 {
                roots.push(sign / root);
            }
        });
    }
    roots.sort_by_key(|root| *root);
    roots
}

#[cfg(test)]
mod tests {
    use super::real_roots;
    use proptest::prelude::*;

    fn expand<const N: usize>(roots: &[f64]) -> [f64; N] {
        let mut f = [0.0; N];
        f[0] = 1.0;
        for root in roots {
            for k in (0..N).rev() {
                f[k] = if k > 0 { f[k - 1] } else { 0.0 } - root * f[k];
            }
        }
        f
    }

    #[test]
    fn finds_clustered_and_huge_roots() {
        let truth = [-1.0e4, -2.0, -1.999, 0.0, 1e-6, 0.5, 0.5001, 3.0];
        let found = real_roots(&expand::<9>(&truth));
        assert_eq!(found.len(), truth.len(), "{found:?}");
        for (a, b) in found.iter().zip(truth) {
            assert!((a - b).abs() < 1e-8 * (1.0 + b.abs()), "{a} {b}");
        }
    }

    #[test]
    fn a_double_root_is_found_at_least_once() {
        let found = real_roots(&expand::<4>(&[0.7, 0.7, -2.0]));
        assert!((2..=3).contains(&found.len()), "{found:?}");
        assert!((found[0] + 2.0).abs() < 1e-12);
        assert!(found[1..].iter().all(|root| (root - 0.7).abs() < 1e-6));
    }

    #[test]
    fn finds_nothing_where_nothing_is() {
        assert!(real_roots(&[1.0, 0.0, 1.0]).is_empty());
        assert!(real_roots(&[3.0, 0.0, 0.0]).is_empty());
        assert!(real_roots(&[0.0, 0.0, 0.0]).is_empty());
    }

    proptest! {
        #[test]
        fn every_separated_root_is_found(mut truth in prop::collection::vec(-3.0_f64..3.0, 6), c in 0.1_f64..2.0) {
            truth.sort_by(f64::total_cmp);
            prop_assume!(truth.windows(2).all(|pair| pair[1] - pair[0] > 0.02));
            // Times x² + c, which adds no real root.
            let base = expand::<9>(&truth);
            let mut f = [0.0; 9];
            for k in 0..9 {
                f[k] = c * base[k] + if k >= 2 { base[k - 2] } else { 0.0 };
            }
            let found = real_roots(&f);
            prop_assert_eq!(found.len(), truth.len());
            for (a, b) in found.iter().zip(&truth) {
                prop_assert!((a - b).abs() < 1e-7);
            }
        }
    }
}
