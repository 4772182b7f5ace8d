//! The ring on its robot: fires its transducers in turn, and reads what comes back.

use std::collections::{BTreeMap, VecDeque};

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
use super::transducer::{Transducer, TransducerParams};
use crate::fault::{Fault, Result};
use crate::geometry::{Point, Robot, Transform, World};
use crate::time::{Span, Stamp};

/// Echoes that have less than this share of the threshold are not looked for: several of them may pass it together.
const SHARE: f64 = 0.3;
/// Delays between pings that are kept in mind.
const DELAYS_MAX: usize = 64;

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
    /// What echoes need by how long before the receiver's own ping theirs began [ns]: the same few delays again and again.
    needs: BTreeMap<i64, Need>,
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
        let air = Air { temperature_k, ..params.air };
        // The next step of the schedule ends the listening.
        let heard_m = params.transducer.range_m_max.min(params.interval_s * air.sound_m_s() / 2.0);
        let it = Transducer::new(TransducerParams { range_m_max: heard_m, ..params.transducer }, &air)?;
        let assumed = Air { temperature_k: params.assumed_k, ..params.air };
        let footprint = Footprint::new(&it);
        let scale = assumed.sound_m_s() / it.sound_m_s;
        Ok(Self { params, it, footprint, needs: BTreeMap::new(), scale, step: 0, earlier: VecDeque::new(), rng })
    }

    /// What it is made of.
    pub fn params(&self) -> &RingParams {
        &self.params
    }

    /// The arc in which a smooth wall's normal is seen by the main lobe, from side to side [rad].
    pub fn main_lobe_rad(&self) -> f64 {
        2.0 * self.it.main_lobe_rad()
    }

    /// The least and the largest range that the module states [m]: in the air that it works ranges out with.
    pub fn range_limits_m(&self) -> [f64; 2] {
        let RingParams { transducer, interval_s, .. } = self.params;
        let assumed_m_s = self.scale * self.it.sound_m_s;
        let heard_m = transducer.range_m_max.min(interval_s * assumed_m_s / 2.0);
        [transducer.blanking_s * assumed_m_s / 2.0, heard_m]
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
        if self.needs.len() > DELAYS_MAX {
            self.needs.clear();
        }
        for shot in &self.earlier {
            let delay = stamp - shot.stamp;
            // Echoes that are left over are not added up.
            let share = if delay.0 == 0 { SHARE } else { 1.0 };
            self.needs.entry(delay.0).or_insert_with(|| Need::new(&self.it, delay.as_secs(), share));
        }
        let now = self.earlier.back().map(|shot| shot.aims.clone()).unwrap_or_default();
        Ok(now.into_iter().map(|(i, aim)| self.ping(stamp, i, aim, targets)).collect())
    }

    fn ping(&mut self, stamp: Stamp, transducer: usize, aim: Aim, targets: &Targets) -> Ping {
        let mut echoes = Vec::new();
        // Pulses, and which echo each is of.
        let mut coming: Vec<(Pulse, usize)> = Vec::new();
        for shot in &self.earlier {
            let Some(need) = self.needs.get(&(stamp - shot.stamp).0).filter(|need| !need.hopeless()) else { continue };
            let (it, footprint, order) = (&self.it, &self.footprint, self.params.order);
            let delay_s = (stamp - shot.stamp).as_secs();
            let ghost_times = if delay_s > 0.0 { 1.0 } else { 1.0 / SHARE };
            let search = Search { it, footprint, targets, need, order, ghost_times };
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

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, UnitQuaternion};

    use super::*;
    use crate::sonar::{Schedule, TransducerParams};
    use crate::world::{Body, Material, Motion, Scene, Shape};

    fn block(name: &str, size: [f64; 3], at: [f64; 3], yaw_deg: f64) -> Body {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_deg.to_radians());
        Body {
            name: name.into(),
            shape: Shape::Box { size: Vector3::from(size) },
            pose: Isometry3::from_parts(Vector3::from(at).into(), turn),
            material: Material::default(),
            motion: Motion::Static,
            ground: false,
        }
    }

    fn floor() -> Body {
        Body {
            name: "floor".into(),
            shape: Shape::Plane,
            pose: Isometry3::identity(),
            ..block("", [1.0; 3], [0.0; 3], 0.0)
        }
    }

    fn pole(radius: f64, at: [f64; 2], height: f64) -> Body {
        let shape = Shape::Cylinder { radius, length: height };
        let pose = Isometry3::translation(at[0], at[1], height / 2.0);
        Body { name: "pole".into(), shape, pose, ..block("", [1.0; 3], [0.0; 3], 0.0) }
    }

    fn targets(bodies: Vec<Body>) -> Targets {
        Targets::new(&Scene { bodies, ..Scene::default() }).unwrap()
    }

    /// A room of 8 x 6 m.
    fn room() -> Vec<Body> {
        vec![
            floor(),
            block("east", [0.1, 6.2, 2.5], [4.05, 0.0, 1.25], 0.0),
            block("north", [8.0, 0.1, 2.5], [0.0, 3.05, 1.25], 0.0),
            block("west", [0.1, 6.2, 2.5], [-4.05, 0.0, 1.25], 0.0),
            block("south", [8.0, 0.1, 2.5], [0.0, -3.05, 1.25], 0.0),
        ]
    }

    fn alone() -> RingParams {
        RingParams { count: 1, radius_m: 0.0, ..RingParams::default() }.noiseless()
    }

    /// What one transducer at the origin hears along `yaw_deg`.
    fn one(bodies: Vec<Body>, yaw_deg: f64) -> Ping {
        let pose = Transform::planar(0.0, 0.0, yaw_deg.to_radians());
        Ring::new(alone(), 0).unwrap().fire(Stamp(0), &pose, &targets(bodies)).unwrap().remove(0)
    }

    fn turn(params: RingParams, seed: u64, world: &Targets) -> Vec<Ping> {
        let mut ring = Ring::new(params, seed).unwrap();
        let steps = params.schedule.steps(params.count);
        let pose = Transform::planar(0.5, -0.4, 0.1);
        let at = |step: usize| Stamp::from_secs(step as f64 * params.interval_s);
        (0..steps).flat_map(|step| ring.fire(at(step), &pose, world).unwrap()).collect()
    }

    #[test]
    fn a_ring_in_an_empty_room_reads_walls_and_corners_and_little_else() {
        let pings = turn(RingParams::default().noiseless(), 0, &targets(room()));
        assert_eq!(pings.iter().map(|p| p.reading.transducer).collect::<Vec<_>>(), (0..24).collect::<Vec<_>>());
        for ping in &pings {
            // No reading is nearer than what the axis or anything near it meets.
            let Some(range) = ping.reading.range_m() else { continue };
            let cause = ping.echoes[ping.causes[0]];
            assert!((-1e-3..0.06).contains(&(range - cause.range_m)), "{range} {cause:?}");
            assert!(matches!(cause.kind, EchoKind::Wall | EchoKind::Corner), "{cause:?}");
            assert!((cause.place.xyz - ping.aim.at.xyz).norm() > 2.0);
        }
        // The east wall's normal lies at −5.7°: transducer 0 (0°) sees it, where it is.
        let east = pings[0].reading.range_m().unwrap();
        let truth = 4.0 - pings[0].aim.at.xyz.x;
        assert!((0.0..5e-3).contains(&(east - truth)), "{east} {truth}");
        let silent = pings.iter().filter(|p| p.reading.ranges_m.is_empty()).count();
        assert!((3..=14).contains(&silent), "{silent} of 24 without echo");
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_and_noise_has_its_size() {
        let world = targets(room());
        assert_eq!(turn(RingParams::default(), 7, &world), turn(RingParams::default(), 7, &world));
        let pose = Transform::planar(0.5, -0.4, 0.1);
        let first = |params: RingParams, seed: u64| {
            Ring::new(params, seed).unwrap().fire(Stamp(0), &pose, &world).unwrap()[0].reading.range_m().unwrap()
        };
        let exact = first(RingParams::default().noiseless(), 0);
        let errors: Vec<f64> = (0..60).map(|seed| first(RingParams::default(), seed) / exact - 1.0).collect();
        let mean = errors.iter().sum::<f64>() / 60.0;
        let sigma = (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / 60.0).sqrt();
        // 1 % of scale and 0.3 % a reading: 1.04 %.
        assert!(mean.abs() < 0.006 && (0.007..0.014).contains(&sigma), "{mean} {sigma}");
    }

    #[test]
    fn what_stands_before_a_wall_hides_it() {
        let wall = block("wall", [0.1, 8.0, 3.0], [3.05, 0.0, 1.5], 0.0);
        let screen = block("screen", [0.1, 2.0, 3.0], [1.55, 0.0, 1.5], 0.0);
        let seen = |bodies| one(bodies, 0.0).reading.ranges_m;
        assert!((seen(vec![wall.clone()])[0] - 3.0).abs() < 3e-3);
        let both = seen(vec![wall, screen]);
        assert!((both[0] - 1.5).abs() < 3e-3 && both.iter().all(|r| *r < 2.0), "{both:?}");
    }

    #[test]
    fn what_lies_below_or_hangs_above_the_beam_is_not_seen_and_a_pole_is() {
        // 0.4 m up: the foot of a step of 0.1 m, 1.65 m away, lies 13.6° down, in the null; its upper edge is weak.
        assert_eq!(
            one(vec![floor(), block("step", [0.6, 2.0, 0.1], [1.95, 0.0, 0.05], 0.0)], 0.0).reading.range_m(),
            None
        );
        // A table top 1.1 m up, 1.5 m away.
        assert_eq!(
            one(vec![floor(), block("top", [0.8, 1.4, 0.03], [1.9, 0.0, 1.1], 0.0)], 0.0).reading.range_m(),
            None
        );
        // A pole of 30 mm at 2 m: √(0.015/2.015) of a wall, −21 dB.
        let ping = one(vec![floor(), pole(0.015, [2.0, 0.0], 1.0)], 0.0);
        assert!((ping.reading.range_m().unwrap() - 1.985).abs() < 4e-3);
        let level = ping.echoes[ping.causes[0]].level_db + 20.0 * 1.985_f64.log10() + 2.0 * 1.6414 * 1.985;
        assert!((level + 21.3).abs() < 0.5, "{level}");
        assert_eq!(one(vec![floor(), pole(0.015, [2.0, 0.0], 1.0)], 12.0).reading.range_m(), None);
    }

    #[test]
    fn a_rough_wall_is_seen_askew_where_a_smooth_one_is_not() {
        let wall = |roughness: f64| {
            let mut wall = block("wall", [0.1, 8.0, 3.0], [2.05, 0.0, 1.5], 0.0);
            wall.material.acoustic_roughness_m = roughness;
            one(vec![wall], 35.0).reading.range_m()
        };
        assert_eq!(wall(0.0), None);
        let rough = wall(0.005).unwrap();
        // Along the axis it is 2.44 m away; the near side of the beam comes first.
        assert!((2.1..2.5).contains(&rough), "{rough}");
    }

    #[test]
    fn a_mirror_shows_what_stands_beside_as_if_it_were_behind() {
        // A smooth wall under 45° ahead sends the beam to the left, where a wall stands square to it.
        let mirror =
            block("mirror", [0.05, 1.6, 3.0], [2.0 + 0.025 / f64::sqrt(2.0), -0.025 / f64::sqrt(2.0), 1.5], -45.0);
        let wall = block("wall", [3.0, 0.1, 3.0], [2.0, 2.05, 1.5], 0.0);
        let ping = one(vec![mirror.clone(), wall.clone()], 0.0);
        let ghost = ping.echoes.iter().find(|e| e.surfaces == 3 && e.kind == EchoKind::Wall).unwrap();
        assert!((ghost.range_m - 4.0).abs() < 1e-3 && !ghost.is_straight(0), "{ghost:?}");
        assert!(ping.reading.ranges_m.iter().any(|r| (r - 4.0).abs() < 5e-3), "{:?}", ping.reading);
        let mut single = Ring::new(RingParams { order: 1, ..alone() }, 0).unwrap();
        let ping = single.fire(Stamp(0), &Transform::identity(), &targets(vec![mirror, wall])).unwrap().remove(0);
        assert!(ping.echoes.iter().all(|e| e.surfaces == 1 && e.is_straight(0)));
    }

    #[test]
    fn transducers_that_fire_at_once_hear_one_another() {
        let world = targets(room());
        let strangers = |schedule| {
            let pings = turn(RingParams { schedule, ..RingParams::default() }.noiseless(), 0, &world);
            pings
                .iter()
                .flat_map(|p| p.echoes.iter().map(move |e| e.source != p.reading.transducer))
                .filter(|x| *x)
                .count()
        };
        assert_eq!(strangers(Schedule::Sequential), 0);
        assert_eq!(strangers(Schedule::Alternating), 0);
        assert!(strangers(Schedule::Groups { groups: 1 }) > 10);
    }

    #[test]
    fn an_echo_that_outlives_the_interval_is_read_as_a_near_one() {
        let wall = || block("wall", [0.1, 30.0, 3.0], [6.05, 0.0, 1.5], 0.0);
        let params = RingParams { interval_s: 0.030, ..alone() };
        let mut ring = Ring::new(params, 0).unwrap();
        let world = targets(vec![wall()]);
        let mut fire = |k: i32| {
            ring.fire(Stamp::from_secs(0.030 * f64::from(k)), &Transform::identity(), &world).unwrap().remove(0)
        };
        // 30 ms are 5.15 m: the first ping hears nothing, the next one hears the first at 0.85 m.
        assert_eq!(fire(0).reading.range_m(), None);
        let second = fire(1);
        let cause = second.echoes[second.causes[0]];
        assert!(cause.late && !cause.is_straight(0) && (cause.range_m - 0.85).abs() < 0.01, "{cause:?}");
        assert!((second.reading.range_m().unwrap() - 0.85).abs() < 0.03);
        // With 65 ms there is no such thing.
        let mut slow = Ring::new(alone(), 0).unwrap();
        for k in 0..3 {
            let ping =
                slow.fire(Stamp::from_secs(0.065 * f64::from(k)), &Transform::identity(), &world).unwrap().remove(0);
            assert!((ping.reading.range_m().unwrap() - 6.0).abs() < 5e-3 && ping.reading.ranges_m.len() == 1);
        }
    }

    #[test]
    fn what_moves_is_heard_where_it_is() {
        let mut crate_ = block("crate", [0.5, 0.5, 1.0], [2.25, 0.0, 0.5], 0.0);
        crate_.motion = Motion::Dynamic { mass_kg: 5.0 };
        let mut world = targets(vec![floor(), crate_]);
        let mut ring = Ring::new(alone(), 0).unwrap();
        let mut range = |world: &Targets, k: i64| {
            ring.fire(Stamp(k * 100_000_000), &Transform::identity(), world).unwrap()[0].reading.range_m()
        };
        assert!((range(&world, 0).unwrap() - 2.0).abs() < 3e-3);
        world.set_pose(1, Isometry3::translation(3.25, 0.0, 0.5)).unwrap();
        assert!((range(&world, 1).unwrap() - 3.0).abs() < 3e-3);
        world.set_pose(1, Isometry3::translation(0.0, 5.0, 0.5)).unwrap();
        assert_eq!(range(&world, 2), None);
    }

    #[test]
    fn a_cylinder_of_facets_sounds_like_a_round_one() {
        let round = pole(0.15, [1.65, 0.0], 2.0);
        let mut cut = round.clone();
        cut.shape = Shape::from(round.shape.tessellate(1.0));
        let level = |body: Body| {
            let ping = one(vec![body], 0.0);
            (ping.reading.range_m().unwrap(), ping.echoes[ping.causes[0]].level_db)
        };
        let (round, cut) = (level(round), level(cut));
        assert!((round.0 - cut.0).abs() < 6e-3, "{round:?} {cut:?}");
    }

    #[test]
    fn what_cannot_be_fired_is_refused() {
        let world = targets(room());
        let mut ring = Ring::new(RingParams::default(), 0).unwrap();
        let lost: Transform<World, Robot> = Isometry3::translation(f64::NAN, 0.0, 0.0).into();
        assert!(ring.fire(Stamp(0), &lost, &world).unwrap_err().to_string().starts_with("pose of the robot"));
        ring.fire(Stamp(5), &Transform::identity(), &world).unwrap();
        let fault = ring.fire(Stamp(4), &Transform::identity(), &world).unwrap_err();
        assert!(fault.to_string().starts_with("time of a ping"), "{fault}");
        assert!(Ring::new(RingParams { count: 0, ..RingParams::default() }, 0).is_err());
        let wide = TransducerParams { radius_m: 0.09, frequency_hz: 190e3, ..TransducerParams::default() };
        assert!(Ring::new(RingParams { transducer: wide, ..RingParams::default() }, 0).is_err());
        // No world, no echo.
        assert!(ring.fire(Stamp(6), &Transform::identity(), &targets(vec![])).unwrap()[0].reading.ranges_m.is_empty());
        assert_eq!(ring.due(Stamp(0)), Stamp(65_000_000));
        let exact = Ring::new(RingParams::default().noiseless(), 0).unwrap();
        let [low, high] = exact.range_limits_m();
        assert!((low - 0.4085).abs() < 1e-3 && (high - 10.7).abs() < 1e-9);
        assert!((exact.main_lobe_rad().to_degrees() - 22.4).abs() < 0.2);
    }
}
