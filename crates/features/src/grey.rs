use opencv::core::{Mat, Size};
use opencv::imgproc::INTER_AREA;

use crate::decode::check_buffer;
use crate::{DecodedImage, FeatureError, sift};

/// A grey picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreyImage {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Row-major luma, a byte a pixel.
    pub(crate) values: Vec<u8>,
}

/// Luma of ITU-R BT.601 of one RGB pixel, in 14-bit integers.
fn luma(pixel: &[u8]) -> u8 {
    let sum = 4899 * u32::from(pixel[0]) + 9617 * u32::from(pixel[1]) + 1868 * u32::from(pixel[2]);
    ((sum + (1 << 13)) >> 14) as u8
}

impl From<&DecodedImage> for GreyImage {
    fn from(image: &DecodedImage) -> Self {
        Self {
            width: image.width as usize,
            height: image.height as usize,
            values: image.rgb.chunks_exact(3).map(luma).collect(),
        }
    }
}

impl GreyImage {
    /// A picture from pixels that come from elsewhere, row by row.
    ///
    /// # Errors
    /// [`FeatureError::NoPixels`] for an empty picture and [`FeatureError::SizeMismatch`] if there are not
    /// `width × height` values.
    pub fn from_values(width: u32, height: u32, values: Vec<u8>) -> Result<Self, FeatureError> {
        check_buffer(width, height, values.len(), 1)?;
        Ok(Self { width: width as usize, height: height as usize, values })
    }

    /// Reduced by averaging, to these shares of its width and height.
    pub(crate) fn reduced(&self, share: [f64; 2]) -> Result<Self, FeatureError> {
        let side = |side: usize, share: f64| ((side as f64 * share).round() as usize).max(1);
        let (width, height) = (side(self.width, share[0]), side(self.height, share[1]));
        let mut values = vec![0; width * height];
        let mut run = || {
            let source = Mat::new_rows_cols_with_data(self.height as i32, self.width as i32, &self.values)?;
            let mut target = Mat::new_rows_cols_with_data_mut(height as i32, width as i32, &mut values)?;
            let size = Size::new(width as i32, height as i32);
            opencv::imgproc::resize(&source, &mut target, size, 0.0, 0.0, INTER_AREA)
        };
        run().map_err(|error: opencv::Error| FeatureError::Detector { reason: error.message })?;
        Ok(Self { width, height, values })
    }

    /// With `padding` columns of the other side left and right.
    pub(crate) fn wrapped(self, padding: usize) -> Self {
        if padding == 0 {
            return self;
        }
        let mut values = Vec::with_capacity((self.width + 2 * padding) * self.height);
        for row in self.values.chunks_exact(self.width) {
            values.extend_from_slice(&row[self.width - padding..]);
            values.extend_from_slice(row);
            values.extend_from_slice(&row[..padding]);
        }
        Self { width: self.width + 2 * padding, height: self.height, values }
    }

    pub(crate) fn view(&self) -> sift::Grey<'_> {
        sift::Grey { width: self.width, height: self.height, values: &self.values }
    }
}
