//! Line → Profile: pixels to points, in the sensor's, the robot's (eq. 7) and the world's frame, each with its covariance.

use nalgebra::Matrix3;

use crate::geometry::{Frame, Point, Robot, Transform};
use crate::image::{Drop, Dropped, Line};
use crate::optics::{LaserPlane, Rig, Uncertainty, triangulate};
use crate::time::Stamp;

/// One point of a profile.
#[derive(Clone, Copy, Debug)]
pub struct ProfilePoint<F> {
    /// Image column it was seen in.
    pub column: u16,
    /// The point.
    pub point: Point<F>,
    /// Its covariance [m²].
    pub covariance: Matrix3<f64>,
    /// Level of its peak over the background [levels].
    pub level: f32,
}

/// The points of one capture: all on one plane of light, all seen from one camera.
#[derive(Clone, Debug)]
pub struct Profile<F> {
    /// Middle of the exposure.
    pub stamp: Stamp,
    /// The sheet of light.
    pub sheet: LaserPlane<F>,
    /// Whether `sheet.origin` is known to be where the light comes from.
    pub knows_laser_origin: bool,
    /// The camera's centre.
    pub eye: Point<F>,
    /// The points, in the order of their columns.
    pub points: Vec<ProfilePoint<F>>,
}

/// The profile of a line in the robot's frame, by eq. (4)–(7) and (42), and the columns that gave no point.
///
/// Errors: an encoder outside its travel.
pub fn profile(
    rig: &Rig,
    line: &Line,
    stamp: Stamp,
    cylinder_pulse: i32,
    mirror_pulse: i32,
) -> crate::fault::Result<(Profile<Robot>, Dropped)> {
    let sheet = rig.laser_plane(mirror_pulse)?;
    let robot_from_sensor = rig.robot_from_sensor(cylinder_pulse)?;
    let mut dropped = Dropped::default();
    let mut points = Vec::with_capacity(line.width());
    for (column, peak) in line.columns.iter().enumerate() {
        let Some(peak) = peak else { continue };
        let sigma = Uncertainty {
            u_px: 1.0 / 12f64.sqrt(),
            v_px: f64::from(peak.sigma),
            beam_rad: rig.beam_sigma_rad,
            cylinder_rad: rig.cylinder_sigma_rad,
        };
        let Some(seen) = triangulate(rig, &sheet, column as f64, f64::from(peak.v), &sigma) else {
            dropped.add(Drop::NoPoint);
            continue;
        };
        if seen.point.xyz.norm() > rig.range_m_max {
            dropped.add(Drop::OutOfRange);
            continue;
        }
        let turn = robot_from_sensor.iso.rotation.to_rotation_matrix();
        points.push(ProfilePoint {
            column: column as u16,
            point: robot_from_sensor * seen.point,
            covariance: turn.matrix() * seen.covariance * turn.matrix().transpose(),
            level: peak.level,
        });
    }
    let profile = Profile {
        stamp,
        sheet: robot_from_sensor * sheet,
        knows_laser_origin: rig.knows_laser_origin(),
        eye: robot_from_sensor * Point::from(rig.sensor_from_camera.xyz()),
        points,
    };
    Ok((profile, dropped))
}

impl<F: Frame> Profile<F> {
    /// The same profile seen from another frame.
    pub fn moved<To: Frame>(&self, to_from: &Transform<To, F>) -> Profile<To> {
        let turn = to_from.iso.rotation.to_rotation_matrix();
        let moved = |p: &ProfilePoint<F>| ProfilePoint {
            column: p.column,
            point: *to_from * p.point,
            covariance: turn.matrix() * p.covariance * turn.matrix().transpose(),
            level: p.level,
        };
        Profile {
            stamp: self.stamp,
            sheet: *to_from * self.sheet,
            knows_laser_origin: self.knows_laser_origin,
            eye: *to_from * self.eye,
            points: self.points.iter().map(moved).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::World;
    use crate::image::Peak;

    fn flat_line(v: f32) -> Line {
        let peak = Peak { v, sigma: 0.1, level: 50.0 };
        Line { height: 480, columns: vec![Some(peak); 512], dropped: Dropped::default() }
    }

    #[test]
    fn points_lie_on_the_sheet_and_turn_with_the_cylinder() {
        let rig = Rig::metro_i();
        let (ahead, _) = profile(&rig, &flat_line(250.0), Stamp(0), 0, 0).unwrap();
        let (left, _) = profile(&rig, &flat_line(250.0), Stamp(0), 1000, 0).unwrap(); // a quarter turn
        assert_eq!(ahead.points.len(), 512);
        for (a, l) in ahead.points.iter().zip(&left.points) {
            assert!(ahead.sheet.plane.distance(a.point).abs() < 1e-9);
            let turned = nalgebra::Vector3::new(-a.point.xyz.y, a.point.xyz.x, a.point.xyz.z); // eq. (7)
            assert!((turned - l.point.xyz).norm() < 1e-9);
        }
    }

    #[test]
    fn a_profile_moved_and_moved_back_is_the_same() {
        let rig = Rig::metro_i();
        let (seen, _) = profile(&rig, &flat_line(250.0), Stamp(0), 300, 20).unwrap();
        let pose = Transform::<World, Robot>::from_xyz_rpy([1.0, 2.0, 0.1], [0.1, -0.1, 2.0]);
        let back: Profile<Robot> = seen.moved(&pose).moved(&pose.inverse());
        for (a, b) in seen.points.iter().zip(&back.points) {
            assert!((a.point.xyz - b.point.xyz).norm() < 1e-12);
            assert!((a.covariance - b.covariance).norm() < 1e-15);
        }
    }

    #[test]
    fn an_encoder_outside_its_travel_is_an_error() {
        assert!(profile(&Rig::metro_i(), &flat_line(250.0), Stamp(0), 0, 9999).is_err());
    }
}
