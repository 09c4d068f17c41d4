use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};

use super::MAX_CAMERA_PARAMS;

/// Camera models with COLMAP's names and parameter order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
#[non_exhaustive]
pub enum CameraModel {
    /// f, cx, cy
    SimplePinhole,
    /// fx, fy, cx, cy
    Pinhole,
    /// f, cx, cy, k
    SimpleRadial,
    /// f, cx, cy, k1, k2
    Radial,
    /// fx, fy, cx, cy, k1, k2, p1, p2
    Opencv,
    /// Equidistant: f, cx, cy
    SimpleFisheye,
    /// Kannala–Brandt: fx, fy, cx, cy, k1, k2, k3, k4
    OpencvFisheye,
    /// w, h of the full sphere; cropped panoramas add the crop's left and top.
    Equirectangular,
    /// f, cx, cy of the paper's rectilinear formula, which is no pinhole off the axes; for reproduction only.
    PaperRectilinear,
    /// A panorama whose stitching moves directions: w, h of the full sphere, the crop's left and top (0 for a whole one), the
    /// stretch xx, xy, xz, yz, and the twist txx, txy, txz, tyz, tyy. COLMAP has no such model.
    StitchedEquirectangular,
}

/// What an intrinsic parameter stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ParamRole {
    /// A focal length in pixels.
    Focal,
    /// A coordinate of the principal point in pixels.
    PrincipalPoint,
    /// A distortion coefficient.
    Distortion,
    /// Width or height in pixels of a panorama's full sphere; never refined.
    SphereSize,
    /// Left or top in pixels of a panorama's crop; never refined.
    CropOffset,
    /// A term by which a panorama's directions are stretched or twisted.
    Stretch,
}

use ParamRole::{CropOffset, Distortion, Focal, PrincipalPoint, SphereSize, Stretch};

impl CameraModel {
    /// All models.
    pub const ALL: [Self; 10] = [
        Self::SimplePinhole,
        Self::Pinhole,
        Self::SimpleRadial,
        Self::Radial,
        Self::Opencv,
        Self::SimpleFisheye,
        Self::OpencvFisheye,
        Self::Equirectangular,
        Self::PaperRectilinear,
        Self::StitchedEquirectangular,
    ];

    /// COLMAP's name, or one of that kind where COLMAP has none.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SimplePinhole => "SIMPLE_PINHOLE",
            Self::Pinhole => "PINHOLE",
            Self::SimpleRadial => "SIMPLE_RADIAL",
            Self::Radial => "RADIAL",
            Self::Opencv => "OPENCV",
            Self::SimpleFisheye => "SIMPLE_FISHEYE",
            Self::OpencvFisheye => "OPENCV_FISHEYE",
            Self::Equirectangular => "EQUIRECTANGULAR",
            Self::PaperRectilinear => "PAPER_RECTILINEAR",
            Self::StitchedEquirectangular => "STITCHED_EQUIRECTANGULAR",
        }
    }

    /// The model of COLMAP's name, `None` for models that are not supported.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// COLMAP's numeric id, as binary files store it; `None` for the models that COLMAP lacks.
    pub const fn colmap_id(self) -> Option<i32> {
        match self {
            Self::SimplePinhole => Some(0),
            Self::Pinhole => Some(1),
            Self::SimpleRadial => Some(2),
            Self::Radial => Some(3),
            Self::Opencv => Some(4),
            Self::OpencvFisheye => Some(5),
            Self::SimpleFisheye => Some(14),
            Self::Equirectangular => Some(17),
            Self::PaperRectilinear | Self::StitchedEquirectangular => None,
        }
    }

    /// Number of parameters of the plain model; a cropped panorama has two more.
    pub const fn num_params(self) -> usize {
        match self {
            Self::Equirectangular => 2,
            _ => self.param_roles().len(),
        }
    }

    /// Whether a camera of this model may have so many parameters.
    pub const fn accepts_num_params(self, count: usize) -> bool {
        count == self.num_params() || count == self.param_roles().len()
    }

    /// Names of the parameters in order (with the crop's, for panoramas).
    pub const fn param_names(self) -> &'static [&'static str] {
        match self {
            Self::SimplePinhole | Self::SimpleFisheye | Self::PaperRectilinear => &["f", "cx", "cy"],
            Self::Pinhole => &["fx", "fy", "cx", "cy"],
            Self::SimpleRadial => &["f", "cx", "cy", "k"],
            Self::Radial => &["f", "cx", "cy", "k1", "k2"],
            Self::Opencv => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"],
            Self::OpencvFisheye => &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
            Self::Equirectangular => &["w", "h", "left", "top"],
            Self::StitchedEquirectangular => {
                &["w", "h", "left", "top", "xx", "xy", "xz", "yz", "txx", "txy", "txz", "tyz", "tyy"]
            }
        }
    }

    /// What each parameter is, in order (with the crop's, for panoramas).
    pub const fn param_roles(self) -> &'static [ParamRole] {
        match self {
            Self::SimplePinhole | Self::SimpleFisheye | Self::PaperRectilinear => {
                &[Focal, PrincipalPoint, PrincipalPoint]
            }
            Self::Pinhole => &[Focal, Focal, PrincipalPoint, PrincipalPoint],
            Self::SimpleRadial => &[Focal, PrincipalPoint, PrincipalPoint, Distortion],
            Self::Radial => &[Focal, PrincipalPoint, PrincipalPoint, Distortion, Distortion],
            Self::Opencv | Self::OpencvFisheye => &[
                Focal,
                Focal,
                PrincipalPoint,
                PrincipalPoint,
                Distortion,
                Distortion,
                Distortion,
                Distortion,
            ],
            Self::Equirectangular => &[SphereSize, SphereSize, CropOffset, CropOffset],
            Self::StitchedEquirectangular => {
                const ROLES: [ParamRole; MAX_CAMERA_PARAMS] = {
                    let mut roles = [Stretch; MAX_CAMERA_PARAMS];
                    (roles[0], roles[1], roles[2], roles[3]) =
                        (SphereSize, SphereSize, CropOffset, CropOffset);
                    roles
                };
                &ROLES
            }
        }
    }

    /// Columns in this model's order from the canonical fx, fy, cx, cy and four distortion terms.
    ///
    /// A model with a single focal length gets the sum of both focal columns (chain rule).
    pub(super) fn fold_columns<const ROWS: usize>(
        self,
        canonical: &SMatrix<f64, ROWS, MAX_CAMERA_PARAMS>,
    ) -> SMatrix<f64, ROWS, MAX_CAMERA_PARAMS> {
        let roles = self.param_roles();
        if roles[1] == Focal {
            let mut folded = *canonical;
            folded.columns_mut(roles.len(), MAX_CAMERA_PARAMS - roles.len()).fill(0.0);
            return folded;
        }
        let mut folded = SMatrix::<f64, ROWS, MAX_CAMERA_PARAMS>::zeros();
        folded.set_column(0, &(canonical.column(0) + canonical.column(1)));
        for index in 1..roles.len() {
            folded.set_column(index, &canonical.column(index + 1));
        }
        folded
    }
}
