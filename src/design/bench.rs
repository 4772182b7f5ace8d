//! A finder on the bench: where its beam and its camera meet a given place, and what light comes back from there.
//!
//! Everything is in the robot's frame with the cylinder straight ahead (θR = 0), so the floor is z = 0. The light is that of
//! `instrument.md` 1, the geometry that of `optics::triangulate`; a test holds both against the renderer.

use std::f64::consts::PI;

use nalgebra::{Matrix2, Matrix3, Rotation3, Vector2, Vector3};

use crate::geometry::{Point, Robot, Sensor, Transform};
use crate::optics::{Axis, Laser, LaserPlane, Rig, Uncertainty, triangulate};
use crate::scanner::ImageParams;

pub(super) type V3 = Vector3<f64>;

/// h·c [J·m].
const PLANCK_TIMES_LIGHT: f64 = 6.626_070_15e-34 * 299_792_458.0;
/// Nothing uncertain.
pub(super) const EXACT: Uncertainty = Uncertainty { u_px: 0.0, v_px: 0.0, beam_rad: 0.0, cylinder_rad: 0.0 };

/// A finder, looked at from outside.
pub(super) struct Bench<'a> {
    pub rig: &'a Rig,
    pub image: &'a ImageParams,
    pub robot_from_sensor: Transform<Robot, Sensor>,
    /// The camera's centre.
    pub eye: V3,
    /// Where the light comes from.
    pub source: V3,
}

/// A lit place as the camera sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sight {
    pub point: V3,
    /// (u, v) [px]; may lie outside the image.
    pub pixel: [f64; 2],
    pub beam_rad: f64,
    /// RMS width of the stripe along the column, without the pixel's own [px].
    pub stripe_px: f64,
    /// Electrons that a column gets from a white surface (albedo 1).
    pub electrons: f64,
    /// Length of the stripe that one column sees [m].
    pub column_m: f64,
    pub in_image: bool,
    /// Within the 1/e² width of the sheet.
    pub in_fan: bool,
    pub in_travel: bool,
}

impl<'a> Bench<'a> {
    pub fn new(rig: &'a Rig, image: &'a ImageParams) -> Self {
        let robot_from_sensor = rig.robot_from_sensor_at(0.0);
        let eye = (robot_from_sensor * Point::<Sensor>::from(rig.sensor_from_camera.xyz())).xyz;
        let mut bench = Self { rig, image, robot_from_sensor, eye, source: eye };
        bench.source = bench.sheet(0.0).map_or(eye, |sheet| sheet.origin.xyz);
        bench
    }

    /// The axis of the beam; `None` where the laser stands still.
    pub fn beam(&self) -> Option<Axis> {
        match self.rig.laser {
            Laser::Mirror(mirror) => Some(mirror.beam),
            Laser::Plane(_) => None,
        }
    }

    /// The sheet at a beam angle.
    pub fn sheet(&self, beam_rad: f64) -> Option<LaserPlane<Robot>> {
        Some(self.robot_from_sensor * self.rig.laser_plane_at(beam_rad).ok()?)
    }

    /// The beam angle whose sheet passes through a point: θB of (1), with the slit's roll. A sheet that stands still has
    /// angle 0, and passes where it passes.
    pub fn beam_to(&self, point: &V3) -> Option<f64> {
        let Laser::Mirror(mirror) = self.rig.laser else { return Some(0.0) };
        let here = self.robot_from_sensor.inverse() * Point::<Robot>::from(*point);
        let q = here.xyz - V3::from(mirror.mirror_m);
        // n = Ry(θ)·Rx(roll)·z = (sinθ·cos r, −sin r, cosθ·cos r); n·q = 0.
        let across = q.y * mirror.roll_rad.tan();
        let reach = q.x.hypot(q.z);
        let beam = (across / reach).asin() - q.z.atan2(q.x);
        beam.is_finite().then_some(beam)
    }

    /// The pulse count, not rounded, of a beam angle.
    pub fn pulse(&self, beam_rad: f64) -> Option<f64> {
        let axis = self.beam()?;
        let pulse = (beam_rad - axis.zero_rad) / axis.rad_per_pulse;
        pulse.is_finite().then_some(pulse)
    }

    /// Whether the mirror can make this angle.
    pub fn in_travel(&self, beam_rad: f64) -> bool {
        let Some(axis) = self.beam() else { return true };
        let half = axis.rad_per_pulse.abs() / 2.0 + 1e-9;
        let ends = [axis.pulse_min, axis.pulse_max].map(|p| axis.zero_rad + f64::from(p) * axis.rad_per_pulse);
        beam_rad >= ends[0].min(ends[1]) - half && beam_rad <= ends[0].max(ends[1]) + half
    }

    /// The line of sight of a pixel.
    pub fn ray(&self, u: f64, v: f64) -> Option<V3> {
        let ray = self.rig.camera.ray(u, v)?;
        Some(self.robot_from_sensor.rotate(&self.rig.sensor_from_camera.rotate(&ray)))
    }

    /// Where a point falls in the image.
    pub fn project(&self, point: &V3) -> Option<[f64; 2]> {
        let to_camera = (self.robot_from_sensor * self.rig.sensor_from_camera).inverse();
        self.rig.camera.project(&(to_camera * Point::<Robot>::from(*point)).xyz)
    }

    /// The column of the optical axis, or the middle one if that lies outside the image.
    pub fn middle_column(&self) -> f64 {
        let camera = &self.rig.camera;
        let last = camera.width as f64 - 1.0;
        if (0.0..=last).contains(&camera.cx) { camera.cx } else { last / 2.0 }
    }

    /// The lines of sight of the picture's top and bottom edge in the middle column.
    pub fn edges(&self) -> Option<[V3; 2]> {
        let u = self.middle_column();
        Some([self.ray(u, -0.5)?, self.ray(u, self.rig.camera.height as f64 - 0.5)?])
    }

    /// Where three planes meet: n·x = d each.
    fn meet(planes: [(V3, f64); 3]) -> Option<V3> {
        let rows = Matrix3::from_rows(&planes.map(|(n, _)| n.transpose()));
        let point = rows.try_inverse()? * V3::from(planes.map(|(_, d)| d));
        point.iter().all(|x| x.is_finite()).then_some(point)
    }

    /// The plane of the middle column's lines of sight.
    fn section(&self) -> Option<(V3, f64)> {
        let [top, bottom] = self.edges()?;
        let normal = top.cross(&bottom).try_normalize(1e-12)?;
        Some((normal, normal.dot(&self.eye)))
    }

    /// The floor at X, in the middle column.
    pub fn floor_at(&self, x_m: f64) -> Option<V3> {
        Self::meet([self.section()?, (V3::x(), x_m), (V3::z(), 0.0)])
    }

    /// The sheet of a beam at X, in the middle column.
    pub fn sheet_at(&self, beam_rad: f64, x_m: f64) -> Option<V3> {
        let sheet = self.sheet(beam_rad)?;
        Self::meet([self.section()?, (V3::x(), x_m), (sheet.plane.normal, sheet.plane.offset)])
    }

    /// A lit place on a surface with this normal; `None` if the camera cannot image it, or camera or laser are behind it.
    pub fn look(&self, point: &V3, normal: &V3, beam_rad: f64) -> Option<Sight> {
        let (rig, camera) = (self.rig, &self.rig.camera);
        let sheet = self.sheet(beam_rad)?;
        let (to_laser, to_eye) = (sheet.origin.xyz - point, self.eye - point);
        if normal.dot(&to_laser) <= 0.0 || normal.dot(&to_eye) <= 0.0 {
            return None;
        }
        let camera_from_robot = (self.robot_from_sensor * rig.sensor_from_camera).inverse();
        let seen = (camera_from_robot * Point::<Robot>::from(*point)).xyz;
        let [u, v] = camera.project(&seen)?;
        let pixels_per_ray: Matrix2<f64> = camera.ray_jacobian(u, v)?.try_inverse()?;
        let flow = |way: &V3| {
            let way = camera_from_robot.rotate(way);
            let ray = Vector2::new(way.x * seen.z - seen.x * way.z, way.y * seen.z - seen.y * way.z);
            pixels_per_ray * ray / (seen.z * seen.z)
        };
        let along = normal.cross(&sheet.plane.normal).try_normalize(1e-12)?;
        let across = normal.cross(&along);
        let (along_px, across_px) = (flow(&along), flow(&across));
        let columns_per_m = along_px.x.abs().max(0.05 * along_px.y.abs());
        let row_per_m = (across_px.y - across_px.x * along_px.y / columns_per_m.copysign(along_px.x))
            / sheet.plane.normal.dot(&across);
        // The fan: power between two of its rays is the same at any range and slant.
        let (x, y) = (-sheet.forward.dot(&to_laser), -sheet.lateral.dot(&to_laser));
        let width = rig.sheet.width_m(x);
        let fan = sheet.lateral.dot(&along) - y / width * rig.sheet.width_per_m * sheet.forward.dot(&along);
        let power_w = rig.sheet.line_power_w_per_m(x, y) * (fan / columns_per_m).abs(); // p·Δy
        let range = to_eye.norm();
        let electrons = power_w * self.electrons_per_watt(range) * normal.dot(&to_eye) / range;
        let inside = |at: f64, size: usize| at >= -0.5 && at <= size as f64 - 0.5;
        Some(Sight {
            point: *point,
            pixel: [u, v],
            beam_rad,
            stripe_px: self.stripe_px(to_laser.norm(), range, row_per_m),
            electrons,
            column_m: 1.0 / columns_per_m,
            in_image: inside(u, camera.width) && inside(v, camera.height),
            in_fan: x > 0.0 && y.abs() <= width / 2.0,
            in_travel: self.in_travel(beam_rad),
        })
    }

    /// Electrons from a watt on a white surface that faces the camera at this range: Ω/π·τ·t·η·λ/(hc).
    pub fn electrons_per_watt(&self, range_m: f64) -> f64 {
        let aperture = PI * (self.image.focal_length_m / (2.0 * self.image.f_number)).powi(2) / (range_m * range_m); // Ω
        aperture / PI * self.image.exposure_s * self.electrons_per_joule()
    }

    /// Electrons that a joule in front of the lens becomes.
    fn electrons_per_joule(&self) -> f64 {
        let image = self.image;
        let through = image.lens_transmission * image.filter_transmission * image.quantum_efficiency;
        through * self.rig.sheet.wavelength_m / PLANCK_TIMES_LIGHT
    }

    /// Electrons that every pixel has without the laser, in this ambient light within the filter's band [W/m²].
    pub fn background(&self, ambient_w_per_m2: f64) -> f64 {
        let image = self.image;
        let pitch = image.focal_length_m.powi(2) / (self.rig.camera.fx * self.rig.camera.fy);
        // A pixel sees radiance ρE/π through the solid angle π/(4N²).
        let power_w = ambient_w_per_m2 * image.ambient_albedo / (4.0 * image.f_number * image.f_number) * pitch;
        image.dark_electrons + power_w * image.exposure_s * self.electrons_per_joule()
    }

    /// RMS width of the stripe: thickness of the sheet, defocus (a quarter of its disc), point spread [px].
    pub fn stripe_px(&self, laser_range_m: f64, range_m: f64, row_per_m: f64) -> f64 {
        let (rig, image) = (self.rig, self.image);
        let thick = rig.sheet.thickness_m(laser_range_m) / 2.0 * row_per_m;
        let disc_m =
            image.focal_length_m / image.f_number * image.focal_length_m * (1.0 / range_m - 1.0 / image.focus_m).abs();
        let defocus = disc_m / 4.0 * rig.camera.fy / image.focal_length_m;
        (thick * thick + defocus * defocus + image.point_spread_px.powi(2)).sqrt()
    }

    /// Standard deviations of x, y, z [m] where the camera's pixel meets the sheet.
    pub fn spread(&self, sight: &Sight, sigma: &Uncertainty) -> Option<V3> {
        let sheet = self.rig.laser_plane_at(sight.beam_rad).ok()?;
        let seen = triangulate(self.rig, &sheet, sight.pixel[0], sight.pixel[1], sigma)?;
        let turn = self.robot_from_sensor.iso.rotation.to_rotation_matrix();
        let covariance = turn.matrix() * seen.covariance * turn.matrix().transpose();
        Some(covariance.diagonal().map(|variance| variance.max(0.0).sqrt()))
    }

    /// How far a point moves in x, y, z [m/rad] with the camera's pitch, nose down, by a small difference.
    pub fn by_pitch(&self, sight: &Sight) -> Option<V3> {
        let step = 1e-6;
        let at = |pitch: f64| {
            let rig = pitched(self.rig, pitch);
            let sheet = rig.laser_plane_at(sight.beam_rad).ok()?;
            let seen = triangulate(&rig, &sheet, sight.pixel[0], sight.pixel[1], &EXACT)?;
            Some((self.robot_from_sensor * seen.point).xyz)
        };
        Some((at(step)? - at(-step)?) / (2.0 * step))
    }
}

/// The rig with its camera's nose turned down by `pitch_rad` about its own x axis.
pub(super) fn pitched(rig: &Rig, pitch_rad: f64) -> Rig {
    let mut rig = rig.clone();
    // The camera's y points down: turning z towards y is a turn about −x.
    let turn = Rotation3::from_axis_angle(&V3::x_axis(), -pitch_rad);
    rig.sensor_from_camera.iso.rotation *= nalgebra::UnitQuaternion::from_rotation_matrix(&turn);
    rig
}
