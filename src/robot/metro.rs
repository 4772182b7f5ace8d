//! METRO-I's numbers: diameter 0.6 m, three motors, two modes of motion. Nothing else is published: all else is [A].

use serde::{Deserialize, Serialize};

use super::drive::{Drive, DriveLimits, Synchro};
use super::odometry::OdometryParams;
use crate::fault::{Fault, Result, number_within};
use crate::world::RobotBody;

/// Where the robot starts; it stands on whatever ground is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StartParams {
    /// Position along the world's x [m].
    pub x_m: f64,
    /// Position along the world's y [m].
    pub y_m: f64,
    /// Heading, counter-clockwise from x [°].
    pub yaw_deg: f64,
}

/// How the wheels are driven.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DriveKind {
    /// All wheels are driven by one motor and steered by a second; a third turns the body.
    #[default]
    Synchro,
}

/// The robot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotParams {
    /// Where it starts.
    pub start: StartParams,
    /// How its wheels are driven.
    pub drive: DriveKind,
    /// Mass [kg].
    pub mass_kg: f64,
    /// Height of the centre of mass over the floor [m].
    pub mass_height_m: f64,
    /// Radius [m].
    pub radius_m: f64,
    /// Height [m].
    pub height_m: f64,
    /// Height of the underside over the floor [m].
    pub clearance_m: f64,
    /// Number of wheels, 3 to 8.
    pub wheels: usize,
    /// Radius of the circle the wheels stand on [m].
    pub wheel_circle_m: f64,
    /// Radius of a wheel [m].
    pub wheel_radius_m: f64,
    /// Coulomb friction of the wheels.
    pub friction: f64,
    /// Highest speed [m/s].
    pub speed_m_s_max: f64,
    /// Highest acceleration [m/s²].
    pub accel_m_s2_max: f64,
    /// Highest turn rate [rad/s].
    pub turn_rad_s_max: f64,
    /// Highest angular acceleration [rad/s²].
    pub turn_rad_s2_max: f64,
    /// What its odometry gets wrong.
    pub odometry: OdometryParams,
}

impl Default for RobotParams {
    fn default() -> Self {
        let body = RobotBody::default();
        Self {
            start: StartParams::default(),
            drive: DriveKind::Synchro,
            mass_kg: body.mass_kg,
            mass_height_m: body.mass_height_m,
            radius_m: body.radius_m,
            height_m: body.height_m,
            clearance_m: body.clearance_m,
            wheels: body.wheels,
            wheel_circle_m: body.wheel_circle_m,
            wheel_radius_m: body.wheel_radius_m,
            friction: body.friction,
            speed_m_s_max: 0.4,
            accel_m_s2_max: 0.5,
            turn_rad_s_max: 0.8,
            turn_rad_s2_max: 1.5,
            odometry: OdometryParams::default(),
        }
    }
}

impl RobotParams {
    /// Refuses a robot that cannot be; faults are named `robot.…`.
    pub fn validated(self) -> Result<Self> {
        let named = |fault: Fault| Fault { what: format!("robot.{}", fault.what), ..fault };
        number_within("start.x_m", self.start.x_m, -1e5, 1e5).map_err(named)?;
        number_within("start.y_m", self.start.y_m, -1e5, 1e5).map_err(named)?;
        number_within("start.yaw_deg", self.start.yaw_deg, -3600.0, 3600.0).map_err(named)?;
        self.body().validated().map_err(named)?;
        self.limits().validated().map_err(named)?;
        self.odometry.validated().map_err(named)?;
        Ok(self)
    }

    /// The rigid body.
    pub fn body(&self) -> RobotBody {
        RobotBody {
            radius_m: self.radius_m,
            height_m: self.height_m,
            clearance_m: self.clearance_m,
            mass_kg: self.mass_kg,
            mass_height_m: self.mass_height_m,
            wheels: self.wheels,
            wheel_circle_m: self.wheel_circle_m,
            wheel_radius_m: self.wheel_radius_m,
            friction: self.friction,
        }
    }

    /// What the motors can do.
    pub fn limits(&self) -> DriveLimits {
        DriveLimits {
            speed_m_s: self.speed_m_s_max,
            accel_m_s2: self.accel_m_s2_max,
            turn_rad_s: self.turn_rad_s_max,
            turn_rad_s2: self.turn_rad_s2_max,
        }
    }

    /// The drive, at rest.
    pub fn new_drive(&self) -> Result<Box<dyn Drive>> {
        match self.drive {
            DriveKind::Synchro => Ok(Box::new(Synchro::new(self.limits())?)),
        }
    }

    /// Position of the start [m].
    pub fn start_xy(&self) -> [f64; 2] {
        [self.start.x_m, self.start.y_m]
    }

    /// Heading at the start [rad].
    pub fn start_yaw(&self) -> f64 {
        self.start.yaw_deg.to_radians()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_valid_and_a_table_changes_what_it_names() {
        RobotParams::default().validated().unwrap();
        let text = "speed_m_s_max = 0.2\nstart = { x_m = 1, yaw_deg = 90 }\n[odometry]\nperfect = true";
        let robot: RobotParams = toml::from_str(text).unwrap();
        assert_eq!((robot.speed_m_s_max, robot.start_xy(), robot.mass_kg), (0.2, [1.0, 0.0], 60.0));
        assert!((robot.start_yaw() - std::f64::consts::FRAC_PI_2).abs() < 1e-15);
        assert!(robot.odometry.perfect);
    }

    #[test]
    fn what_cannot_be_is_refused_by_name() {
        let fault = |text: &str| toml::from_str::<RobotParams>(text).unwrap().validated().unwrap_err().to_string();
        assert!(fault("mass_kg = -1").starts_with("robot.mass_kg: found -1"));
        assert!(fault("speed_m_s_max = nan").starts_with("robot.speed_m_s_max"));
        assert!(fault("start = { x_m = inf }").starts_with("robot.start.x_m"));
        assert!(
            fault("odometry = { drift = 1 }".replace("drift = 1", "k_ss_m = -1").as_str())
                .starts_with("robot.odometry")
        );
        assert!(toml::from_str::<RobotParams>("sped = 1").unwrap_err().to_string().contains("sped"));
        assert!(toml::from_str::<RobotParams>("drive = \"tracks\"").is_err());
    }
}
