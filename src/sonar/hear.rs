//! From a world to the echoes that one transducer hears of another's ping (or of its own): straight, and by one mirror.

use super::diffuse::Footprint;
use super::face::{Face, V3};
use super::feature::Feature;
use super::need::Need;
use super::reflect::{Bounce, Ends, bounces};
use super::sight::{Aim, End};
use super::targets::Targets;
use super::transducer::Transducer;

/// Smaller faces are no mirrors on the way to others [m], nor are those that mirror less.
const MIRROR_M: f64 = 0.1;
const MIRROR_SHARE: f64 = 0.1;
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
}

impl<'a> Search<'a> {
    /// All echoes of a ping by `from` that `to` hears, in the order of their ways.
    pub fn echoes(&self, from: &Aim, to: &Aim) -> Vec<Heard> {
        let mut out = Vec::new();
        let (a, b) = (End::straight(from), End::straight(to));
        let same = from == to;
        let direct = Ends { from: &a, to: &b, same, need: self.need };
        let mut mirrors: Vec<&'a Face> = Vec::new();
        self.visit(&direct, |feature| {
            self.try_feature(&direct, feature, 1.0, 1, &mut out);
            if let Feature::Face(face) = feature {
                if same {
                    self.rough(&a, face, &mut out);
                }
                if self.order > 1 && self.is_mirror(face, &direct) {
                    mirrors.push(face);
                }
            }
        });
        mirrors.sort_unstable_by_key(|face| face.id);
        for mirror in mirrors {
            self.by_mirror(&direct, mirror, &mut out);
        }
        out.sort_by(|x, y| {
            let key = |h: &Heard| (h.bounce.kind, h.bounce.body, h.surfaces);
            x.bounce.way_m.total_cmp(&y.bounce.way_m).then_with(|| key(x).cmp(&key(y)))
        });
        out
    }

    /// What the transducers hear by one mirror: there, back, or both.
    fn by_mirror(&self, direct: &Ends<'a>, mirror: &'a Face, out: &mut Vec<Heard>) {
        let (a, b) = (direct.from.mirrored(mirror), direct.to.mirrored(mirror));
        let ways = [
            (Ends { from: &a, to: direct.to, same: false, need: self.need }, 2),
            (Ends { from: direct.from, to: &b, same: false, need: self.need }, 2),
            (Ends { from: &a, to: &b, same: direct.same, need: self.need }, 3),
        ];
        for (index, (ends, surfaces)) in ways.into_iter().enumerate() {
            // One transducer hears the way there and the same way back at once.
            let gain = match (direct.same, index) {
                (true, 0) => 2.0,
                (true, 1) => continue,
                _ => 1.0,
            };
            self.visit(&ends, |feature| {
                let itself = match feature {
                    Feature::Face(face) => {
                        // What two faces of one corner send, the corner has already.
                        face.id == mirror.id || surfaces == 2 && self.targets.is_corner(face.id, mirror.id)
                    }
                    Feature::Corner(c) => c.faces.contains(&mirror.id),
                    Feature::Edge(e) => {
                        let far = e.from + e.along * e.length;
                        [e.from, far].iter().all(|end| mirror.height(end).abs() < IN_MIRROR_M)
                    }
                    Feature::Rod(_) | Feature::Ball(_) | Feature::Rim(_) => false,
                };
                if !itself {
                    self.try_feature(&ends, feature, gain, surfaces, out);
                }
            });
        }
    }

    fn is_mirror(&self, face: &Face, ends: &Ends) -> bool {
        let (h, g) = (face.height(&ends.from.at), face.height(&ends.to.at));
        let before = if face.two_sided { h * g > 0.0 } else { h > 0.0 && g > 0.0 };
        before && face.reach > MIRROR_M && self.it.mirrored(face.roughness_m, 1.0) > MIRROR_SHARE
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
        let mut least_m = 0.0;
        let mut most_m = 0.0;
        let mut gain = 1.0;
        for end in [ends.from, ends.to] {
            let nearest = (low - end.at).sup(&(end.at - high)).sup(&V3::zeros()).norm();
            let way = middle - end.at;
            let far = way.norm();
            least_m += nearest;
            most_m += far + ball;
            if far > ball {
                // The least angle off the axis of anything in the ball around the box.
                let off = (way.dot(&end.axis) / far).clamp(-1.0, 1.0).acos() - (ball / far).asin();
                if off >= std::f64::consts::FRAC_PI_2 {
                    return false;
                }
                gain *= self.it.piston.most(off.max(0.0).sin());
            }
        }
        let fill = if ends.same { self.it.piston.fill(least_m.max(0.02) / 2.0) } else { 0.0 };
        least_m < self.need.way_m_max && (gain + fill) * 2.0 / least_m.max(1e-3) >= self.need.least(most_m)
    }

    fn try_feature(&self, ends: &Ends, feature: &Feature, gain: f64, surfaces: u8, out: &mut Vec<Heard>) {
        for mut bounce in bounces(self.it, ends, feature).into_iter().flatten() {
            bounce.share = bounce.share * (gain * self.mirror_loss(ends, &bounce));
            if bounce.share.total().norm() >= self.need.at(bounce.way_m)
                && ends.from.sees(self.targets, &bounce.place)
                && (ends.same || ends.to.sees(self.targets, &bounce.place))
            {
                let surfaces = surfaces + u8::from(matches!(feature, Feature::Corner(_)));
                out.push(Heard { bounce, surfaces });
            }
        }
    }

    /// What rough mirrors on the way leave.
    fn mirror_loss(&self, ends: &Ends, bounce: &Bounce) -> f64 {
        let loss = |end: &End| {
            end.mirror
                .map_or(1.0, |face| self.it.mirrored(face.roughness_m, end.mirror_cos(&end.view(&bounce.place).to)))
        };
        loss(ends.from) * loss(ends.to)
    }

    fn rough(&self, end: &End, face: &Face, out: &mut Vec<Heard>) {
        if face.roughness_m <= 0.0 {
            return;
        }
        for bounce in self.footprint.layers(self.it, end, face) {
            if bounce.share.total().norm() >= self.need.at(bounce.way_m) && end.sees(self.targets, &bounce.place) {
                out.push(Heard { bounce, surfaces: 1 });
            }
        }
    }
}
