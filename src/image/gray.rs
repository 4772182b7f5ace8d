//! Grey images.

use crate::fault::{Fault, Result};

/// A grey image: rows from the top, columns from the left, one byte a pixel.
#[derive(Clone, PartialEq, Eq)]
pub struct Image {
    width: usize,
    height: usize,
    /// The level at which a pixel is full: 127 for the paper's 7-bit grabber, 255 for most others.
    white: u8,
    levels: Vec<u8>,
}

impl Image {
    /// The largest image taken: 64 Mpixel.
    pub const PIXELS_MAX: usize = 1 << 26;

    /// Takes `levels` row by row; an error if they are not width × height, or if there are none.
    pub fn new(width: usize, height: usize, white: u8, levels: Vec<u8>) -> Result<Self> {
        let pixels = width.checked_mul(height).filter(|n| (1..=Self::PIXELS_MAX).contains(n));
        let Some(pixels) = pixels else {
            return Err(Fault::new("image size", format!("{width} x {height}"), "1 to 64 Mpixel"));
        };
        if levels.len() != pixels {
            let expected = format!("{pixels} for {width} x {height}");
            return Err(Fault::new("image bytes", levels.len(), expected));
        }
        if white == 0 {
            return Err(Fault::new("image white level", white, "1 to 255"));
        }
        Ok(Self { width, height, white, levels })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The level of a full pixel.
    pub fn white(&self) -> u8 {
        self.white
    }

    /// All levels, row by row from the top.
    pub fn levels(&self) -> &[u8] {
        &self.levels
    }

    /// All levels, taken out.
    pub fn into_levels(self) -> Vec<u8> {
        self.levels
    }

    /// The levels of one row.
    pub fn row(&self, v: usize) -> &[u8] {
        &self.levels[v * self.width..(v + 1) * self.width]
    }
}

impl std::fmt::Debug for Image {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Image({} x {}, white {})", self.width, self.height, self.white)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        assert!(Image::new(2, 2, 127, vec![0; 4]).is_ok());
        assert!(Image::new(2, 2, 127, vec![0; 3]).is_err());
        assert!(Image::new(0, 2, 127, vec![]).is_err());
        assert!(Image::new(usize::MAX, 2, 127, vec![]).is_err());
        assert!(Image::new(1, 1, 0, vec![0]).is_err());
    }
}
