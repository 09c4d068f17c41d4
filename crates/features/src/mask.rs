use crate::{DecodeLimits, FeatureError, decode};

/// Which parts of an image to look at, at any resolution of the same aspect.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    width: u32,
    height: u32,
    values: Vec<u8>,
}

impl Mask {
    /// A mask from row-major values; 0 means ignore.
    ///
    /// # Errors
    /// [`FeatureError::NoPixels`] for an empty mask, [`FeatureError::SizeMismatch`] for a wrong number of values.
    pub fn new(width: u32, height: u32, values: Vec<u8>) -> Result<Self, FeatureError> {
        if width == 0 || height == 0 {
            return Err(FeatureError::NoPixels { width: width.into(), height: height.into() });
        }
        if values.len() as u64 != u64::from(width) * u64::from(height) {
            return Err(FeatureError::SizeMismatch {
                what: "mask",
                expected_width: width,
                expected_height: height,
                width,
                height: u32::try_from(values.len() as u64 / u64::from(width)).unwrap_or(u32::MAX),
            });
        }
        Ok(Self { width, height, values })
    }

    /// A mask from an image file; black means ignore.
    ///
    /// # Errors
    /// As [`decode`].
    pub fn decode(bytes: &[u8], limits: &DecodeLimits) -> Result<Self, FeatureError> {
        let image = decode(bytes, limits)?;
        let values = image.rgb.chunks_exact(3).map(|pixel| pixel[0].max(pixel[1]).max(pixel[2])).collect();
        Self::new(image.width, image.height, values)
    }

    /// Whether the mask, scaled to an image of this size, allows this place.
    pub fn allows(&self, x: f32, y: f32, image_width: u32, image_height: u32) -> bool {
        let cell = |at: f32, image: u32, mask: u32| {
            ((f64::from(at) / f64::from(image) * f64::from(mask)) as u32).min(mask - 1) as usize
        };
        let (column, row) = (cell(x, image_width, self.width), cell(y, image_height, self.height));
        self.values[row * self.width as usize + column] != 0
    }
}
