//! Where a line of sight meets the sheet: eq. (1)–(10), (42), as ray ∩ plane for any camera and any plane, with covariance.

use nalgebra::{Matrix3, Vector3};

use super::camera::Camera;
use super::rig::{Laser, Rig};
use super::sheet::LaserPlane;
use crate::geometry::{Point, Sensor};

/// Standard deviations of what a point is computed from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uncertainty {
    /// Column of the peak [px]: half a column's box, 1/√12.
    pub u_px: f64,
    /// Row of the peak [px].
    pub v_px: f64,
    /// Beam angle θB [rad].
    pub beam_rad: f64,
    /// Cylinder angle θR [rad].
    pub cylinder_rad: f64,
}

/// A triangulated point and its covariance.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    /// The point.
    pub point: Point<Sensor>,
    /// Covariance J·diag(σu², σv², σB², σR²)·Jᵀ [m²] (`instrument.md` 3).
    pub covariance: Matrix3<f64>,
}

/// The point where the line of sight of pixel (u, v) meets the sheet; `None` where they do not meet in front of the
/// camera. Exact for every u and v: the general form of (4)–(6) with (42).
pub fn place(rig: &Rig, sheet: &LaserPlane<Sensor>, u: f64, v: f64) -> Option<Point<Sensor>> {
    let eye = Point::<Sensor>::from(rig.sensor_from_camera.xyz());
    let direction = rig.sensor_from_camera.rotate(&rig.camera.ray(u, v)?);
    let t = sheet.plane.meet(eye, &direction).filter(|t| *t > 0.0 && t.is_finite())?;
    Some((eye.xyz + direction * t).into())
}

/// The same with the covariance that noise of pixel and encoders gives it. It is singular where only one or two of them
/// are uncertain.
pub fn triangulate(rig: &Rig, sheet: &LaserPlane<Sensor>, u: f64, v: f64, sigma: &Uncertainty) -> Option<Sighting> {
    let ray = rig.camera.ray(u, v)?;
    let turn = rig.sensor_from_camera.iso.rotation;
    let eye = Point::<Sensor>::from(rig.sensor_from_camera.xyz());
    let direction = turn * ray;
    let t = sheet.plane.meet(eye, &direction).filter(|t| *t > 0.0 && t.is_finite())?;
    let xyz = eye.xyz + direction * t;

    // x = e + t·r with n·x = d: dx = t·(dr − r·(n·dr)/(n·r)) for a turned ray,
    // and dx = r·(dd − dn·x)/(n·r) for a moved plane.
    let n = sheet.plane.normal;
    let closing = n.dot(&direction);
    let turned = camera_ray_turn(&rig.camera, u, v)?;
    let by_ray = |dr: Vector3<f64>| t * (dr - direction * (n.dot(&dr) / closing));
    let du = by_ray(turn * turned.0) * sigma.u_px;
    let dv = by_ray(turn * turned.1) * sigma.v_px;
    // The mirror turns the plane about the sensor's y axis through A, whatever its roll: dn = y × n, n·A − d stays 0.
    let axis = match rig.laser {
        Laser::Mirror(_) => Vector3::y(),
        Laser::Plane(_) => sheet.lateral,
    };
    let dn = axis.cross(&n);
    let db = direction * (-dn.dot(&(xyz - sheet.origin.xyz)) / closing) * sigma.beam_rad;
    let dr = Vector3::new(-xyz.y, xyz.x, 0.0) * sigma.cylinder_rad; // eq. (7): Rz(θR)
    let covariance = du * du.transpose() + dv * dv.transpose() + db * db.transpose() + dr * dr.transpose();
    Some(Sighting { point: xyz.into(), covariance })
}

/// d(ray)/du and d(ray)/dv in the camera frame.
fn camera_ray_turn(camera: &Camera, u: f64, v: f64) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let j = camera.ray_jacobian(u, v)?;
    Some((Vector3::new(j.m11, j.m21, 0.0), Vector3::new(j.m12, j.m22, 0.0)))
}

/// The paper's own closed form (4)–(6), (42), kept beside the general one: for its numbers, and to see what its
/// approximation of Y costs. Lengths in metres, image coordinates divided by the focal length, V up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperGeometry {
    /// Height of the mirror lA.
    pub mirror_height_m: f64,
    /// Height of the camera lA + lB = h_B.
    pub camera_height_m: f64,
    /// Signed OO' of eq. (38): negative, the camera is ahead of the mirror axis.
    pub x0_m: f64,
    /// Tilt of the viewing axis θv.
    pub tilt_rad: f64,
}

impl PaperGeometry {
    /// Tables 3 and 4 as printed, with h_B = lc·sinθc.
    pub fn metro_i() -> Self {
        Self {
            mirror_height_m: 0.817_230,
            camera_height_m: 2.197_820 * 0.489_f64.sin(),
            x0_m: -0.164_630,
            tilt_rad: 0.484,
        }
    }

    /// Eq. (4)–(6), (42) with the exact Y of `paper.md` 5.3. `u`, `v`: undistorted, over lf, V up. Axes of the sensor.
    pub fn exact(&self, u: f64, v: f64, beam_rad: f64) -> Vector3<f64> {
        let (x, z) = self.x_and_z(v, beam_rad);
        let y = -x * u / (self.tilt_rad.cos() + v * self.tilt_rad.sin()); // 5.3: exact form of (5)
        Vector3::new(x - self.x0_m, y, z) // (42)
    }

    /// The same with eq. (5) as printed: exact only at V = 0.
    pub fn printed(&self, u: f64, v: f64, beam_rad: f64) -> Vector3<f64> {
        let (x, z) = self.x_and_z(v, beam_rad);
        let y = -x * u / self.tilt_rad.cos(); // (5)
        Vector3::new(x - self.x0_m, y, z) // (42)
    }

    /// X' from the camera's foot (4) and Z' (6).
    fn x_and_z(&self, v: f64, beam_rad: f64) -> (f64, f64) {
        let over_foot = self.mirror_height_m + self.x0_m * beam_rad.tan(); // (40): l'A(θB) = lA + x0·tanθB
        let above_beam = self.camera_height_m - over_foot; // (41): l'B
        let tilt = self.tilt_rad.tan();
        let x = above_beam / ((tilt - v) / (1.0 + tilt * v) - beam_rad.tan()); // (4)
        (x, over_foot - x * beam_rad.tan()) // (6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::Rig;
    use proptest::prelude::*;

    const EXACT: Uncertainty = Uncertainty { u_px: 0.0, v_px: 0.0, beam_rad: 0.0, cylinder_rad: 0.0 };

    /// `paper.md` 6: (Uf, Vf upwards), X, Y exact, Y print, Z [mm]; numbers that no code here produced.
    const ORACLE: [([f64; 2], [f64; 4]); 3] = [
        ([356.0, 300.0], [1834.8129, -184.3697, -189.4313, 262.7375]),
        ([156.0, 340.0], [2427.9248, 245.9602, 257.2378, 83.4952]),
        ([400.0, 150.0], [971.2675, -138.2801, -132.5508, 523.7066]),
    ];

    #[test]
    fn the_general_form_gives_the_oracle() {
        let rig = Rig::metro_i();
        let sheet = rig.laser_plane(0).unwrap(); // pulse 0 is the beam at P
        for ([u, v_up], [x, y, _, z]) in ORACLE {
            let v = 480.0 - 1.0 - v_up;
            let seen = triangulate(&rig, &sheet, u, v, &EXACT).unwrap().point.xyz * 1e3;
            assert!((seen - Vector3::new(x, y, z)).norm() < 1e-3, "{seen} against {x} {y} {z}");
        }
    }

    #[test]
    fn the_closed_form_gives_the_oracle_exact_and_as_printed() {
        let paper = PaperGeometry::metro_i();
        let beam = (817.230f64 / 2704.210).atan(); // (39)
        for ([u, v_up], [x, y, y_print, z]) in ORACLE {
            let ray = Rig::metro_i().camera.ray(u, 479.0 - v_up).unwrap();
            let exact = paper.exact(ray.x, -ray.y, beam) * 1e3;
            let printed = paper.printed(ray.x, -ray.y, beam) * 1e3;
            assert!((exact - Vector3::new(x, y, z)).norm() < 1e-3, "{exact}");
            assert!((printed - Vector3::new(x, y_print, z)).norm() < 1e-3, "{printed}");
        }
    }

    proptest! {
        #[test]
        fn closed_and_general_form_agree(u in 0.0..511.0f64, v in 60.0..479.0f64, pulse in -100..150i32) {
            let rig = Rig::metro_i();
            let sheet = rig.laser_plane(pulse).unwrap();
            let ray = rig.camera.ray(u, v).unwrap();
            let beam = rig.beam_rad(pulse).unwrap();
            let closed = PaperGeometry::metro_i().exact(ray.x, -ray.y, beam);
            if let Some(general) = triangulate(&rig, &sheet, u, v, &EXACT) && closed.x < 20.0 && closed.x > 0.3 {
                prop_assert!((general.point.xyz - closed).norm() < 1e-8);
            }
        }

        #[test]
        fn the_covariance_is_that_of_small_changes(u in 20.0..490.0f64, v in 150.0..400.0f64, pulse in -20..60i32) {
            let rig = Rig::metro_i();
            let sheet = rig.laser_plane(pulse).unwrap();
            let at = |u: f64, v: f64| triangulate(&rig, &sheet, u, v, &EXACT).map(|s| s.point.xyz);
            let only_v = Uncertainty { v_px: 1e-3, ..EXACT };
            if let (Some(s), Some(hi), Some(lo)) = (triangulate(&rig, &sheet, u, v, &only_v), at(u, v + 5e-4), at(u, v - 5e-4)) {
                let moved = hi - lo;
                prop_assert!((s.covariance - moved * moved.transpose()).norm() < 1e-3 * s.covariance.norm() + 1e-16);
            }
        }
    }

    #[test]
    fn the_covariance_of_a_rolled_slit_is_that_of_a_turned_mirror() {
        let mut rig = Rig::metro_i();
        if let Laser::Mirror(mirror) = &mut rig.laser {
            mirror.roll_rad = 0.1;
        }
        let (beam, step) = (0.3, 1e-5);
        let only_beam = Uncertainty { beam_rad: 1e-3, ..EXACT };
        for (u, v) in [(100.0, 240.0), (400.0, 260.0)] {
            let at = |beam: f64| triangulate(&rig, &rig.laser_plane_at(beam).unwrap(), u, v, &only_beam).unwrap();
            let slope = (at(beam + step).point.xyz - at(beam - step).point.xyz) / (2.0 * step) * 1e-3;
            let covariance = at(beam).covariance;
            assert!((covariance - slope * slope.transpose()).norm() < 1e-4 * covariance.norm());
        }
    }

    #[test]
    fn sensitivities_are_those_of_the_paper() {
        // instrument.md 3, X' = 1500 and 2400 mm: 9.02 and 21.83 mm/px with the printed constants (paper.md 5.6).
        let rig = Rig::metro_i();
        let sheet = rig.laser_plane(0).unwrap();
        for (x_foot_m, mm_per_px, mm_per_pulse) in [(1.5, 9.02, 16.1), (2.4, 21.83, 39.6)] {
            let x = x_foot_m + 0.164_630;
            let z = 0.817_230 - x * (817.230f64 / 2704.210);
            let seen = rig.sensor_from_camera.inverse() * Point::<Sensor>::new(x, 0.0, z);
            let ideal_v = seen.xyz.y / seen.xyz.z;
            let v = rig.camera.cy + rig.camera.fy * ideal_v; // without distortion, as in instrument.md
            let mut ideal = rig.clone();
            ideal.camera.distortion = crate::optics::Distortion::Pinhole;
            let by =
                |sigma: Uncertainty| triangulate(&ideal, &sheet, 256.0, v, &sigma).unwrap().covariance.m11.sqrt() * 1e3;
            let per_px = by(Uncertainty { v_px: 1.0, ..EXACT });
            let per_pulse = by(Uncertainty { beam_rad: std::f64::consts::TAU / 4000.0, ..EXACT });
            assert!((per_px - mm_per_px).abs() < 0.06, "{per_px} mm/px at {x_foot_m} m");
            assert!((per_pulse / mm_per_pulse - 1.0).abs() < 0.02, "{per_pulse} mm/pulse at {x_foot_m} m");
        }
    }
}
