//! Line → Profile: pixels to points, in the sensor's, the robot's (eq. 7) and the world's frame, each with its covariance.

use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};

use crate::fault::Result;
use crate::geometry::{Frame, Point, Robot, Sensor, Transform};
use crate::image::{Drop, Dropped, Line};
use crate::optics::{LaserPlane, Rig, RigCovariance, Uncertainty, place, triangulate};
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

/// A finder with its sheet and its cylinder where they were, and one parameter larger by so much.
struct Shifted {
    rig: Rig,
    sheet: LaserPlane<Sensor>,
    robot_from_sensor: Transform<Robot, Sensor>,
    by: f64,
}

/// What calibration leaves open about one capture's points.
struct Calibration {
    shifted: Vec<Shifted>,
    covariance: DMatrix<f64>,
}

impl Calibration {
    /// A parameter is moved by this share of its standard deviation to see what it does: small beside what bends the
    /// geometry, large beside rounding.
    const STEP: f64 = 0.01;

    fn new(rig: &Rig, cylinder_pulse: i32, mirror_pulse: i32) -> Result<Self> {
        let RigCovariance { parameters, matrix } = &rig.covariance;
        let size = parameters.len();
        let mut shifted = Vec::with_capacity(size);
        for (i, name) in parameters.iter().enumerate() {
            let by = Self::STEP * matrix[i][i].max(0.0).sqrt();
            let rig = rig.shifted(name, by)?;
            let (sheet, robot_from_sensor) = (rig.laser_plane(mirror_pulse)?, rig.robot_from_sensor(cylinder_pulse)?);
            shifted.push(Shifted { rig, sheet, robot_from_sensor, by });
        }
        Ok(Self { shifted, covariance: DMatrix::from_fn(size, size, |i, j| matrix[i][j]) })
    }

    /// J·Σ·Jᵀ of the point in the robot's frame that pixel (u, v) shows; `None` where a finder nearby sees no such point.
    fn covariance(&self, point: &Point<Robot>, u: f64, v: f64) -> Option<Matrix3<f64>> {
        let mut jacobian = Matrix3xX::zeros(self.shifted.len());
        for (i, Shifted { rig, sheet, robot_from_sensor, by }) in self.shifted.iter().enumerate() {
            if *by > 0.0 {
                let there = *robot_from_sensor * place(rig, sheet, u, v)?;
                jacobian.set_column(i, &((there.xyz - point.xyz) / *by));
            }
        }
        Some(&jacobian * &self.covariance * jacobian.transpose())
    }
}

/// The profile of a line in the robot's frame, by eq. (4)–(7) and (42), and the columns that gave no point. Covariances
/// are those of pixel, encoders and, where the finder has it, calibration (`instrument.md` 3).
///
/// Errors: an encoder outside its travel.
pub fn profile(
    rig: &Rig,
    line: &Line,
    stamp: Stamp,
    cylinder_pulse: i32,
    mirror_pulse: i32,
) -> Result<(Profile<Robot>, Dropped)> {
    let sheet = rig.laser_plane(mirror_pulse)?;
    let robot_from_sensor = rig.robot_from_sensor(cylinder_pulse)?;
    let calibration = Calibration::new(rig, cylinder_pulse, mirror_pulse)?;
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
        let (u, v) = (column as f64, f64::from(peak.v));
        let seen = triangulate(rig, &sheet, u, v, &sigma).and_then(|seen| {
            let point = robot_from_sensor * seen.point;
            Some((seen, point, calibration.covariance(&point, u, v)?))
        });
        let Some((seen, point, by_calibration)) = seen else {
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
            point,
            covariance: turn.matrix() * seen.covariance * turn.matrix().transpose() + by_calibration,
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
    /// The same profile seen from another frame, whose place is taken as exact.
    pub fn moved<To: Frame>(&self, to_from: &Transform<To, F>) -> Profile<To> {
        self.moved_uncertain(to_from, &Matrix3::zeros())
    }

    /// The same where the pose itself is uncertain: `pose` is the covariance of its x [m], y [m] and yaw [rad].
    pub fn moved_uncertain<To: Frame>(&self, to_from: &Transform<To, F>, pose: &Matrix3<f64>) -> Profile<To> {
        let turn = to_from.iso.rotation.to_rotation_matrix();
        let moved = |p: &ProfilePoint<F>| {
            let covariance = turn.matrix() * p.covariance * turn.matrix().transpose();
            let arm = to_from.rotate(&p.point.xyz);
            let jacobian = Matrix3::new(1.0, 0.0, -arm.y, 0.0, 1.0, arm.x, 0.0, 0.0, 0.0); // d(point)/d(x, y, yaw)
            ProfilePoint {
                column: p.column,
                point: *to_from * p.point,
                covariance: covariance + jacobian * pose * jacobian.transpose(),
                level: p.level,
            }
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

/// How far an error is from 0 in units of its standard deviation, squared, and the number of directions that the
/// covariance leaves open: χ² distributed with that many degrees of freedom if the covariance is true. Infinite for an
/// error in a direction that should have none, but for what second order makes of a real one (a hundredth of the largest
/// standard deviation).
pub fn normalised_error(error: &Vector3<f64>, covariance: &Matrix3<f64>) -> (f64, usize) {
    let eigen = covariance.symmetric_eigen();
    let largest = eigen.eigenvalues.max().max(0.0);
    let (mut squared, mut rank) = (0.0, 0);
    for (value, way) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        let along = way.dot(error);
        if *value > 1e-12 * largest {
            squared += along * along / value;
            rank += 1;
        } else if along * along > 1e-4 * largest {
            squared = f64::INFINITY;
        }
    }
    (squared, rank)
}

/// The 95 % quantiles of χ² with 0 to 3 degrees of freedom: the squared size of the 95 % ellipsoid.
pub const ELLIPSOID_95: [f64; 4] = [0.0, 3.841, 5.991, 7.815];

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
            let turned = Vector3::new(-a.point.xyz.y, a.point.xyz.x, a.point.xyz.z); // eq. (7)
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
    fn an_uncertain_pose_adds_its_arm() {
        // ψ of 1 mrad at 2 m: 2 mm across; x of 3 mm: 3 mm along.
        let rig = Rig::metro_i();
        let (seen, _) = profile(&rig, &flat_line(250.0), Stamp(0), 0, 0).unwrap();
        let pose = Transform::<World, Robot>::planar(5.0, -3.0, 0.7);
        let known = seen.moved(&pose);
        let placed = seen.moved_uncertain(&pose, &Matrix3::from_diagonal(&Vector3::new(9e-6, 0.0, 1e-6)));
        for (k, p) in known.points.iter().zip(&placed.points) {
            let arm = k.point.xyz - pose.xyz();
            let across = Vector3::new(-arm.y, arm.x, 0.0) * 1e-3;
            let along = Vector3::x() * 3e-3;
            let expected = k.covariance + across * across.transpose() + along * along.transpose();
            assert!((p.covariance - expected).norm() < 1e-12);
        }
    }

    #[test]
    fn calibration_adds_what_its_parameters_move() {
        // instrument.md 3: 10.4 and 25.3 mm of X a mrad of camera pitch at X' = 1.5 and 2.4 m; and a metre of lA at the
        // same rows moves the sheet, so X, by 1/l'B·X'²·... as the two finders differ: taken from them.
        let mut rig = Rig::metro_i();
        (rig.beam_sigma_rad, rig.cylinder_sigma_rad) = (0.0, 0.0);
        let both = |rig: &Rig| {
            let line = flat_line(238.0);
            let exact = profile(rig, &line, Stamp(0), 400, 0).unwrap().0.points[256];
            (exact.point.xyz, exact.covariance)
        };
        let (point, noise) = both(&rig);
        for (name, sigma) in
            [("tilt_rad", 1e-3), ("mirror_height_m", 1e-3), ("fy_px", 2.0), ("k", 0.01), ("pan_rad", 1e-3)]
        {
            let known = RigCovariance::with_sigmas([(name, sigma)]);
            let (same, covariance) = both(&Rig { covariance: known, ..rig.clone() });
            let moved = both(&rig.shifted(name, sigma).unwrap()).0 - point;
            assert_eq!(same, point);
            let expected = noise + moved * moved.transpose();
            assert!((covariance - expected).norm() < 0.03 * (covariance - noise).norm(), "{name}");
        }
        // Two that do the same, and are known to cancel, add nothing.
        let cancel = RigCovariance {
            parameters: vec!["pan_rad".into(), "beam_zero_rad".into()],
            matrix: vec![vec![0.0, 0.0], vec![0.0, 0.0]],
        };
        assert!((both(&Rig { covariance: cancel, ..rig.clone() }).1 - noise).norm() < 1e-15);
    }

    #[test]
    fn errors_are_measured_in_the_directions_that_are_open() {
        let (x, y) = (Vector3::x(), Vector3::y());
        let flat = x * x.transpose() * 4.0 + y * y.transpose();
        assert_eq!(normalised_error(&(x * 4.0 + y), &flat), (5.0, 2));
        assert_eq!(normalised_error(&Vector3::z(), &flat), (f64::INFINITY, 2));
        assert_eq!(normalised_error(&Vector3::zeros(), &Matrix3::zeros()), (0.0, 0));
        assert_eq!(normalised_error(&x, &Matrix3::identity()), (1.0, 3));
    }

    #[test]
    fn an_encoder_outside_its_travel_is_an_error() {
        assert!(profile(&Rig::metro_i(), &flat_line(250.0), Stamp(0), 0, 9999).is_err());
    }
}
