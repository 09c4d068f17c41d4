use serde::{Deserialize, Serialize};

/// Robust loss ρ on a squared whitened residual s = ‖r‖²; the cost is ½ Σ ρ(s).
///
/// Scales are in units of the standard deviation. All losses have ρ(s) ≈ s near zero.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum RobustLoss {
    /// ρ(s) = s.
    #[default]
    Trivial,
    /// s up to k², 2k√s − k² beyond.
    Huber(f64),
    /// k² ln(1 + s/k²).
    Cauchy(f64),
    /// 2k² (√(1 + s/k²) − 1).
    SoftL1(f64),
}

impl RobustLoss {
    /// (ρ(s), ρ′(s)) for s ≥ 0.
    pub fn evaluate(self, s: f64) -> (f64, f64) {
        match self {
            Self::Trivial => (s, 1.0),
            Self::Huber(k) => {
                if s <= k * k {
                    (s, 1.0)
                } else {
                    let root = s.sqrt();
                    (2.0 * k * root - k * k, k / root)
                }
            }
            Self::Cauchy(k) => {
                let t = s / (k * k);
                (k * k * t.ln_1p(), 1.0 / (1.0 + t))
            }
            Self::SoftL1(k) => {
                // t / (√(1+t) + 1) is √(1+t) − 1 without cancellation.
                let t = s / (k * k);
                let root = (1.0 + t).sqrt();
                (2.0 * k * k * t / (root + 1.0), 1.0 / root)
            }
        }
    }

    /// ρ′(s) + s ρ″(s): half the trace of the second derivative of ½ρ(‖r‖²) by r, the mean of what it is along r and across it.
    pub(super) fn mean_curvature(self, s: f64) -> f64 {
        match self {
            Self::Trivial => 1.0,
            Self::Huber(k) => {
                if s <= k * k {
                    1.0
                } else {
                    0.5 * k / s.sqrt()
                }
            }
            Self::Cauchy(k) => (1.0 + s / (k * k)).powi(-2),
            Self::SoftL1(k) => (1.0 + 0.5 * s / (k * k)) * (1.0 + s / (k * k)).powf(-1.5),
        }
    }

    /// Whether the scale is usable.
    pub fn is_valid(self) -> bool {
        match self {
            Self::Trivial => true,
            Self::Huber(k) | Self::Cauchy(k) | Self::SoftL1(k) => k.is_finite() && k > 0.0,
        }
    }
}

/// Sum of ρ over many squared residuals.
///
/// The logarithms of the Cauchy loss, a tenth of an adjustment's time, are taken of products of many terms.
#[derive(Debug, Clone, Copy)]
pub(super) struct LossSum {
    loss: RobustLoss,
    sum: f64,
    /// Of 1 + s/k² since the last logarithm.
    product: f64,
}

/// Below this the logarithm of 1 + t is the beginning of its series; the product would lose what is left of t.
const SMALL: f64 = 1e-4;
/// Products are taken up to here, so that another term overflows in no sane problem.
const LARGE: f64 = 1e150;

impl LossSum {
    /// Nothing yet.
    pub fn new(loss: RobustLoss) -> Self {
        Self { loss, sum: 0.0, product: 1.0 }
    }

    /// Adds ρ(s); returns ρ′(s).
    #[inline]
    pub fn add(&mut self, s: f64) -> f64 {
        if let RobustLoss::Cauchy(k) = self.loss {
            let t = s / (k * k);
            if t < SMALL {
                self.sum += k * k * t * (1.0 - t * (0.5 - t / 3.0));
            } else {
                self.product *= 1.0 + t;
                if self.product > LARGE {
                    self.sum += k * k * self.product.ln();
                    self.product = 1.0;
                }
            }
            return 1.0 / (1.0 + t);
        }
        let (rho, weight) = self.loss.evaluate(s);
        self.sum += rho;
        weight
    }

    /// Σ ρ.
    pub fn total(&self) -> f64 {
        match self.loss {
            RobustLoss::Cauchy(k) => self.sum + k * k * self.product.ln(),
            _ => self.sum,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_curvature_is_half_the_trace_of_the_second_derivative() {
        let losses =
            [RobustLoss::Trivial, RobustLoss::Huber(1.5), RobustLoss::Cauchy(1.5), RobustLoss::SoftL1(1.5)];
        for loss in losses {
            for s in [0.0, 0.3, 1.0, 4.0, 50.0] {
                let slope = |s: f64| loss.evaluate(s).1;
                let second =
                    (slope(s + 1e-5) - slope((s - 1e-5).max(0.0))) / if s > 0.0 { 2e-5 } else { 1e-5 };
                let expected = slope(s) + s * second;
                assert!((loss.mean_curvature(s) - expected).abs() < 1e-6, "{loss:?} {s}");
            }
        }
    }

    #[test]
    fn a_sum_is_that_of_its_terms() {
        let terms = |at: u32| 1e-9 * 1.7_f64.powi(at as i32 % 90);
        for loss in [RobustLoss::Trivial, RobustLoss::Cauchy(0.5), RobustLoss::Huber(1.5)] {
            let (mut sum, mut expected) = (LossSum::new(loss), 0.0);
            for s in (0..500).map(terms) {
                let (rho, weight) = loss.evaluate(s);
                expected += rho;
                assert!((sum.add(s) - weight).abs() <= 1e-15);
            }
            assert!((sum.total() - expected).abs() <= 1e-12 * expected, "{loss:?}");
        }
        let mut sum = LossSum::new(RobustLoss::Cauchy(1.0));
        sum.add(f64::NAN);
        assert!(sum.total().is_nan());
    }

    #[test]
    fn derivative_matches_the_difference_quotient() {
        let losses =
            [RobustLoss::Trivial, RobustLoss::Huber(1.5), RobustLoss::Cauchy(2.0), RobustLoss::SoftL1(0.7)];
        for loss in losses {
            for s in [1e-3, 0.5, 2.0, 4.0, 100.0] {
                let h = 1e-5 * s;
                let numeric = (loss.evaluate(s + h).0 - loss.evaluate(s - h).0) / (2.0 * h);
                assert!((numeric - loss.evaluate(s).1).abs() < 1e-7, "{loss:?} at {s}");
            }
            assert!((loss.evaluate(1e-12).0 - 1e-12).abs() < 1e-22);
        }
    }

    #[test]
    fn rejects_scales_that_are_not_positive() {
        assert!(!RobustLoss::Huber(0.0).is_valid());
        assert!(!RobustLoss::Cauchy(f64::NAN).is_valid());
        assert!(RobustLoss::SoftL1(1.0).is_valid());
    }
}
