use nalgebra::{Const, DimMin, SMatrix, SVector};

/// A robust nonlinear least-squares problem of `D` parameters over independent terms.
pub(crate) trait LeastSquares<const D: usize> {
    /// What is estimated.
    type Model: Copy;

    /// Adds the terms' weighted JᵀJ and Jᵀr to `normal`; returns the robust cost.
    fn accumulate(&self, model: &Self::Model, normal: &mut Normal<D>) -> f64;

    /// The robust cost alone.
    fn cost(&self, model: &Self::Model) -> f64;

    /// Moves the model by a small step of its own parametrization.
    fn step(&self, model: &Self::Model, delta: &SVector<f64, D>) -> Self::Model;
}

/// Normal equations JᵀJ·δ = −Jᵀr.
pub(crate) struct Normal<const D: usize> {
    pub(crate) matrix: SMatrix<f64, D, D>,
    pub(crate) gradient: SVector<f64, D>,
}

impl<const D: usize> Normal<D> {
    pub(crate) fn zeros() -> Self {
        Self { matrix: SMatrix::zeros(), gradient: SVector::zeros() }
    }

    /// Adds one scalar residual with derivative `row` (1×D); only the lower triangle is kept.
    #[inline(always)]
    pub(crate) fn add(&mut self, value: f64, row: &SVector<f64, D>, weight: f64) {
        for j in 0..D {
            let weighted = row[j] * weight;
            self.gradient[j] += weighted * value;
            for i in j..D {
                self.matrix[(i, j)] += weighted * row[i];
            }
        }
    }
}

/// Cauchy loss c²·ln(1 + r²/c²) of a squared residual, and its weight.
#[inline(always)]
pub(crate) fn cauchy(squared: f64, inverse_scale_squared: f64) -> (f64, f64) {
    let ratio = squared * inverse_scale_squared;
    (ratio.ln_1p() / inverse_scale_squared, 1.0 / (1.0 + ratio))
}

/// Levenberg–Marquardt with Marquardt's diagonal damping; never returns a model of higher cost.
pub(crate) fn minimize<const D: usize, P: LeastSquares<D>>(
    problem: &P,
    initial: P::Model,
    max_steps: usize,
) -> P::Model
where
    Const<D>: DimMin<Const<D>, Output = Const<D>>,
{
    let mut model = initial;
    let mut damping = 1e-4;
    let mut normal = Normal::zeros();
    let mut cost = problem.accumulate(&model, &mut normal);
    for _ in 0..max_steps {
        let mut damped = normal.matrix;
        for k in 0..D {
            damped[(k, k)] += damping * damped[(k, k)] + 1e-300;
        }
        let Some(factor) = damped.cholesky() else {
            damping *= 100.0;
            continue;
        };
        let candidate = problem.step(&model, &-factor.solve(&normal.gradient));
        let next = problem.cost(&candidate);
        if next < cost {
            let done = cost - next <= 1e-10 * cost;
            model = candidate;
            damping = (damping * 0.1_f64).max(1e-12);
            if done {
                break;
            }
            normal = Normal::zeros();
            cost = problem.accumulate(&model, &mut normal);
        } else {
            if !(cost.is_finite() && damping < 1e6) || (next - cost).abs() <= 1e-12 * cost {
                break;
            }
            damping *= 10.0;
        }
    }
    model
}
