//! Where the finder looks: two servos with encoders, and the schedules that lead them from stop to stop.
//!
//! Servos work in pulses of 2π/4000 rad; what angle a pulse is, the rig knows.

use std::f64::consts::TAU;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};
use crate::optics::Rig;
use crate::robot::normal;

/// A pulse of an encoder, q [rad].
const PULSE_RAD: f64 = TAU / 4000.0;
/// A servo has settled when it is this near [pulses] ...
const NEAR_PULSES: f64 = 0.25;
/// ... and needs longer than this for as much again [s].
const SLOW_S: f64 = 1.0 / 30.0;
/// Longest step of the integration [s].
const STEP_S_MAX: f64 = 5e-4;
/// Longest schedule.
const STOPS_MAX: usize = 100_000;

/// A servo axis (`instrument.md` 5; all [A]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServoParams {
    /// Natural frequency ωn [rad/s].
    pub natural_rad_s: f64,
    /// Damping ratio ζ.
    pub damping: f64,
    /// Highest rate [rad/s].
    pub rate_rad_s_max: f64,
    /// Highest acceleration [rad/s²].
    pub accel_rad_s2_max: f64,
    /// Standard deviation of where it stops, about a whole pulse [pulses].
    pub stop_sigma_pulse: f64,
    /// Play between the encoder and the axis [rad]: the axis lags by half of it.
    pub backlash_rad: f64,
    /// How far the axis is turned where its encoder reads 0 [pulses].
    pub zero_error_pulse: f64,
}

impl Default for ServoParams {
    fn default() -> Self {
        Self {
            natural_rad_s: 30.0,
            damping: 0.8,
            rate_rad_s_max: 10.0,
            accel_rad_s2_max: 400.0,
            stop_sigma_pulse: 0.1,
            backlash_rad: 0.0,
            zero_error_pulse: 0.0,
        }
    }
}

impl ServoParams {
    fn validated(self, axis: &str) -> Result<Self> {
        for (what, value, low, high) in [
            ("natural_rad_s", self.natural_rad_s, 1.0, 1000.0),
            ("damping", self.damping, 0.3, 3.0),
            ("rate_rad_s_max", self.rate_rad_s_max, 0.01, 1e3),
            ("accel_rad_s2_max", self.accel_rad_s2_max, 0.1, 1e6),
            ("stop_sigma_pulse", self.stop_sigma_pulse, 0.0, 10.0),
            ("backlash_rad", self.backlash_rad, 0.0, 0.1),
            ("zero_error_pulse", self.zero_error_pulse, -100.0, 100.0),
        ] {
            number_within(&format!("sweep.{axis}.{what}"), value, low, high)?;
        }
        Ok(self)
    }
}

/// One axis: a motor with an encoder, and the axis behind it.
#[derive(Clone, Debug)]
pub struct Servo {
    params: ServoParams,
    rng: ChaCha8Rng,
    /// The whole pulse it was sent to.
    target: i32,
    /// Where it will stop, near that [pulses].
    stop: f64,
    /// Motor [pulses].
    angle: f64,
    /// [pulses/s]
    rate: f64,
    /// Which side of its play the axis lies on: the sign of the last motion.
    side: f64,
    settled: bool,
}

impl Servo {
    /// At rest at pulse 0.
    pub fn new(params: ServoParams, seed: u64) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self { params, rng, target: 0, stop: 0.0, angle: 0.0, rate: 0.0, side: 1.0, settled: true }
    }

    /// Sends it to a pulse; the same pulse again moves nothing.
    pub fn target(&mut self, pulse: i32) {
        if pulse == self.target {
            return;
        }
        self.target = pulse;
        self.stop = f64::from(pulse) + self.params.stop_sigma_pulse * normal(&mut self.rng);
        self.settled = false;
    }

    /// Lets it move for `dt_s` seconds: θ̈ = ωn²(θcmd − θ) − 2ζωn·θ̇ within its limits, until it has settled.
    pub fn advance(&mut self, dt_s: f64) {
        let steps = (dt_s / STEP_S_MAX).ceil().clamp(1.0, 1e6) as usize;
        let step = dt_s / steps as f64;
        let p = self.params;
        let (accel_max, rate_max) = (p.accel_rad_s2_max / PULSE_RAD, p.rate_rad_s_max / PULSE_RAD);
        for _ in 0..steps {
            if self.settled {
                return;
            }
            let pull = p.natural_rad_s.powi(2) * (self.stop - self.angle);
            let accel = pull - 2.0 * p.damping * p.natural_rad_s * self.rate;
            self.rate = (self.rate + accel.clamp(-accel_max, accel_max) * step).clamp(-rate_max, rate_max);
            self.angle += self.rate * step;
            if self.rate != 0.0 {
                self.side = self.rate.signum();
            }
            let near = (self.stop - self.angle).abs() < NEAR_PULSES;
            if near && self.rate.abs() < NEAR_PULSES / SLOW_S {
                // It stops: what is left of the motion would be a lag of 0.1 pulse in every exposure.
                (self.angle, self.rate, self.settled) = (self.stop, 0.0, true);
            }
        }
    }

    /// Whether it stands where it was sent.
    pub fn settled(&self) -> bool {
        self.settled
    }

    /// Where the axis truly is [pulses].
    pub fn angle(&self) -> f64 {
        self.angle + self.params.zero_error_pulse - self.side * self.params.backlash_rad / PULSE_RAD / 2.0
    }

    /// What the encoder reads: the motor, to a whole pulse.
    pub fn encoder(&self) -> i32 {
        self.angle.round() as i32
    }
}

/// The finder's head: cylinder (θR) and mirror (θB).
#[derive(Clone, Debug)]
pub struct Head {
    cylinder: Servo,
    mirror: Servo,
}

impl Head {
    /// At rest, both encoders at 0.
    pub fn new(params: &SweepParams, seed: u64) -> Self {
        let cylinder = Servo::new(params.cylinder, seed);
        Self { cylinder, mirror: Servo::new(params.mirror, seed ^ 0x6d69_7272_6f72) }
    }

    /// Sends both axes to a stop.
    pub fn target(&mut self, stop: Stop) {
        self.cylinder.target(stop.cylinder);
        self.mirror.target(stop.mirror);
    }

    /// Lets both axes move for `dt_s` seconds.
    pub fn advance(&mut self, dt_s: f64) {
        self.cylinder.advance(dt_s);
        self.mirror.advance(dt_s);
    }

    /// Whether both axes stand where they were sent.
    pub fn settled(&self) -> bool {
        self.cylinder.settled() && self.mirror.settled()
    }

    /// Where the axes truly are: cylinder, mirror [pulses].
    pub fn angles(&self) -> (f64, f64) {
        (self.cylinder.angle(), self.mirror.angle())
    }

    /// What the encoders read: cylinder, mirror [pulses].
    pub fn encoders(&self) -> (i32, i32) {
        (self.cylinder.encoder(), self.mirror.encoder())
    }
}

/// One stop of a schedule [pulses].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stop {
    /// Cylinder, θR.
    pub cylinder: i32,
    /// Mirror, θB.
    pub mirror: i32,
}

/// What views and lines to take. A schedule that repeats runs to and fro.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// One view; the mirror goes from one pulse to another.
    Fixed {
        /// Cylinder [pulses].
        #[serde(default)]
        cylinder: i32,
        /// First mirror pulse.
        from: i32,
        /// Last mirror pulse, or the one before it that a step meets.
        to: i32,
        /// Pulses between two lines.
        step: u32,
    },
    /// Views side by side, from one cylinder pulse to another, each with the same lines, up and down in turn.
    Sweep {
        /// First cylinder pulse.
        from: i32,
        /// Last cylinder pulse, or the one before it that a step meets.
        to: i32,
        /// Pulses between two views: 250 are 22.5°.
        step: u32,
        /// Mirror pulses of the lines; without them those of `sweep.lines`.
        #[serde(default)]
        lines: Option<Vec<i32>>,
    },
    /// A full turn of views, each with the same lines, up and down in turn.
    Turn {
        /// Number of views: 16 overlap by 22 %.
        #[serde(default = "views_default")]
        views: u32,
        /// Mirror pulses of the lines; without them those of `sweep.lines`.
        #[serde(default)]
        lines: Option<Vec<i32>>,
    },
    /// Any stops in any order.
    Table {
        /// Cylinder and mirror pulses; lists of two, since of a longer one the TOML reader would pass over the rest.
        stops: Vec<Vec<i32>>,
    },
}

fn views_default() -> u32 {
    16
}

/// When an image is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Trigger {
    /// One at each stop, when both servos have settled.
    #[default]
    Settled,
    /// All the time, settled or not.
    Free,
}

/// The finder's motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SweepParams {
    /// When an image is taken.
    pub trigger: Trigger,
    /// Highest rate of images [Hz]; the rate of a free trigger.
    pub rate_hz_max: f64,
    /// Mirror pulses of a scan's lines.
    pub lines: Vec<i32>,
    /// What runs while the robot drives, again and again.
    pub driving: Schedule,
    /// The scan `turn`.
    pub turn: Schedule,
    /// The scan `view`.
    pub view: Schedule,
    /// The cylinder's servo.
    pub cylinder: ServoParams,
    /// The mirror's servo.
    pub mirror: ServoParams,
}

impl Default for SweepParams {
    fn default() -> Self {
        Self {
            trigger: Trigger::Settled,
            rate_hz_max: 30.0,
            // METRO-I, pulse 0 at P: 16 beams that meet the floor evenly from X = 3.6 to 1.45 m, and 4 flatter ones.
            lines: vec![-130, -105, -82, -62, -45, -39, -33, -26, -19, -11, -2, 7, 18, 30, 43, 58, 74, 93, 115, 140],
            driving: Schedule::Fixed { cylinder: 0, from: -52, to: 140, step: 16 },
            turn: Schedule::Turn { views: 16, lines: None },
            view: Schedule::Fixed { cylinder: 0, from: -130, to: 148, step: 2 },
            cylinder: ServoParams::default(),
            mirror: ServoParams::default(),
        }
    }
}

impl SweepParams {
    /// Refuses impossible servos and schedules without stops; faults are named `sweep.…`.
    pub fn validated(self) -> Result<Self> {
        number_within("sweep.rate_hz_max", self.rate_hz_max, 0.01, 1000.0)?;
        self.cylinder.validated("cylinder")?;
        self.mirror.validated("mirror")?;
        for (what, schedule) in [("driving", &self.driving), ("turn", &self.turn), ("view", &self.view)] {
            let named = |fault: Fault| Fault { what: format!("sweep.{what}.{}", fault.what), ..fault };
            schedule.stops(&self.lines).map_err(named)?;
        }
        Ok(self)
    }

    /// The stops of a schedule.
    ///
    /// Errors: none or too many of them, or one outside the travel of the rig's axes.
    pub fn stops(&self, schedule: &Schedule, rig: &Rig) -> Result<Vec<Stop>> {
        let stops = schedule.stops(&self.lines)?;
        for stop in &stops {
            rig.robot_from_sensor(stop.cylinder)?;
            rig.beam_rad(stop.mirror)?;
        }
        Ok(stops)
    }
}

impl Schedule {
    fn stops(&self, common: &[i32]) -> Result<Vec<Stop>> {
        let stops = match self {
            Self::Fixed { cylinder, from, to, step } => {
                run(*from, *to, *step)?.into_iter().map(|mirror| Stop { cylinder: *cylinder, mirror }).collect()
            }
            Self::Sweep { from, to, step, lines } => {
                views(&run(*from, *to, *step)?, lines.as_deref().unwrap_or(common))?
            }
            Self::Turn { views: count, lines } => {
                if !(1..=4000).contains(count) {
                    return Err(Fault::new("views", count, "1 to 4000 views"));
                }
                let at = |k: u32| (f64::from(k) * 4000.0 / f64::from(*count)).round() as i32;
                views(&(0..*count).map(at).collect::<Vec<_>>(), lines.as_deref().unwrap_or(common))?
            }
            Self::Table { stops } => stops.iter().map(|stop| pair(stop)).collect::<Result<_>>()?,
        };
        if stops.is_empty() || stops.len() > STOPS_MAX {
            return Err(Fault::new("stops", stops.len(), format!("1 to {STOPS_MAX} of them")));
        }
        Ok(stops)
    }
}

fn pair(stop: &[i32]) -> Result<Stop> {
    match *stop {
        [cylinder, mirror] => Ok(Stop { cylinder, mirror }),
        _ => Err(Fault::new("stops", format!("{stop:?}"), "pairs of a cylinder and a mirror pulse")),
    }
}

/// Every view with every line, the lines to and fro.
fn views(cylinders: &[i32], lines: &[i32]) -> Result<Vec<Stop>> {
    let count = cylinders.len().saturating_mul(lines.len());
    if count > STOPS_MAX {
        return Err(Fault::new("stops", count, format!("1 to {STOPS_MAX} of them")));
    }
    let mut stops = Vec::with_capacity(count);
    for (k, &cylinder) in cylinders.iter().enumerate() {
        let view = lines.iter().map(|&mirror| Stop { cylinder, mirror });
        if k % 2 == 0 { stops.extend(view) } else { stops.extend(view.rev()) }
    }
    Ok(stops)
}

/// Pulses from one to another, either way.
fn run(from: i32, to: i32, step: u32) -> Result<Vec<i32>> {
    let span = (i64::from(to) - i64::from(from)).unsigned_abs();
    if step == 0 || span / u64::from(step) >= STOPS_MAX as u64 {
        return Err(Fault::new("step", step, "a number that leads from `from` to `to` in 1 to 100000 stops"));
    }
    let toward = if to < from { -1 } else { 1 };
    // Within i32, since it stays between `from` and `to`.
    Ok((0..=span / u64::from(step)).map(|k| (i64::from(from) + toward * (k * u64::from(step)) as i64) as i32).collect())
}

/// An exposure, at its middle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Where the axes truly are: cylinder, mirror [pulses].
    pub angles: (f64, f64),
    /// What the encoders read: cylinder, mirror [pulses].
    pub encoders: (i32, i32),
    /// Whether both servos stood still.
    pub settled: bool,
}

/// The exposure under way.
#[derive(Clone, Copy, Debug)]
struct Exposure {
    since_s: f64,
    /// Whether the head stood still when it began: then it stands still to its end.
    settled: bool,
    /// Whether its middle is past.
    taken: bool,
}

/// A schedule at work.
#[derive(Clone, Debug)]
pub struct Sweep {
    stops: Vec<Stop>,
    trigger: Trigger,
    period_s: f64,
    exposure_s: f64,
    /// Number of the stop it is at, over all passes.
    at: usize,
    clock_s: f64,
    open: Option<Exposure>,
    /// No exposure begins before.
    next_s: f64,
    shots: usize,
}

impl Sweep {
    /// Ready for the first stop of `stops` (as `SweepParams::stops` gives them), with this exposure time [s].
    ///
    /// Errors: no stops, a bad exposure time.
    pub fn new(stops: Vec<Stop>, params: &SweepParams, exposure_s: f64) -> Result<Self> {
        if stops.is_empty() {
            return Err(Fault::new("schedule", "no stops", "at least one stop"));
        }
        positive("exposure_s", exposure_s)?;
        number_within("exposure_s", exposure_s, 0.0, 10.0)?;
        let period_s = 1.0 / positive("sweep.rate_hz_max", params.rate_hz_max)?;
        let trigger = params.trigger;
        Ok(Self { stops, trigger, period_s, exposure_s, at: 0, clock_s: 0.0, open: None, next_s: 0.0, shots: 0 })
    }

    /// Lets the head and the schedule run for `dt_s` seconds; gives the exposure whose middle has just passed.
    pub fn advance(&mut self, head: &mut Head, dt_s: f64) -> Option<Shot> {
        head.target(self.stop());
        head.advance(dt_s);
        self.clock_s += dt_s;
        let half_step = dt_s / 2.0; // so that rounding moves nothing by a whole step
        let settled = head.settled();
        if self.open.is_none() && self.clock_s + half_step > self.next_s && (settled || self.trigger == Trigger::Free) {
            self.open = Some(Exposure { since_s: self.clock_s, settled, taken: false });
            self.next_s = self.clock_s + self.period_s;
        }
        let mut exposure = self.open?;
        let mut shot = None;
        let open_s = self.clock_s - exposure.since_s + half_step;
        if !exposure.taken && open_s > self.exposure_s / 2.0 {
            shot = Some(Shot { angles: head.angles(), encoders: head.encoders(), settled: exposure.settled });
            exposure.taken = true;
            self.shots += 1;
        }
        self.open = Some(exposure);
        if open_s > self.exposure_s {
            self.open = None;
            // A free trigger takes what it gets on the way; the stop is left when an image was taken there.
            self.at += usize::from(exposure.settled);
        }
        shot
    }

    /// Whether every stop was visited at least once.
    pub fn done(&self) -> bool {
        self.at >= self.stops.len()
    }

    /// How much of one pass is over, 0 to 1.
    pub fn progress(&self) -> f64 {
        (self.at as f64 / self.stops.len() as f64).min(1.0)
    }

    /// Images taken so far.
    pub fn shots(&self) -> usize {
        self.shots
    }

    /// The stop it is at: forth in even passes, back in odd ones.
    fn stop(&self) -> Stop {
        let (pass, k) = (self.at / self.stops.len(), self.at % self.stops.len());
        self.stops[if pass % 2 == 0 { k } else { self.stops.len() - 1 - k }]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 1.0 / 240.0;
    const EXPOSURE_S: f64 = 1.0 / 60.0;

    fn settle_s(params: ServoParams, pulses: i32) -> f64 {
        let mut servo = Servo::new(params, 1);
        servo.target(pulses);
        let mut time = 0.0;
        while !servo.settled() {
            servo.advance(1e-3);
            time += 1e-3;
            assert!(time < 10.0);
        }
        time
    }

    #[test]
    fn servos_take_the_time_of_their_model() {
        let exact = ServoParams { stop_sigma_pulse: 0.0, ..ServoParams::default() };
        assert!((settle_s(exact, 3) - 0.12).abs() < 0.01, "{}", settle_s(exact, 3));
        assert!((settle_s(exact, 250) - 0.30).abs() < 0.015, "{}", settle_s(exact, 250));
        assert!((settle_s(exact, -250) - settle_s(exact, 250)).abs() < 1e-9);
        // The limits tell on a long way: half a turn at 2 rad/s takes at least 1.57 s.
        let slow = ServoParams { rate_rad_s_max: 2.0, ..exact };
        assert!((1.57..2.2).contains(&settle_s(slow, 2000)), "{}", settle_s(slow, 2000));
        let weak = ServoParams { accel_rad_s2_max: 20.0, ..exact };
        assert!(settle_s(weak, 250) > 2.0 * (250.0 * PULSE_RAD / 20.0).sqrt(), "{}", settle_s(weak, 250));
    }

    #[test]
    fn the_motion_is_that_of_the_linear_model() {
        // θ(t) = 1 − e^(−ζωn·t)·(cos ωd·t + ζ/√(1−ζ²)·sin ωd·t), ωd = ωn·√(1−ζ²)
        let mut servo = Servo::new(ServoParams { stop_sigma_pulse: 0.0, ..ServoParams::default() }, 0);
        servo.target(200);
        for k in 1..=40 {
            servo.advance(DT);
            let t = f64::from(k) * DT;
            let exact = 200.0 * (1.0 - (-24.0 * t).exp() * ((18.0 * t).cos() + 0.8 / 0.6 * (18.0 * t).sin()));
            assert!((servo.angle() - exact).abs() < 1.5, "{t} {} {exact}", servo.angle());
        }
    }

    #[test]
    fn stops_scatter_about_whole_pulses_and_the_encoder_reads_whole_ones() {
        let mut servo = Servo::new(ServoParams::default(), 5);
        let errors: Vec<f64> = (1..=1000)
            .map(|k| {
                let pulse = if k % 2 == 0 { 0 } else { 3 };
                servo.target(pulse);
                servo.advance(1.0);
                assert!(servo.settled() && servo.encoder() == pulse);
                let there = servo.angle();
                servo.target(pulse);
                servo.advance(1.0);
                assert_eq!(servo.angle(), there); // told to stay, it stays
                there - f64::from(pulse)
            })
            .collect();
        let sigma = (errors.iter().map(|e| e * e).sum::<f64>() / 1000.0).sqrt();
        assert!((sigma - 0.1).abs() < 0.01, "{sigma}");
        let mean = errors.iter().sum::<f64>() / 1000.0;
        assert!(mean.abs() < 0.015, "{mean}");
    }

    #[test]
    fn backlash_and_zero_error_part_axis_and_encoder() {
        let params = ServoParams { stop_sigma_pulse: 0.0, backlash_rad: 2.0 * PULSE_RAD, ..ServoParams::default() };
        let mut servo = Servo::new(ServoParams { zero_error_pulse: 1.0, ..params }, 0);
        // The axis lags behind the motor by half of the play, on either way.
        servo.target(3);
        servo.advance(1.0);
        assert_eq!((servo.encoder(), servo.angle()), (3, 3.0 + 1.0 - 1.0));
        servo.target(-2);
        servo.advance(1.0);
        assert_eq!((servo.encoder(), servo.angle()), (-2, -2.0 + 1.0 + 1.0));
    }

    fn stops(schedule: Schedule) -> Vec<Stop> {
        SweepParams::default().stops(&schedule, &Rig::metro_i()).unwrap()
    }

    #[test]
    fn schedules_visit_what_they_say() {
        let pairs = |schedule| stops(schedule).iter().map(|s| (s.cylinder, s.mirror)).collect::<Vec<_>>();
        let fixed = Schedule::Fixed { cylinder: 7, from: 10, to: -5, step: 5 };
        assert_eq!(pairs(fixed), [(7, 10), (7, 5), (7, 0), (7, -5)]);
        let turn = Schedule::Turn { views: 4, lines: Some(vec![1, 2]) };
        let expected = [(0, 1), (0, 2), (1000, 2), (1000, 1), (2000, 1), (2000, 2), (3000, 2), (3000, 1)];
        assert_eq!(pairs(turn), expected);
        let sweep = Schedule::Sweep { from: -250, to: 250, step: 250, lines: Some(vec![0]) };
        assert_eq!(pairs(sweep), [(-250, 0), (0, 0), (250, 0)]);
        assert_eq!(stops(Schedule::Turn { views: 16, lines: None }).len(), 320);
    }

    #[test]
    fn the_default_lines_meet_the_floor_evenly() {
        let (rig, params) = (Rig::metro_i(), SweepParams::default().validated().unwrap());
        let reach = |pulse: &i32| 0.817_230 / rig.beam_rad(*pulse).unwrap().tan();
        let floor: Vec<f64> = params.lines.iter().skip(4).map(reach).collect();
        assert!((floor[0] - 3.6).abs() < 0.03 && (floor[15] - 1.45).abs() < 0.03, "{floor:?}");
        assert!(floor.windows(2).all(|pair| (pair[0] - pair[1] - 2.15 / 15.0).abs() < 0.05), "{floor:?}");
        for schedule in [&params.driving, &params.turn, &params.view] {
            params.stops(schedule, &rig).unwrap();
        }
    }

    fn shoot(params: &SweepParams, schedule: Schedule, seconds: f64) -> Vec<(f64, Shot)> {
        let mut head = Head::new(params, 3);
        let mut sweep = Sweep::new(params.stops(&schedule, &Rig::metro_i()).unwrap(), params, EXPOSURE_S).unwrap();
        let steps = (seconds / DT) as usize;
        let shots: Vec<_> = (1..=steps).filter_map(|k| Some((k as f64 * DT, sweep.advance(&mut head, DT)?))).collect();
        assert_eq!(sweep.shots(), shots.len());
        shots
    }

    #[test]
    fn a_settled_trigger_takes_one_image_at_every_stop_and_turns_back_at_the_end() {
        let params = SweepParams::default();
        let shots = shoot(&params, Schedule::Fixed { cylinder: 0, from: 0, to: 6, step: 3 }, 2.0);
        let seen: Vec<i32> = shots.iter().map(|s| s.1.encoders.1).take(8).collect();
        assert_eq!(seen, [0, 3, 6, 6, 3, 0, 0, 3]);
        assert!(shots.iter().all(|s| s.1.settled && (s.1.angles.1 - f64::from(s.1.encoders.1)).abs() < 0.5));
        // 0.12 s to settle, 1/60 s of light: about 6 or 7 lines a second.
        let line_s = shots[2].0 - shots[1].0;
        assert!((0.12..0.16).contains(&line_s), "{line_s}");
        // A head that stands still takes images no faster than allowed.
        let still = shoot(&params, Schedule::Table { stops: vec![vec![0, 0]] }, 2.0);
        assert!((58..=61).contains(&still.len()), "{}", still.len());
    }

    #[test]
    fn a_free_trigger_takes_images_on_the_way_and_flags_them() {
        let params = SweepParams { trigger: Trigger::Free, ..SweepParams::default() };
        let shots = shoot(&params, Schedule::Fixed { cylinder: 0, from: -50, to: 140, step: 16 }, 10.0);
        assert!((295..=301).contains(&shots.len()), "{}", shots.len());
        let moving = shots.iter().filter(|s| !s.1.settled).count();
        assert!(moving > 100 && moving < 290, "{moving}");
        // Still, no stop is left without a settled image.
        let seen: Vec<i32> = shots.iter().filter(|s| s.1.settled).map(|s| s.1.encoders.1).collect();
        assert!(seen.windows(2).all(|pair| (pair[0] - pair[1]).abs() <= 16), "{seen:?}");
    }

    #[test]
    fn a_turn_is_done_when_all_stops_are_visited() {
        let params = SweepParams::default();
        let run = || {
            let mut head = Head::new(&params, 9);
            let stops = params.stops(&params.turn, &Rig::metro_i()).unwrap();
            let mut sweep = Sweep::new(stops, &params, EXPOSURE_S).unwrap();
            let mut bits = Vec::new();
            let mut time = 0.0;
            while !sweep.done() {
                if let Some(shot) = sweep.advance(&mut head, DT) {
                    bits.push((shot.angles.0.to_bits(), shot.angles.1.to_bits(), shot.encoders));
                }
                time += DT;
                assert!(time < 200.0);
            }
            assert_eq!(bits.len(), 320);
            assert!((40.0..80.0).contains(&time), "{time}");
            bits
        };
        assert_eq!(run(), run());
    }

    #[test]
    fn what_cannot_be_swept_is_refused() {
        let fault = |text: &str| match toml::from_str::<SweepParams>(text) {
            Ok(params) => params.validated().unwrap_err().to_string(),
            Err(error) => error.to_string(),
        };
        assert!(fault("driving = { kind = \"fixed\", from = 0, to = 9, step = 0 }").starts_with("sweep.driving.step"));
        assert!(fault("lines = []").starts_with("sweep.turn.stops: found 0"));
        assert!(fault("turn = { kind = \"turn\", views = 0 }").starts_with("sweep.turn.views"));
        assert!(
            fault("view = { kind = \"fixed\", from = -2147483648, to = 2147483647, step = 1 }").contains("view.step")
        );
        assert!(fault("mirror = { backlash_rad = nan }").starts_with("sweep.mirror.backlash_rad"));
        assert!(fault("view = { kind = \"fixed\", from = 0, to = 9, step = 1, stride = 2 }").contains("stride"));
        assert!(
            fault("view = { kind = \"table\", stops = [[1, 2, 3]] }").starts_with("sweep.view.stops: found [1, 2, 3]")
        );
        assert!(fault("speed = 1").contains("speed"));
        let table = Schedule::Table { stops: vec![vec![0, 301]] };
        let fault = SweepParams::default().stops(&table, &Rig::metro_i()).unwrap_err();
        assert!(fault.to_string().starts_with("mirror encoder: found 301"), "{fault}");
        assert!(Sweep::new(vec![], &SweepParams::default(), EXPOSURE_S).is_err());
        let one = vec![Stop { cylinder: 0, mirror: 0 }];
        assert!(Sweep::new(one, &SweepParams::default(), f64::NAN).is_err());
    }
}
