//! A finder: a camera, a laser, and how encoders move them. METRO-I is one instance, a fixed camera and plane another.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::camera::Camera;
use super::parameters::RigCovariance;
use super::sheet::{LaserPlane, Sheet};
use super::triangulate::PaperGeometry;
use crate::fault::{Fault, Result, exactly, exactly_if_there, number_within, positive};
use crate::geometry::{Plane, Point, Robot, Sensor, Transform};

/// A rotary axis read by an encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Axis {
    /// Angle at pulse 0 [rad].
    pub zero_rad: f64,
    /// Angle a pulse [rad].
    pub rad_per_pulse: f64,
    /// Lowest pulse the axis can reach.
    pub pulse_min: i32,
    /// Highest pulse the axis can reach.
    pub pulse_max: i32,
}

impl Axis {
    /// An axis that does not move.
    pub const FIXED: Self = Self { zero_rad: 0.0, rad_per_pulse: 0.0, pulse_min: 0, pulse_max: 0 };

    /// The angle at a pulse count; an error outside the axis' travel.
    pub fn angle(&self, what: &str, pulse: i32) -> Result<f64> {
        if !(self.pulse_min..=self.pulse_max).contains(&pulse) {
            let expected = format!("a pulse count from {} to {}", self.pulse_min, self.pulse_max);
            return Err(Fault::new(what, pulse, expected));
        }
        Ok(self.zero_rad + f64::from(pulse) * self.rad_per_pulse)
    }

    fn validated(self, what: &str) -> Result<Self> {
        number_within(&format!("{what}.zero_rad"), self.zero_rad, -1e3, 1e3)?;
        number_within(&format!("{what}.rad_per_pulse"), self.rad_per_pulse, -1.0, 1.0)?;
        if self.pulse_min > self.pulse_max {
            let expected = format!("at most pulse_max, {}", self.pulse_max);
            return Err(Fault::new(format!("{what}.pulse_min"), self.pulse_min, expected));
        }
        Ok(self)
    }
}

/// A sheet tilted by a mirror: the plane through A at the beam angle θB below the horizontal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MirrorLaser {
    /// A, the centre of the mirror, in the sensor frame [m]: (0, 0, lA).
    #[serde(deserialize_with = "exactly")]
    pub mirror_m: [f64; 3],
    /// θB over mirror pulses; the angle grows as the beam tilts down.
    pub beam: Axis,
    /// Turn of the slit about the beam [rad]: 0 is level.
    #[serde(default)]
    pub roll_rad: f64,
}

/// A sheet that stands still with respect to the camera: n·x = d in the camera's optical frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaneLaser {
    /// Normal of the plane, any length.
    #[serde(deserialize_with = "exactly")]
    pub normal: [f64; 3],
    /// Offset d of n·x = d [m], for the normal as given.
    pub offset_m: f64,
    /// Where the light comes from, in the camera frame [m]. Without it, the foot of the camera on the plane is taken:
    /// then no free space is claimed along the laser's own rays.
    #[serde(default, deserialize_with = "exactly_if_there")]
    pub origin_m: Option<[f64; 3]>,
}

/// How the sheet of light is held.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Laser {
    /// By a tilting mirror.
    Mirror(MirrorLaser),
    /// Fixed to the camera.
    Plane(PlaneLaser),
}

/// A finder: all that turns pixels and pulses into points.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// Its name.
    pub name: String,
    /// The camera.
    pub camera: Camera,
    /// Where the camera is on the cylinder.
    pub sensor_from_camera: Transform<Sensor, crate::geometry::Camera>,
    /// The laser.
    pub laser: Laser,
    /// The light in the sheet.
    pub sheet: Sheet,
    /// θR over cylinder pulses.
    pub cylinder: Axis,
    /// Where the finder stands on the robot at θR = 0.
    pub robot_from_finder: Transform<Robot, Robot>,
    /// Standard deviation of the beam angle [rad].
    pub beam_sigma_rad: f64,
    /// Standard deviation of the cylinder angle [rad].
    pub cylinder_sigma_rad: f64,
    /// Points farther than this from the robot's origin are not used [m].
    pub range_m_max: f64,
    /// How well its calibration knows it; exactly, by default.
    pub covariance: RigCovariance,
}

/// The mirror's and the cylinder's encoders: 4000 pulses a turn of the beam (`paper.md` 5.4).
const RAD_PER_PULSE: f64 = TAU / 4000.0;

impl Rig {
    /// METRO-I with the constants of Tables 3 and 4 as printed; mirror pulse 0 puts the beam on P.
    pub fn metro_i() -> Self {
        let paper = PaperGeometry::metro_i();
        let beam_at_p = (paper.mirror_height_m / (1.504_210 + 2.0 * 0.600)).atan(); // (39)
        Self {
            name: "METRO-I".into(),
            camera: Camera::metro_i(),
            sensor_from_camera: tilted_camera([-paper.x0_m, 0.0, paper.camera_height_m], paper.tilt_rad),
            laser: Laser::Mirror(MirrorLaser {
                mirror_m: [0.0, 0.0, paper.mirror_height_m],
                beam: Axis { zero_rad: beam_at_p, rad_per_pulse: RAD_PER_PULSE, pulse_min: -190, pulse_max: 300 },
                roll_rad: 0.0,
            }),
            sheet: Sheet::default(),
            cylinder: Axis { zero_rad: 0.0, rad_per_pulse: RAD_PER_PULSE, pulse_min: -4000, pulse_max: 8000 },
            robot_from_finder: Transform::identity(),
            beam_sigma_rad: 0.1 * RAD_PER_PULSE, // [A] instrument.md 5: the mirror stops with σ = 0.1 pulse
            cylinder_sigma_rad: RAD_PER_PULSE / 12f64.sqrt(), // read to whole pulses
            range_m_max: 4.5,
            covariance: RigCovariance::default(),
        }
    }

    /// Refuses a finder that cannot see: bad camera or axes, or a laser plane through the camera's centre.
    pub fn validated(mut self) -> Result<Self> {
        self.covariance = std::mem::take(&mut self.covariance).validated(&self)?;
        self.camera.validated()?;
        self.sheet.validated()?;
        self.cylinder.validated("cylinder")?;
        positive("range_m_max", self.range_m_max)?;
        number_within("beam_sigma_rad", self.beam_sigma_rad, 0.0, 1.0)?;
        number_within("cylinder_sigma_rad", self.cylinder_sigma_rad, 0.0, 1.0)?;
        for (what, finite) in
            [("mount", self.sensor_from_camera.is_finite()), ("finder", self.robot_from_finder.is_finite())]
        {
            if !finite {
                return Err(Fault::new(what, "a pose that is not finite", "finite numbers"));
            }
        }
        let pulses = match self.laser {
            Laser::Mirror(mirror) => {
                mirror.beam.validated("laser.beam")?;
                evenly(mirror.beam.pulse_min, mirror.beam.pulse_max)
            }
            Laser::Plane(_) => vec![0],
        };
        let eye = Point::from(self.sensor_from_camera.xyz());
        let mut side = 0.0;
        for pulse in pulses {
            let apart = self.laser_plane(pulse)?.plane.distance(eye);
            if apart.abs() < 1e-3 || apart * side < 0.0 {
                let found =
                    format!("a plane {:.3} mm from the camera's centre at mirror pulse {pulse}", apart.abs() * 1e3);
                let expected = "a plane at least 1 mm from it that never sweeps over it: nothing can be triangulated";
                return Err(Fault::new("laser", found, expected));
            }
            side = apart;
        }
        Ok(self)
    }

    /// θB at a mirror pulse [rad]; 0 for a fixed plane.
    pub fn beam_rad(&self, mirror_pulse: i32) -> Result<f64> {
        match self.laser {
            Laser::Mirror(mirror) => mirror.beam.angle("mirror encoder", mirror_pulse),
            Laser::Plane(_) => Axis::FIXED.angle("mirror encoder", mirror_pulse),
        }
    }

    /// The sheet at a mirror pulse.
    pub fn laser_plane(&self, mirror_pulse: i32) -> Result<LaserPlane<Sensor>> {
        self.laser_plane_at(self.beam_rad(mirror_pulse)?)
    }

    /// The sheet at a beam angle θB [rad], which a simulated mirror takes between whole pulses.
    pub fn laser_plane_at(&self, beam_rad: f64) -> Result<LaserPlane<Sensor>> {
        match self.laser {
            Laser::Mirror(mirror) => {
                let [x, y, z] = mirror.mirror_m;
                let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), beam_rad)
                    * Rotation3::from_axis_angle(&Vector3::x_axis(), mirror.roll_rad);
                let (forward, lateral, normal) = (turn * Vector3::x(), turn * Vector3::y(), turn * Vector3::z());
                let origin = Point::new(x, y, z);
                let plane = Plane::through(origin, normal)
                    .ok_or_else(|| Fault::new("laser.mirror_m", format!("{x}, {y}, {z}"), "finite numbers"))?;
                Ok(LaserPlane { plane, origin, forward, lateral }) // (1): Z' = lA − X'·tanθB
            }
            Laser::Plane(fixed) => self.fixed_plane(&fixed),
        }
    }

    fn fixed_plane(&self, fixed: &PlaneLaser) -> Result<LaserPlane<Sensor>> {
        let [a, b, c] = fixed.normal;
        let refused = || Fault::new("laser.normal", format!("{a}, {b}, {c}"), "finite numbers, not all 0");
        let plane = Plane::<crate::geometry::Camera>::new(Vector3::new(a, b, c), fixed.offset_m).ok_or_else(refused)?;
        let foot = plane.normal * plane.offset;
        let origin = fixed.origin_m.map_or(foot, |[x, y, z]| Vector3::new(x, y, z));
        let along = Vector3::z() - plane.normal * plane.normal.z;
        let forward = along.try_normalize(1e-9).unwrap_or_else(|| plane.normal.cross(&Vector3::x()).normalize());
        let lateral = -plane.normal.cross(&forward) * if plane.normal.y > 0.0 { -1.0 } else { 1.0 };
        Ok(self.sensor_from_camera * LaserPlane { plane, origin: origin.into(), forward, lateral })
    }

    /// Whether the laser's own position is known, so that its rays prove free space.
    pub fn knows_laser_origin(&self) -> bool {
        match self.laser {
            Laser::Mirror(_) => true,
            Laser::Plane(fixed) => fixed.origin_m.is_some(),
        }
    }

    /// Eq. (7): the pose of the turned cylinder on the robot.
    pub fn robot_from_sensor(&self, cylinder_pulse: i32) -> Result<Transform<Robot, Sensor>> {
        Ok(self.robot_from_sensor_at(self.cylinder.angle("cylinder encoder", cylinder_pulse)?))
    }

    /// Eq. (7) at an angle θR [rad].
    pub fn robot_from_sensor_at(&self, cylinder_rad: f64) -> Transform<Robot, Sensor> {
        let turn = Transform::<Robot, Sensor>::planar(0.0, 0.0, cylinder_rad); // Rz(θR)
        self.robot_from_finder * turn
    }
}

/// Up to some 4000 pulses from first to last, both among them.
fn evenly(first: i32, last: i32) -> Vec<i32> {
    let step = ((i64::from(last) - i64::from(first)) / 4000).max(1);
    let inner = (i64::from(first)..i64::from(last)).step_by(step as usize).map(|pulse| pulse as i32);
    inner.chain([last]).collect()
}

/// A camera at a position [m] in the sensor frame that looks forward, tilted down by `tilt_rad`, without roll.
pub fn tilted_camera(xyz: [f64; 3], tilt_rad: f64) -> Transform<Sensor, crate::geometry::Camera> {
    // Columns: the camera's x (right = −Y'), y (down), z (view) in the sensor frame.
    let (s, c) = tilt_rad.sin_cos();
    let axes = Matrix3::new(0.0, -s, c, -1.0, 0.0, 0.0, 0.0, -c, -s);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    nalgebra::Isometry3::from_parts(nalgebra::Translation3::new(xyz[0], xyz[1], xyz[2]), rotation).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metro_i_is_valid_and_has_the_papers_numbers() {
        let rig = Rig::metro_i().validated().unwrap();
        let h_b = rig.sensor_from_camera.xyz().z * 1e3;
        assert!((h_b - 1032.411).abs() < 1e-3); // paper.md 6
        // (40), (41): l'A = 767.478, l'B = 264.934 mm under and over the beam at the camera's foot.
        let sheet = rig.laser_plane(0).unwrap();
        let eye = Point::<Sensor>::from(rig.sensor_from_camera.xyz());
        let down = sheet.plane.meet(eye, &-Vector3::z()).unwrap() * 1e3;
        assert!((down - 264.934).abs() < 1e-3, "{down}");
    }

    #[test]
    fn the_beam_reaches_the_floor_at_the_slits_of_the_paper() {
        // Fig. 11: 46, 81, 108, 130 pulses from the slit at 0 to those at 300, 600, 900, 1200 mm, outward from R.
        let rig = Rig::metro_i();
        let beam_at = |x_mm: f64| (817.230f64 / x_mm).atan();
        for (slit_mm, pulses) in [(300.0, 46.0), (600.0, 81.0), (900.0, 108.0), (1200.0, 130.0)] {
            let turned = (beam_at(1504.210) - beam_at(1504.210 + slit_mm)) / RAD_PER_PULSE;
            assert_eq!(turned.round(), pulses);
        }
        assert!((rig.beam_rad(0).unwrap() - beam_at(2704.210)).abs() < 1e-9);
    }

    #[test]
    fn a_pulse_outside_the_travel_is_refused() {
        let fault = Rig::metro_i().laser_plane(301).unwrap_err();
        assert_eq!(fault.to_string(), "mirror encoder: found 301, expected a pulse count from -190 to 300");
        assert!(Rig::metro_i().robot_from_sensor(-4001).is_err());
    }

    #[test]
    fn a_plane_that_sweeps_over_the_camera_is_refused() {
        let mut rig = Rig::metro_i();
        if let Laser::Mirror(mirror) = &mut rig.laser {
            mirror.mirror_m = [0.0, 0.0, rig.sensor_from_camera.xyz().z];
            mirror.beam = Axis { zero_rad: 0.0, rad_per_pulse: 0.01, pulse_min: -10, pulse_max: 10 };
        }
        assert!(rig.validated().unwrap_err().to_string().contains("mirror pulse"));
    }

    #[test]
    fn a_plane_through_the_camera_is_refused() {
        let laser = Laser::Plane(PlaneLaser { normal: [0.0, 1.0, 0.2], offset_m: 0.0, origin_m: None });
        let fault = Rig { laser, ..Rig::metro_i() }.validated().unwrap_err();
        assert!(fault.to_string().contains("from the camera's centre"), "{fault}");
        let laser = Laser::Plane(PlaneLaser { normal: [0.0, 0.0, 0.0], offset_m: 1.0, origin_m: None });
        assert!(Rig { laser, ..Rig::metro_i() }.validated().is_err());
    }
}
