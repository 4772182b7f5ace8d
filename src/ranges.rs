//! What an ultrasonic transducer gives, whether simulated, recorded or live: one range a ping, and all that is needed to map
//! it. Truth travels beside it, never in it.

use crate::fault::{Fault, Result};
use crate::geometry::{Odom, Robot, Transducer, Transform};
use crate::time::Stamp;

/// One ping of one transducer, as `sensor_msgs/msg/Range` holds it: ranges and angles are single floats, so that a recording
/// gives the same bits as the run that made it.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeReading {
    /// When it was fired.
    pub stamp: Stamp,
    /// Frame of the transducer, such as `sonar_07`: which one it is.
    pub frame: String,
    /// Where the transducer is on the robot: x along its axis.
    pub robot_from_transducer: Transform<Robot, Transducer>,
    /// The arc, from side to side, in which what echoed may be [rad].
    pub field_of_view_rad: f32,
    /// Nothing nearer is reported [m].
    pub range_m_min: f32,
    /// Nothing farther is reported [m].
    pub range_m_max: f32,
    /// The first echo [m]; `None`: there was none, which does not mean that nothing is there.
    pub range_m: Option<f32>,
    /// Where the robot was at `stamp`, as its odometry has it.
    pub odom_from_robot: Transform<Odom, Robot>,
}

impl RangeReading {
    /// Refuses what no transducer gives.
    ///
    /// # Errors
    /// Limits that are no span of ranges, a field of view that is no angle, a range outside its limits.
    pub fn check(&self) -> Result<()> {
        let Self { frame, field_of_view_rad: view, range_m_min: min, range_m_max: max, .. } = self;
        if !(min.is_finite() && max.is_finite() && 0.0 <= *min && min <= max) {
            let found = format!("{min} to {max} m");
            return Err(Fault::new(format!("{frame}: limits of range"), found, "0 ≤ least ≤ greatest, finite"));
        }
        if !(view.is_finite() && (0.0..=std::f32::consts::TAU).contains(view)) {
            return Err(Fault::new(format!("{frame}: field of view"), format!("{view} rad"), "0 to 2π rad"));
        }
        match self.range_m {
            Some(range) if !(*min..=*max).contains(&range) => {
                let expected = format!("{min} to {max} m, its limits, or no echo");
                Err(Fault::new(format!("{frame}: range"), format!("{range} m"), expected))
            }
            _ => Ok(()),
        }
    }
}

/// The frame of a ring's transducer by its number: `sonar_00`, `sonar_01`, …
pub fn transducer_frame(number: usize) -> String {
    format!("sonar_{number:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading() -> RangeReading {
        RangeReading {
            stamp: Stamp(0),
            frame: transducer_frame(7),
            robot_from_transducer: Transform::identity(),
            field_of_view_rad: 0.4,
            range_m_min: 0.41,
            range_m_max: 10.7,
            range_m: Some(1.0),
            odom_from_robot: Transform::identity(),
        }
    }

    #[test]
    fn what_no_transducer_gives_is_refused_by_name() {
        assert_eq!(reading().check(), Ok(()));
        assert_eq!(RangeReading { range_m: None, ..reading() }.check(), Ok(()));
        let fault = |bad: RangeReading| bad.check().unwrap_err().to_string();
        for range in [0.4, 10.8, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0] {
            let text = fault(RangeReading { range_m: Some(range), ..reading() });
            assert!(text.starts_with("sonar_07: range: found"), "{text}");
        }
        for (min, max) in [(f32::NAN, 1.0), (0.0, f32::INFINITY), (2.0, 1.0), (-1.0, 1.0)] {
            let text = fault(RangeReading { range_m: None, range_m_min: min, range_m_max: max, ..reading() });
            assert!(text.starts_with("sonar_07: limits of range"), "{text}");
        }
        for view in [f32::NAN, -0.1, 7.0] {
            assert!(fault(RangeReading { field_of_view_rad: view, ..reading() }).contains("field of view"));
        }
    }
}
