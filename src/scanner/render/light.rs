//! How bright and how wide the stripe is at one place, as the camera gets it.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix2, Vector2};

use super::speckle::Grain;
use super::{BORDER_PX, V3, View};
use crate::world::Cut;

use super::trace::PARTS;

/// A stripe that runs along a column is taken to cross at least this part of a column a row.
const STEEP: f64 = 0.05;

/// How the stripe crosses a column.
#[derive(Clone, Copy, Debug)]
pub(super) struct Glimpse {
    pub v: f64,
    pub sigma_px: f64,
    /// Mean number of electrons.
    pub electrons: f64,
    pub grain: Grain,
}

impl View<'_> {
    /// What the camera would get of the place at t if nothing stood in the way, with how far that place moves on the
    /// surface a metre of the sheet's thickness; `None` if laser or camera are behind the surface, or the stripe is too
    /// faint or too far outside the image.
    pub fn glimpse(&self, cut: &Cut, t: f64) -> Option<(V3, V3, Glimpse)> {
        let (rig, params, sheet) = (&self.renderer.rig, &self.renderer.params, &self.beam.sheet);
        let (point, normal, tangent) = (cut.curve.at(t), cut.normal(t), cut.curve.tangent(t));
        let (to_laser, to_eye) = (sheet.origin.xyz - point, self.eye - point);
        let (lit, seen) = (normal.dot(&to_laser), normal.dot(&to_eye));
        let facing = if cut.two_sided { lit * seen > 0.0 } else { lit > 0.0 && seen > 0.0 };
        if !facing {
            return None;
        }
        let camera = self.turn * -to_eye;
        let [u, v] = rig.camera.project(&camera)?;
        if v < -BORDER_PX || v > rig.camera.height as f64 - 1.0 + BORDER_PX {
            return None;
        }
        let pixels_per_ray: Matrix2<f64> = rig.camera.ray_jacobian(u, v)?.try_inverse()?;
        let flow = |way: &V3| {
            let way = self.turn * way;
            let ray = Vector2::new(way.x * camera.z - camera.x * way.z, way.y * camera.z - camera.y * way.z);
            pixels_per_ray * ray / (camera.z * camera.z)
        };
        // Along the stripe, and across it in the surface; then the mix that stays in the column.
        let along = tangent.try_normalize(0.0)?;
        let across = normal.cross(&along);
        let (mut along_px, across_px) = (flow(&along), flow(&across));
        along_px.x = along_px.x.abs().max(STEEP * along_px.y.abs()).copysign(along_px.x);
        let slope = along_px.y / along_px.x;
        let thickness = sheet.plane.normal.dot(&across); // of the sheet, a metre across
        let row_per_m = (across_px.y - across_px.x * slope) / thickness;

        // The fan: power between two of its rays, p(y)·D·d(y/D), is the same at any range and slant.
        let (x, y) = (-sheet.forward.dot(&to_laser), -sheet.lateral.dot(&to_laser));
        let width = rig.sheet.width_m(x);
        let fan = sheet.lateral.dot(&along) - y / width * rig.sheet.width_per_m * sheet.forward.dot(&along);
        let power_w = rig.sheet.line_power_w_per_m(x, y) * (fan / along_px.x).abs(); // p·Δy

        let range = to_eye.norm();
        let aperture = PI * (params.focal_length_m / (2.0 * params.f_number)).powi(2) / (range * range); // Ω
        let share = self.scattered(cut.body, &normal, &to_laser, &to_eye) * aperture * self.fall_off(camera.z / range);
        let joules = power_w * self.beam.share * share * params.exposure_s;
        let electrons = joules * params.electrons_per_joule(rig.sheet.wavelength_m);
        let sigma_px = self.stripe_sigma_px(&point, to_laser.norm(), range, row_per_m, slope);
        let is_bright = electrons >= params.signal_electrons_min * self.beam.share * sigma_px.max(1.0);
        let glimpse = Glimpse { v, sigma_px, electrons, grain: Grain::NONE };
        is_bright.then_some((point, across / thickness, glimpse))
    }

    /// Share of the light that a place of a body scatters towards the eye, a steradian: ρ·cosθr/π, and about the mirror
    /// direction a lobe with the material's gloss in it (von Mises and Fisher's, blurred by the aperture).
    pub fn scattered(&self, body: usize, normal: &V3, to_laser: &V3, to_eye: &V3) -> f64 {
        let Some(material) = self.renderer.materials.get(body) else { return 0.0 };
        let (range, cosine) = (to_eye.norm(), normal.dot(to_eye));
        let diffuse = material.albedo * (cosine.abs() / range) / PI;
        let params = &self.renderer.params;
        if material.gloss == 0.0 || !params.specular {
            return diffuse;
        }
        let mirrored = normal * (2.0 * normal.dot(to_laser)) - to_laser;
        let off_axis = 1.0 - mirrored.dot(to_eye) / (to_laser.norm() * range); // 1 − cosψ
        let aperture_rad = params.focal_length_m / params.f_number / (4.0 * range); // RMS of a disc, one axis
        let kappa = 1.0 / (material.gloss_spread_rad.powi(2) + aperture_rad * aperture_rad);
        diffuse + material.gloss * kappa / (TAU * (1.0 - (-2.0 * kappa).exp())) * (-kappa * off_axis).exp()
    }

    /// What is left at the angle α off the axis. 1/R² and the slant of what is seen hold three of the cosines of cosⁿα.
    fn fall_off(&self, cosine: f64) -> f64 {
        match self.renderer.params.vignetting - 3.0 {
            1.0 => cosine,
            power => cosine.powf(power),
        }
    }

    /// RMS width of the stripe along a column before the pixels' own: the sheet's thickness (1/e² half width w = 2σ), its
    /// spread by what mirrored it, the lens' point spread, the disc of defocus (RMS a quarter of its diameter) and the
    /// rows a third of a column runs over.
    fn stripe_sigma_px(&self, point: &V3, laser_range_m: f64, range_m: f64, row_per_m: f64, slope: f64) -> f64 {
        let (rig, params) = (&self.renderer.rig, &self.renderer.params);
        let own_m = rig.sheet.thickness_m(laser_range_m) / 2.0 * self.beam.thinness;
        let spread_m = self.beam.mirror.map_or(0.0, |mirror| mirror.spread_m(point));
        let thick = own_m.hypot(spread_m) * row_per_m;
        let lf = params.focal_length_m;
        let disc_m = lf / params.f_number * lf * (1.0 / range_m - 1.0 / params.focus_m).abs();
        let defocus = disc_m / 4.0 * rig.camera.fy / lf;
        let run = slope / f64::from(PARTS) / 12f64.sqrt();
        let sum = thick * thick + defocus * defocus + run * run + params.point_spread_px.powi(2);
        sum.sqrt().min(rig.camera.height as f64)
    }
}
