//! What is looked at: an image, or what it shows more than one taken with the laser off.

use super::LineParams;
use super::gauss::Sensor;
use super::peak::{Column, Estimator};
use super::ridge::Found;
use super::tops::Look;
use crate::fault::{Fault, Result};
use crate::image::Image;

/// Level of a difference where both images are the same: noise goes both ways.
const PEDESTAL: i16 = 16;
/// A difference of this or more is this: `u8::MAX` is for what is saturated.
const DIFFERENCE_MAX: i16 = 254;

/// An image with what is known of its noise.
pub(super) struct View<'a> {
    pub image: &'a Image,
    /// The image taken with the laser off, if `image` is what is left without it.
    off: Option<&'a Image>,
    /// Shot noise: variance a level.
    shot: f32,
    /// Read and quantisation noise that every pixel has [levels²].
    floor: f32,
    sigma_min_px: f32,
    is_plain: bool,
}

impl<'a> View<'a> {
    /// An image as it is.
    pub fn plain(image: &'a Image, params: &LineParams) -> Self {
        let shot = f32::from(image.white()) / params.well_electrons;
        let read = params.read_electrons * shot;
        let is_plain = params.estimator == Estimator::Auto;
        let floor = read * read + 1.0 / 12.0;
        Self { image, off: None, shot, floor, sigma_min_px: params.sigma_min_px, is_plain }
    }

    /// A difference of two images with this white level.
    pub fn above(image: &'a Image, off: &'a Image, white: u8, params: &LineParams) -> Self {
        let shot = f32::from(white) / params.well_electrons;
        let read = params.read_electrons * shot;
        let floor = 2.0 * (read * read + 1.0 / 12.0);
        Self { image, off: Some(off), shot, floor, sigma_min_px: params.sigma_min_px, is_plain: false }
    }

    /// What all columns have in common, where the image shows so much `noise` without a stripe [levels].
    pub fn look(&self, noise: f32) -> Look {
        let sensor = Sensor { seen: noise * noise, floor: self.floor, shot: self.shot };
        let extra = self.sigma_min_px * self.sigma_min_px;
        Look { sensor, seen: 2.0 * noise.max(0.5), extra, is_plain: self.is_plain }
    }

    /// One column about a ridge.
    pub fn column(&self, u: usize, found: Found, noise: f32) -> Column<'_> {
        let Look { sensor, seen, .. } = self.look(noise);
        let background = found.background();
        let ambient = self.off.map_or(background, |off| {
            // Both images have the noise of this light.
            2.0 * f32::from(off.row(usize::from(found.row))[u])
        });
        Column { image: self.image, u, background, ambient, sensor, seen }
    }
}

/// `image` less `off`, over a pedestal; what is saturated in `image` is. `levels` is used for the result.
pub(super) fn difference(image: &Image, off: &Image, mut levels: Vec<u8>) -> Result<Image> {
    if (image.width(), image.height()) != (off.width(), off.height()) {
        let found = format!("{} x {}", off.width(), off.height());
        let expected = format!("{} x {}, as the image has", image.width(), image.height());
        return Err(Fault::new("size of the background image", found, expected));
    }
    levels.clear();
    levels.extend(image.levels().iter().zip(off.levels()).map(|(level, off)| {
        let less = (i16::from(*level) - i16::from(*off) + PEDESTAL).clamp(0, DIFFERENCE_MAX) as u8;
        if *level >= image.white() { u8::MAX } else { less }
    }));
    Image::new(image.width(), image.height(), u8::MAX, levels)
}
