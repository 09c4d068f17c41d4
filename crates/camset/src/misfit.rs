//! Whether a photo is as its lens makes it: not stretched, sheared or cut from the side of a larger picture.
//!
//! A camera that no such picture has is fitted by a pose aside, with matches of its own that agree with it. What is left of the
//! residuals then changes smoothly over the picture, where noise does not.

use std::fmt;

use nalgebra::{SMatrix, SVector};
use setloc_index::SceneIndex;
use setloc_sfm::Rigid;

use crate::SceneMatch;
use crate::evidence::PhotoRays;

/// Terms of a polynomial of second degree in two variables.
const TERMS: usize = 6;
/// F statistic from which on what residuals have in common is more than noise and what a scene is bent by. Photos of rendered scenes that
/// stand right have up to 1.4 alone and 1.3 in their sets, photos cut from stitched panoramas, among such, up to 3.6; photos that are 7 % too
/// low or sheared by 1.5 %, or of a picture that is seen aslant, 5 to 40 in their sets and 3 to 9 alone, where their camera gives way.
const CLEAR: f64 = 5.0;

/// What the residuals of a photo's matches have in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Misfit {
    /// How many times more each term explains than noise would: the F statistic of the polynomials' terms.
    statistic: f64,
    /// Root mean square of the polynomials at the matches, in pixels.
    rms_px: f64,
}

impl Misfit {
    /// Fits a polynomial of second degree to the residuals along each axis of the picture; `None` of too few matches.
    pub fn of(
        rays: &PhotoRays<'_>,
        index: &SceneIndex,
        pose: &Rigid,
        inliers: &[SceneMatch],
    ) -> Option<Self> {
        let middle = f64::from(rays.camera.width) / 2.0;
        let mut rows: Vec<(SVector<f64, 2>, SVector<f64, TERMS>, f64)> = Vec::new();
        for &found in inliers {
            let seen = rays.place_of(found.feature).pixel;
            let point = pose.inverse_transform_point(&index.position(found.point));
            let Some(expected) = rays.camera.project(&point) else { continue };
            let residual = expected - seen;
            let sigma = residual.norm() / rays.error_sigmas(index, pose, found);
            if sigma.is_finite() && sigma > 0.0 {
                let (u, v) = (seen.x / middle - 1.0, seen.y / middle - 1.0);
                rows.push((residual / sigma, SVector::from([1.0, u, v, u * u, u * v, v * v]) / sigma, sigma));
            }
        }
        let spare = (2 * rows.len()).checked_sub(2 * TERMS).filter(|spare| *spare > 0)?;
        let mut normal = SMatrix::<f64, TERMS, TERMS>::zeros();
        let mut right = SMatrix::<f64, TERMS, 2>::zeros();
        for (residual, terms, _) in &rows {
            normal += terms * terms.transpose();
            right += terms * residual.transpose();
        }
        let fitted = normal.cholesky()?.solve(&right);
        let (mut explained, mut left, mut squares) = (0.0, 0.0, 0.0);
        for (residual, terms, sigma) in &rows {
            let common = fitted.transpose() * terms;
            explained += residual.norm_squared() - (residual - common).norm_squared();
            left += (residual - common).norm_squared();
            squares += common.norm_squared() * sigma * sigma;
        }
        Some(Self {
            statistic: explained / (2 * TERMS) as f64 / (left / spare as f64),
            rms_px: (squares / rows.len() as f64).sqrt(),
        })
    }

    /// Whether it is more than noise and errors of the scene.
    pub fn is_clear(&self) -> bool {
        self.statistic > CLEAR
    }
}

impl fmt::Display for Misfit {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "its matches are off alike by {:.1} px, as of a picture that is stretched, sheared or cut from the side of a larger one, \
             or of other intrinsics",
            self.rms_px
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::World;

    /// The misfit of a photo of the synthetic street, its picture so many times as high.
    fn misfit(seed: u64, height: f64) -> Misfit {
        let mut world = World::chain(1, 0.2, seed);
        let matches = world.scene_matches(0);
        let middle = f64::from(world.camera.height) / 2.0;
        for keypoint in &mut world.photos[0].features.keypoints {
            keypoint.y = ((f64::from(keypoint.y) - middle) * height + middle) as f32;
        }
        let view = &world.photos[0];
        let rays = PhotoRays::new(&view.features, &world.camera);
        Misfit::of(&rays, world.scene().index, &view.pose, &matches).expect("it has many matches")
    }

    #[test]
    fn a_picture_that_is_pressed_is_told_from_one_that_is_not() {
        for seed in 0..5 {
            let (usual, pressed) = (misfit(seed, 1.0), misfit(seed, 0.99));
            assert!(!usual.is_clear() && usual.statistic < 3.0, "{usual:?}");
            assert!(pressed.is_clear() && pressed.rms_px > 0.5, "{pressed:?}");
            assert!(pressed.to_string().starts_with("its matches are off alike by "));
        }
    }

    #[test]
    fn few_matches_tell_nothing() {
        let world = World::chain(1, 0.2, 1);
        let (view, matches) = (&world.photos[0], world.scene_matches(0));
        let rays = PhotoRays::new(&view.features, &world.camera);
        assert!(Misfit::of(&rays, world.scene().index, &view.pose, &matches[..TERMS]).is_none());
    }
}
