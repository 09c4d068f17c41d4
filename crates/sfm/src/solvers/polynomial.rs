use super::Solutions;

/// Bisections after which two roots count as one.
const MAX_BISECTIONS: u32 = 60;
/// Newton steps that end a root.
const MAX_NEWTON: u32 = 60;

/// Sturm chain in the form f₍k₎ = (aₖ·x + bₖ)·f₍k+1₎ − cₖ·f₍k+2₎, so that one evaluation costs O(degree).
struct SturmChain<const N: usize> {
    quotients: [[f64; 3]; N],
    tail: f64,
    len: usize,
}

impl<const N: usize> SturmChain<N> {
    /// Chain of `f` (ascending, of degree `degree`, monic).
    fn new(f: &[f64; N], degree: usize) -> Self {
        let mut upper = *f;
        let mut lower = [0.0; N];
        for k in 1..=degree {
            lower[k - 1] = f[k] * k as f64 / degree as f64;
        }
        let mut quotients = [[0.0; 3]; N];
        let mut len = 0;
        let mut d = degree;
        // `upper` has degree d and `lower` degree d − 1, both with known leading coefficients.
        while d >= 2 {
            let a = upper[d] / lower[d - 1];
            let b = (upper[d - 1] - a * lower[d - 2]) / lower[d - 1];
            let mut rest = [0.0; N];
            rest[0] = b * lower[0] - upper[0];
            for k in 1..d - 1 {
                rest[k] = a * lower[k - 1] + b * lower[k] - upper[k];
            }
            let c = rest[d - 2].abs();
            // A common factor: the chain ends here, and repeated roots are counted once.
            if !(c > 1e-280) {
                quotients[len] = [a, b, 0.0];
                len += 1;
                return Self { quotients, tail: lower[d - 1].signum(), len };
            }
            let scale = 1.0 / c;
            for value in &mut rest[..d - 1] {
                *value *= scale;
            }
            quotients[len] = [a, b, c];
            len += 1;
            upper = lower;
            lower = rest;
            d -= 1;
        }
        quotients[len] = [upper[1] / lower[0], upper[0] / lower[0], 0.0];
        Self { quotients, tail: lower[0], len: len + 1 }
    }

    /// Sign changes of the chain at `x`.
    #[inline]
    fn changes(&self, x: f64) -> u32 {
        let (mut below, mut here) = (0.0, self.tail);
        let mut changes = 0;
        for [a, b, c] in self.quotients[..self.len].iter().rev() {
            let above = (a * x + b) * here - c * below;
            changes += u32::from((above < 0.0) != (here < 0.0));
            below = here;
            here = above;
        }
        changes
    }
}

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
fn bracketed_newton<const N: usize>(f: &[f64; N], degree: usize, mut low: f64, mut high: f64) -> f64 {
    let low_negative = evaluate(f, degree, low).0 < 0.0;
    let mut x = 0.5 * (low + high);
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
        if !(next > low && next < high) {
            next = 0.5 * (low + high);
        }
        if (next - x).abs() <= 4.0 * f64::EPSILON * next.abs() {
            return next;
        }
        x = next;
    }
    x
}

/// Real roots of Σ coefficients\[k\]·xᵏ, ascending, without multiplicity.
///
/// Sturm's theorem isolates them (J. C. F. Sturm, 1829; as used for minimal problems by D. Nistér, "An efficient
/// solution to the five-point relative pose problem", PAMI 2004, section 3.2.4), safeguarded Newton finishes. Leading
/// coefficients that are negligible relative to the largest are dropped. Roots that bisection cannot part are
/// returned once. At most `N` − 1 roots.
pub fn real_roots<const N: usize>(coefficients: &[f64; N]) -> Solutions<f64, N> {
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
    let mut f = [0.0; N];
    let leading = 1.0 / coefficients[degree];
    for k in 0..=degree {
        f[k] = coefficients[k] * leading;
    }
    if degree == 1 {
        roots.push(-f[0]);
        return roots;
    }
    let chain = SturmChain::new(&f, degree);
    // Cauchy's bound 1 + max|aₖ|, against Fujiwara's costs no roots of higher order.
    let bound = 1.0 + f[..degree].iter().fold(0.0_f64, |m, c| m.max(c.abs()));
    let mut stack = [(0.0, 0.0, 0, 0, 0); N];
    stack[0] = (-bound, bound, chain.changes(-bound), chain.changes(bound), 0);
    let mut top = 1;
    while top > 0 {
        top -= 1;
        let (low, high, changes_low, changes_high, depth) = stack[top];
        if changes_low <= changes_high {
            continue;
        }
        if changes_low == changes_high + 1 {
            let (at_low, at_high) = (evaluate(&f, degree, low).0, evaluate(&f, degree, high).0);
            if (at_low < 0.0) != (at_high < 0.0) {
                roots.push(bracketed_newton(&f, degree, low, high));
                continue;
            }
        }
        let middle = split(low, high);
        if depth == MAX_BISECTIONS || !(middle > low && middle < high) {
            roots.push(middle);
            continue;
        }
        let changes = chain.changes(middle);
        // The right half waits on the stack, so that roots come out ascending. Depth-first search keeps at most one
        // waiting interval per root.
        if top + 2 > N {
            break;
        }
        stack[top] = (middle, high, changes, changes_high, depth + 1);
        stack[top + 1] = (low, middle, changes_low, changes, depth + 1);
        top += 2;
    }
    roots
}

/// Where to cut an interval: the geometric mean of its magnitudes when these differ much.
#[inline]
fn split(low: f64, high: f64) -> f64 {
    if low < -1.0 && high > 1.0 {
        0.0
    } else if low >= 0.0 && high > 4.0 * low.max(1.0) {
        (low.max(0.25) * high).sqrt()
    } else if high <= 0.0 && -low > 4.0 * (-high).max(1.0) {
        -((-high).max(0.25) * -low).sqrt()
    } else {
        0.5 * (low + high)
    }
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
        assert_eq!(found.len(), truth.len());
        for (a, b) in found.iter().zip(truth) {
            assert!((a - b).abs() < 1e-8 * (1.0 + b.abs()), "{a} {b}");
        }
    }

    #[test]
    fn returns_a_double_root_once() {
        let found = real_roots(&expand::<4>(&[1.0, 1.0, -2.0]));
        assert_eq!(found.len(), 2);
        assert!((found[0] + 2.0).abs() < 1e-12 && (found[1] - 1.0).abs() < 1e-6);
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
