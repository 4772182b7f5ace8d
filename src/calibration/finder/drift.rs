//! The drift alarm: on a floor that is known to be flat, does the calibration still fit, and if not, what moved?
//!
//! Every capture shows a stretch of floor where encoders and calibration say its row must be. [`DriftWatch`] keeps rows and
//! slopes of the line in blocks of columns of the last captures. Objects and walls put them off the floor's line too, but
//! each elsewhere: what is off in a way that bends smoothly over image, mirror and cylinder is the floor (`floor`). If that
//! is off by more than a few millimetres of height, every parameter of the finder in turn is asked how much of it one shift
//! would explain (`suspects`).
//!
//! A finder that was knocked hard sees its floor far from where it should be and at another slope. Then it is looked for
//! about where each single shift, in steps up to 0.3 rad or 0.3 m, would put it (`far`). Where that finds none either,
//! though lines lie where nothing can be, below the floor, or none on it all around, that is an alarm of its own:
//! [`DriftState::NoFloor`].
//!
//! What the floor cannot tell is not claimed: a camera that tilts and a beam whose zero slips move the floor's line nearly
//! alike, and then both are named; x0 and the mirror's place ahead never come apart. A sheet fixed to the camera draws the
//! same line for ever: its place and slope are two numbers, so height, tilt and the laser's offset are always named together,
//! and roll stands for a sheet that turned as well.
//!
//! False alarms: none in 300 simulated windows of 80 captures with and without objects and walls (the test
//! `undisturbed_finders_raise_no_alarm`), so fewer than one window in 100 at 95 % confidence. A wall is smooth as well: a
//! large misfit that no single parameter explains is no alarm while the finder looks one way and sees nothing below the
//! floor. A floor that is not flat to [`DriftParams::misfit_m`] raises an alarm, as it should.

mod far;
mod floor;
mod shift;
mod suspects;

use std::collections::VecDeque;
use std::fmt;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use self::floor::Floor;
use self::shift::Shifts;
use crate::fault::{Fault, Result, number_within, positive};
use crate::geometry::{Plane, Robot};
use crate::image::{Line, Peak};
use crate::optics::{Laser, Rig};

/// Blocks of columns of a line that are read as one.
const BLOCKS: usize = 16;
/// A block counts with this part of its columns at least.
const FILLED: f64 = 0.6;
/// A block whose rows scatter about a straight line by more than this has an edge in it [px, median deviation].
const SCATTER_MAX_PX: f64 = 0.5;
/// A floor that is this share of all blocks is where it was looked for first.
const CLEAR_SHARE: f64 = 0.5;
/// No floor is an alarm where this share of what is seen lies below it.
const BELOW_SHARE: f64 = 0.25;
/// Or where no more than this share lies on it, all around.
const ON_SHARE: f64 = 0.03;
/// A misfit of no single parameter larger than this may be a wall [m, rms].
const WALL_M: f64 = 0.1;
/// Smallest standard deviation of a block [px]: what speckle and the lens model leave.
const BLOCK_SIGMA_PX: f64 = 0.05;

/// When the alarm looks, and what it overlooks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriftParams {
    /// Whether the floor is known to be flat, at the height of the robot's wheels: without that the alarm is off.
    pub flat_floor: bool,
    /// So many captures are looked at together, the newest.
    pub captures: usize,
    /// They are looked at anew after so many more.
    pub every: usize,
    /// So few captures that show floor say nothing.
    pub captures_min: usize,
    /// Apparent height of the floor that is overlooked [m, rms].
    pub misfit_m: f64,
    /// A shift smaller than so many of its standard deviations is overlooked.
    pub significance: f64,
}

impl Default for DriftParams {
    fn default() -> Self {
        Self { flat_floor: false, captures: 300, every: 50, captures_min: 40, misfit_m: 0.004, significance: 6.0 }
    }
}

impl DriftParams {
    /// Refuses numbers that make no alarm.
    pub fn validated(self) -> Result<Self> {
        for (what, value, low) in
            [("captures", self.captures, 10), ("every", self.every, 1), ("captures_min", self.captures_min, 5)]
        {
            if !(low..=100_000).contains(&value) {
                return Err(Fault::new(format!("drift.{what}"), value, format!("{low} to 100000")));
            }
        }
        if self.captures_min > self.captures {
            let expected = format!("at most drift.captures, {}", self.captures);
            return Err(Fault::new("drift.captures_min", self.captures_min, expected));
        }
        positive("drift.misfit_m", self.misfit_m)?;
        number_within("drift.significance", self.significance, 3.0, 1e6)?;
        Ok(self)
    }
}

/// A parameter that may have moved.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moved {
    /// Its name, as in a calibration.
    pub parameter: &'static str,
    /// The true finder's minus the calibrated one's.
    pub by: f64,
    /// Standard deviation of that.
    pub sigma: f64,
    /// The unit of both.
    pub unit: &'static str,
    /// Share of the floor's squared height that it explains: 1 is all that bends smoothly.
    pub explains: f64,
}

/// What the floor says of the calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DriftState {
    /// Nothing yet: too little floor was seen.
    Unseen,
    /// The calibration fits.
    Fits,
    /// One parameter has moved: the first of `moved`, or any other there, which the data do not tell from it.
    Moved,
    /// The floor does not fit, and no single parameter explains it: several have moved, or the floor is not flat.
    Several,
    /// Lines were seen, but no floor where it must be, nor anywhere that one shift would put it: the finder was knocked
    /// so hard that the floor is not recognized.
    NoFloor,
}

/// The evidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// What the floor says.
    pub state: DriftState,
    /// The captures that showed floor.
    pub captures: usize,
    /// So many must.
    pub captures_needed: usize,
    /// The captures that showed any line and were looked at.
    pub lines: usize,
    /// Blocks of columns on the floor.
    pub readings: usize,
    /// Share of all blocks of columns that lie on the floor, wherever it was found.
    pub floor_share: f64,
    /// Share of all blocks that lie below the calibrated floor, where nothing can be.
    pub below_share: f64,
    /// Apparent height of the floor [m, rms].
    pub misfit_m: f64,
    /// What would be left of it with the first of `moved` put right [m, rms].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub misfit_after_m: Option<f64>,
    /// What may have moved, the likeliest first; those that the data do not tell from it after it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub moved: Vec<Moved>,
}

impl Drift {
    fn unseen(params: &DriftParams, lines: usize) -> Self {
        Self {
            state: DriftState::Unseen,
            captures: 0,
            captures_needed: params.captures_min,
            lines,
            readings: 0,
            floor_share: 0.0,
            below_share: 0.0,
            misfit_m: 0.0,
            misfit_after_m: None,
            moved: Vec::new(),
        }
    }

    /// Whether the calibration does not fit.
    pub fn is_alarm(&self) -> bool {
        matches!(self.state, DriftState::Moved | DriftState::Several | DriftState::NoFloor)
    }
}

impl fmt::Display for Moved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // As many places as its error bar has a use for.
        let places = (1.0 - self.sigma.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0) as usize;
        write!(f, "{} by {:+.places$} ± {:.places$} {}", self.parameter, self.by, self.sigma, self.unit)
    }
}

impl fmt::Display for Drift {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (mm, captures, lines) = (self.misfit_m * 1e3, self.captures, self.lines);
        match self.state {
            DriftState::Unseen => write!(
                f,
                "calibration not checked: {captures} of the last {lines} captures with a line showed flat floor, and {} \
                 must",
                self.captures_needed
            ),
            DriftState::NoFloor => write!(
                f,
                "calibration does not fit: no floor where it must be; of what the last {lines} captures with a line show, \
                 {:.0} % lies on it and {:.0} % below it (the finder was knocked hard, or the floor is not flat)",
                self.floor_share * 100.0,
                self.below_share * 100.0
            ),
            DriftState::Fits => {
                write!(f, "calibration fits: the floor is level to {mm:.1} mm rms over {captures} captures")
            }
            DriftState::Several => write!(
                f,
                "calibration does not fit: the floor is off by {mm:.1} mm rms over {captures} captures, and no single \
                 parameter explains it (several moved, or the floor is not flat)"
            ),
            DriftState::Moved => {
                let after = self.misfit_after_m.unwrap_or(f64::NAN) * 1e3;
                write!(f, "calibration does not fit: the floor is off by {mm:.1} mm rms over {captures} captures; ")?;
                for (i, moved) in self.moved.iter().enumerate() {
                    write!(f, "{}{moved}", if i == 0 { "moved: " } else { ", or " })?;
                }
                let which = if self.moved.len() > 1 { " (the floor does not tell which)" } else { "" };
                write!(f, "{which}; put right, {after:.1} mm are left")
            }
        }
    }
}

/// A block of columns of one capture's line.
#[derive(Clone, Copy, Debug)]
struct Block {
    /// Middle column, and the row that is read there [px].
    u: f64,
    v: f64,
    /// How the rows run [rows a column].
    slope: f64,
    /// Standard deviation of the row [px].
    sigma: f64,
}

impl Block {
    /// What columns from `from` on show; `None` where too few do, or an edge is among them.
    fn read(columns: &[Option<Peak>], from: usize, height: usize) -> Option<Self> {
        let row = |peak: &Option<Peak>| peak.map(|peak| f64::from(peak.v)).filter(|v| (0.0..height as f64).contains(v));
        let rows: Vec<Option<f64>> = columns.iter().map(row).collect();
        let count = rows.iter().flatten().count();
        if (count as f64) < FILLED * columns.len() as f64 {
            return None;
        }
        // Half a block apart: what stands in the way of less than a quarter does not matter.
        let half = columns.len() / 2;
        let pairs = rows.iter().zip(rows.iter().skip(half));
        let mut slopes: Vec<f64> = pairs.filter_map(|(a, b)| Some((b.as_ref()? - a.as_ref()?) / half as f64)).collect();
        let slope = if slopes.is_empty() { return None } else { median(&mut slopes) };
        let middle = columns.len() as f64 / 2.0;
        let level = |(k, v): (usize, &Option<f64>)| v.map(|v| v - slope * (k as f64 - middle));
        let mut rows: Vec<f64> = rows.iter().enumerate().filter_map(level).collect();
        let v = median(&mut rows);
        rows.iter_mut().for_each(|row| *row = (*row - v).abs());
        let scatter = median(&mut rows);
        let sigma = BLOCK_SIGMA_PX.hypot(1.86 * scatter / (count as f64).sqrt()); // of a median
        (scatter <= SCATTER_MAX_PX).then_some(Self { u: from as f64 + middle, v, slope, sigma })
    }
}

/// What one capture showed.
#[derive(Clone, Debug)]
struct Look {
    mirror_pulse: f64,
    cylinder_pulse: f64,
    blocks: Vec<Block>,
}

/// Watches captures go by.
#[derive(Clone, Debug)]
pub struct DriftWatch {
    params: DriftParams,
    shifts: Shifts,
    /// Standard deviation of the mirror's reading [pulses].
    pulse_sigma: f64,
    floor: Plane<Robot>,
    looks: VecDeque<Look>,
    since: usize,
    is_judged: bool,
    latest: Drift,
}

impl DriftWatch {
    /// A watch over a finder; `None` where the floor is not known to be flat.
    ///
    /// Errors: parameters that make no alarm.
    pub fn new(rig: &Rig, params: DriftParams) -> Result<Option<Self>> {
        let params = params.validated()?;
        let floor = Plane::new(Vector3::z(), 0.0);
        let (Some(floor), true) = (floor, params.flat_floor) else { return Ok(None) };
        let gain = match rig.laser {
            Laser::Mirror(mirror) => mirror.beam.rad_per_pulse.abs().max(1e-12),
            Laser::Plane(_) => f64::INFINITY,
        };
        Ok(Some(Self {
            params,
            shifts: Shifts::of(rig)?,
            // A tenth of a pulse at least: no mirror stops exactly.
            pulse_sigma: (rig.beam_sigma_rad / gain).max(0.1),
            floor,
            looks: VecDeque::new(),
            since: 0,
            is_judged: false,
            latest: Drift::unseen(&params, 0),
        }))
    }

    /// One more capture. Returns what the floor says when it was looked at anew: as soon as as many captures may show floor
    /// as must, then every so many, and four times as often until there is something to say.
    pub fn see(&mut self, line: &Line, mirror_pulse: i32, cylinder_pulse: i32) -> Option<&Drift> {
        let look = self.look(line, f64::from(mirror_pulse), f64::from(cylinder_pulse))?;
        if self.looks.len() >= self.params.captures {
            self.looks.pop_front();
        }
        self.looks.push_back(look);
        self.since += 1;
        let due = match (self.is_judged, self.latest.state) {
            (false, _) => self.params.captures_min,
            (true, DriftState::Unseen) => self.params.every.div_ceil(4),
            (true, _) => self.params.every,
        };
        if self.since < due {
            if !self.is_judged {
                self.latest.lines = self.looks.len();
            }
            return None;
        }
        (self.since, self.is_judged) = (0, true);
        self.latest = self.judge();
        Some(&self.latest)
    }

    /// What the floor said when it was last looked at.
    pub fn latest(&self) -> &Drift {
        &self.latest
    }

    /// Columns of a block [px].
    fn block_px(&self) -> f64 {
        (self.shifts.nominal().camera.width / BLOCKS) as f64
    }

    /// The blocks of a line; `None` for a capture without any.
    fn look(&self, line: &Line, mirror_pulse: f64, cylinder_pulse: f64) -> Option<Look> {
        let wide = line.width() / BLOCKS;
        if wide < 4 || line.width() != self.shifts.nominal().camera.width {
            return None;
        }
        let columns = line.columns.chunks_exact(wide).take(BLOCKS).enumerate();
        let blocks: Vec<Block> = columns.filter_map(|(i, c)| Block::read(c, i * wide, line.height)).collect();
        (!blocks.is_empty()).then_some(Look { mirror_pulse, cylinder_pulse, blocks })
    }

    fn judge(&self) -> Drift {
        let near = Floor::about(self, None);
        // Where the floor is most of what is seen there is no need to look elsewhere.
        let is_clear = near.as_ref().is_some_and(|floor| floor.share >= CLEAR_SHARE);
        let far = if is_clear { None } else { far::found(self) };
        let much_more = |far: &Floor, near: &Floor| far.readings() as f64 > 1.5 * near.readings() as f64;
        let floor = match (near, far) {
            (Some(near), Some(far)) if !much_more(&far, &near) => Some(near),
            (near, far) => far.or(near),
        };
        let (on, below) = floor::on_and_below(self);
        let unseen = Drift { below_share: below, ..Drift::unseen(&self.params, self.looks.len()) };
        // A wall ahead is smooth as well; but nothing stands below the floor, and no wall on three sides at once.
        let is_no_wall = || below >= BELOW_SHARE || self.looks_around();
        let Some(floor) = floor else {
            let is_lost = (below >= BELOW_SHARE || on <= ON_SHARE) && is_no_wall();
            let enough = self.looks.len() >= self.params.captures_min;
            let state = if enough && is_lost { DriftState::NoFloor } else { DriftState::Unseen };
            return Drift { state, floor_share: on, ..unseen };
        };
        let drift = self.judged(&floor, &unseen);
        // About what moved the floor is seen best.
        let again = (drift.moved.first())
            .and_then(|moved| Floor::about(self, Some((moved.parameter, moved.by))))
            .filter(|again| again.readings() > floor.readings())
            .map(|again| self.judged(&again, &unseen));
        let drift = again.unwrap_or(drift);
        let may_be_a_wall = drift.state == DriftState::Several && drift.misfit_m > WALL_M && !is_no_wall();
        if may_be_a_wall { Drift { floor_share: on, ..unseen } } else { drift }
    }

    /// What one floor says.
    fn judged(&self, floor: &Floor, unseen: &Drift) -> Drift {
        let (captures, readings, floor_share) = (floor.captures(), floor.readings(), floor.share);
        let drift = Drift { captures, readings, floor_share, ..unseen.clone() };
        if captures < self.params.captures_min {
            return drift;
        }
        let misfit_m = floor.misfit_m();
        let drift = Drift { state: DriftState::Fits, misfit_m, ..drift };
        if misfit_m < self.params.misfit_m { drift } else { suspects::suspected(self, floor, drift) }
    }

    /// Whether captures go to at least three of four quarters: no wall stands in all of them.
    fn looks_around(&self) -> bool {
        let cylinder = self.shifts.nominal().cylinder;
        let mut quarters = [false; 4];
        for look in &self.looks {
            let turned = cylinder.zero_rad + look.cylinder_pulse * cylinder.rad_per_pulse;
            let quarter = (turned / std::f64::consts::FRAC_PI_2).round().rem_euclid(4.0);
            if let Some(quarter) = quarters.get_mut(quarter as usize) {
                *quarter = true;
            }
        }
        quarters.iter().filter(|quarter| **quarter).count() >= 3
    }
}

/// The middle of some numbers, which it sorts; 0 of none.
fn median(numbers: &mut [f64]) -> f64 {
    numbers.sort_unstable_by(f64::total_cmp);
    numbers.get(numbers.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use rand::{Rng, RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    use super::*;
    use crate::calibration::finder::model::slit_line;
    use crate::calibration::finder::simulate::row_at;
    use crate::calibration::finder::{normal, shifted, uniform};
    use crate::image::Dropped;

    fn bumped(moves: &[(&str, f64)]) -> Rig {
        shifted(&Rig::metro_i(), &moves.iter().map(|(name, by)| (name.to_string(), *by)).collect::<BTreeMap<_, _>>())
            .unwrap()
    }

    /// What stands where.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Around {
        Nothing,
        Objects,
    }

    /// Rows of the line on a surface, column by column; straight over four.
    fn rows(truth: &Rig, pulse: f64, cylinder: i32, normal: Vector3<f64>, offset: f64) -> Vec<Option<f64>> {
        let surface = Plane::new(normal, offset).unwrap();
        let line = slit_line(truth, pulse, f64::from(cylinder), &surface);
        let knots: Vec<_> =
            (0..=128).map(|k| line.as_ref().and_then(|line| row_at(truth, line, 4.0 * f64::from(k)))).collect();
        let row = |u: usize| {
            let (from, part) = (knots[u / 4]?, (u % 4) as f64 / 4.0);
            Some(if part > 0.0 { from + part * (knots[u / 4 + 1]? - from) } else { from })
        };
        (0..512).map(row).collect()
    }

    /// The line of such rows: each to 0.1 px, and to 0.05 px the blocks of a watch, by speckle and lens.
    fn noisy(rows: Vec<Option<f64>>, rng: &mut impl Rng) -> Line {
        let blocks: Vec<f64> = (0..BLOCKS).map(|_| BLOCK_SIGMA_PX * normal(rng)).collect();
        let peak = |v: f64| Peak { v: v as f32, sigma: 0.1, level: 50.0 };
        let columns = (rows.into_iter().enumerate())
            .map(|(u, v)| v.map(|v| peak(v + blocks[u * BLOCKS / 512] + 0.1 * normal(rng))))
            .collect();
        Line { height: 480, columns, dropped: Dropped::default() }
    }

    /// The line that `truth` sees, its mirror up to some tenths of a pulse off.
    fn line(truth: &Rig, around: Around, mirror: i32, cylinder: i32, rng: &mut impl Rng) -> Line {
        let pulse = f64::from(mirror) + 0.1 * normal(rng);
        let surface = |normal: Vector3<f64>, offset: f64| rows(truth, pulse, cylinder, normal, offset);
        let mut columns = surface(Vector3::z(), 0.0);
        if around == Around::Objects {
            // Boxes of any height, and a wall now and then; what is nearer is lower in the image.
            for _ in 0..rng.random_range(0..3) {
                let (from, wide) = (rng.random_range(0..512), rng.random_range(20..200));
                let top = surface(Vector3::z(), 0.005 + rng.random::<f64>() * 0.4);
                for (column, top) in columns.iter_mut().zip(top).skip(from).take(wide) {
                    *column = top;
                }
            }
            if rng.random::<f64>() < 0.25 {
                let heading = f64::from(cylinder) * truth.cylinder.rad_per_pulse + uniform(rng, 0.5);
                let across = Vector3::new(heading.cos(), heading.sin(), 0.0);
                nearer(&mut columns, surface(across, 1.2 + 1.5 * rng.random::<f64>()));
            }
        }
        noisy(columns, rng)
    }

    fn nearer(columns: &mut [Option<f64>], other: Vec<Option<f64>>) {
        for (column, other) in columns.iter_mut().zip(other) {
            *column = [*column, other].into_iter().flatten().reduce(f64::max);
        }
    }

    fn watch(rig: &Rig) -> DriftWatch {
        let params = DriftParams { flat_floor: true, ..DriftParams::default() };
        DriftWatch::new(rig, params).unwrap().unwrap()
    }

    /// What a watch over METRO-I says after so many captures of `truth` on its way.
    fn watched(truth: &Rig, around: Around, captures: usize, seed: u64) -> Drift {
        watched_at(truth, around, captures, seed, |i| -45 + (i as i32 * 37) % 180)
    }

    fn watched_at(truth: &Rig, around: Around, captures: usize, seed: u64, mirror: impl Fn(usize) -> i32) -> Drift {
        let mut watch = watch(&Rig::metro_i());
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        for i in 0..captures {
            let cylinder = 250 * (((i / 20) as i32 * 5) % 16);
            watch.see(&line(truth, around, mirror(i), cylinder, &mut rng), mirror(i), cylinder);
        }
        watch.latest().clone()
    }

    #[test]
    fn every_bump_is_named_and_measured() {
        for (name, by) in [
            ("tilt_rad", 0.003),
            ("tilt_rad", -0.02),
            ("roll_rad", 0.01),
            ("roll_rad", -0.03),
            ("pan_rad", 0.03),
            ("camera_height_m", 0.006),
            ("camera_height_m", -0.02),
            ("x0_m", 0.012),
            ("mirror_height_m", 0.006),
            ("mirror_height_m", -0.03),
            ("beam_zero_rad", 0.003),
            ("beam_zero_rad", -0.012),
            ("slit_roll_rad", 0.015),
            ("f_mm", 0.15),
            ("axis_pitch_rad", 0.006),
            ("axis_roll_rad", -0.006),
        ] {
            let drift = watched(&bumped(&[(name, by)]), Around::Objects, 300, 5);
            assert_eq!(drift.state, DriftState::Moved, "{name} {by}: {drift}");
            let moved = drift.moved.iter().find(|moved| moved.parameter == name);
            let moved = moved.unwrap_or_else(|| panic!("{name} {by} is not named: {drift}"));
            assert!((moved.by - by).abs() <= 3.0 * moved.sigma, "{name} {by}: {drift}");
            assert!(drift.misfit_after_m.unwrap() < 0.5 * drift.misfit_m, "{name} {by}: {drift}");
        }
    }

    #[test]
    fn a_hard_knock_is_named_and_measured() {
        for (name, by) in [
            ("roll_rad", 0.05),
            ("roll_rad", 0.07),
            ("roll_rad", -0.08),
            ("roll_rad", 0.25),
            ("tilt_rad", 0.1),
            ("tilt_rad", -0.13),
            ("tilt_rad", 0.2),
            ("pan_rad", 0.2),
            ("slit_roll_rad", 0.05),
            ("slit_roll_rad", -0.17),
            ("beam_zero_rad", 0.1),
            ("camera_height_m", -0.12),
            ("mirror_height_m", -0.2),
            ("axis_pitch_rad", 0.07),
        ] {
            for around in [Around::Nothing, Around::Objects] {
                let drift = watched(&bumped(&[(name, by)]), around, 130, 5);
                assert_eq!(drift.state, DriftState::Moved, "{name} {by}, {around:?}: {drift}");
                let moved = drift.moved.iter().find(|moved| moved.parameter == name);
                let moved = moved.unwrap_or_else(|| panic!("{name} {by} is not named: {drift}"));
                assert!((moved.by - by).abs() <= 3.5 * moved.sigma, "{name} {by}, {around:?}: {drift}");
            }
        }
    }

    #[test]
    fn knocked_hard_in_two_ways_it_does_not_fit_either() {
        for (moves, state) in [
            // The floor is found about one of them.
            ([("pan_rad", -0.15), ("slit_roll_rad", 0.06)], DriftState::Several),
            // All lies below the floor, and all above.
            ([("roll_rad", 0.15), ("tilt_rad", 0.15)], DriftState::NoFloor),
            ([("roll_rad", 0.2), ("tilt_rad", -0.2)], DriftState::NoFloor),
        ] {
            for around in [Around::Nothing, Around::Objects] {
                let drift = watched(&bumped(&moves), around, 130, 5);
                assert_eq!(drift.state, state, "{moves:?}, {around:?}: {drift}");
                assert!(drift.is_alarm() && drift.to_string().contains("does not fit"), "{drift}");
            }
        }
    }

    #[test]
    fn a_line_at_the_edge_of_the_image_is_evidence_like_any_other() {
        // The highest and the lowest slit are within half a pulse of the image's edge.
        let lines = [-51, -50, -40, 0, 40, 80, 120, 145];
        let rig = Rig::metro_i();
        let floor = |pulse: f64| rows(&rig, pulse, 0, Vector3::z(), 0.0);
        let leaves = |pulse: i32, by: f64| {
            let (here, there) = (floor(f64::from(pulse)), floor(f64::from(pulse) + by));
            here.iter().zip(&there).any(|(here, there)| here.is_some() && there.is_none())
        };
        assert!(leaves(-51, -0.5) || leaves(145, 0.5));
        let drift = watched_at(&bumped(&[("roll_rad", 0.02)]), Around::Nothing, 60, 5, |i| lines[i % 8]);
        assert_eq!(drift.state, DriftState::Moved, "{drift}");
        assert_eq!(drift.moved[0].parameter, "roll_rad", "{drift}");
    }

    #[test]
    fn the_error_bar_of_a_shift_is_true() {
        let moves = [
            ("mirror_height_m", 0.01),
            ("roll_rad", 0.01),
            ("tilt_rad", -0.01),
            ("slit_roll_rad", 0.05),
            ("axis_pitch_rad", 0.01),
            ("pan_rad", 0.05),
        ];
        let repeats = 50;
        let mut all = 0.0;
        for (i, (name, by)) in moves.into_iter().enumerate() {
            let truth = bumped(&[(name, by)]);
            let mut square = 0.0;
            for seed in 0..repeats {
                let drift = watched(&truth, Around::Nothing, 53, 1000 * i as u64 + seed);
                let moved = drift.moved.iter().find(|moved| moved.parameter == name);
                let moved = moved.unwrap_or_else(|| panic!("{name} is not named: {drift}"));
                square += ((moved.by - by) / moved.sigma).powi(2);
            }
            // χ² of 50 degrees of freedom: 0.05 and 99.95 %.
            assert!((23.5..89.6).contains(&square), "{name}: {square}");
            all += square;
        }
        // Of 300: bars too short or too long by a sixth would show.
        assert!((223.0..389.0).contains(&all), "{all}");
    }

    #[test]
    fn parked_before_a_wall_there_is_no_alarm() {
        let rig = Rig::metro_i();
        let mut rng = ChaCha12Rng::seed_from_u64(1);
        let mut unseen = 0;
        for _ in 0..60 {
            let (x, heading) = (0.5 + 2.2 * rng.random::<f64>(), uniform(&mut rng, 0.6));
            let across = Vector3::new(heading.cos(), heading.sin(), 0.0);
            let mut watch = watch(&rig);
            for i in 0..60i32 {
                let mirror = -45 + (i * 37) % 180;
                let pulse = f64::from(mirror) + 0.1 * normal(&mut rng);
                let mut columns = rows(&rig, pulse, 0, Vector3::z(), 0.0);
                nearer(&mut columns, rows(&rig, pulse, 0, across, x));
                watch.see(&noisy(columns, &mut rng), mirror, 0);
            }
            let drift = watch.latest();
            assert!(!drift.is_alarm(), "{x} m, {heading} rad: {drift}");
            unseen += u8::from(drift.state == DriftState::Unseen);
        }
        assert!(unseen > 30, "{unseen}: the wall hides the floor mostly");
    }

    #[test]
    fn two_bumps_at_once_are_no_single_one() {
        let drift = watched(&bumped(&[("roll_rad", 0.01), ("mirror_height_m", 0.01)]), Around::Objects, 300, 5);
        assert_eq!(drift.state, DriftState::Several, "{drift}");
        assert!(drift.moved.is_empty() && drift.is_alarm() && drift.to_string().contains("no single"), "{drift}");
    }

    #[test]
    fn what_shows_no_floor_says_nothing() {
        let feed = |mut watch: DriftWatch, line: &dyn Fn(usize) -> Line| {
            for i in 0..100 {
                watch.see(&line(i), (i as i32 * 37) % 100, 0);
            }
            watch.latest().clone()
        };
        let of = |rows: &dyn Fn(usize) -> Option<f32>| Line {
            height: 480,
            columns: (0..512).map(|u| rows(u).map(|v| Peak { v, sigma: 0.1, level: 9.0 })).collect(),
            dropped: Dropped::default(),
        };
        assert_eq!(feed(watch(&Rig::metro_i()), &|_| of(&|_| None)).state, DriftState::Unseen);
        // Noise all over the image, and columns that are not the camera's.
        let noise = |i: usize| of(&|u| Some(((u * 7919 + i * 104_729) % 480) as f32));
        assert_eq!(feed(watch(&Rig::metro_i()), &noise).state, DriftState::Unseen);
        let short = |_| Line { height: 480, columns: vec![None; 3], dropped: Dropped::default() };
        assert_eq!(feed(watch(&Rig::metro_i()), &short).state, DriftState::Unseen);
        let infinite = |_| of(&|_| Some(f32::NAN));
        assert_eq!(feed(watch(&Rig::metro_i()), &infinite).state, DriftState::Unseen);
    }

    #[test]
    fn it_is_off_where_the_floor_is_not_known() {
        let on = DriftParams { flat_floor: true, ..DriftParams::default() };
        assert!(DriftWatch::new(&Rig::metro_i(), DriftParams::default()).unwrap().is_none());
        for bad in [
            DriftParams { misfit_m: 0.0, ..on },
            DriftParams { significance: f64::NAN, ..on },
            DriftParams { captures: 0, ..on },
            DriftParams { every: 0, ..on },
            DriftParams { captures_min: 301, ..on },
        ] {
            assert!(DriftWatch::new(&Rig::metro_i(), bad).unwrap_err().what.starts_with("drift."), "{bad:?}");
        }
    }

    /// METRO-I with its mirror held still, the sheet told as the camera has it.
    fn fixed() -> Rig {
        let rig = Rig::metro_i();
        let sheet = (rig.sensor_from_camera.inverse() * rig.laser_plane(40).unwrap()).plane;
        let (normal, offset_m) = (sheet.normal.into(), sheet.offset);
        Rig { laser: Laser::Plane(crate::optics::PlaneLaser { normal, offset_m, origin_m: None }), ..rig }
    }

    #[test]
    fn a_fixed_sheet_is_watched_as_well() {
        let rig = fixed();
        let see = |truth: &Rig, around| {
            let mut watch = watch(&rig);
            let mut rng = ChaCha12Rng::seed_from_u64(3);
            for _ in 0..60 {
                watch.see(&line(truth, around, 0, 0, &mut rng), 0, 0);
            }
            watch.latest().clone()
        };
        let shifts = Shifts::of(&rig).unwrap();
        for around in [Around::Nothing, Around::Objects] {
            assert_eq!(see(&rig, around).state, DriftState::Fits, "{}", see(&rig, around));
            for (name, by, with) in [
                ("roll_rad", 0.02, "roll_rad"),
                ("roll_rad", -0.1, "roll_rad"),
                ("tilt_rad", 0.01, "camera_height_m"),
                ("camera_height_m", -0.03, "tilt_rad"),
                ("laser_offset_m", 0.02, "tilt_rad"),
            ] {
                let drift = see(&shifts.moved(name, by), around);
                assert_eq!(drift.state, DriftState::Moved, "{name} {by}: {drift}");
                assert!([name, with].iter().all(|n| drift.moved.iter().any(|m| m.parameter == *n)), "{drift}");
                let moved = drift.moved.iter().find(|moved| moved.parameter == name).unwrap();
                assert!((moved.by - by).abs() < 4.0 * moved.sigma, "{name} {by}: {drift}");
            }
        }
    }

    #[test]
    fn undisturbed_finders_raise_no_alarm() {
        let (mut alarms, mut windows) = (0, 0);
        for seed in 0..150 {
            for around in [Around::Nothing, Around::Objects] {
                let drift = watched(&Rig::metro_i(), around, 80, seed);
                assert!(drift.state != DriftState::Unseen && drift.misfit_m < 0.002, "seed {seed}: {drift}");
                alarms += u32::from(drift.is_alarm());
                windows += 1;
            }
        }
        // None of 300: fewer than one in 100 at 95 % confidence.
        assert_eq!((alarms, windows), (0, 300));
    }
}
