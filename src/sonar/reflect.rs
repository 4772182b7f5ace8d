//! What each kind of feature sends from one end to another: the closed forms. They are held against numerical integrals
//! in `reference`.
//!
//! An amplitude is 1 for a smooth endless wall square to the beam at 1 m, without air; a wave that comes straight from a
//! source at distance r has 2/r, since a wall at 1 m is a source 2 m away. Phases are those of exp(−jk·way), to which the
//! complex amplitude is what comes on top.

use nalgebra::Complex;

use super::beam::{Bend, Share};
use super::face::{Face, V3};
use super::feature::{Ball, Corner, Edge, Feature, Rim, Rod};
use super::need::Need;
use super::sight::{End, View, before};
use super::special::fresnel_tail;
use super::transducer::Transducer;
use super::wedge::{self, About};

/// No edge sends more of a wall's echo: where the wall begins it has half, with ripples beside.
const BENT_MOST: f64 = 0.7;

/// What sent an echo back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EchoKind {
    /// A flat surface, as a mirror.
    Wall,
    /// A flat surface that is rough, on all sides.
    Rough,
    /// Two surfaces that enclose an angle.
    Corner,
    /// An edge that stands out.
    Edge,
    /// A cylinder.
    Cylinder,
    /// A ball.
    Sphere,
}

/// A way from one end to the other by one feature.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounce {
    pub kind: EchoKind,
    pub body: u32,
    /// Length of the whole way [m].
    pub way_m: f64,
    pub share: Share,
    /// The place that is seen, a little before the surface.
    pub place: V3,
}

/// Source and receiver of a way.
#[derive(Clone, Copy)]
pub(super) struct Ends<'a> {
    pub from: &'a End<'a>,
    pub to: &'a End<'a>,
    /// Both are one transducer, seen the same way.
    pub same: bool,
    /// What an echo must have to be of any use, and how many times that is asked for.
    pub need: &'a Need,
    pub times: f64,
}

impl Ends<'_> {
    fn views(&self, place: &V3) -> [View; 2] {
        [self.from.view(place), self.to.view(place)]
    }

    /// The amplitude that an echo by a way of this length needs.
    pub fn needed(&self, way_m: f64) -> f64 {
        self.need.at(way_m) * self.times
    }

    /// Whether an echo that is `gain` of a wall's is lost in any case: behind a transducer, or too far off its axis.
    fn lost(&self, it: &Transducer, views: &[View; 2], way_m: f64, gain: f64) -> bool {
        let [a, b] = views;
        if a.cos <= 0.0 || b.cos <= 0.0 {
            return true;
        }
        let near = if self.same { it.piston.near(way_m / 2.0) } else { 1.0 };
        let most = it.piston.most(a.sin) * it.piston.most(b.sin) * near;
        most * gain * 2.0 / way_m < self.needed(way_m)
    }
}

/// The bounce off any feature, if there is one; two for a corner that is not right-angled.
pub(super) fn bounces(it: &Transducer, ends: &Ends, feature: &Feature) -> [Option<Bounce>; 2] {
    match feature {
        Feature::Face(face) => [wall(it, ends, face), None],
        Feature::Edge(e) => [edge(it, ends, e), None],
        Feature::Corner(c) => corner(it, ends, c),
        Feature::Rod(r) => [rod(it, ends, r), None],
        Feature::Ball(b) => [ball(it, ends, b), None],
        Feature::Rim(r) => [rim(it, ends, r), None],
    }
}

/// What the beam leaves of an echo from a place. `line` is the direction in which the target bends sound as `along` says
/// and at right angles to which as `perp`.
fn beam(it: &Transducer, ends: &Ends, views: &[View; 2], line: &V3, perp: Bend, along: Bend) -> Share {
    let [a, b] = views;
    if !ends.same {
        return Share::whole(it.piston.far(a.sin, a.cos) * it.piston.far(b.sin, b.cos));
    }
    // The way in which the axis leans, seen along the line of sight.
    let lean = (ends.from.axis - a.to * a.cos).try_normalize(1e-9).unwrap_or_else(V3::zeros);
    let share = 1.0 - lean.dot(line).powi(2);
    it.piston.both_ways(a.sin, a.cos, perp.mixed(share, along), perp.mixed(1.0 - share, along))
}

/// A mirror: the image source, at its full strength wherever the foot is on the face (its edges do the rest).
pub(super) fn wall(it: &Transducer, ends: &Ends, face: &Face) -> Option<Bounce> {
    let side = if face.two_sided { face.height(&ends.from.at).signum() } else { 1.0 };
    let (h, g) = (face.height(&ends.from.at) * side, face.height(&ends.to.at) * side);
    if h <= 0.0 || g <= 0.0 {
        return None;
    }
    let image = face.mirror(&ends.from.at);
    let foot = image + (ends.to.at - image) * (h / (h + g));
    if !face.holds(&foot) {
        return None;
    }
    let views = ends.views(&foot);
    let way_m = views[0].way_m + views[1].way_m;
    if ends.lost(it, &views, way_m, 1.0) {
        return None;
    }
    let bend = Bend::mirror(way_m / 2.0, f64::INFINITY);
    let mirrored = it.mirrored(face.roughness_m, (h + g) / way_m);
    let share = beam(it, ends, &views, &V3::zeros(), bend, bend) * (2.0 / way_m * mirrored);
    Some(Bounce { kind: EchoKind::Wall, body: face.body, way_m, share, place: before(&foot, &(face.normal * side)) })
}

/// A place on a line where the way is shortest, kept within the line's ends.
struct OnLine {
    place: V3,
    views: [View; 2],
    /// Sine of the angle between line and ways.
    sin_beta: f64,
    /// The way by `place`, and by how much it is longer than if the line had no ends [m].
    way_m: f64,
    beyond_m: f64,
    /// Near its shortest the way grows with q·z²/2; the line's ends and `place`, from there [m].
    q: f64,
    ends_m: [f64; 2],
    zero_m: f64,
}

impl OnLine {
    /// What the ends of the line leave of an endless one; its phase is that of the way by `place`.
    fn left(&self, it: &Transducer) -> Complex<f64> {
        between(it.wave_number, self.q, self.ends_m[0], self.ends_m[1], self.zero_m)
    }
}

/// Where on a line the way by it is shortest (Fermat): both ways make the same angle with it.
fn on_line(ends: &Ends, from: &V3, along: &V3, length: f64) -> Option<OnLine> {
    let [(a, za), (b, zb)] = [ends.from.at, ends.to.at].map(|at| {
        let z = (at - from).dot(along);
        ((at - from - along * z).norm(), z)
    });
    if a < 1e-3 || b < 1e-3 {
        return None;
    }
    let best = (za * b + zb * a) / (a + b);
    let z = best.clamp(0.0, length);
    let place = from + along * z;
    let views = ends.views(&place);
    let way_m = views[0].way_m + views[1].way_m;
    let (wa, wb) = (a.hypot(za - best), b.hypot(zb - best));
    let q = a * a / wa.powi(3) + b * b / wb.powi(3);
    let (ends_m, zero_m) = ([-best, length - best], z - best);
    Some(OnLine { place, views, sin_beta: a / wa, way_m, beyond_m: way_m - wa - wb, q, ends_m, zero_m })
}

/// What is left of ∫exp(−jkq·z²/2)dz over all z when it ends at `low` and `high`; phases count from z = `zero` on.
fn between(k: f64, q: f64, low: f64, high: f64, zero: f64) -> Complex<f64> {
    let scale = (k * q / 2.0).sqrt();
    let whole = Complex::from_polar(1.0 / std::f64::consts::PI.sqrt(), std::f64::consts::FRAC_PI_4);
    (fresnel_tail(low * scale) - fresnel_tail(high * scale)) * whole * Complex::from_polar(1.0, (zero * scale).powi(2))
}

/// Diffraction: D·√(s'/(s(s'+s)))/s' for a straight edge.
fn edge(it: &Transducer, ends: &Ends, e: &Edge) -> Option<Bounce> {
    let at = on_line(ends, &e.from, &e.along, e.length)?;
    if ends.lost(it, &at.views, at.way_m, BENT_MOST) {
        return None;
    }
    let phi = [e.bearing(&ends.from.at), e.bearing(&ends.to.at)];
    let free = e.n * std::f64::consts::PI;
    if phi.iter().any(|phi| *phi <= 0.0 || *phi >= free) {
        return None;
    }
    let share = bent(it, ends, &at, e.n, phi, 1.0, &e.along) * dulled(it, e.roughness_m);
    let place = before(&at.place, &e.about(free / 2.0));
    Some(Bounce { kind: EchoKind::Edge, body: e.body, way_m: at.way_m, share, place })
}

/// What an edge sends; `spread` is the share of the power that its curvature leaves.
fn bent(it: &Transducer, ends: &Ends, at: &OnLine, n: f64, phi: [f64; 2], spread: f64, line: &V3) -> Share {
    let [s, t] = at.views.map(|view| view.way_m);
    let about = About { n, phi, sin_beta: at.sin_beta, way_m: [s, t] };
    let r = (s + t) / 2.0;
    let beam = beam(it, ends, &at.views, line, Bend::mirror(r, 0.0), Bend::mirror(r, f64::INFINITY));
    beam * (wedge::coefficient(it.wave_number, &about) * at.left(it)) * (2.0 * (spread / (s * t * (s + t))).sqrt())
}

/// A rough edge is blurred like a rough wall under 45°.
fn dulled(it: &Transducer, roughness_m: f64) -> f64 {
    it.mirrored(roughness_m, std::f64::consts::FRAC_1_SQRT_2)
}

/// The round edge of a lid, at its nearest place: a right-angled edge that curves away.
fn rim(it: &Transducer, ends: &Ends, rim: &Rim) -> Option<Bounce> {
    let middle = (ends.from.at + ends.to.at) / 2.0 - rim.centre;
    let flat = middle - rim.axis * middle.dot(&rim.axis);
    if flat.norm() <= rim.radius {
        return None; // over the lid: there the lid itself is the echo
    }
    let out = flat.normalize();
    let from = rim.centre + out * rim.radius;
    let line = rim.axis.cross(&out);
    // As if it were straight and long: it curves away faster than it ends.
    let at = on_line(ends, &(from - line * 50.0), &line, 100.0)?;
    if ends.lost(it, &at.views, at.way_m, BENT_MOST) {
        return None;
    }
    let bearing = |p: &V3| {
        let v = p - from;
        let angle = v.dot(&rim.axis).atan2(v.dot(&-out));
        if angle < 0.0 { angle + std::f64::consts::TAU } else { angle }
    };
    let phi = [bearing(&ends.from.at), bearing(&ends.to.at)];
    if phi.iter().any(|phi| *phi <= 0.0 || *phi >= 1.5 * std::f64::consts::PI) {
        return None;
    }
    let outward = (out.dot(&-at.views[0].to) + out.dot(&-at.views[1].to)) / 2.0;
    let spread = rim.radius / (rim.radius + at.way_m / 2.0 * outward.max(0.0));
    let share = bent(it, ends, &at, 1.5, phi, spread, &line) * dulled(it, rim.roughness_m);
    let free = (rim.axis + out).normalize();
    Some(Bounce { kind: EchoKind::Edge, body: rim.body, way_m: at.way_m, share, place: before(&at.place, &free) })
}

/// The mantle of a cylinder: a wall that curves away, √(Rc/(Rc + r)) of it there and back.
fn rod(it: &Transducer, ends: &Ends, rod: &Rod) -> Option<Bounce> {
    let at = on_line(ends, &rod.from, &rod.along, rod.length)?;
    let level = |p: &V3| (p - rod.from) - rod.along * (p - rod.from).dot(&rod.along);
    let [a, b] = [level(&ends.from.at), level(&ends.to.at)];
    if a.norm() <= rod.radius || b.norm() <= rod.radius {
        return None;
    }
    let out = towards(&a, &b, rod.radius);
    let place = at.place + out * rod.radius;
    let views = ends.views(&place);
    let cos = -views[0].to.dot(&out);
    if cos <= 0.0 || ends.lost(it, &views, views[0].way_m + views[1].way_m, 1.0) {
        return None;
    }
    let [s, t] = views.map(|view| view.way_m);
    // 1/ρ = 1/s + 2/(Rc·cosθ) around, 1/s along (Balanis 13-24 and 13-25, for a plane through the axis' normal).
    let around = 1.0 / (1.0 / s + 2.0 / (rod.radius * cos));
    let spread = around / (around + t) * s / (s + t);
    let r = (s + t) / 2.0;
    let (perp, along) = (Bend::mirror(r, rod.radius), Bend::mirror(r, f64::INFINITY));
    let beam = beam(it, ends, &views, &rod.along, perp, along);
    let share = beam * at.left(it) * (2.0 / s * spread.sqrt() * it.mirrored(rod.roughness_m, cos));
    Some(Bounce { kind: EchoKind::Cylinder, body: rod.body, way_m: s + t, share, place: before(&place, &out) })
}

/// A ball: a wall that curves away both ways, Rc/(Rc + r) of it there and back.
fn ball(it: &Transducer, ends: &Ends, ball: &Ball) -> Option<Bounce> {
    let [a, b] = [ends.from.at - ball.centre, ends.to.at - ball.centre];
    if a.norm() <= ball.radius || b.norm() <= ball.radius {
        return None;
    }
    let out = towards(&a, &b, ball.radius);
    let place = ball.centre + out * ball.radius;
    let views = ends.views(&place);
    let cos = -views[0].to.dot(&out);
    if cos <= 0.0 || ends.lost(it, &views, views[0].way_m + views[1].way_m, 1.0) {
        return None;
    }
    let [s, t] = views.map(|view| view.way_m);
    let bow = [2.0 / (ball.radius * cos), 2.0 * cos / ball.radius].map(|bow| 1.0 / (1.0 / s + bow));
    let spread: f64 = bow.iter().map(|rho| rho / (rho + t)).product();
    let bend = Bend::mirror((s + t) / 2.0, ball.radius);
    let beam = beam(it, ends, &views, &V3::zeros(), bend, bend);
    let share = beam * (2.0 / s * spread.sqrt() * it.mirrored(ball.roughness_m, cos));
    Some(Bounce { kind: EchoKind::Sphere, body: ball.body, way_m: s + t, share, place: before(&place, &out) })
}

/// The direction from the middle of a round body to where it mirrors a to b: that halves the angle between both ways.
fn towards(a: &V3, b: &V3, radius: f64) -> V3 {
    let mut out = (a.normalize() + b.normalize()).try_normalize(1e-9).unwrap_or_else(|| a.normalize());
    if a != b {
        for _ in 0..8 {
            let at = out * radius;
            let halved = (a - at).normalize() + (b - at).normalize();
            out = (out + halved.try_normalize(1e-9).unwrap_or(out)).normalize();
        }
    }
    out
}

/// Two faces that enclose an angle: one image source for each order of both bounces. Where both ways by the corner's line
/// are the same (a right angle, seen from one place), they are two halves of one echo.
fn corner(it: &Transducer, ends: &Ends, c: &Corner) -> [Option<Bounce>; 2] {
    let Some(at) = on_line(ends, &c.from, &c.along, c.length) else { return [None, None] };
    let [first, second] = [[0, 1], [1, 0]].map(|order| twice(it, ends, c, order, &at));
    match (first, second) {
        (Some(a), Some(b)) if (a.way_m - b.way_m).abs() < 1e-4 => {
            [Some(Bounce { share: a.share + b.share, ..a }), None]
        }
        both => both.into(),
    }
}

fn twice(it: &Transducer, ends: &Ends, c: &Corner, order: [usize; 2], at: &OnLine) -> Option<Bounce> {
    let (near_to, way_m, inside) = turned(c, order, &ends.from.at, &ends.to.at)?;
    let (near_from, ..) = turned(c, [order[1], order[0]], &ends.to.at, &ends.from.at)?;
    let along = at.place - c.from;
    let lift = |near: V3| near + c.along * along.dot(&c.along);
    let views = [ends.from.view(&lift(near_from)), ends.to.view(&lift(near_to))];
    if ends.lost(it, &views, way_m + at.beyond_m, 1.0) {
        return None;
    }
    // The faces go on so far, seen from the transducer.
    let sight = (ends.from.at + ends.to.at) / 2.0 - at.place;
    let flat = (sight - c.along * sight.dot(&c.along)).try_normalize(1e-9)?;
    let wide = [0, 1].map(|i| c.reach[i].min(1e3) * (1.0 - flat.dot(&c.into[i]).powi(2)).max(0.0).sqrt());
    let wide = wide[0].min(wide[1]);
    let q = 4.0 / way_m;
    let zero = (-inside).max(0.0) + (wide - inside).min(0.0);
    let part = between(it.wave_number, q, -inside, wide - inside, zero);
    // Beyond the ends of a face the way is by its border, and longer.
    let way_m = way_m + zero * zero * q / 2.0 + at.beyond_m;
    let r = way_m / 2.0;
    let beam = beam(it, ends, &views, &c.along, Bend::corner(r), Bend::mirror(r, f64::INFINITY));
    let mirrored: f64 = (0..2).map(|i| it.mirrored(c.roughness_m[i], c.normals[i].dot(&flat).abs())).product();
    let free = (c.into[0] + c.into[1]).normalize();
    let share = beam * (at.left(it) * part) * (2.0 / way_m * mirrored);
    Some(Bounce { kind: EchoKind::Corner, body: c.body, way_m, share, place: before(&at.place, &free) })
}

/// The image of `source` in the first and then the second face, seen from `receiver`: the place of the straight way to it
/// that is nearest to the line (from the line's start, across it), the length of the way, and how far within the angle that
/// way is seen (negative: it misses the second face).
fn turned(c: &Corner, order: [usize; 2], source: &V3, receiver: &V3) -> Option<(V3, f64, f64)> {
    let mirror = |p: V3, normal: &V3| p - normal * (2.0 * normal.dot(&p));
    let image = mirror(mirror(source - c.from, &c.normals[order[0]]), &c.normals[order[1]]);
    let here = receiver - c.from;
    let (height, depth) = (c.normals[order[1]].dot(&here), c.normals[order[1]].dot(&image));
    if height <= 0.0 || depth >= 0.0 {
        return None; // the last bounce is off the second face's front
    }
    let way = here - image;
    let way_m = way.norm();
    let bounce = image + way * (-depth / (height - depth));
    let within = bounce.dot(&c.into[order[1]]);
    let flat = |p: V3| p - c.along * p.dot(&c.along);
    let (a, b) = (flat(image), flat(here));
    let run = b - a;
    let near = a - run * (a.dot(&run) / run.norm_squared().max(1e-12));
    Some((c.from + near, way_m, near.norm().copysign(within)))
}
