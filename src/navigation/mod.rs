//! Where the robot goes: missions, the follower that carries them out on the map alone, and the sums of a run.

mod follow;
mod metrics;

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};

pub use follow::{Command, FollowParams, Follower, MissionProgress, ScanRequest};
pub use metrics::{Rms, Travel};

/// Coordinates and times of a mission stay below this.
const NUMBER_MAX: f64 = 1e5;

/// Which scan to make, standing still.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScanKind {
    /// A full turn.
    Turn,
    /// One view.
    View,
}

/// One step of a mission.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Table", into = "Table")]
pub enum Step {
    /// Turn towards a point of the map and drive there.
    GoTo {
        /// The point [m].
        to_m: [f64; 2],
        /// Speed [m/s], if not the usual one.
        speed_m_s: Option<f64>,
    },
    /// Turn on the spot to a heading of the map.
    TurnTo {
        /// The heading [rad].
        yaw_rad: f64,
    },
    /// Drive without a goal.
    Drive(DriveStep),
    /// Stand still and make a scan.
    Scan(ScanKind),
    /// Stand still.
    Wait {
        /// How long [s].
        seconds: f64,
    },
}

/// Driving without a goal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveStep {
    /// Speed [m/s], backwards if negative.
    pub v_m_s: f64,
    /// Turn rate [rad/s].
    #[serde(default)]
    pub omega_rad_s: f64,
    /// How long [s].
    pub seconds: f64,
    /// Whether to drive on whatever the map shows.
    #[serde(default)]
    pub blind: bool,
}

/// A step as a `[[mission]]` table has it: exactly one of the first five fields.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Table {
    /// A list, since for an array of two the TOML reader would pass over a third number.
    #[serde(skip_serializing_if = "Option::is_none")]
    go_to: Option<Vec<f64>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    turn_to_deg: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    drive: Option<DriveStep>,
    #[serde(skip_serializing_if = "Option::is_none")]
    scan: Option<ScanKind>,
    #[serde(skip_serializing_if = "Option::is_none")]
    wait_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    speed_m_s: Option<f64>,
}

impl TryFrom<Table> for Step {
    type Error = Fault;

    fn try_from(table: Table) -> Result<Self> {
        let speed_m_s = table.speed_m_s;
        let point = |go_to: Vec<f64>| match go_to[..] {
            [x, y] => Ok([x, y]),
            _ => Err(Fault::new("go_to", format!("{} numbers", go_to.len()), "two: x and y")),
        };
        let to_m = table.go_to.map(point).transpose()?;
        let steps = [
            to_m.map(|to_m| Self::GoTo { to_m, speed_m_s }),
            table.turn_to_deg.map(|deg| Self::TurnTo { yaw_rad: deg.to_radians() }),
            table.drive.map(Self::Drive),
            table.scan.map(Self::Scan),
            table.wait_s.map(|seconds| Self::Wait { seconds }),
        ];
        let mut given = steps.into_iter().flatten();
        let (Some(step), None) = (given.next(), given.next()) else {
            let found = format!("{} of these", steps.iter().flatten().count());
            return Err(Fault::new("mission step", found, "exactly one of go_to, turn_to_deg, drive, scan, wait_s"));
        };
        if speed_m_s.is_some() && to_m.is_none() {
            return Err(Fault::new("mission step", "speed_m_s without go_to", "speed_m_s beside go_to only"));
        }
        Ok(step)
    }
}

impl From<Step> for Table {
    fn from(step: Step) -> Self {
        let none = Self::default();
        match step {
            Step::GoTo { to_m, speed_m_s } => Self { go_to: Some(to_m.to_vec()), speed_m_s, ..none },
            Step::TurnTo { yaw_rad } => Self { turn_to_deg: Some(yaw_rad.to_degrees()), ..none },
            Step::Drive(drive) => Self { drive: Some(drive), ..none },
            Step::Scan(kind) => Self { scan: Some(kind), ..none },
            Step::Wait { seconds } => Self { wait_s: Some(seconds), ..none },
        }
    }
}

/// What the robot does, one step after the other: the `[[mission]]` tables of a scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Mission {
    /// The steps.
    pub steps: Vec<Step>,
}

impl Default for Mission {
    fn default() -> Self {
        Self::look_around()
    }
}

impl Mission {
    /// Stand where you are and make one full turn.
    pub fn look_around() -> Self {
        Self { steps: vec![Step::Scan(ScanKind::Turn)] }
    }

    /// Refuses steps that cannot be made; faults are named `mission[k].…`, counted from 0.
    pub fn validated(self) -> Result<Self> {
        for (k, step) in self.steps.iter().enumerate() {
            step.check().map_err(|fault| Fault { what: format!("mission[{k}].{}", fault.what), ..fault })?;
        }
        Ok(self)
    }
}

impl Step {
    fn check(&self) -> Result<()> {
        match self {
            Self::GoTo { to_m: [x, y], speed_m_s } => {
                number_within("go_to x", *x, -NUMBER_MAX, NUMBER_MAX)?;
                number_within("go_to y", *y, -NUMBER_MAX, NUMBER_MAX)?;
                if let Some(speed) = speed_m_s {
                    number_within("speed_m_s", positive("speed_m_s", *speed)?, 0.0, 10.0)?;
                }
            }
            Self::TurnTo { yaw_rad } => {
                number_within("turn_to_deg", yaw_rad.to_degrees(), -3600.0, 3600.0)?;
            }
            Self::Drive(drive) => {
                number_within("drive.v_m_s", drive.v_m_s, -10.0, 10.0)?;
                number_within("drive.omega_rad_s", drive.omega_rad_s, -10.0, 10.0)?;
                number_within("drive.seconds", drive.seconds, 0.0, NUMBER_MAX)?;
            }
            Self::Scan(_) => {}
            Self::Wait { seconds } => {
                number_within("wait_s", *seconds, 0.0, NUMBER_MAX)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Serialize, Deserialize)]
    struct File {
        mission: Mission,
    }

    fn parse(text: &str) -> Result<Mission, String> {
        let file: File = toml::from_str(text).map_err(|e| e.to_string())?;
        file.mission.validated().map_err(|e| e.to_string())
    }

    #[test]
    fn a_mission_reads_as_its_tables_and_back() {
        let text = "[[mission]]\nscan = \"turn\"\n[[mission]]\ngo_to = [1, 2.5]\nspeed_m_s = 0.2\n[[mission]]\nturn_to_deg = 90\n\
            [[mission]]\ndrive = { v_m_s = 0.1, omega_rad_s = 0.2, seconds = 3 }\n[[mission]]\nwait_s = 1.5\n[[mission]]\nscan = \"view\"";
        let mission = parse(text).unwrap();
        assert_eq!(mission.steps.len(), 6);
        assert_eq!(mission.steps[0], Step::Scan(ScanKind::Turn));
        assert_eq!(mission.steps[1], Step::GoTo { to_m: [1.0, 2.5], speed_m_s: Some(0.2) });
        assert_eq!(mission.steps[2], Step::TurnTo { yaw_rad: std::f64::consts::FRAC_PI_2 });
        let again = toml::to_string(&File { mission: mission.clone() }).unwrap();
        assert_eq!(parse(&again).unwrap(), mission);
    }

    #[test]
    fn steps_that_cannot_be_made_are_refused() {
        let fault = |step: &str| parse(&format!("[[mission]]\n{step}")).unwrap_err();
        assert!(fault("").contains("exactly one of go_to"));
        assert!(fault("wait_s = 1\nscan = \"turn\"").contains("found 2 of these"));
        assert!(fault("wait_s = 1\nspeed_m_s = 1").contains("speed_m_s without go_to"));
        assert!(fault("go_to = [nan, 0]").starts_with("mission[0].go_to x"));
        assert!(fault("go_to = [1, 2, 3]").contains("found 3 numbers"));
        assert!(fault("go_to = [1, 2]\nspeed_m_s = 0").starts_with("mission[0].speed_m_s"));
        assert!(fault("wait_s = -1").starts_with("mission[0].wait_s"));
        assert!(fault("drive = { v_m_s = 0.1, seconds = inf }").starts_with("mission[0].drive.seconds"));
        assert!(fault("goto = [1, 2]").contains("goto"));
        assert!(fault("scan = \"twice\"").contains("twice"));
    }
}
