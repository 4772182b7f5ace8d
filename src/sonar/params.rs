//! What a ring of transducers is made of, and when each of them fires.

use serde::{Deserialize, Serialize};

use super::air::Air;
use super::transducer::TransducerParams;
use crate::fault::{Fault, Result, number_within};

/// The most transducers in a ring.
const COUNT_MAX: usize = 72;

/// Who fires when. One step of the schedule comes every `interval_s`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// One after the other, around the ring.
    #[default]
    Sequential,
    /// One at a time, first those with even numbers, then those with odd ones: neighbours never follow one another.
    Alternating,
    /// All of a group at once: `groups` of them, the members of each evenly spread around the ring.
    Groups {
        /// How many groups, 1 (all at once) to the number of transducers.
        groups: usize,
    },
}

impl Schedule {
    /// How many steps a ring of this many transducers takes.
    pub fn steps(self, count: usize) -> usize {
        match self {
            Self::Sequential | Self::Alternating => count,
            Self::Groups { groups } => groups,
        }
    }

    /// Which transducers fire at once in a step, counted from the start.
    pub fn firing(self, count: usize, step: usize) -> Vec<usize> {
        let step = step % self.steps(count).max(1);
        match self {
            Self::Sequential => vec![step],
            Self::Alternating => {
                let even = count.div_ceil(2);
                vec![if step < even { 2 * step } else { 2 * (step - even) + 1 }]
            }
            Self::Groups { groups } => (step..count).step_by(groups.max(1)).collect(),
        }
    }
}

/// A ring of transducers on a robot (`instrument.md` 6).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RingParams {
    /// How many transducers, evenly around the robot: 1 to 72.
    pub count: usize,
    /// Bearing of the first one, counter-clockwise from ahead [°]; so are they numbered.
    pub first_deg: f64,
    /// Radius of the circle they are on [m].
    pub radius_m: f64,
    /// Height over the floor [m] [A].
    pub height_m: f64,
    /// How far they look up [°].
    pub tilt_deg: f64,
    /// The arc, from side to side, in which what a transducer reports may be, as it is stated for maps [°].
    pub field_of_view_deg: f64,
    /// Time between two steps of the schedule [s] [A].
    pub interval_s: f64,
    /// Who fires when.
    pub schedule: Schedule,
    /// 1: single bounces and corners; 2: also what is seen in one mirror.
    pub order: u8,
    /// The air, as it is on average.
    pub air: Air,
    /// The temperature that ranges are worked out with [K].
    pub assumed_k: f64,
    /// Standard deviation of the air's temperature from run to run [K]: 5.9 K are 1 % of range [A].
    pub temperature_sigma_k: f64,
    /// Each transducer.
    pub transducer: TransducerParams,
}

/// 24 at 15°, fired in sequence 65 ms apart.
impl Default for RingParams {
    fn default() -> Self {
        Self {
            count: 24,
            first_deg: 0.0,
            radius_m: 0.3,
            height_m: 0.4,
            tilt_deg: 0.0,
            field_of_view_deg: 30.0,
            interval_s: 0.065,
            schedule: Schedule::Sequential,
            order: 2,
            air: Air::default(),
            assumed_k: 293.15,
            temperature_sigma_k: 5.9,
            transducer: TransducerParams::default(),
        }
    }
}

impl RingParams {
    /// 16 at 22.5°.
    pub fn sixteen() -> Self {
        Self { count: 16, ..Self::default() }
    }

    /// The same without noise, in air of exactly the temperature that is assumed.
    pub fn noiseless(self) -> Self {
        let transducer = TransducerParams { range_sigma_m: 0.0, range_sigma_share: 0.0, ..self.transducer };
        Self { temperature_sigma_k: 0.0, assumed_k: self.air.temperature_k, transducer, ..self }
    }

    /// Refuses a ring that cannot be; faults are named `sonar.…`.
    pub fn validated(self) -> Result<Self> {
        self.checked().map_err(|fault| Fault { what: format!("sonar.{}", fault.what), ..fault })
    }

    fn checked(self) -> Result<Self> {
        if !(1..=COUNT_MAX).contains(&self.count) {
            return Err(Fault::new("count", self.count, format!("1 to {COUNT_MAX} transducers")));
        }
        number_within("first_deg", self.first_deg, -360.0, 360.0)?;
        number_within("radius_m", self.radius_m, 0.0, 5.0)?;
        number_within("height_m", self.height_m, 0.0, 10.0)?;
        number_within("tilt_deg", self.tilt_deg, -80.0, 80.0)?;
        number_within("field_of_view_deg", self.field_of_view_deg, 1.0, 180.0)?;
        number_within("interval_s", self.interval_s, 1e-3, 10.0)?;
        number_within("assumed_k", self.assumed_k, 233.15, 333.15)?;
        number_within("temperature_sigma_k", self.temperature_sigma_k, 0.0, 20.0)?;
        if !(1..=2).contains(&self.order) {
            return Err(Fault::new("order", self.order, "1 or 2"));
        }
        if let Schedule::Groups { groups } = self.schedule
            && !(1..=self.count).contains(&groups)
        {
            return Err(Fault::new(
                "schedule.groups",
                groups,
                format!("1 to {}, the number of transducers", self.count),
            ));
        }
        self.air.validated()?;
        let transducer = self.transducer.validated()?;
        if self.interval_s <= transducer.blanking_s {
            let expected = format!("more than the {} s of the blanking", transducer.blanking_s);
            return Err(Fault::new("interval_s", self.interval_s, expected));
        }
        Ok(self)
    }

    /// Bearing of a transducer, counter-clockwise from ahead [rad].
    pub fn bearing_rad(&self, transducer: usize) -> f64 {
        self.first_deg.to_radians() + std::f64::consts::TAU * transducer as f64 / self.count as f64
    }

    /// How long one ring takes [s].
    pub fn ring_s(&self) -> f64 {
        self.schedule.steps(self.count) as f64 * self.interval_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_schedule_fires_every_transducer_once_a_ring() {
        for count in [1, 5, 16, 24] {
            let mut schedules = vec![Schedule::Sequential, Schedule::Alternating];
            schedules.extend((1..=count).map(|groups| Schedule::Groups { groups }));
            for schedule in schedules {
                let steps = schedule.steps(count);
                let mut fired: Vec<usize> = (0..steps).flat_map(|step| schedule.firing(count, step)).collect();
                fired.sort_unstable();
                assert_eq!(fired, (0..count).collect::<Vec<_>>(), "{schedule:?} of {count}");
                assert_eq!(schedule.firing(count, 0), schedule.firing(count, steps));
            }
        }
        let apart = |a: usize, b: usize| a.abs_diff(b).min(24 - a.abs_diff(b));
        let order: Vec<usize> = (0..24).flat_map(|step| Schedule::Alternating.firing(24, step)).collect();
        assert!(order.windows(2).all(|pair| apart(pair[0], pair[1]) > 1), "{order:?}");
        assert_eq!(Schedule::Groups { groups: 4 }.firing(24, 1), [1, 5, 9, 13, 17, 21]);
    }

    #[test]
    fn a_ring_takes_its_time() {
        assert!((RingParams::default().ring_s() - 1.56).abs() < 1e-12);
        assert!((RingParams::sixteen().bearing_rad(1).to_degrees() - 22.5).abs() < 1e-12);
        assert!((RingParams::default().bearing_rad(6).to_degrees() - 90.0).abs() < 1e-12);
    }

    #[test]
    fn what_cannot_be_is_refused_by_name() {
        let fault = |text: &str| toml::from_str::<RingParams>(text).unwrap().validated().unwrap_err().to_string();
        assert_eq!(fault("count = 0"), "sonar.count: found 0, expected 1 to 72 transducers");
        assert_eq!(fault("count = 1000"), "sonar.count: found 1000, expected 1 to 72 transducers");
        assert!(fault("[air]\ntemperature_k = -5").starts_with("sonar.air.temperature_k: found -5"));
        assert!(fault("assumed_k = -300").starts_with("sonar.assumed_k: found -300"));
        let short = fault("interval_s = 0.002");
        assert_eq!(short, "sonar.interval_s: found 0.002, expected more than the 0.00238 s of the blanking");
        assert!(fault("interval_s = nan").starts_with("sonar.interval_s"));
        assert!(fault("schedule = { groups = { groups = 0 } }").starts_with("sonar.schedule.groups: found 0"));
        assert!(fault("order = 3").starts_with("sonar.order"));
        assert!(fault("[transducer]\nrange_m_max = inf").starts_with("sonar.transducer.range_m_max"));
        assert!(toml::from_str::<RingParams>("colour = 1").is_err());
        assert!(toml::from_str::<RingParams>("count = -1").is_err());
        let ring: RingParams = toml::from_str("count = 16\nschedule = \"alternating\"").unwrap();
        assert_eq!((ring.count, ring.schedule), (16, Schedule::Alternating));
        let text = toml::to_string(&RingParams::default()).unwrap();
        assert_eq!(toml::from_str::<RingParams>(&text).unwrap(), RingParams::default());
    }
}
