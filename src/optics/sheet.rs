//! The sheet of laser light: where its plane is, how wide it fans, how thick and how bright it is.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::fault::{Result, positive};
use crate::geometry::{Frame, Plane, Point, Transform};

/// The sheet's plane at one moment, in frame `F`, with the point that the light comes from.
#[derive(Clone, Copy, Debug)]
pub struct LaserPlane<F> {
    /// The plane.
    pub plane: Plane<F>,
    /// Where the fan opens: A, the centre of the third mirror.
    pub origin: Point<F>,
    /// Unit vector in the plane along the middle of the fan.
    pub forward: Vector3<f64>,
    /// Unit vector in the plane, to the left of `forward`.
    pub lateral: Vector3<f64>,
}

impl<A: Frame, B: Frame> std::ops::Mul<LaserPlane<B>> for Transform<A, B> {
    type Output = LaserPlane<A>;
    fn mul(self, sheet: LaserPlane<B>) -> LaserPlane<A> {
        LaserPlane {
            plane: self * sheet.plane,
            origin: self * sheet.origin,
            forward: self.rotate(&sheet.forward),
            lateral: self.rotate(&sheet.lateral),
        }
    }
}

/// The light in the sheet (`paper.md` 3, 5.2; `instrument.md` 1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sheet {
    /// Wavelength λ [m].
    pub wavelength_m: f64,
    /// Power that leaves the finder [W]; 7 of the 10 mW reach the target [A].
    pub power_w: f64,
    /// Full 1/e² width of the fan where it opens [m].
    pub width_at_origin_m: f64,
    /// Growth of the full 1/e² width per metre of range: 2·tan(θ2).
    pub width_per_m: f64,
    /// 1/e² half thickness at the waist, w0 [m].
    pub waist_m: f64,
}

impl Default for Sheet {
    /// METRO-I with lm = 15 mm and the corrected optics of `paper.md` 5.2: 3.668 m wide at 3 m, θ2 = 31.39°.
    fn default() -> Self {
        Self {
            wavelength_m: 632.8e-9,
            power_w: 7e-3,
            width_at_origin_m: 5.895e-3,
            width_per_m: 1.2205,
            waist_m: 0.4e-3,
        }
    }
}

impl Sheet {
    /// Refuses sizes that make no sheet.
    pub fn validated(self) -> Result<Self> {
        positive("sheet.wavelength_m", self.wavelength_m)?;
        positive("sheet.power_w", self.power_w)?;
        positive("sheet.width_at_origin_m", self.width_at_origin_m)?;
        positive("sheet.width_per_m", self.width_per_m)?;
        positive("sheet.waist_m", self.waist_m)?;
        Ok(self)
    }

    /// Full 1/e² width of the fan D [m] at a forward range [m].
    pub fn width_m(&self, range_m: f64) -> f64 {
        self.width_at_origin_m + self.width_per_m * range_m
    }

    /// 1/e² half thickness w(R) = w0·√(1 + (R/zR)²), zR = π·w0²/λ [m].
    pub fn thickness_m(&self, range_m: f64) -> f64 {
        let rayleigh = std::f64::consts::PI * self.waist_m * self.waist_m / self.wavelength_m;
        self.waist_m * (1.0 + (range_m / rayleigh).powi(2)).sqrt()
    }

    /// Power per metre across the fan, p(y) = P·√(2/π)/(D/2)·exp(−8y²/D²) [W/m], y from the middle of the fan.
    pub fn line_power_w_per_m(&self, range_m: f64, y_m: f64) -> f64 {
        let width = self.width_m(range_m);
        let peak = self.power_w * (2.0 / std::f64::consts::PI).sqrt() / (width / 2.0);
        peak * (-8.0 * (y_m / width).powi(2)).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn width_and_thickness_are_the_published_ones() {
        let sheet = Sheet::default();
        assert!((sheet.width_m(3.0) - 3.6676).abs() < 1e-3); // paper.md 5.2, lm = 15 mm
        assert!(((sheet.width_per_m / 2.0).atan().to_degrees() - 31.39).abs() < 0.01);
        for (range, thickness_mm) in [(1.5, 0.85), (2.0, 1.08), (3.0, 1.56)] {
            assert!((sheet.thickness_m(range) * 1e3 - thickness_mm).abs() < 0.01); // instrument.md 1
        }
    }

    #[test]
    fn all_the_power_is_somewhere_across_the_fan() {
        let sheet = Sheet::default();
        let step = 1e-3;
        let total: f64 = (-6000..6000).map(|i| sheet.line_power_w_per_m(2.0, f64::from(i) * step) * step).sum();
        assert!((total - sheet.power_w).abs() < 1e-9);
    }

    #[test]
    fn sizes_that_make_no_sheet_are_refused() {
        assert!(Sheet { power_w: 0.0, ..Sheet::default() }.validated().is_err());
        assert!(Sheet { waist_m: f64::NAN, ..Sheet::default() }.validated().is_err());
    }
}
