//! COLMAP's camera models as cameras that are known here.

use std::collections::BTreeMap;

use anyhow::{Context, Result};
use setloc_features::{Camera, CameraModel};

/// Cameras of a model by their number.
pub(super) type Cameras = BTreeMap<u32, ColmapCamera>;

/// A camera as COLMAP has it.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum ColmapCamera {
    /// One that is known here.
    Known(Camera),
    /// One of a model with this name, which is not known here.
    Foreign(&'static str),
}

/// A camera model of COLMAP.
#[derive(Debug, Clone, Copy)]
pub(super) enum ColmapModel {
    Known(CameraModel),
    Foreign(&'static ForeignModel),
}

/// One that is none of [`CameraModel`].
#[derive(Debug)]
pub(super) struct ForeignModel {
    id: i32,
    name: &'static str,
    num_params: usize,
    /// Whether it is `OPENCV_FISHEYE` with one focal length f, cx, cy and its first distortion terms.
    is_radial_fisheye: bool,
}

const fn foreign(id: i32, name: &'static str, num_params: usize) -> ForeignModel {
    ForeignModel { id, name, num_params, is_radial_fisheye: matches!(id, 8 | 9) }
}

static FOREIGN: [ForeignModel; 10] = [
    foreign(6, "FULL_OPENCV", 12),
    foreign(7, "FOV", 5),
    foreign(8, "SIMPLE_RADIAL_FISHEYE", 4),
    foreign(9, "RADIAL_FISHEYE", 5),
    foreign(10, "THIN_PRISM_FISHEYE", 12),
    foreign(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    foreign(12, "SIMPLE_DIVISION", 4),
    foreign(13, "DIVISION", 5),
    foreign(15, "FISHEYE", 4),
    foreign(16, "EUCM", 6),
];

impl ColmapModel {
    /// The model of a number in binary files.
    pub(super) fn of_id(id: i32) -> Result<Self> {
        let known = CameraModel::ALL.into_iter().find(|known| known.colmap_id() == Some(id));
        let foreign = || FOREIGN.iter().find(|foreign| foreign.id == id).map(Self::Foreign);
        known.map(Self::Known).or_else(foreign).with_context(|| {
            format!("camera model {id} is none of COLMAP 4.2's: write the model as text (`colmap model_converter`)")
        })
    }

    /// The model of a name in text files.
    pub(super) fn of_name(name: &str) -> Result<Self> {
        let foreign = || FOREIGN.iter().find(|foreign| foreign.name == name).map(Self::Foreign);
        CameraModel::from_name(name).map(Self::Known).or_else(foreign).with_context(|| {
            let known = CameraModel::ALL.into_iter().filter(|model| model.colmap_id().is_some());
            let known: Vec<&str> = known.map(CameraModel::name).collect();
            format!("`{name}` is no camera model: those that are known are {}", known.join(", "))
        })
    }

    pub(super) fn num_params(self) -> usize {
        match self {
            Self::Known(model) => model.num_params(),
            Self::Foreign(model) => model.num_params,
        }
    }

    /// The camera of this model with these parameters.
    ///
    /// # Errors
    /// When they are none of it.
    pub(super) fn camera(self, (width, height): (u32, u32), params: Vec<f64>) -> Result<ColmapCamera> {
        let (model, params) = match self {
            Self::Known(model) => (model, params),
            Self::Foreign(foreign) => {
                let (expected, got) = (foreign.num_params, params.len());
                anyhow::ensure!(got == expected, "{} has {expected} parameters, got {got}", foreign.name);
                if !foreign.is_radial_fisheye {
                    return Ok(ColmapCamera::Foreign(foreign.name));
                }
                (CameraModel::OpencvFisheye, as_opencv_fisheye(&params))
            }
        };
        let camera = Camera { model, width, height, params };
        camera.validate()?;
        Ok(ColmapCamera::Known(camera))
    }
}

/// f, cx, cy and some distortion terms as fx, fy, cx, cy, k1, k2, k3, k4: the higher terms are zero.
fn as_opencv_fisheye(params: &[f64]) -> Vec<f64> {
    let mut all: Vec<f64> = params.first().into_iter().chain(params).copied().collect();
    all.resize(CameraModel::OpencvFisheye.num_params(), 0.0);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radial_fisheyes_are_opencv_s_without_its_higher_terms() {
        let camera = |name: &str, params: &[f64]| {
            let camera = ColmapModel::of_name(name).unwrap().camera((640, 480), params.to_vec()).unwrap();
            let ColmapCamera::Known(camera) = camera else { panic!("{camera:?}") };
            (camera.model, camera.params)
        };
        let simple = camera("SIMPLE_RADIAL_FISHEYE", &[300.0, 320.0, 240.0, 0.05]);
        let expected = vec![300.0, 300.0, 320.0, 240.0, 0.05, 0.0, 0.0, 0.0];
        assert_eq!(simple, (CameraModel::OpencvFisheye, expected));
        let radial = camera("RADIAL_FISHEYE", &[300.0, 320.0, 240.0, 0.05, -0.01]);
        let expected = vec![300.0, 300.0, 320.0, 240.0, 0.05, -0.01, 0.0, 0.0];
        assert_eq!(radial, (CameraModel::OpencvFisheye, expected));
    }

    #[test]
    fn no_two_models_have_one_number_or_name() {
        for foreign in &FOREIGN {
            assert!(CameraModel::from_name(foreign.name).is_none(), "{foreign:?}");
            assert!(CameraModel::ALL.into_iter().all(|model| model.colmap_id() != Some(foreign.id)));
            assert_eq!(ColmapModel::of_id(foreign.id).unwrap().num_params(), foreign.num_params);
        }
    }

    #[test]
    fn parameters_of_another_number_are_refused_with_the_model_s_name() {
        let fov = ColmapModel::of_name("FOV").unwrap();
        let error = fov.camera((640, 480), vec![1.0; 4]).unwrap_err().to_string();
        assert_eq!(error, "FOV has 5 parameters, got 4");
        assert_eq!(fov.camera((640, 480), vec![1.0; 5]).unwrap(), ColmapCamera::Foreign("FOV"));
    }
}
