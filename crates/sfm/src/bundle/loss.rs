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

    /// Whether the scale is usable.
    pub fn is_valid(self) -> bool {
        match self {
            Self::Trivial => true,
            Self::Huber(k) | Self::Cauchy(k) | Self::SoftL1(k) => k.is_finite() && k > 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
