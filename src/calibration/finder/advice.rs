//! What the data do not tell apart, and the measurement that would.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, SymmetricEigen, Vector3};
use serde::Serialize;

use super::bundle::{HELD, foreseen, is_prior};
use super::known::{Assumptions, CameraPrior, Knowledge};
use super::measured::{Observations, Slit, SlitEnd, SlitPeak, Surface, Wall};
use super::model::{CAMERA_AT, Model, TAPE_AT, slit_line};
use super::simulate::row_at;
use crate::calibration::solve::Solution;
use crate::geometry::{Plane, Point, Robot};
use crate::optics::{Laser, Rig};

/// At most so many measurements are advised.
const ROUNDS_MAX: usize = 4;

/// A combination of parameters that the data do not tell apart: they may all change so at once, and hardly a reading does.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Weak {
    /// What each parameter of it changes by at one standard deviation, in its unit.
    pub changes: BTreeMap<String, f64>,
    /// How much of what was believed before is left: 1 where the data say nothing, at most 0.2 where they hold it.
    pub left: f64,
}

/// A measurement that would settle what is weak.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Advice {
    /// What to do.
    pub measure: &'static str,
    /// For each parameter that it settles: its standard deviation now and then, in its unit.
    pub settles: BTreeMap<String, [f64; 2]>,
}

/// Combinations of free parameters that keep more than [`HELD`] of what was believed before, the worst first.
pub(super) fn weak_directions(model: &Model, solution: &Solution, covariance: &DMatrix<f64>) -> Vec<Weak> {
    let free: Vec<usize> =
        (0..solution.parameters.len()).filter(|&i| !solution.parameters[i].fixed && !is_prior(model, i)).collect();
    let before: Vec<f64> = free.iter().map(|&i| model.sigma_before(i)).collect();
    let scaled =
        DMatrix::from_fn(free.len(), free.len(), |a, b| covariance[(free[a], free[b])] / (before[a] * before[b]));
    let eigen = SymmetricEigen::new(scaled);
    let mut order: Vec<usize> = (0..free.len()).filter(|&k| eigen.eigenvalues[k] > HELD * HELD).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    let weak = |k: usize| {
        let left = eigen.eigenvalues[k].sqrt();
        let parts = eigen.eigenvectors.column(k);
        let (largest, sign) =
            parts.iter().fold((0.0, 1.0), |(l, s), p| if p.abs() > l { (p.abs(), p.signum()) } else { (l, s) });
        let changes = (0..free.len())
            .filter(|&a| parts[a].abs() > 0.2 * largest)
            .map(|a| (solution.parameters[free[a]].name.clone(), sign * parts[a] * left * before[a]))
            .collect();
        Weak { changes, left }
    };
    order.into_iter().map(weak).collect()
}

/// An experiment that could be made on top of this one.
struct Candidate {
    measure: &'static str,
    slits: Vec<Slit>,
    walls: Vec<Wall>,
    assumptions: Assumptions,
}

/// An experiment: what was measured so far or would be, and the numbers it is foreseen at.
#[derive(Clone)]
struct Plan {
    seen: Observations,
    assumptions: Assumptions,
    numbers: Vec<f64>,
}

impl Plan {
    fn with(&self, candidate: &Candidate) -> Self {
        let mut plan = Self { assumptions: candidate.assumptions.clone(), ..self.clone() };
        plan.seen.slits.extend(candidate.slits.iter().cloned());
        for wall in &candidate.walls {
            plan.seen.walls.push(*wall);
            plan.numbers.extend([0.0, wall.mark_m.unwrap_or(0.0)]);
        }
        plan
    }

    fn model<'a>(&'a self, nominal: &'a Rig) -> Model<'a> {
        Model { nominal, assumptions: &self.assumptions, seen: &self.seen }
    }

    /// The standard deviations that this experiment would give; `None` if this finder cannot make it.
    fn sigmas(&self, nominal: &Rig) -> Option<Vec<f64>> {
        let covariance = foreseen(&self.model(nominal), &self.numbers)?;
        Some((0..self.numbers.len()).map(|i| covariance[(i, i)].max(0.0).sqrt()).collect())
    }
}

/// What would hold the weak parameters (or halve their σ at least), the most useful measurement first, each on top of
/// those before it; nothing where nothing is weak.
pub(super) fn advise(model: &Model, solution: &Solution, covariance: &DMatrix<f64>) -> Vec<Advice> {
    let mut now: Vec<f64> = (0..solution.values.len()).map(|i| covariance[(i, i)].max(0.0).sqrt()).collect();
    let target = |i: usize| HELD * model.sigma_before(i);
    let mut weak: Vec<usize> = (0..now.len())
        .filter(|&i| !solution.parameters[i].fixed && !is_prior(model, i) && now[i] > target(i))
        .collect();
    let (seen, assumptions) = (model.seen.clone(), model.assumptions.clone());
    let mut plan = Plan { seen, assumptions, numbers: solution.values.clone() };
    let mut advice = Vec::new();
    while !weak.is_empty() && advice.len() < ROUNDS_MAX {
        let mut best: Option<(Vec<usize>, Vec<f64>, Candidate)> = None;
        for candidate in candidates(&plan.model(model.nominal), &plan.numbers) {
            let Some(then) = plan.with(&candidate).sigmas(model.nominal) else { continue };
            // Held, or twice as good; and not just by a hair.
            let settled: Vec<usize> =
                weak.iter().copied().filter(|&i| then[i] <= target(i).max(0.5 * now[i]).min(0.7 * now[i])).collect();
            // Candidates stand in the order of their work: the first of the most useful.
            if !settled.is_empty() && best.as_ref().is_none_or(|(held, ..)| settled.len() > held.len()) {
                best = Some((settled, then, candidate));
            }
        }
        let Some((settled, then, candidate)) = best else { break };
        let settles = settled.iter().map(|&i| (solution.parameters[i].name.clone(), [now[i], then[i]])).collect();
        advice.push(Advice { measure: candidate.measure, settles });
        plan = plan.with(&candidate);
        weak.retain(|&i| then[i] > target(i));
        now = then;
    }
    advice
}

/// What could be measured next, the least work first.
fn candidates(model: &Model, numbers: &[f64]) -> Vec<Candidate> {
    let rig = model.rig(numbers);
    let tape = numbers[TAPE_AT];
    let aim = Foreseen { rig: &rig, tape };
    let half = (std::f64::consts::PI / rig.cylinder.rad_per_pulse.abs().max(1e-9)).round();
    let same = || model.assumptions.clone();
    let only = |measure, slits, walls| Candidate { measure, slits, walls, assumptions: same() };
    let known = |measure, name, sigma: f64| Candidate {
        measure,
        slits: vec![],
        walls: vec![],
        assumptions: same().with(name, Knowledge::Within(sigma)),
    };
    let floor =
        |cylinder: f64| (0..6).filter_map(move |i| aim.floor(1.45 + 0.35 * f64::from(i), cylinder)).collect::<Vec<_>>();
    let walls: Vec<Wall> = [1.5, 2.0, 2.5].map(|x| Wall { mark_m: Some(x - tape), square_sigma_rad: 0.01 }).into();
    let first = model.seen.walls.len();
    let on_walls = |ruler: bool| -> Vec<Slit> {
        let at = |(wall, x): (usize, f64)| {
            [0.1, 0.25, 0.4].into_iter().filter_map(move |z| aim.wall(first + wall, x, z * (3.2 - x), ruler))
        };
        [1.5, 2.0, 2.5].into_iter().enumerate().flat_map(at).collect()
    };
    let mut list = vec![
        known("the beam's zero with a level, to 0.05 pulse", "beam_zero_rad", 0.05 * numbers[7].abs()),
        known("the mirror's height over the floor with a ruler, to 1 mm", "mirror_height_m", 1e-3),
        only(
            "whole lines instead of single rows: the same slits with 8 columns each",
            aim.whole(&model.seen.slits),
            vec![],
        ),
        only("six slits on the floor, 0.35 m apart from 1.4 m on, at marks of the tape", floor(0.0), vec![]),
        only("the ends of lines at a known place beside the tape, on five slits on the floor", aim.ended(), vec![]),
        only("a wall at 1.5, 2.0 and 2.5 m, three slits on each", on_walls(false), walls.clone()),
        only("a wall at 1.5, 2.0 and 2.5 m, three slits on each, their heights by a ruler", on_walls(true), walls),
        only(
            "six slits on the floor behind, the cylinder turned half round, at marks of the same tape",
            floor(half),
            vec![],
        ),
        only(
            "six slits on the floor at each of four turns of the cylinder, a quarter turn apart, ahead and behind at marks",
            [0.0, 0.5 * half, half, 1.5 * half].into_iter().flat_map(floor).collect(),
            vec![],
        ),
    ];
    if model.assumptions.camera.is_none() {
        let mut values = [0.0; 5];
        values.copy_from_slice(&numbers[CAMERA_AT..TAPE_AT]);
        let assumptions = Assumptions { camera: Some(CameraPrior::two_planes(values)), ..same() };
        let measure = "the camera by itself, on two planes of 30 points";
        list.insert(2, Candidate { measure, slits: vec![], walls: vec![], assumptions });
    }
    list
}

/// Slits as the finder found so far would see them.
#[derive(Clone, Copy)]
struct Foreseen<'a> {
    rig: &'a Rig,
    tape: f64,
}

impl Foreseen<'_> {
    /// The mirror's place for a beam of this angle below the horizontal.
    fn pulse(&self, beam_rad: f64) -> Option<f64> {
        let Laser::Mirror(mirror) = self.rig.laser else { return None };
        Some((beam_rad - mirror.beam.zero_rad) / mirror.beam.rad_per_pulse).filter(|pulse| pulse.is_finite())
    }

    fn mirror_height(&self) -> f64 {
        if let Laser::Mirror(mirror) = self.rig.laser { mirror.mirror_m[2] } else { 0.0 }
    }

    /// On the floor at this range, marked where the tape is.
    fn floor(&self, range_m: f64, cylinder_pulse: f64) -> Option<Slit> {
        let pulse = self.pulse((self.mirror_height() / range_m).atan())?;
        let surface = Plane::<Robot>::new(Vector3::z(), 0.0)?;
        let mut slit = self.slit(pulse, cylinder_pulse, Surface::Floor, &surface)?;
        let turn = (cylinder_pulse * self.rig.cylinder.rad_per_pulse).sin();
        if turn.abs() < 1e-3 {
            slit.mark_m = Some(slit_line(self.rig, pulse, cylinder_pulse, &surface)?.at_tape()?.x - self.tape);
        }
        Some(slit)
    }

    /// On a wall at this distance and height.
    fn wall(&self, wall: usize, x_m: f64, z_m: f64, ruler: bool) -> Option<Slit> {
        let pulse = self.pulse(((self.mirror_height() - z_m) / x_m).atan())?;
        let surface = Plane::through(Point::<Robot>::new(x_m, 0.0, 0.0), Vector3::x())?;
        let mut slit = self.slit(pulse, 0.0, Surface::Wall(wall), &surface)?;
        if ruler {
            slit.height_m = Some(slit_line(self.rig, pulse, 0.0, &surface)?.at_tape()?.z);
        }
        Some(slit)
    }

    fn slit(&self, mirror_pulse: f64, cylinder_pulse: f64, on: Surface, surface: &Plane<Robot>) -> Option<Slit> {
        let line = slit_line(self.rig, mirror_pulse, cylinder_pulse, surface)?;
        let peaks =
            self.columns().filter_map(|u| Some(SlitPeak { u, v: row_at(self.rig, &line, u)?, sigma: 0.1 })).collect();
        Some(Slit {
            name: String::new(),
            mirror_pulse,
            cylinder_pulse,
            on,
            mark_m: None,
            height_m: None,
            end: None,
            peaks,
        })
    }

    fn columns(&self) -> impl Iterator<Item = f64> {
        let width = self.rig.camera.width as f64;
        (0..8).map(move |i| (f64::from(i) + 0.5) / 8.0 * width)
    }

    /// Five on the floor that end 0.3 m to the left.
    fn ended(&self) -> Vec<Slit> {
        let with_end = |i: i32| {
            let mut slit = self.floor(1.5 + 0.4 * f64::from(i), 0.0)?;
            let line = slit_line(self.rig, slit.mirror_pulse, 0.0, &Plane::new(Vector3::z(), 0.0)?)?;
            let y_m = 0.3;
            let [u, _] = line.beside(&self.rig.camera, y_m)?;
            slit.end = Some(SlitEnd { y_m, u, sigma: 0.2 });
            slit.peaks.clear();
            Some(slit)
        };
        (0..5).filter_map(with_end).collect()
    }

    /// The floor slits of these once more, seen along their whole length.
    fn whole(&self, slits: &[Slit]) -> Vec<Slit> {
        let Some(surface) = Plane::<Robot>::new(Vector3::z(), 0.0) else { return Vec::new() };
        let floor = slits.iter().filter(|slit| slit.on == Surface::Floor);
        floor.filter_map(|slit| self.slit(slit.mirror_pulse, slit.cylinder_pulse, Surface::Floor, &surface)).collect()
    }
}
