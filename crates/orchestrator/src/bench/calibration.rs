use nalgebra::{Matrix3, Matrix6, Vector3};
use serde::Serialize;

/// What 95 % of squared distances Σ⁻¹ of three coordinates are below: χ² with 3 degrees of freedom.
const CHI_SQUARED_95: f64 = 7.814_727_903_251_178;

/// A pose's error in what its covariance states: mean squared normalized error per coordinate, 1 where it states the
/// truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NormalizedError {
    /// eᵀ Σ⁻¹ e / 3 of the centre.
    pub position: f64,
    /// The same of the rotation vector in the camera's frame.
    pub rotation: f64,
}

impl NormalizedError {
    /// Of a rotation vector (camera's frame, radians) and a centre's error (scene units), with the covariance of
    /// both; `None` where that is not positive definite.
    pub fn of(rotation: &Vector3<f64>, center: &Vector3<f64>, covariance: &Matrix6<f64>) -> Option<Self> {
        let normalized = |error: &Vector3<f64>, start: usize| {
            let block: Matrix3<f64> = covariance.fixed_view::<3, 3>(start, start).into_owned();
            Some(error.dot(&block.cholesky()?.solve(error)) / 3.0)
        };
        Some(Self { position: normalized(center, 3)?, rotation: normalized(rotation, 0)? })
    }

    /// Whether the true centre lies in the stated 95 % ellipsoid.
    pub fn holds_the_centre(&self) -> bool {
        3.0 * self.position <= CHI_SQUARED_95
    }
}

/// How stated covariances compare with errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Calibration {
    /// Photos with a covariance and truth.
    pub photos: usize,
    /// Those whose true centre lies in the 95 % ellipsoid.
    pub within_95: usize,
    /// Means of the photos' normalized errors.
    pub mean: NormalizedError,
}

impl Calibration {
    /// Of some photos, `None` of none.
    pub fn of(errors: impl IntoIterator<Item = NormalizedError>) -> Option<Self> {
        let errors: Vec<NormalizedError> = errors.into_iter().collect();
        let count = errors.len();
        let mean = |of: fn(&NormalizedError) -> f64| errors.iter().map(of).sum::<f64>() / count as f64;
        (count > 0).then(|| Self {
            photos: count,
            within_95: errors.iter().filter(|error| error.holds_the_centre()).count(),
            mean: NormalizedError { position: mean(|e| e.position), rotation: mean(|e| e.rotation) },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_of_one_deviation_in_each_coordinate_is_one() {
        let sigmas = [0.01, 0.02, 0.03, 1.0, 2.0, 4.0];
        let covariance = Matrix6::from_diagonal(&nalgebra::Vector6::from(sigmas).map(|sigma| sigma * sigma));
        let error = |by: f64| {
            let (rotation, center) = (Vector3::new(0.01, -0.02, 0.03), by * Vector3::new(1.0, 2.0, -4.0));
            NormalizedError::of(&rotation, &center, &covariance).unwrap()
        };
        let one = error(1.0);
        assert!((one.position - 1.0).abs() < 1e-12 && (one.rotation - 1.0).abs() < 1e-12);
        assert!(error(1.61).holds_the_centre() && !error(1.62).holds_the_centre());
        let both = Calibration::of([one, error(2.0)]).unwrap();
        assert_eq!((both.photos, both.within_95), (2, 1));
        assert!((both.mean.position - 2.5).abs() < 1e-12);
        assert!(Calibration::of([]).is_none());
        assert!(NormalizedError::of(&Vector3::zeros(), &Vector3::zeros(), &Matrix6::zeros()).is_none());
    }
}
