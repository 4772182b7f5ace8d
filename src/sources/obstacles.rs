//! The `[compare]` table of a scenario: what is looked for when sensors are compared, and on what terms.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within};
use crate::world::Scene;

/// Most obstacles that are looked for.
const TARGETS_MAX: usize = 1000;

/// What seeing it means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A surface is where it is.
    #[default]
    Obstacle,
    /// The floor ends there.
    Drop,
    /// There is a way through.
    Opening,
}

/// Something to be seen: bodies, or an upright strip over a line on the ground.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetParams {
    /// Its name.
    pub name: String,
    /// What it is an example of.
    pub class: String,
    /// What it is an example of while the robot is fast; without it, it does not count then.
    pub fast_class: Option<String>,
    /// What seeing it means.
    #[serde(default)]
    pub kind: Kind,
    /// Names of the bodies it is made of.
    #[serde(default)]
    pub bodies: Vec<String>,
    /// Or the ends of its line on the ground, x and y [m]; of a drop, two opposite corners of the hole.
    #[serde(default)]
    pub line: Vec<Vec<f64>>,
    /// Heights of the strip over that line, lowest and highest [m].
    #[serde(default)]
    pub z: Vec<f64>,
}

/// On what terms sensors are compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CompareParams {
    /// What is farther is not looked for at all [m].
    pub range_m: f64,
    /// Nominal range of both sensors: rates are over what is nearer than this [m].
    pub nominal_m: f64,
    /// What is farther off the robot's heading is not expected to be seen [°]: where the finder looks while driving.
    pub sector_deg: f64,
    /// What a sensor says is right within this [m].
    pub tolerance_m: f64,
    /// What is not this much higher than the floor is no obstacle [m].
    pub clearance_m: f64,
    /// A bin of distance counts where the obstacle was in it for at least this [s].
    pub bin_s_min: f64,
    /// The robot is fast from here on [m/s].
    pub fast_m_s: f64,
    /// Every seed moves the start and each goal by up to this [m]: without it all seeds would see the same.
    pub jitter_m: f64,
    /// ... and turns the start by up to this [°].
    pub jitter_deg: f64,
    /// ... and begins its mission up to this later [s]: or sweep and ring would be at the same stop at the same place.
    pub jitter_s: f64,
    /// Power of the finder: laser, camera and two servos [W] [A].
    pub laser_w: f64,
    /// Power of one ultrasonic module that listens, 100 mA at 5 V [W] (Polaroid 6500).
    pub module_w: f64,
    /// Energy of one ping, 2 A at 5 V for 16 cycles [J].
    pub ping_j: f64,
    /// What is looked for; without any, each body that stands on the floor, all of class `obstacle`.
    pub target: Vec<TargetParams>,
}

impl Default for CompareParams {
    fn default() -> Self {
        Self {
            range_m: 4.0,
            nominal_m: 3.0,
            sector_deg: 35.0,
            tolerance_m: 0.15,
            clearance_m: 0.05,
            bin_s_min: 0.4,
            fast_m_s: 0.6,
            jitter_m: 0.08,
            jitter_deg: 3.0,
            jitter_s: 6.0,
            laser_w: 7.0,
            module_w: 0.5,
            ping_j: 0.0033,
            target: Vec::new(),
        }
    }
}

impl CompareParams {
    /// Refuses numbers that make no comparison, and targets that are not in the scene; faults are named `compare.…`.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn validated(self, scene: &Scene) -> Result<Self> {
        for (what, value, low, high) in [
            ("range_m", self.range_m, 0.5, 20.0),
            ("nominal_m", self.nominal_m, 0.5, 20.0),
            ("sector_deg", self.sector_deg, 1.0, 180.0),
            ("tolerance_m", self.tolerance_m, 0.001, 2.0),
            ("clearance_m", self.clearance_m, 0.001, 1.0),
            ("bin_s_min", self.bin_s_min, 0.0, 60.0),
            ("fast_m_s", self.fast_m_s, 0.01, 100.0),
            ("jitter_m", self.jitter_m, 0.0, 2.0),
            ("jitter_deg", self.jitter_deg, 0.0, 180.0),
            ("jitter_s", self.jitter_s, 0.0, 600.0),
            ("laser_w", self.laser_w, 0.0, 1e4),
            ("module_w", self.module_w, 0.0, 1e4),
            ("ping_j", self.ping_j, 0.0, 1e3),
        ] {
            number_within(&format!("compare.{what}"), value, low, high)?;
        }
        if self.target.len() > TARGETS_MAX {
            let expected = format!("at most {TARGETS_MAX}");
            return Err(Fault::new("compare.target", format!("{} targets", self.target.len()), expected));
        }
        for (k, target) in self.target.iter().enumerate() {
            if self.target[..k].iter().any(|other| other.name == target.name) {
                let found = format!("`{}`, used before", target.name);
                return Err(Fault::new("compare.target.name", found, "a name of its own"));
            }
            target.check(scene)?;
        }
        Ok(self)
    }
}

impl TargetParams {
    fn check(&self, scene: &Scene) -> Result<()> {
        let what = |key: &str| format!("compare.target `{}`: {key}", self.name);
        if self.class.trim().is_empty() {
            return Err(Fault::new(what("class"), "an empty name", "what it is an example of"));
        }
        if self.bodies.is_empty() == self.line.is_empty() {
            let found = if self.line.is_empty() { "neither" } else { "both" };
            return Err(Fault::new(what("bodies, line"), found, "one of the two"));
        }
        for name in &self.bodies {
            if !scene.bodies.iter().any(|body| body.name == *name) {
                return Err(Fault::new(what("bodies"), format!("`{name}`"), "the name of a body"));
            }
        }
        if self.kind != Kind::Obstacle && self.line.is_empty() {
            return Err(Fault::new(what("line"), "no such key", "the line where the floor ends, or from post to post"));
        }
        if self.line.is_empty() {
            return Ok(());
        }
        if self.line.len() != 2 || self.line.iter().any(|end| end.len() != 2) {
            return Err(Fault::new(what("line"), format!("{:?}", self.line), "two ends of x and y"));
        }
        for value in self.line.iter().flatten() {
            number_within(&what("line"), *value, -1e5, 1e5)?;
        }
        match *self.z.as_slice() {
            [low, high] if low.is_finite() && high.is_finite() && low <= high && low.abs().max(high.abs()) < 100.0 => {
                Ok(())
            }
            _ => Err(Fault::new(what("z"), format!("{:?}", self.z), "the lowest and the highest height")),
        }
    }
}

/// The line where the target that a fault of `validated` names has its name, from 1.
pub(super) fn line_of_target(text: &str, what: &str) -> Option<usize> {
    let name = what.strip_prefix("compare.target `")?.split('`').next()?;
    let mut is_target = false;
    text.lines()
        .position(|line| {
            let line = line.trim();
            if line.starts_with('[') {
                is_target = line.starts_with("[[compare.target]]");
            }
            let value = line.strip_prefix("name").and_then(|rest| rest.trim_start().strip_prefix('='));
            is_target && value.is_some_and(|value| value.trim().trim_matches(['"', '\'']) == name)
        })
        .map(|line| line + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> String {
        toml::from_str::<CompareParams>(text).unwrap().validated(&Scene::default()).unwrap_err().to_string()
    }

    #[test]
    fn a_target_is_found_by_its_name() {
        let text = "[[world.box]]\nname = 'b'\n[[compare.target]]\nname = 'a'\n[[compare.target]]\nclass = 'c'\nname = \"b\"\n";
        assert_eq!(line_of_target(text, "compare.target `b`: bodies"), Some(7));
        assert_eq!(line_of_target(text, "compare.target `a`: z"), Some(4));
        assert_eq!(
            (line_of_target(text, "compare.target `c`: z"), line_of_target(text, "compare.range_m")),
            (None, None)
        );
    }

    #[test]
    fn targets_that_are_none_are_refused_by_name() {
        assert!(fault("tolerance_m = nan").starts_with("compare.tolerance_m"));
        assert!(fault("range_m = 0").starts_with("compare.range_m: found 0"));
        let target = |rest: &str| fault(&format!("[[target]]\nname = 'a'\nclass = 'c'\n{rest}"));
        assert!(target("bodies = ['gone']").contains("compare.target `a`: bodies: found `gone`"));
        assert!(target("").contains("found neither"));
        assert!(target("line = [[0, 0], [1, 0]]").contains("z: found []"));
        assert!(target("line = [[0, 0], [1]]\nz = [0, 1]").contains("two ends"));
        assert!(target("line = [[0, 0], [1, nan]]\nz = [0, 1]").contains("line"));
        assert!(target("line = [[0, 0], [1, 1]]\nz = [1, 0]").contains("z: found"));
        assert!(target("kind = 'drop'\nbodies = ['x']").contains("bodies"));
        let two = "[[target]]\nname = 'a'\nclass = 'c'\nline = [[0, 0], [1, 0]]\nz = [0, 1]\n";
        assert!(fault(&format!("{two}{two}")).contains("used before"));
        assert!(toml::from_str::<CompareParams>("colour = 1").is_err());
    }
}
