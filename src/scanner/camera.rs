//! The simulated camera: what its lens and sensor are assumed to be.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};

/// h·c [J·m].
const PLANCK_TIMES_LIGHT: f64 = 6.626_070_15e-34 * 299_792_458.0;

/// The camera's optics and sensor. All are assumptions [A] of `instrument.md` 1: the paper gives none of them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImageParams {
    /// Focal length over aperture [A].
    pub f_number: f64,
    /// Focal length lf [m]; with the rig's focal lengths in pixels it gives the pixel pitch.
    pub focal_length_m: f64,
    /// Distance of sharpest focus from the lens [m] [A].
    pub focus_m: f64,
    /// Exposure time [s] [A].
    pub exposure_s: f64,
    /// Electrons a photon [A].
    pub quantum_efficiency: f64,
    /// Transmission of the lens [A]; times the filter's it is τ = 0.51.
    pub lens_transmission: f64,
    /// Transmission of the band-pass filter within its band [A].
    pub filter_transmission: f64,
    /// Electrons that fill a pixel [A].
    pub well_electrons: f64,
    /// RMS read noise [electrons] [A].
    pub read_noise_electrons: f64,
    /// Mean dark signal of a pixel over the exposure [electrons] [A].
    pub dark_electrons: f64,
    /// Level of a full pixel: 127 for the paper's 7-bit grabber.
    pub white_level: u8,
    /// RMS radius of the lens' point spread along one axis [px rows] [A].
    pub point_spread_px: f64,
    /// Albedo of whatever reflects the ambient light: the same everywhere in the image [A].
    pub ambient_albedo: f64,
    /// Electrons in a column under which a stripe is neither drawn nor part of the truth.
    pub signal_electrons_min: f64,
    /// How far the laser is followed [m].
    pub reach_m: f64,
}

impl Default for ImageParams {
    fn default() -> Self {
        Self {
            f_number: 2.0,
            focal_length_m: 11.434e-3,
            focus_m: 2.0,
            exposure_s: 1.0 / 60.0,
            quantum_efficiency: 0.35,
            lens_transmission: 0.85,
            filter_transmission: 0.6,
            well_electrons: 100e3,
            read_noise_electrons: 60.0,
            dark_electrons: 200.0,
            white_level: 127,
            point_spread_px: 0.3,
            ambient_albedo: 0.5,
            signal_electrons_min: 20.0,
            reach_m: 12.0,
        }
    }
}

impl ImageParams {
    /// Refuses numbers that make no camera.
    pub fn validated(self) -> Result<Self> {
        number_within("image.f_number", self.f_number, 0.5, 100.0)?;
        number_within("image.focal_length_m", self.focal_length_m, 1e-4, 10.0)?;
        positive("image.focus_m", self.focus_m)?;
        number_within("image.exposure_s", self.exposure_s, 1e-9, 1e3)?;
        number_within("image.quantum_efficiency", self.quantum_efficiency, 0.0, 1.0)?;
        number_within("image.lens_transmission", self.lens_transmission, 0.0, 1.0)?;
        number_within("image.filter_transmission", self.filter_transmission, 0.0, 1.0)?;
        number_within("image.well_electrons", self.well_electrons, 1.0, 1e12)?;
        number_within("image.read_noise_electrons", self.read_noise_electrons, 0.0, 1e12)?;
        number_within("image.dark_electrons", self.dark_electrons, 0.0, 1e12)?;
        number_within("image.point_spread_px", self.point_spread_px, 0.01, 100.0)?;
        number_within("image.ambient_albedo", self.ambient_albedo, 0.0, 1.0)?;
        number_within("image.signal_electrons_min", self.signal_electrons_min, 0.0, f64::INFINITY)?;
        number_within("image.reach_m", self.reach_m, 0.1, 1e4)?;
        if self.white_level == 0 {
            return Err(Fault::new("image.white_level", self.white_level, "1 to 255"));
        }
        Ok(self)
    }

    /// Electrons that a joule of light in front of the lens becomes.
    pub(super) fn electrons_per_joule(&self, wavelength_m: f64) -> f64 {
        let transmission = self.lens_transmission * self.filter_transmission;
        transmission * self.quantum_efficiency * wavelength_m / PLANCK_TIMES_LIGHT
    }
}
