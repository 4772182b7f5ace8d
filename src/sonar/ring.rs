//! The ring on its robot: fires its transducers in turn, and reads what comes back.

use std::collections::VecDeque;

use nalgebra::Vector3;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::air::Air;
use super::diffuse::Footprint;
use super::hear::{Heard, Search};
use super::need::Need;
use super::params::RingParams;
use super::receive::{Pulse, crossings, pulses};
use super::reflect::EchoKind;
use super::sight::Aim;
use super::targets::Targets;
use super::transducer::Transducer;
use crate::fault::{Fault, Result};
use crate::geometry::{Point, Robot, Transform, World};
use crate::time::{Span, Stamp};

/// Echoes that have less than this share of the threshold are not looked for: several of them may pass it together.
const SHARE: f64 = 0.3;

/// What a transducer reports of one ping.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reading {
    /// When it was fired.
    pub stamp: Stamp,
    /// Which transducer.
    pub transducer: usize,
    /// Ranges of the echoes it told apart, nearest first [m]; a module in single-echo mode has the first one only. None: no
    /// echo.
    pub ranges_m: Vec<f64>,
}

impl Reading {
    /// The first echo [m].
    pub fn range_m(&self) -> Option<f64> {
        self.ranges_m.first().copied()
    }
}

/// An echo as it truly was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Echo {
    /// The range at which it appears, without noise [m]; half its way, but for the echo of an earlier ping.
    pub range_m: f64,
    /// Length of its way [m].
    pub way_m: f64,
    /// Level over that of a smooth wall square to the beam at 1 m in air that swallows nothing [dB].
    pub level_db: f64,
    /// Level over the receiver's threshold when the echo has risen [dB].
    pub margin_db: f64,
    /// What sent it back.
    pub kind: EchoKind,
    /// Index of the body in the scene.
    pub body: usize,
    /// Where on the body.
    pub place: Point<World>,
    /// How many surfaces the sound met: 1 straight, 2 in a corner or by one mirror, 3 and more by a mirror twice.
    pub surfaces: u8,
    /// The transducer that sent it.
    pub source: usize,
    /// Whether it is left over from an earlier step of the schedule.
    pub late: bool,
}

impl Echo {
    /// Whether a reading of it is what it seems to be: the transducer's own ping, straight from where it looks.
    pub fn is_straight(&self, transducer: usize) -> bool {
        self.source == transducer
            && !self.late
            && (self.surfaces == 1 || self.kind == EchoKind::Corner && self.surfaces == 2)
    }
}

/// A reading with the truth beside it.
#[derive(Clone, Debug, PartialEq)]
pub struct Ping {
    /// What the transducer reports.
    pub reading: Reading,
    /// All echoes near or over the threshold, in the order of their ways within each source.
    pub echoes: Vec<Echo>,
    /// For each range of the reading the echo that was the strongest then: an index into `echoes`.
    pub causes: Vec<usize>,
    /// Where the transducer was and looked.
    pub aim: Aim,
}

/// A step of the schedule that may still be heard of.
#[derive(Clone, Debug)]
struct Shot {
    stamp: Stamp,
    aims: Vec<(usize, Aim)>,
}

/// A ring of ultrasonic transducers.
#[derive(Clone, Debug)]
pub struct Ring {
    params: RingParams,
    it: Transducer,
    footprint: Footprint,
    /// What echoes of its own ping need.
    need: Need,
    /// Metres that are read for a metre that is.
    scale: f64,
    step: usize,
    earlier: VecDeque<Shot>,
    rng: ChaCha8Rng,
}

impl Ring {
    /// A ring before its first ping. The seed sets the air's temperature of this run, and the noise.
    ///
    /// # Errors
    /// Parameters that make no ring.
    pub fn new(params: RingParams, seed: u64) -> Result<Self> {
        let params = params.validated()?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // Not beyond three standard deviations, nor beyond what any air is.
        let off_k = params.temperature_sigma_k * normal(&mut rng).clamp(-3.0, 3.0);
        let temperature_k = (params.air.temperature_k + off_k).clamp(233.15, 333.15);
        let it = Transducer::new(params.transducer, &Air { temperature_k, ..params.air })?;
        let assumed = Air { temperature_k: params.assumed_k, ..params.air };
        let (footprint, need) = (Footprint::new(&it), Need::new(&it, 0.0, SHARE));
        let scale = assumed.sound_m_s() / it.sound_m_s;
        Ok(Self { params, it, footprint, need, scale, step: 0, earlier: VecDeque::new(), rng })
    }

    /// What it is made of.
    pub fn params(&self) -> &RingParams {
        &self.params
    }

    /// When the next step of the schedule is due, if the last one was fired then.
    pub fn due(&self, last: Stamp) -> Stamp {
        last + Span::from_secs(self.params.interval_s)
    }

    /// Where a transducer is and looks.
    pub fn aim(&self, transducer: usize, world_from_robot: &Transform<World, Robot>) -> Aim {
        let (sin, cos) = self.params.bearing_rad(transducer).sin_cos();
        let (up, level) = self.params.tilt_deg.to_radians().sin_cos();
        let at = Point::<Robot>::new(self.params.radius_m * cos, self.params.radius_m * sin, self.params.height_m);
        Aim { at: *world_from_robot * at, axis: world_from_robot.rotate(&Vector3::new(level * cos, level * sin, up)) }
    }

    /// Fires the next step of the schedule, and returns what its transducers hear until the next one: a ping each.
    ///
    /// # Errors
    /// A pose that is not finite; a time before the last one.
    pub fn fire(
        &mut self,
        stamp: Stamp,
        world_from_robot: &Transform<World, Robot>,
        targets: &Targets,
    ) -> Result<Vec<Ping>> {
        if !world_from_robot.is_finite() {
            return Err(Fault::new("pose of the robot", "a number that is not finite", "finite numbers"));
        }
        if let Some(last) = self.earlier.back().filter(|last| last.stamp > stamp) {
            let expected = format!("at least the last one's {} s", last.stamp.as_secs());
            return Err(Fault::new("time of a ping", format!("{} s", stamp.as_secs()), expected));
        }
        let firing = self.params.schedule.firing(self.params.count, self.step);
        self.step = (self.step + 1) % self.params.schedule.steps(self.params.count);
        let aims = firing.into_iter().map(|i| (i, self.aim(i, world_from_robot))).collect();
        // Twice the time to the end of the range: what comes later is far too weak.
        let oldest = 2.0 * self.it.last_s();
        self.earlier.retain(|shot| (stamp - shot.stamp).as_secs() < oldest);
        self.earlier.push_back(Shot { stamp, aims });
        let needs: Vec<Need> = self
            .earlier
            .iter()
            .map(|shot| match (stamp - shot.stamp).as_secs() {
                0.0 => self.need.clone(),
                delay => Need::new(&self.it, delay, SHARE),
            })
            .collect();
        let now = self.earlier.back().map(|shot| shot.aims.clone()).unwrap_or_default();
        Ok(now.into_iter().map(|(i, aim)| self.ping(stamp, i, aim, &needs, targets)).collect())
    }

    fn ping(&mut self, stamp: Stamp, transducer: usize, aim: Aim, needs: &[Need], targets: &Targets) -> Ping {
        let mut echoes = Vec::new();
        // Pulses, and which echo each is of.
        let mut coming: Vec<(Pulse, usize)> = Vec::new();
        for (shot, need) in self.earlier.iter().zip(needs).filter(|(_, need)| !need.hopeless()) {
            let (it, footprint, order) = (&self.it, &self.footprint, self.params.order);
            let search = Search { it, footprint, targets, need, order };
            let delay_s = (stamp - shot.stamp).as_secs();
            for (source, from) in &shot.aims {
                for heard in search.echoes(from, &aim) {
                    let (way_m, share) = (heard.bounce.way_m, &heard.bounce.share);
                    let start_s = way_m / it.sound_m_s - delay_s;
                    coming.extend(pulses(it, share, way_m, start_s).map(|pulse| (pulse, echoes.len())));
                    echoes.push(self.echo(&heard, start_s, *source, shot.stamp != stamp));
                }
            }
        }
        coming.sort_by(|a, b| a.0.start_s.total_cmp(&b.0.start_s).then(a.1.cmp(&b.1)));
        let sorted: Vec<Pulse> = coming.iter().map(|(pulse, _)| *pulse).collect();
        let found = crossings(&self.it, &sorted);
        let causes = found.iter().map(|crossing| coming[crossing.pulse].1).collect();
        let ranges_m = found.iter().map(|crossing| self.read(crossing.time_s)).collect();
        Ping { reading: Reading { stamp, transducer, ranges_m }, echoes, causes, aim }
    }

    /// An echo as it truly is, from when it begins after the start of the ping.
    fn echo(&self, heard: &Heard, start_s: f64, source: usize, late: bool) -> Echo {
        let (it, bounce) = (&self.it, &heard.bounce);
        let amplitude = bounce.share.total().norm() * it.air_leaves(bounce.way_m);
        let risen_s = (start_s + it.params.cycles / it.params.frequency_hz).max(it.params.blanking_s);
        let decibel = |share: f64| 20.0 * share.max(1e-30).log10();
        Echo {
            range_m: start_s * it.sound_m_s / 2.0,
            way_m: bounce.way_m,
            level_db: decibel(amplitude),
            margin_db: decibel(amplitude / it.threshold(risen_s)),
            kind: bounce.kind,
            body: bounce.body as usize,
            place: bounce.place.into(),
            surfaces: heard.surfaces,
            source,
            late,
        }
    }

    /// A time of flight as the module reports it.
    fn read(&mut self, time_s: f64) -> f64 {
        let range_m = time_s * self.it.sound_m_s / 2.0;
        let sigma = self.params.transducer.range_sigma_m.max(self.params.transducer.range_sigma_share * range_m);
        (range_m * self.scale + sigma * normal(&mut self.rng)).max(0.0)
    }
}

/// A draw from N(0, 1), by Box and Muller.
fn normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt(); // 1 − u is never 0
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}
