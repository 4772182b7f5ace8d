//! From a world to the echoes that one transducer hears of another's ping (or of its own): straight, and by one mirror.

use super::diffuse::Footprint;
use super::face::{Face, V3};
use super::feature::Feature;
use super::need::Need;
use super::reflect::{Bounce, Ends, bounces, wall};
use super::sight::{Aim, End};
use super::targets::Targets;
use super::transducer::Transducer;

/// Smaller faces are no mirrors on the way to others [m], nor are those that mirror less.
const MIRROR_M: f64 = 0.1;
const MIRROR_SHARE: f64 = 0.1;
/// The largest mirrors, as seen, are enough: a mesh has thousands of faces.
const MIRRORS_MAX: usize = 128;
/// What lies nearer to a mirror is seen in it where it is seen anyway [m].
const IN_MIRROR_M: f64 = 0.01;

/// An echo, without air.
#[derive(Clone, Copy, Debug)]
pub(super) struct Heard {
    pub bounce: Bounce,
    /// How many surfaces the sound met.
    pub surfaces: u8,
}

/// One search for echoes.
pub(super) struct Search<'a> {
    pub it: &'a Transducer,
    pub footprint: &'a Footprint,
    pub targets: &'a Targets,
    pub need: &'a Need,
    /// Bounces of the longest ways: 1 or 2.
    pub order: u8,
    /// How many times what a straight echo needs one by a mirror needs: weak ones are not added up.
    pub ghost_times: f64,
}

/// A mirror, and the most that either beam leaves of anything in it.
struct Mirror<'a> {
    face: &'a Face,
    most: [f64; 2],
}

impl<'a> Search<'a> {
    /// All echoes of a ping by `from` that `to` hears, in the order of their ways.
    pub fn echoes(&self, from: &Aim, to: &Aim) -> Vec<Heard> {
        let mut out = Vec::new();
        let (a, b) = (End::straight(from), End::straight(to));
        let same = from == to;
        let direct = Ends { from: &a, to: &b, same, need: self.need, times: 1.0 };
        self.visit(&direct, |feature| {
            self.try_feature(&direct, feature, 1.0, 1, &mut out);
            if same {
                self.rough(&a, feature, &mut out);
            }
        });
        if self.order > 1 {
            self.by_mirrors(&direct, &mut out);
        }
        out.sort_by(|x, y| {
            let key = |h: &Heard| (h.bounce.kind, h.bounce.body, h.surfaces);
            x.bounce.way_m.total_cmp(&y.bounce.way_m).then_with(|| key(x).cmp(&key(y)))
        });
        out
    }

    /// What is heard by one mirror. What is heard there straight and back by the mirror comes after the straight echo of the
    /// same thing, so of such ways only those by strong things are looked for: faces, which may not be heard straight, and
    /// corners.
    fn by_mirrors(&self, direct: &Ends<'a>, out: &mut Vec<Heard>) {
        let mirrors = self.mirrors(direct);
        // A pair of beams that leaves less than this leaves no wall at all to be heard.
        let (need, times) = (self.need, self.ghost_times);
        let least = need.ratio_min() * times;
        for mirror in &mirrors {
            let (a, b) = (direct.from.mirrored(mirror.face), direct.to.mirrored(mirror.face));
            let there = Ends { from: &a, to: direct.to, same: false, need, times };
            for other in mirrors.iter().filter(|other| mirror.most[0] * other.most[1] >= least) {
                self.two_mirrors(&there, mirror.face, other.face, out);
            }
            if mirror.most[0] * mirror.most[1] < least {
                continue;
            }
            let back = Ends { from: direct.from, to: &b, same: false, need, times };
            let both = Ends { from: &a, to: &b, same: direct.same, need, times };
            self.visit(&both, |feature| {
                if seen_anyway(mirror.face, feature) {
                    return;
                }
                self.try_feature(&both, feature, 1.0, 3, out);
                if let Feature::Corner(_) = feature {
                    // One transducer hears the way there and the same way back at once.
                    self.try_feature(&there, feature, if direct.same { 2.0 } else { 1.0 }, 2, out);
                    if !direct.same {
                        self.try_feature(&back, feature, 1.0, 2, out);
                    }
                }
            });
        }
    }

    /// The faces that mirror what either end sends.
    fn mirrors(&self, direct: &Ends<'a>) -> Vec<Mirror<'a>> {
        let mut out = Vec::new();
        let (a, b) = (direct.from, direct.to);
        let near = |low: &V3, high: &V3| {
            let away = |end: &End| (low - end.at).sup(&(end.at - high)).sup(&V3::zeros()).norm();
            away(a) + away(b) < self.need.way_m_max
        };
        for group in self.targets.groups() {
            group.find(near, |feature| {
                let Feature::Face(face) = feature else { return };
                let (h, g) = (face.height(&a.at), face.height(&b.at));
                let before = if face.two_sided { h * g > 0.0 } else { h > 0.0 && g > 0.0 };
                if before && face.reach > MIRROR_M && self.it.mirrored(face.roughness_m, 1.0) > MIRROR_SHARE {
                    let most = [a, b].map(|end| self.most_in(end, &face.centre, face.reach));
                    out.push(Mirror { face, most });
                }
            });
        }
        let seen = |mirror: &Mirror| mirror.face.reach / (mirror.face.centre - a.at).norm().max(1e-3);
        out.sort_by(|x, y| seen(y).total_cmp(&seen(x)).then(x.face.id.cmp(&y.face.id)));
        out.truncate(MIRRORS_MAX);
        out.sort_unstable_by_key(|mirror| mirror.face.id);
        out
    }

    /// The way by one face and then another: a first look that costs little, since there are many pairs.
    fn two_mirrors(&self, there: &Ends<'a>, first: &'a Face, second: &'a Face, out: &mut Vec<Heard>) {
        if first.id == second.id {
            return;
        }
        let image = second.mirror(&there.from.at);
        let way = image - there.to.at;
        let way_m = way.norm();
        let cos = way.dot(&there.to.axis) / way_m;
        if cos <= 0.0 || way_m >= self.need.way_m_max {
            return;
        }
        // The way leaves towards the receiver's image in the second and then the first face.
        let leaving = there.from.at - second.mirror(&there.to.at);
        let other = -leaving.dot(&there.from.axis) / way_m;
        let sin = |cos: f64| (1.0 - cos * cos).max(0.0).sqrt();
        let most = self.it.piston.most(sin(cos)) * self.it.piston.most(sin(other));
        if other > 0.0 && most * 2.0 / way_m >= self.need.at(way_m) && !self.targets.is_corner(first.id, second.id) {
            // The same way backwards is another pair of mirrors.
            if let Some(bounce) = wall(self.it, there, second) {
                self.keep(there, bounce, 1.0, 2, out);
            }
        }
    }

    /// Calls `look` for each feature that both ends may hear of.
    fn visit(&self, ends: &Ends, mut look: impl FnMut(&'a Feature)) {
        let near = |low: &V3, high: &V3| self.within(ends, low, high);
        for group in self.targets.groups() {
            group.find(near, &mut look);
        }
    }

    /// Whether anything in a box may be heard.
    fn within(&self, ends: &Ends, low: &V3, high: &V3) -> bool {
        let (middle, ball) = ((low + high) / 2.0, (high - low).norm() / 2.0);
        if ends.same && !framed(ends.from, &middle, ball) {
            return false;
        }
        let away = |end: &End| (low - end.at).sup(&(end.at - high)).sup(&V3::zeros()).norm();
        let far = |end: &End| (middle - end.at).norm() + ball;
        let (least_m, most_m, gain) = if ends.same {
            let most = self.most_in(ends.from, &middle, ball);
            let least_m = 2.0 * away(ends.from);
            (least_m, 2.0 * far(ends.from), most * most * self.it.piston.near(least_m.max(0.02) / 2.0))
        } else {
            let gain = self.most_in(ends.from, &middle, ball) * self.most_in(ends.to, &middle, ball);
            (away(ends.from) + away(ends.to), far(ends.from) + far(ends.to), gain)
        };
        least_m < self.need.way_m_max && gain * 2.0 >= self.need.least(most_m) * ends.times * least_m
    }

    /// The most that the beam leaves of anything in a ball; 0 behind the baffle.
    fn most_in(&self, end: &End, middle: &V3, radius: f64) -> f64 {
        let way = middle - end.at;
        let square = way.norm_squared();
        if square <= radius * radius {
            return 1.0;
        }
        let far = square.sqrt();
        // The least angle off the axis: that of the middle less that of the ball, by their sines and cosines.
        let (cos, ball) = ((way.dot(&end.axis) / far).clamp(-1.0, 1.0), radius / far);
        let (sin, rest) = ((1.0 - cos * cos).sqrt(), (1.0 - ball * ball).sqrt());
        if cos >= rest {
            return 1.0; // the axis runs through the ball
        }
        if cos * rest + sin * ball <= 0.0 { 0.0 } else { self.it.piston.most(sin * rest - cos * ball) }
    }

    fn try_feature(&self, ends: &Ends, feature: &Feature, gain: f64, surfaces: u8, out: &mut Vec<Heard>) {
        for bounce in bounces(self.it, ends, feature).into_iter().flatten() {
            self.keep(ends, bounce, gain, surfaces + u8::from(matches!(feature, Feature::Corner(_))), out);
        }
    }

    /// Keeps a bounce if it is strong enough, and if nothing stands in its way.
    fn keep(&self, ends: &Ends, mut bounce: Bounce, gain: f64, surfaces: u8, out: &mut Vec<Heard>) {
        bounce.share = bounce.share * (gain * self.mirror_loss(ends, &bounce));
        if bounce.share.total().norm() >= ends.needed(bounce.way_m)
            && ends.from.sees(self.targets, &bounce.place)
            && (ends.same || ends.to.sees(self.targets, &bounce.place))
        {
            out.push(Heard { bounce, surfaces });
        }
    }

    /// What rough mirrors on the way leave.
    fn mirror_loss(&self, ends: &Ends, bounce: &Bounce) -> f64 {
        let loss = |end: &End| {
            let cos = |face: &Face| face.normal.dot(&end.view(&bounce.place).to).abs();
            end.mirror.map_or(1.0, |face| self.it.mirrored(face.roughness_m, cos(face)))
        };
        loss(ends.from) * loss(ends.to)
    }

    fn rough(&self, end: &End, feature: &Feature, out: &mut Vec<Heard>) {
        for bounce in self.footprint.layers(self.it, end, feature) {
            if bounce.share.total().norm() >= self.need.at(bounce.way_m) && end.sees(self.targets, &bounce.place) {
                out.push(Heard { bounce, surfaces: 1 });
            }
        }
    }
}

/// Whether anything in a ball may be seen through the mirror of an end, as through a window.
fn framed(end: &End, middle: &V3, radius: f64) -> bool {
    let Some(face) = end.mirror else { return true };
    // Behind the mirror, where the image of the transducer is, nothing is seen.
    let side = face.height(&end.at);
    if face.height(middle) * side.signum() >= radius {
        return false;
    }
    let (to, frame) = (middle - end.at, face.centre - end.at);
    let (far, away) = (to.norm(), frame.norm());
    if far <= radius || away <= face.reach {
        return true;
    }
    // The angle between both middles against the sum of both half angles, by cosines.
    let (a, b) = (radius / far, face.reach / away);
    let (c, d) = ((1.0 - a * a).sqrt(), (1.0 - b * b).sqrt());
    to.dot(&frame) / (far * away) >= c * d - a * b - 1e-9
}

/// Whether a feature lies in the mirror itself.
fn seen_anyway(mirror: &Face, feature: &Feature) -> bool {
    match feature {
        Feature::Face(face) => face.id == mirror.id,
        Feature::Corner(c) => c.faces.contains(&mirror.id),
        Feature::Edge(e) => {
            let far = e.from + e.along * e.length;
            [e.from, far].iter().all(|end| mirror.height(end).abs() < IN_MIRROR_M)
        }
        Feature::Rod(_) | Feature::Ball(_) | Feature::Rim(_) => false,
    }
}
