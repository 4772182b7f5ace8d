//! The fewest lines that sample a volume, what the camera sees of it, and how long a sweep takes.

use nalgebra::Rotation3;
use serde::Serialize;

use super::bench::{Bench, V3};
use super::params::{DesignParams, Instrument, Volume};
use crate::fault::Result;
use crate::optics::Rig;
use crate::scanner::{Head, Stop, Sweep, SweepParams};

/// Nodes along x, y, z in which a volume is looked at.
const NODES: [usize; 3] = [25, 17, 11];
/// Samples of X along the section of the volume.
const SECTION: i32 = 96;
/// Most views side by side that are tried.
const VIEWS_MAX: usize = 32;
/// Longest list of pulses that is looked through.
const PULSES_MAX: i64 = 100_000;

/// One line of the sweep.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Mirror pulse.
    pub pulse: i32,
    /// Beam angle below the horizontal [°].
    pub beam_deg: f64,
    /// Where it meets the volume's lowest plane [m]; null where that is outside what is seen.
    pub floor_m: Option<f64>,
}

/// Why a part of a volume is not seen: shares of the whole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Unseen {
    /// Over the top row of the picture.
    pub above_picture: f64,
    /// Under its bottom row: too near.
    pub below_picture: f64,
    /// Beside it, in whatever direction the cylinder looks.
    pub beside: f64,
    /// No beam within the mirror's travel gets there.
    pub no_beam: f64,
    /// Beyond the farthest range that is used.
    pub too_far: f64,
}

/// A volume and what a sweep makes of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Watch {
    /// The volume.
    pub volume: Volume,
    /// How far apart lines may fall [m].
    pub resolution_m: f64,
    /// Share of the volume that camera and beam reach with the cylinder straight ahead.
    pub seen_ahead: f64,
    /// The same with the cylinder turned as need be.
    pub seen_turned: f64,
    /// Where the rest stays.
    pub unseen: Unseen,
    /// Views side by side that see all of `seen_turned` but half a percent.
    pub views: usize,
    /// Cylinder angles of the views [°].
    pub view_deg: Vec<f64>,
    /// The lines of each view, steepest first; empty where nothing is seen or the sheet stands still.
    pub lines: Vec<Line>,
    /// Widest gap between lines on the volume's lowest plane, within what is seen [m].
    pub floor_gap_m: f64,
    /// Widest gap between lines up a wall anywhere in the volume, within what is seen [m].
    pub wall_gap_m: f64,
    /// Whether a single pulse of the mirror is coarser than asked somewhere.
    pub limited_by_pulse: bool,
    /// Time of one sweep, motors settled at each line, with the servos' model [s]; null without lines.
    pub sweep_s: Option<f64>,
}

/// Looks at a volume.
///
/// Errors: a sweep that the axes cannot make.
pub(super) fn watch(bench: &Bench, instrument: &Instrument, params: &DesignParams) -> Result<Watch> {
    let nodes = nodes(&params.volume);
    let ahead = share(&nodes, |p| state(bench, p).is_ok());
    let states: Vec<_> = nodes.iter().map(|p| state(bench, &faced(bench, p))).collect();
    let turned = states.iter().filter(|s| s.is_ok()).count() as f64 / nodes.len() as f64;
    let mut unseen = Unseen::default();
    states.iter().filter_map(|s| s.err()).for_each(|why| *why(&mut unseen) += 1.0);
    let all: [Why; 5] =
        [|u| &mut u.above_picture, |u| &mut u.below_picture, |u| &mut u.beside, |u| &mut u.no_beam, |u| &mut u.too_far];
    all.iter().for_each(|why| *why(&mut unseen) /= nodes.len() as f64);
    let view_rad = if turned > 0.0 { views(bench, &nodes, turned) } else { Vec::new() };
    let section = Section::new(bench, &params.volume);
    let (lines, limited) = section.as_ref().map_or((Vec::new(), false), |s| s.lines(bench, params.resolution_m));
    let (floor_gap_m, wall_gap_m) = section.as_ref().map_or((0.0, 0.0), |s| s.widest(&lines));
    let sweep_s = sweep_time(bench.rig, instrument, &lines, &view_rad)?;
    Ok(Watch {
        volume: params.volume,
        resolution_m: params.resolution_m,
        seen_ahead: ahead,
        seen_turned: turned,
        unseen,
        views: view_rad.len(),
        view_deg: view_rad.iter().map(|a| a.to_degrees()).collect(),
        lines,
        floor_gap_m,
        wall_gap_m,
        limited_by_pulse: limited,
        sweep_s,
    })
}

/// Share of a volume that is seen with the cylinder turned as need be.
pub(super) fn seen_turned(bench: &Bench, volume: &Volume) -> f64 {
    share(&nodes(volume), |p| state(bench, &faced(bench, p)).is_ok())
}

fn nodes(volume: &Volume) -> Vec<V3> {
    let at = |[low, high]: [f64; 2], i: usize, n: usize| low + (high - low) * i as f64 / (n - 1) as f64;
    let [nx, ny, nz] = NODES;
    let along = |i: usize| (i / (ny * nz), i / nz % ny, i % nz);
    let node = |i: usize| {
        let (x, y, z) = along(i);
        V3::new(at(volume.x_m, x, nx), at(volume.y_m, y, ny), at(volume.z_m, z, nz))
    };
    (0..nx * ny * nz).map(node).collect()
}

fn share(nodes: &[V3], seen: impl Fn(&V3) -> bool) -> f64 {
    nodes.iter().filter(|p| seen(p)).count() as f64 / nodes.len() as f64
}

type Why = fn(&mut Unseen) -> &mut f64;

/// Whether camera and beam reach a place with the cylinder straight ahead, and if not, why.
fn state(bench: &Bench, point: &V3) -> Result<(), Why> {
    if point.norm() > bench.rig.range_m_max {
        return Err(|u| &mut u.too_far);
    }
    let camera = &bench.rig.camera;
    let Some([u, v]) = bench.project(point) else { return Err(|u| &mut u.beside) };
    if v < -0.5 {
        return Err(|u| &mut u.above_picture);
    }
    if v > camera.height as f64 - 0.5 {
        return Err(|u| &mut u.below_picture);
    }
    if !(-0.5..=camera.width as f64 - 0.5).contains(&u) {
        return Err(|u| &mut u.beside);
    }
    let beam = bench.beam_to(point).filter(|b| bench.in_travel(*b));
    let Some(sheet) = beam.and_then(|b| bench.sheet(b)) else { return Err(|u| &mut u.no_beam) };
    let away = point - sheet.origin.xyz;
    let (x, y) = (sheet.forward.dot(&away), sheet.lateral.dot(&away));
    if x <= 0.0 || y.abs() > bench.rig.sheet.width_m(x) / 2.0 {
        return Err(|u| &mut u.beside);
    }
    Ok(())
}

/// The finder's axis on the robot, about which the cylinder turns.
fn about_axis(bench: &Bench, point: &V3, angle_rad: f64) -> V3 {
    let finder = bench.rig.robot_from_finder;
    let here = finder.inverse().iso * nalgebra::Point3::from(*point);
    let turned = Rotation3::from_axis_angle(&V3::z_axis(), angle_rad) * here;
    (finder.iso * turned).coords
}

/// Bearing of a place from the cylinder's axis [rad].
fn bearing(bench: &Bench, point: &V3) -> f64 {
    let here = bench.rig.robot_from_finder.inverse().iso * nalgebra::Point3::from(*point);
    here.y.atan2(here.x)
}

/// The place as it looks when the cylinder faces it, as far as its travel goes.
fn faced(bench: &Bench, point: &V3) -> V3 {
    let [low, high] = travel(bench.rig);
    about_axis(bench, point, -bearing(bench, point).clamp(low, high))
}

/// Cylinder angles, lowest and highest [rad].
fn travel(rig: &Rig) -> [f64; 2] {
    let axis = rig.cylinder;
    let ends = [axis.pulse_min, axis.pulse_max].map(|p| axis.zero_rad + f64::from(p) * axis.rad_per_pulse);
    [ends[0].min(ends[1]), ends[0].max(ends[1])]
}

/// The fewest cylinder angles, evenly apart over the volume's bearings, that see all that can be seen but half a percent.
fn views(bench: &Bench, nodes: &[V3], turned: f64) -> Vec<f64> {
    let [low, high] = travel(bench.rig);
    let seen: Vec<&V3> = nodes.iter().filter(|p| state(bench, &faced(bench, p)).is_ok()).collect();
    let bearings = || seen.iter().map(|p| bearing(bench, p).clamp(low, high));
    let (from, to) = bearings().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), b| (l.min(b), h.max(b)));
    let spread = |n: usize| -> Vec<f64> { (0..n).map(|k| from + (to - from) * (k as f64 + 0.5) / n as f64).collect() };
    let enough = |angles: &[f64]| {
        let any = |p: &&&V3| angles.iter().any(|a| state(bench, &about_axis(bench, p, -a)).is_ok());
        seen.iter().filter(any).count() as f64 / nodes.len() as f64 >= turned - 0.005
    };
    (1..=VIEWS_MAX).map(spread).find(|angles| enough(angles)).unwrap_or_else(|| spread(VIEWS_MAX))
}

/// What is seen of a volume in the plane of the middle column: over X, from which height to which.
struct Section {
    /// X, lowest and highest seen Z.
    columns: Vec<(f64, f64, f64)>,
    /// The lowest plane, and X between which it is seen.
    ground: f64,
    floor: Option<[f64; 2]>,
    source: V3,
}

impl Section {
    /// `None` where nothing of it is seen.
    fn new(bench: &Bench, volume: &Volume) -> Option<Self> {
        let [top, bottom] = bench.edges()?;
        // A line of sight that does not lead ahead bounds nothing there.
        let slope = |ray: V3| if ray.x > 1e-9 { ray.z / ray.x } else { f64::INFINITY.copysign(ray.z) };
        let (high, low) = (slope(top), slope(bottom));
        let [x0, x1] = volume.x_m;
        let columns: Vec<_> = (0..=SECTION)
            .map(|i| x0 + (x1 - x0) * f64::from(i) / f64::from(SECTION))
            .filter_map(|x| {
                let ahead = x - bench.eye.x;
                let from = (bench.eye.z + low * ahead).max(volume.z_m[0]);
                let to = (bench.eye.z + high * ahead).min(volume.z_m[1]);
                (ahead > 0.0 && x <= bench.rig.range_m_max && from <= to).then_some((x, from, to))
            })
            .collect();
        let ground = volume.z_m[0];
        let on_floor = || columns.iter().filter(|c| c.1 <= ground).map(|c| c.0);
        let floor = on_floor().next().zip(on_floor().next_back()).map(|(a, b)| [a, b]);
        (!columns.is_empty()).then_some(Self { columns, ground, floor, source: bench.source })
    }

    /// Height of a beam at X.
    fn height(&self, beam_rad: f64, x: f64) -> f64 {
        self.source.z - (x - self.source.x) * beam_rad.tan()
    }

    /// Where a beam meets the lowest plane.
    fn meets(&self, beam_rad: f64) -> f64 {
        let slope = beam_rad.tan();
        if slope > 0.0 { self.source.x + (self.source.z - self.ground) / slope } else { f64::INFINITY }
    }

    fn touches(&self, beam_rad: f64) -> bool {
        let inside = |(x, low, high): &(f64, f64, f64)| {
            let z = self.height(beam_rad, *x);
            z >= low - 1e-9 && z <= high + 1e-9
        };
        self.columns.iter().any(inside) || self.floor.is_some_and(|[a, b]| (a..=b).contains(&self.meets(beam_rad)))
    }

    /// What two beams leave between them: along the lowest plane, and up a wall. `None` stands for the edge of what is seen,
    /// under all beams for the steeper and over them for the flatter.
    fn gap(&self, steeper: Option<f64>, flatter: Option<f64>) -> (f64, f64) {
        let floor = self.floor.map_or(0.0, |[a, b]| {
            let near = steeper.map_or(a, |beam| self.meets(beam)).clamp(a, b);
            let far = flatter.map_or(b, |beam| self.meets(beam)).clamp(a, b);
            far - near
        });
        let wall = self.columns.iter().map(|(x, low, high)| {
            let from = steeper.map_or(*low, |beam| self.height(beam, *x)).max(*low);
            let to = flatter.map_or(*high, |beam| self.height(beam, *x)).min(*high);
            to - from
        });
        (floor.max(0.0), wall.fold(0.0, f64::max))
    }

    /// The fewest lines: from the steepest on, each as flat as it may be. Whether a single pulse was too coarse somewhere.
    fn lines(&self, bench: &Bench, resolution_m: f64) -> (Vec<Line>, bool) {
        let Some(axis) = bench.beam() else { return (Vec::new(), false) };
        let span = i64::from(axis.pulse_max) - i64::from(axis.pulse_min);
        let every = (span / PULSES_MAX + 1) as usize;
        let all = (i64::from(axis.pulse_min)..=i64::from(axis.pulse_max)).step_by(every).map(|p| p as i32);
        let angle = |pulse: i32| axis.zero_rad + f64::from(pulse) * axis.rad_per_pulse;
        let mut beams: Vec<(i32, f64)> = all
            .map(|p| (p, angle(p)))
            .filter(|(_, a)| a.abs() < std::f64::consts::FRAC_PI_2 && self.touches(*a))
            .collect();
        beams.sort_by(|a, b| b.1.total_cmp(&a.1));
        let fits = |from: Option<f64>, to: Option<f64>| {
            let (floor, wall) = self.gap(from, to);
            floor.max(wall) <= resolution_m + 1e-9
        };
        let (mut chosen, mut limited, mut last, mut next) = (Vec::new(), false, None, 0);
        while next < beams.len() && !(last.is_some() && fits(last, None)) {
            let reach = beams[next..].iter().take_while(|(_, beam)| fits(last, Some(*beam))).count();
            // The steepest of all leaves what lies under it unlit; that is no fault of the pulse.
            limited |= reach == 0 && last.is_some();
            next += reach.max(1);
            let (pulse, beam) = beams[next - 1];
            let meets = self.meets(beam);
            let floor_m = self.floor.filter(|[a, b]| (*a..=*b).contains(&meets)).map(|_| meets);
            chosen.push(Line { pulse, beam_deg: beam.to_degrees(), floor_m });
            last = Some(beam);
        }
        (chosen, limited)
    }

    /// The widest gaps between lines: on the lowest plane, up a wall.
    fn widest(&self, lines: &[Line]) -> (f64, f64) {
        let beams: Vec<f64> = lines.iter().map(|l| l.beam_deg.to_radians()).collect();
        let gaps = beams.windows(2).map(|w| self.gap(Some(w[0]), Some(w[1])));
        gaps.fold((0.0, 0.0), |(f, w), gap| (gap.0.max(f), gap.1.max(w)))
    }
}

/// How long all views with all lines take, to and fro.
fn sweep_time(rig: &Rig, instrument: &Instrument, lines: &[Line], view_rad: &[f64]) -> Result<Option<f64>> {
    let cylinder = rig.cylinder;
    let pulse_of = |angle: f64| {
        let pulse = (angle - cylinder.zero_rad) / cylinder.rad_per_pulse;
        if pulse.is_finite() { pulse.round() as i32 } else { 0 }
    };
    let mut stops = Vec::new();
    for (k, view) in view_rad.iter().enumerate() {
        let view = lines.iter().map(|line| Stop { cylinder: pulse_of(*view), mirror: line.pulse });
        if k % 2 == 0 { stops.extend(view) } else { stops.extend(view.rev()) }
    }
    let Some(first) = stops.first().copied() else { return Ok(None) };
    let params = instrument.sweep.clone().unwrap_or_default();
    let params = SweepParams { trigger: crate::scanner::Trigger::Settled, ..params };
    let mut head = Head::new(&params, 0);
    // It begins at rest on its first line.
    head.target(first);
    while !head.settled() {
        head.advance(0.1);
    }
    let mut sweep = Sweep::new(stops, &params, bench_exposure(instrument))?;
    let (mut steps, step_s) = (0u32, 1e-3);
    while !sweep.done() && steps < 10_000_000 {
        sweep.advance(&mut head, step_s);
        steps += 1;
    }
    Ok(Some(f64::from(steps) * step_s))
}

/// Exposure time that a sweep can have [s].
fn bench_exposure(instrument: &Instrument) -> f64 {
    instrument.image.exposure_s.min(10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn watched(volume: Volume) -> Watch {
        let instrument = Instrument::metro_i().validated().unwrap();
        let bench = Bench::new(&instrument.rig, &instrument.image);
        watch(&bench, &instrument, &DesignParams { volume, ..DesignParams::default() }).unwrap()
    }

    #[test]
    fn every_part_of_a_volume_is_seen_or_has_one_reason() {
        let sum = |w: &Watch| {
            let u = w.unseen;
            w.seen_turned + u.above_picture + u.below_picture + u.beside + u.no_beam + u.too_far
        };
        for volume in [
            Volume::default(),
            Volume { x_m: [0.2, 6.0], y_m: [-3.0, 3.0], z_m: [-0.2, 1.5] },
            Volume { x_m: [1.5, 2.5], y_m: [-0.1, 0.1], z_m: [0.0, 0.1] },
        ] {
            let w = watched(volume);
            assert!((sum(&w) - 1.0).abs() < 1e-9 && w.seen_ahead <= w.seen_turned + 1e-9, "{w:?}");
        }
        // All of a low, narrow box is seen, in one view; METRO-I's own numbers say so (instrument.md 3).
        let low = watched(Volume { x_m: [1.5, 2.5], y_m: [-0.1, 0.1], z_m: [0.0, 0.1] });
        assert_eq!((low.seen_ahead, low.seen_turned, low.views), (1.0, 1.0, 1));
    }

    #[test]
    fn what_lies_too_near_too_high_or_too_far_says_why() {
        let box_at = |x_m, z_m| watched(Volume { x_m, y_m: [-0.05, 0.05], z_m });
        assert_eq!(box_at([0.5, 1.2], [0.0, 0.02]).unseen.below_picture, 1.0);
        assert_eq!(box_at([2.5, 3.0], [0.8, 1.0]).unseen.above_picture, 1.0);
        assert_eq!(box_at([5.0, 6.0], [0.0, 0.1]).unseen.too_far, 1.0);
        let none = box_at([0.5, 1.2], [0.0, 0.02]);
        assert!(none.lines.is_empty() && none.views == 0 && none.sweep_s.is_none());
    }

    #[test]
    fn a_wide_volume_takes_as_many_views_as_its_bearings_need() {
        let wide = watched(Volume { x_m: [1.5, 2.0], y_m: [-1.5, 1.5], z_m: [0.0, 0.05] });
        assert!(wide.seen_ahead < 0.5 && wide.seen_turned > 0.9, "{wide:?}");
        // ±45° of bearing at some 28° a view.
        assert!((3..=6).contains(&wide.views), "{}", wide.views);
        let one = watched(Volume { x_m: [1.5, 2.0], y_m: [-0.3, 0.3], z_m: [0.0, 0.05] });
        let per_line = one.sweep_s.unwrap() / (one.lines.len() * one.views) as f64;
        // instrument.md 5: some 6 lines a second.
        assert!((0.12..0.2).contains(&per_line), "{per_line}");
    }
}
