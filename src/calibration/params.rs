//! What is known before a camera is calibrated on a block: its chip, and what is held.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};

/// The chip, as its pixels lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Columns in memory.
    pub width: usize,
    /// Rows in memory.
    pub height: usize,
    /// Pitch of the columns in memory, d'u = du·Ncu/Nfu [mm].
    pub column_pitch_mm: f64,
    /// Pitch of the rows, dv [mm].
    pub row_pitch_mm: f64,
}

impl Sensor {
    /// METRO-I: a chip of 6.4 × 4.8 mm with 485 rows, grabbed as 512 × 480.
    pub fn metro_i() -> Self {
        Self { width: 512, height: 480, column_pitch_mm: 6.4 / 512.0, row_pitch_mm: 4.8 / 485.0 }
    }

    /// Refuses sizes and pitches that make no chip; a chip over 100 mm is taken for one whose pitch is in another unit.
    pub fn validated(self) -> Result<Self> {
        for (name, size) in [("sensor.width", self.width), ("sensor.height", self.height)] {
            if !(1..=65_536).contains(&size) {
                return Err(Fault::new(name, size, "a number of pixels from 1 to 65536"));
            }
        }
        for (name, pitch) in
            [("sensor.column_pitch_mm", self.column_pitch_mm), ("sensor.row_pitch_mm", self.row_pitch_mm)]
        {
            positive(name, pitch)?;
        }
        let diagonal = self.diagonal_mm();
        if !(0.5..=100.0).contains(&diagonal) {
            let expected = "0.5 to 100 mm: pitches are in millimetres, are these micrometres or metres?";
            return Err(Fault::new("sensor diagonal", format!("{diagonal:.4} mm"), expected));
        }
        Ok(self)
    }

    pub(super) fn diagonal_mm(&self) -> f64 {
        (self.width as f64 * self.column_pitch_mm).hypot(self.height as f64 * self.row_pitch_mm)
    }
}

/// A number that is either to be found or known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Unknown<T> {
    /// To be found, starting here.
    From(T),
    /// Known: held here.
    Known(T),
}

impl<T: Copy> Unknown<T> {
    pub(super) fn value(&self) -> T {
        let (Self::From(value) | Self::Known(value)) = self;
        *value
    }

    pub(super) fn is_known(&self) -> bool {
        matches!(self, Self::Known(_))
    }
}

/// How a block is calibrated on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlockParams {
    /// Column scale su. A flat target hardly ever gives it: then it must be known.
    pub scale_u: Unknown<f64>,
    /// The optical axis (Cu, Cv) [px], rows from the top; the middle of the image if left out.
    pub centre_px: Option<Unknown<[f64; 2]>>,
    /// Standard deviation of a mark's pixel in u and v [px]; from the residuals if left out.
    pub pixel_sigma_px: Option<f64>,
    /// Marks this many robust standard deviations off are left out, and named.
    pub outlier_sigmas: f64,
    /// Refused above this relative standard deviation of the focal length.
    pub f_sigma_max: f64,
    /// Refused above this standard deviation of su.
    pub scale_sigma_max: f64,
}

impl Default for BlockParams {
    fn default() -> Self {
        Self {
            scale_u: Unknown::From(1.0),
            centre_px: None,
            pixel_sigma_px: None,
            outlier_sigmas: 6.0,
            f_sigma_max: 0.10,
            scale_sigma_max: 0.02,
        }
    }
}

impl BlockParams {
    /// Refuses numbers that make no sense.
    pub fn validated(self) -> Result<Self> {
        number_within("scale_u", self.scale_u.value(), 0.1, 10.0)?;
        for c in self.centre_px.map_or([0.0; 2], |c| c.value()) {
            number_within("centre_px", c, -1e5, 1e5)?;
        }
        if let Some(sigma) = self.pixel_sigma_px {
            number_within("pixel_sigma_px", sigma, 1e-6, 1e3)?;
        }
        number_within("outlier_sigmas", self.outlier_sigmas, 3.0, 1e9)?;
        positive("f_sigma_max", self.f_sigma_max)?;
        positive("scale_sigma_max", self.scale_sigma_max)?;
        Ok(self)
    }
}
