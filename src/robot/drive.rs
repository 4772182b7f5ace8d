//! Motors: from a command for the body to the motion of the wheels, and from that to the motion of the body.

use crate::fault::{Result, number_within, positive};
use crate::world::Rolling;

/// What the robot is asked to do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BodyCommand {
    /// Speed along the wheels' heading, v [m/s].
    pub v_m_s: f64,
    /// Turn rate of the wheels' heading, ω_s [rad/s].
    pub steer_rad_s: f64,
    /// Turn rate of the body, ω_t [rad/s].
    pub turn_rad_s: f64,
}

impl BodyCommand {
    /// Travels with the body along the wheels: ω_s = ω_t.
    pub fn travel(v_m_s: f64, turn_rad_s: f64) -> Self {
        Self { v_m_s, steer_rad_s: turn_rad_s, turn_rad_s }
    }
}

/// METRO-I's two modes of motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// The wheels drive, and may steer meanwhile.
    Travel,
    /// The robot turns on the spot.
    Turn,
}

/// What the wheels did in a while, by their own encoders: the same for every drive.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WheelMotion {
    /// Distance along the wheels' heading, Δs [m].
    pub distance_m: f64,
    /// Change of the wheels' heading, Δψ [rad].
    pub steer_rad: f64,
    /// Change of the body's heading, Δθ [rad].
    pub turn_rad: f64,
}

/// What the motors can do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriveLimits {
    /// Highest speed [m/s].
    pub speed_m_s: f64,
    /// Highest acceleration [m/s²].
    pub accel_m_s2: f64,
    /// Highest turn rate, of wheels and body [rad/s].
    pub turn_rad_s: f64,
    /// Highest angular acceleration [rad/s²].
    pub turn_rad_s2: f64,
}

impl DriveLimits {
    /// Refuses limits that are not positive.
    pub fn validated(self) -> Result<Self> {
        for (what, value) in [
            ("speed_m_s_max", self.speed_m_s),
            ("accel_m_s2_max", self.accel_m_s2),
            ("turn_rad_s_max", self.turn_rad_s),
            ("turn_rad_s2_max", self.turn_rad_s2),
        ] {
            positive(what, value)?;
            number_within(what, value, 0.0, 100.0)?;
        }
        Ok(self)
    }
}

/// A drive: motors that follow a command as fast as they can.
pub trait Drive: Send {
    /// Its name.
    fn name(&self) -> &'static str;

    /// What the motors follow from now on; beyond their limits they do what they can.
    ///
    /// Errors: numbers that are not finite.
    fn command(&mut self, command: BodyCommand) -> Result<()>;

    /// Moves the motors for `dt_s` seconds and tells how far they went.
    fn advance(&mut self, dt_s: f64) -> WheelMotion;

    /// How the wheels roll now, seen from the robot.
    fn rolling(&self) -> Rolling;

    /// Forward kinematics: the motion of the body, in its own frame at the start, if its wheels do as told from a heading
    /// `lead_rad` = ψ − θ before the body's: x, y [m] and turn [rad].
    fn body_motion(&self, lead_rad: f64, motion: &WheelMotion) -> [f64; 3];
}

/// Synchro drive: all wheels point the same way, ψ, and are driven together; the body turns by itself.
///
/// ẋ = v·cosψ, ẏ = v·sinψ, ψ̇ = ω_s, body θ̇ = ω_t (`instrument.md` 5).
#[derive(Clone, Copy, Debug)]
pub struct Synchro {
    limits: DriveLimits,
    wanted: BodyCommand,
    now: BodyCommand,
    /// Steering of the wheels against the body, ψ − θ [rad].
    lead_rad: f64,
}

impl Synchro {
    /// At rest, wheels along the body.
    ///
    /// Errors: limits that are not positive.
    pub fn new(limits: DriveLimits) -> Result<Self> {
        let limits = limits.validated()?;
        Ok(Self { limits, wanted: BodyCommand::default(), now: BodyCommand::default(), lead_rad: 0.0 })
    }

    /// The mode of motion it is in.
    pub fn mode(&self) -> Mode {
        if self.now.v_m_s == 0.0 && self.now.turn_rad_s != 0.0 { Mode::Turn } else { Mode::Travel }
    }
}

/// `now`, moved towards `wanted` by at most `step`.
fn approach(now: f64, wanted: f64, step: f64) -> f64 {
    if (wanted - now).abs() <= step { wanted } else { now + step.copysign(wanted - now) }
}

impl Drive for Synchro {
    fn name(&self) -> &'static str {
        "synchro"
    }

    fn command(&mut self, command: BodyCommand) -> Result<()> {
        let any = f64::INFINITY;
        let v = number_within("command v_m_s", command.v_m_s, -any, any)?;
        let steer = number_within("command steer_rad_s", command.steer_rad_s, -any, any)?;
        let turn = number_within("command turn_rad_s", command.turn_rad_s, -any, any)?;
        let (fast, quick) = (self.limits.speed_m_s, self.limits.turn_rad_s);
        self.wanted = BodyCommand {
            v_m_s: v.clamp(-fast, fast),
            steer_rad_s: steer.clamp(-quick, quick),
            turn_rad_s: turn.clamp(-quick, quick),
        };
        Ok(())
    }

    fn advance(&mut self, dt_s: f64) -> WheelMotion {
        let (accel, spin) = (self.limits.accel_m_s2 * dt_s, self.limits.turn_rad_s2 * dt_s);
        self.now = BodyCommand {
            v_m_s: approach(self.now.v_m_s, self.wanted.v_m_s, accel),
            steer_rad_s: approach(self.now.steer_rad_s, self.wanted.steer_rad_s, spin),
            turn_rad_s: approach(self.now.turn_rad_s, self.wanted.turn_rad_s, spin),
        };
        let motion = WheelMotion {
            distance_m: self.now.v_m_s * dt_s,
            steer_rad: self.now.steer_rad_s * dt_s,
            turn_rad: self.now.turn_rad_s * dt_s,
        };
        self.lead_rad += motion.steer_rad - motion.turn_rad;
        motion
    }

    fn rolling(&self) -> Rolling {
        let (sin, cos) = self.lead_rad.sin_cos();
        Rolling { forward_m_s: self.now.v_m_s * cos, left_m_s: self.now.v_m_s * sin, turn_rad_s: self.now.turn_rad_s }
    }

    fn body_motion(&self, lead_rad: f64, motion: &WheelMotion) -> [f64; 3] {
        // ∫ cos(ψ), ∫ sin(ψ) over the way: a chord of the arc, along its middle heading.
        let half = motion.steer_rad / 2.0;
        let chord = motion.distance_m * if half.abs() < 1e-6 { 1.0 - half * half / 6.0 } else { half.sin() / half };
        let (sin, cos) = (lead_rad + half).sin_cos();
        [chord * cos, chord * sin, motion.turn_rad]
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use super::*;

    const LIMITS: DriveLimits = DriveLimits { speed_m_s: 0.4, accel_m_s2: 0.5, turn_rad_s: 0.8, turn_rad_s2: 1.5 };

    #[test]
    fn motors_need_their_time() {
        let mut drive = Synchro::new(LIMITS).unwrap();
        drive.command(BodyCommand::travel(9.0, 0.3)).unwrap();
        let dt = 1.0 / 1024.0;
        let first: f64 = (0..512).map(|_| drive.advance(dt).distance_m).sum();
        assert!((drive.rolling().forward_m_s - 0.25).abs() < 1e-12); // half a second at 0.5 m/s²
        assert!((first - 0.0625).abs() < 2e-4); // ½·a·t²
        for _ in 0..1024 {
            drive.advance(dt);
        }
        let rolling = drive.rolling();
        assert_eq!((rolling.forward_m_s, rolling.turn_rad_s), (0.4, 0.3)); // as fast as it can, no faster
        assert!(rolling.left_m_s.abs() < 1e-15);
        assert_eq!(drive.mode(), Mode::Travel);
        drive.command(BodyCommand::travel(0.0, -0.3)).unwrap();
        for _ in 0..1024 {
            drive.advance(dt);
        }
        assert_eq!((drive.rolling().forward_m_s, drive.mode()), (0.0, Mode::Turn));
    }

    #[test]
    fn wheels_and_body_turn_each_by_their_own_motor() {
        let mut drive = Synchro::new(LIMITS).unwrap();
        drive.command(BodyCommand { v_m_s: 0.2, steer_rad_s: 0.5, turn_rad_s: 0.0 }).unwrap();
        let dt = 1.0 / 256.0;
        let steered: f64 = (0..512).map(|_| drive.advance(dt).steer_rad).sum();
        let rolling = drive.rolling();
        assert!((rolling.left_m_s.atan2(rolling.forward_m_s) - steered).abs() < 1e-12);
        assert!((rolling.left_m_s.hypot(rolling.forward_m_s) - 0.2).abs() < 1e-12);
        assert_eq!(rolling.turn_rad_s, 0.0);
    }

    #[test]
    fn forward_kinematics_is_exact_on_an_arc() {
        let drive = Synchro::new(LIMITS).unwrap();
        // A quarter circle of radius 1, wheels and body together.
        let quarter = WheelMotion { distance_m: FRAC_PI_2, steer_rad: FRAC_PI_2, turn_rad: FRAC_PI_2 };
        let [x, y, turn] = drive.body_motion(0.0, &quarter);
        assert!((x - 1.0).abs() < 1e-12 && (y - 1.0).abs() < 1e-12 && turn == FRAC_PI_2, "{x} {y}");
        // A half circle by the wheels alone, that begin to the left: the body does not turn.
        let half = WheelMotion { distance_m: PI, steer_rad: PI, turn_rad: 0.0 };
        let [x, y, turn] = drive.body_motion(FRAC_PI_2, &half);
        assert!((x + 2.0).abs() < 1e-12 && y.abs() < 1e-12 && turn == 0.0, "{x} {y}");
    }

    #[test]
    fn commands_that_are_no_numbers_are_refused() {
        let mut drive = Synchro::new(LIMITS).unwrap();
        assert_eq!(drive.command(BodyCommand::travel(f64::NAN, 0.0)).unwrap_err().what, "command v_m_s");
        assert!(drive.command(BodyCommand::travel(0.0, f64::INFINITY)).is_err());
        assert_eq!(drive.advance(1.0), WheelMotion::default());
        assert!(Synchro::new(DriveLimits { accel_m_s2: 0.0, ..LIMITS }).is_err());
    }
}
