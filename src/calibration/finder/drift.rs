//! The drift alarm: on a floor that is known to be flat, does the calibration still fit, and if not, what moved?
//!
//! Every capture shows a stretch of floor where encoders and calibration say its row must be. [`DriftWatch`] keeps how far
//! off the line is, for blocks of columns of the last captures. Objects and walls put it off too, but each elsewhere: what
//! bends smoothly over image, mirror and cylinder is the floor (`floor`). If that is off by more than a few millimetres
//! of height, every parameter of the finder in turn is asked how much of it one shift would explain (`suspects`).
//!
//! What one capture cannot tell is not claimed: a camera that tilts and a beam whose zero slips move the floor's line nearly
//! alike, and then both are named.
//!
//! Rate of false alarms: none in 40 simulated runs through lab and corridor (misfit at most 0.5 mm), none in 200 simulated
//! windows with and without objects (see the tests): below 1.5 % a window at 95 % confidence. A floor that is not flat to
//! [`DriftParams::misfit_m`] raises an alarm, as it should.

mod floor;
mod suspects;

use std::collections::VecDeque;
use std::fmt;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::known::Assumptions;
use super::measured::Observations;
use super::model::{Model, slit_line};
use super::simulate::row_at;
use crate::fault::{Fault, Result, number_within, positive};
use crate::geometry::{Plane, Robot};
use crate::image::Line;
use crate::optics::{Laser, Rig};

/// Blocks of columns of a line that are read as one.
const BLOCKS: usize = 16;
/// A block counts with this part of its columns at least.
const FILLED: f64 = 0.6;
/// A block whose rows scatter by more than this has an edge in it [px, median deviation].
const SCATTER_MAX_PX: f64 = 0.5;
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
}

/// The evidence.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// What the floor says.
    pub state: DriftState,
    /// The captures that showed floor.
    pub captures: usize,
    /// Blocks of columns on the floor, and their share of all.
    pub readings: usize,
    /// Share of the blocks that lie on the floor.
    pub floor_share: f64,
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
    const UNSEEN: Self = Self {
        state: DriftState::Unseen,
        captures: 0,
        readings: 0,
        floor_share: 0.0,
        misfit_m: 0.0,
        misfit_after_m: None,
        moved: Vec::new(),
    };

    /// Whether the calibration does not fit.
    pub fn is_alarm(&self) -> bool {
        matches!(self.state, DriftState::Moved | DriftState::Several)
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
        let (mm, captures) = (self.misfit_m * 1e3, self.captures);
        match self.state {
            DriftState::Unseen => write!(f, "calibration not checked: too little flat floor was seen"),
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
    /// The row minus that of the floor by the calibration [px], and its standard deviation.
    off: f64,
    sigma: f64,
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
    rig: Rig,
    /// The rig as numbers, in the order of a calibration's parameters.
    numbers: Vec<f64>,
    /// Standard deviation of the mirror's reading [pulses].
    pulse_sigma: f64,
    floor: Plane<Robot>,
    looks: VecDeque<Look>,
    since: usize,
    latest: Drift,
}

impl DriftWatch {
    /// A watch over a finder; `None` where the floor is not known to be flat, or the finder has no mirror.
    ///
    /// Errors: parameters that make no alarm.
    pub fn new(rig: &Rig, params: DriftParams) -> Result<Option<Self>> {
        let params = params.validated()?;
        let (Laser::Mirror(mirror), true) = (rig.laser, params.flat_floor) else { return Ok(None) };
        let numbers = modelled(rig, |model| model.numbers_of(rig))?;
        let Some(floor) = Plane::new(Vector3::z(), 0.0) else { return Ok(None) };
        let gain = mirror.beam.rad_per_pulse.abs().max(1e-12);
        Ok(Some(Self {
            params,
            rig: rig.clone(),
            numbers,
            // A tenth of a pulse at least: no mirror stops exactly.
            pulse_sigma: (rig.beam_sigma_rad / gain).max(0.1),
            floor,
            looks: VecDeque::new(),
            since: 0,
            latest: Drift::UNSEEN,
        }))
    }

    /// One more capture. Returns what the floor says when it was looked at anew.
    pub fn see(&mut self, line: &Line, mirror_pulse: i32, cylinder_pulse: i32) -> Option<&Drift> {
        let look = self.look(line, f64::from(mirror_pulse), f64::from(cylinder_pulse))?;
        if self.looks.len() >= self.params.captures {
            self.looks.pop_front();
        }
        self.looks.push_back(look);
        self.since += 1;
        if self.since < self.params.every {
            return None;
        }
        self.since = 0;
        self.latest = self.judge();
        Some(&self.latest)
    }

    /// What the floor said when it was last looked at.
    pub fn latest(&self) -> &Drift {
        &self.latest
    }

    /// The blocks of a line that may be floor; `None` for a capture without any.
    fn look(&self, line: &Line, mirror_pulse: f64, cylinder_pulse: f64) -> Option<Look> {
        let wide = line.width() / BLOCKS;
        if wide == 0 {
            return None;
        }
        let slit = slit_line(&self.rig, mirror_pulse, cylinder_pulse, &self.floor)?;
        let edges: Vec<Option<f64>> = (0..=BLOCKS).map(|i| row_at(&self.rig, &slit, (i * wide) as f64)).collect();
        let mut blocks = Vec::with_capacity(BLOCKS);
        let mut offs = Vec::with_capacity(wide);
        for (i, columns) in line.columns.chunks_exact(wide).take(BLOCKS).enumerate() {
            let (Some(Some(left)), Some(Some(right))) = (edges.get(i), edges.get(i + 1)) else { continue };
            offs.clear();
            for (k, peak) in columns.iter().enumerate() {
                let floor = left + (right - left) * k as f64 / wide as f64;
                offs.extend(peak.map(|peak| f64::from(peak.v) - floor).filter(|off| off.is_finite()));
            }
            if (offs.len() as f64) < FILLED * wide as f64 {
                continue;
            }
            let off = median(&mut offs);
            offs.iter_mut().for_each(|o| *o = (*o - off).abs());
            let scatter = median(&mut offs);
            if scatter > SCATTER_MAX_PX {
                continue;
            }
            let sigma = BLOCK_SIGMA_PX.hypot(1.86 * scatter / (offs.len() as f64).sqrt()); // of a median
            let floor = (left + right) / 2.0;
            blocks.push(Block { u: (i * wide) as f64 + wide as f64 / 2.0, v: floor + off, off, sigma });
        }
        (!blocks.is_empty()).then_some(Look { mirror_pulse, cylinder_pulse, blocks })
    }

    fn judge(&self) -> Drift {
        let Some(floor) = floor::Floor::in_looks(self) else { return Drift::UNSEEN };
        let captures = floor.captures();
        if captures < self.params.captures_min {
            return Drift { captures, ..Drift::UNSEEN };
        }
        let misfit_m = floor.misfit_m();
        let (readings, floor_share) = (floor.readings(), floor.share);
        let drift = Drift { state: DriftState::Fits, captures, readings, floor_share, misfit_m, ..Drift::UNSEEN };
        if misfit_m < self.params.misfit_m {
            return drift;
        }
        suspects::suspected(self, &floor, drift)
    }

    /// The finder with parameter `i` moved.
    fn moved(&self, i: usize, by: f64) -> Rig {
        let mut numbers = self.numbers.clone();
        if let Some(number) = numbers.get_mut(i) {
            *number += by;
        }
        modelled(&self.rig, |model| model.rig(&numbers))
    }
}

/// What a model of a finder without measurements says.
fn modelled<T>(rig: &Rig, ask: impl FnOnce(&Model) -> T) -> T {
    let seen = Observations { slits: Vec::new(), walls: Vec::new(), pulse_sigma: 1.0, mark_sigma_m: 1.0 };
    ask(&Model { nominal: rig, assumptions: &Assumptions::free(), seen: &seen })
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
    use crate::calibration::finder::{normal, shifted, uniform};
    use crate::image::{Dropped, Peak};

    fn bumped(moves: &[(&str, f64)]) -> Rig {
        shifted(&Rig::metro_i(), &moves.iter().map(|(name, by)| (name.to_string(), *by)).collect::<BTreeMap<_, _>>())
            .unwrap()
    }

    /// What stands where.
    #[derive(Clone, Copy, PartialEq)]
    enum Around {
        Nothing,
        Objects,
    }

    /// The line that `truth` sees, its mirror up to some tenths of a pulse off, rows to 0.1 px.
    fn line(truth: &Rig, around: Around, mirror: i32, cylinder: i32, rng: &mut impl Rng) -> Line {
        let pulse = f64::from(mirror) + 0.1 * normal(rng);
        let surface = |normal: Vector3<f64>, offset: f64| {
            slit_line(truth, pulse, f64::from(cylinder), &Plane::new(normal, offset).unwrap())
        };
        let mut columns: Vec<Option<f64>> = {
            let floor = surface(Vector3::z(), 0.0);
            (0..512).map(|u| floor.as_ref().and_then(|line| row_at(truth, line, f64::from(u)))).collect()
        };
        if around == Around::Objects {
            // Boxes of any height, and a wall now and then; what is nearer is lower in the image.
            for _ in 0..rng.random_range(0..3) {
                let (from, wide) = (rng.random_range(0..512), rng.random_range(20..200));
                let top = surface(Vector3::z(), 0.005 + rng.random::<f64>() * 0.4);
                for (u, column) in columns.iter_mut().enumerate().skip(from).take(wide) {
                    *column = top.as_ref().and_then(|line| row_at(truth, line, u as f64));
                }
            }
            if rng.random::<f64>() < 0.25 {
                let heading = f64::from(cylinder) * truth.cylinder.rad_per_pulse + uniform(rng, 0.5);
                let wall = surface(Vector3::new(heading.cos(), heading.sin(), 0.0), 1.2 + 1.5 * rng.random::<f64>());
                let row = |u: usize| wall.as_ref().and_then(|line| row_at(truth, line, u as f64));
                for (u, column) in columns.iter_mut().enumerate() {
                    *column = match (*column, row(u)) {
                        (Some(floor), Some(wall)) => Some(floor.max(wall)),
                        (floor, wall) => floor.or(wall),
                    };
                }
            }
        }
        let peak = |v: f64| Peak { v: v as f32, sigma: 0.1, level: 50.0 };
        let columns = columns.into_iter().map(|v| v.map(|v| peak(v + 0.1 * normal(rng)))).collect();
        Line { height: 480, columns, dropped: Dropped::default() }
    }

    /// What a watch over METRO-I says after so many captures of `truth` on its way.
    fn watched(truth: &Rig, around: Around, captures: usize, seed: u64) -> Drift {
        let params = DriftParams { flat_floor: true, ..DriftParams::default() };
        let mut watch = DriftWatch::new(&Rig::metro_i(), params).unwrap().unwrap();
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        for i in 0..captures {
            let mirror = -45 + (i as i32 * 37) % 180;
            let cylinder = 250 * (((i / 20) as i32 * 5) % 16);
            watch.see(&line(truth, around, mirror, cylinder, &mut rng), mirror, cylinder);
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
            eprintln!("{name} {by}: {drift}");
            assert_eq!(drift.state, DriftState::Moved, "{name} {by}: {drift}");
            let moved = drift.moved.iter().find(|moved| moved.parameter == name);
            let moved = moved.unwrap_or_else(|| panic!("{name} {by} is not named: {drift}"));
            assert!((moved.by - by).abs() <= 3.0 * moved.sigma, "{name} {by}: {drift}");
            assert!(drift.misfit_after_m.unwrap() < 0.5 * drift.misfit_m, "{name} {by}: {drift}");
        }
    }

    #[test]
    fn the_error_bar_of_a_shift_is_true() {
        let (mut square, repeats) = (0.0, 20);
        for seed in 0..repeats {
            let drift = watched(&bumped(&[("mirror_height_m", 0.01)]), Around::Nothing, 100, seed);
            let moved = drift.moved.iter().find(|moved| moved.parameter == "mirror_height_m").unwrap();
            square += ((moved.by - 0.01) / moved.sigma).powi(2);
        }
        let rms = (square / repeats as f64).sqrt();
        assert!((0.6..1.5).contains(&rms), "{rms}"); // 20 repeats: ±16 %
    }

    #[test]
    fn two_bumps_at_once_are_no_single_one() {
        let drift = watched(&bumped(&[("roll_rad", 0.01), ("mirror_height_m", 0.01)]), Around::Objects, 300, 5);
        assert_eq!(drift.state, DriftState::Several, "{drift}");
        assert!(drift.moved.is_empty() && drift.is_alarm() && drift.to_string().contains("no single"), "{drift}");
    }

    #[test]
    fn what_shows_no_floor_says_nothing() {
        let params = DriftParams { flat_floor: true, ..DriftParams::default() };
        let watch = || DriftWatch::new(&Rig::metro_i(), params).unwrap().unwrap();
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
        assert_eq!(feed(watch(), &|_| of(&|_| None)).state, DriftState::Unseen);
        // Noise all over the image, and columns that are not the camera's.
        let noise = |i: usize| of(&|u| Some(((u * 7919 + i * 104_729) % 480) as f32));
        assert_eq!(feed(watch(), &noise).state, DriftState::Unseen);
        let short = |_| Line { height: 480, columns: vec![None; 3], dropped: Dropped::default() };
        assert_eq!(feed(watch(), &short).state, DriftState::Unseen);
        let infinite = |_| of(&|_| Some(f32::NAN));
        assert_eq!(feed(watch(), &infinite).state, DriftState::Unseen);
    }

    #[test]
    fn it_is_off_where_the_floor_is_not_known_or_nothing_tilts() {
        let on = DriftParams { flat_floor: true, ..DriftParams::default() };
        assert!(DriftWatch::new(&Rig::metro_i(), DriftParams::default()).unwrap().is_none());
        let plane = crate::optics::PlaneLaser { normal: [0.0, 1.0, 0.5], offset_m: 0.3, origin_m: None };
        let fixed = Rig { laser: Laser::Plane(plane), ..Rig::metro_i() };
        assert!(DriftWatch::new(&fixed, on).unwrap().is_none());
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

    #[test]
    fn a_finder_as_calibrated_raises_no_alarm() {
        for seed in 0..100 {
            for around in [Around::Nothing, Around::Objects] {
                let drift = watched(&Rig::metro_i(), around, 100, seed);
                assert_eq!(drift.state, DriftState::Fits, "seed {seed}: {drift}");
                assert!(drift.misfit_m < 0.002, "seed {seed}: {drift}");
            }
        }
    }
}
