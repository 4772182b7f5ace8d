//! The simulated camera: what its lens and sensor are assumed to be.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};
use crate::optics::Rig;

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
    /// Band that the filter lets through [nm] [A]; the ambient light of a world is given for 10 nm.
    pub filter_bandwidth_nm: f64,
    /// Direct sunlight on all that the camera sees [W/m² a nm]: 0 indoors, 1.4 in full sun [A].
    pub sun_w_per_m2_nm: f64,
    /// n of the cosⁿα by which an evenly lit wall falls off towards the image's corners: 4 is a simple lens, 0 none [A].
    pub vignetting: f64,
    /// Speckle contrast C: 1 for polarised light on a plain rough surface, 0.7 where it loses its polarisation, 0 off [A].
    pub speckle_contrast: f64,
    /// Share of a full pixel's overflow that goes up and down its column, half each way; 0 drains it all: anti-blooming [A].
    pub blooming: f64,
    /// Whether glossy materials send light about the mirror direction.
    pub specular: bool,
    /// Whether flat glossy surfaces throw the sheet on other surfaces: a false line.
    pub bounce: bool,
    /// Whether an edge within the sheet's thickness splits the stripe.
    pub split: bool,
    /// Whether motion during the exposure smears the image.
    pub smear: bool,
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
            filter_bandwidth_nm: 10.0,
            sun_w_per_m2_nm: 0.0,
            vignetting: 4.0,
            speckle_contrast: 1.0,
            blooming: 0.0,
            specular: true,
            bounce: true,
            split: true,
            smear: true,
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
        number_within("image.filter_bandwidth_nm", self.filter_bandwidth_nm, 0.0, 1e3)?;
        number_within("image.sun_w_per_m2_nm", self.sun_w_per_m2_nm, 0.0, 100.0)?;
        number_within("image.vignetting", self.vignetting, 0.0, 20.0)?;
        number_within("image.speckle_contrast", self.speckle_contrast, 0.0, 1.0)?;
        number_within("image.blooming", self.blooming, 0.0, 1.0)?;
        number_within("image.signal_electrons_min", self.signal_electrons_min, 0.0, f64::INFINITY)?;
        number_within("image.reach_m", self.reach_m, 0.1, 1e4)?;
        if self.white_level == 0 {
            return Err(Fault::new("image.white_level", self.white_level, "1 to 255"));
        }
        Ok(self)
    }

    /// RMS error that speckle gives the row of a stripe in one column, C·λN/π [px] (Dorsch, Häusler, Herrmann 1994).
    /// No image shows it: who extracts the line must be told.
    pub fn speckle_sigma_px(&self, rig: &Rig) -> f64 {
        let row_m = self.focal_length_m / rig.camera.fy;
        self.speckle_contrast * rig.sheet.wavelength_m * self.f_number / (PI * row_m)
    }

    /// Ambient light and sun within the band-pass [W/m²]; `ambient_w_per_m2` is for 10 nm.
    pub fn background_w_per_m2(&self, ambient_w_per_m2: f64) -> f64 {
        (ambient_w_per_m2 / 10.0 + self.sun_w_per_m2_nm) * self.filter_bandwidth_nm
    }

    /// Electrons that a joule of light in front of the lens becomes.
    pub fn electrons_per_joule(&self, wavelength_m: f64) -> f64 {
        let transmission = self.lens_transmission * self.filter_transmission;
        transmission * self.quantum_efficiency * wavelength_m / PLANCK_TIMES_LIGHT
    }

    /// Mean electrons of a pixel on the axis without the laser: dark signal, ambient light (given for 10 nm) and sun.
    pub fn background_electrons(&self, rig: &Rig, ambient_w_per_m2: f64) -> f64 {
        let irradiance = self.background_w_per_m2(ambient_w_per_m2);
        self.dark_electrons + self.electrons_of(rig, irradiance, self.ambient_albedo)
    }

    /// Electrons that a surface of this albedo under an irradiance [W/m²] within the band-pass leaves in a pixel in the
    /// middle of the image.
    pub fn electrons_of(&self, rig: &Rig, irradiance_w_per_m2: f64, albedo: f64) -> f64 {
        // A pixel sees radiance ρE/π through the solid angle π/(4N²).
        let pitch = self.focal_length_m * self.focal_length_m / (rig.camera.fx * rig.camera.fy);
        let power_w = irradiance_w_per_m2 * albedo / (4.0 * self.f_number * self.f_number) * pitch;
        power_w * self.exposure_s * self.electrons_per_joule(rig.sheet.wavelength_m)
    }

    /// Solid angle of the aperture from a place so far away [sr].
    pub fn aperture_sr(&self, range_m: f64) -> f64 {
        PI * (self.focal_length_m / (2.0 * self.f_number)).powi(2) / (range_m * range_m)
    }

    /// What is left of a stripe at an angle of this cosine off the axis. 1/R² and the slant of what is seen hold three of
    /// the cosines of cosⁿα.
    pub fn fall_off(&self, cosine: f64) -> f64 {
        match self.vignetting - 3.0 {
            1.0 => cosine,
            power => cosine.powf(power),
        }
    }

    /// RMS radius of the disc of defocus, a quarter of its diameter [px rows].
    pub fn defocus_px(&self, rig: &Rig, range_m: f64) -> f64 {
        let lf = self.focal_length_m;
        let disc_m = lf / self.f_number * lf * (1.0 / range_m - 1.0 / self.focus_m).abs();
        disc_m / 4.0 * rig.camera.fy / lf
    }
}
