//! Rough surfaces: what the beam lights of them comes back from everywhere, weak and spread over time.
//!
//! A surface patch dA at distance r under the angle ψ takes B²·cosψ·dA/r² of the power and sends s·(n+7)/8π·cosⁿψ of it
//! back into each steradian, of which the transducer takes B²/r²: with dA = r²·dΩ/cosψ this is B⁴·s·(n+7)/8π·cosⁿψ·dΩ/r².
//! (n+7)/8π is Lambert's 1/π for n = 1, and n/8π for a narrow lobe: that of facets, which turn sound by twice their tilt.
//! Patches whose ways differ by more than half a ping do not overlap: each such layer is an echo of its own.
//! Faces are met by rays from the transducer; the round bodies, which may be thin, are cut into patches of their own.

use std::f64::consts::PI;

use super::beam::Share;
use super::face::{Face, V3};
use super::feature::{Ball, Feature, Rod};
use super::reflect::{Bounce, EchoKind};
use super::sight::{End, before};
use super::transducer::Transducer;

/// Rings and spokes of the footprint.
const RINGS: usize = 12;
const SPOKES: usize = 24;
/// Patches around the half of a rod that is seen, and from the top of a ball that is seen to its edge and around.
const AROUND_ROD: usize = 12;
const RINGS_OF_BALL: usize = 8;
const SPOKES_OF_BALL: usize = 12;
/// Most pieces of a rod's length.
const PIECES_MAX: f64 = 500.0;
/// Surfaces that are met more askew than this scatter nothing.
const COS_MIN: f64 = 1e-3;
/// Least scattered share of the power that is looked at.
const SCATTERED_MIN: f64 = 1e-4;

/// The main lobe as rays, each with its share B⁴·dΩ.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    /// Directions in the beam's own frame (z is its axis).
    rays: Vec<(V3, f64)>,
    /// Half the angle of the cone that holds them: cosine and sine.
    cone: (f64, f64),
}

impl Footprint {
    pub fn new(it: &Transducer) -> Self {
        // The first null, or all of the front if there is none.
        let edge = (3.8317 / (it.wave_number * it.params.radius_m)).min(1.0).asin();
        let (step, turn) = (edge / RINGS as f64, 2.0 * PI / SPOKES as f64);
        let mut rays = Vec::with_capacity(RINGS * SPOKES);
        for ring in 0..RINGS {
            let (sin, cos) = ((ring as f64 + 0.5) * step).sin_cos();
            let share = it.piston.far(sin, cos).powi(4) * sin * step * turn;
            for spoke in 0..SPOKES {
                // Each ring is turned a little, so that no direction is favoured.
                let (y, x) = ((spoke as f64 + ring as f64 * 0.382) * turn).sin_cos();
                rays.push((V3::new(sin * x, sin * y, cos), share));
            }
        }
        Self { rays, cone: (edge.cos(), edge.sin()) }
    }

    /// Whether the main lobe meets a ball.
    fn lights(&self, end: &End, middle: &V3, radius: f64) -> bool {
        let view = end.view(middle);
        if view.way_m <= radius {
            return true;
        }
        let ball = radius / view.way_m;
        let (cos, sin) = self.cone;
        // The angle off the axis against the sum of both half angles, by cosines.
        view.cos >= cos * (1.0 - ball * ball).sqrt() - sin * ball - 1e-9
    }

    /// The layers of echo from a rough face, rod or ball.
    pub fn layers(&self, it: &Transducer, end: &End, feature: &Feature) -> Vec<Bounce> {
        let (body, roughness_m, middle, reach) = match feature {
            Feature::Face(f) => (f.body, f.roughness_m, f.centre, f.reach),
            Feature::Rod(r) => {
                (r.body, r.roughness_m, r.from + r.along * (r.length / 2.0), r.radius.hypot(r.length / 2.0))
            }
            Feature::Ball(b) => (b.body, b.roughness_m, b.centre, b.radius),
            Feature::Edge(_) | Feature::Corner(_) | Feature::Rim(_) => return Vec::new(),
        };
        let scattered = it.scattered(roughness_m);
        if scattered < SCATTERED_MIN || !self.lights(end, &middle, reach) {
            return Vec::new();
        }
        let n = it.spread(roughness_m);
        let mut layers = Layers {
            scale: scattered * (n + 7.0) / (8.0 * PI),
            n,
            layer_m: it.params.cycles / it.params.frequency_hz * it.sound_m_s / 2.0,
            far_m: 2.0 * it.params.range_m_max,
            found: Vec::new(),
        };
        match feature {
            Feature::Face(face) => self.of_face(end, face, &mut layers),
            Feature::Rod(rod) => self.of_rod(it, end, rod, &mut layers),
            Feature::Ball(ball) => self.of_ball(it, end, ball, &mut layers),
            Feature::Edge(_) | Feature::Corner(_) | Feature::Rim(_) => {}
        }
        layers.found.iter().map(|layer| layer.bounce(body, end)).collect()
    }

    fn of_face(&self, end: &End, face: &Face, layers: &mut Layers) {
        let height = face.height(&end.at);
        let side = if face.two_sided { height.signum() } else { 1.0 };
        if height * side <= 0.0 {
            return;
        }
        let right = end.axis.cross(&V3::z()).try_normalize(1e-6).unwrap_or_else(V3::x);
        let up = right.cross(&end.axis);
        for (ray, share) in &self.rays {
            let way = right * ray.x + up * ray.y + end.axis * ray.z;
            let cos = -way.dot(&face.normal) * side;
            let r = height * side / cos;
            let place = end.at + way * r;
            if cos > COS_MIN && r <= layers.far_m && face.holds(&place) {
                layers.add(r, cos, *share, place, face.normal * side);
            }
        }
    }

    /// The mantle, in patches about as long as a layer is deep.
    fn of_rod(&self, it: &Transducer, end: &End, rod: &Rod, layers: &mut Layers) {
        let off = end.at - rod.from;
        let foot = off.dot(&rod.along);
        let Some(out) = (off - rod.along * foot).try_normalize(rod.radius) else { return };
        let across = rod.along.cross(&out);
        let pieces = (rod.length / layers.layer_m).ceil().clamp(1.0, PIECES_MAX);
        let (step, turn) = (rod.length / pieces, PI / AROUND_ROD as f64);
        for piece in 0..pieces as usize {
            let at = rod.from + rod.along * ((piece as f64 + 0.5) * step);
            for slice in 0..AROUND_ROD {
                let (sin, cos) = ((slice as f64 + 0.5) * turn - PI / 2.0).sin_cos();
                let normal = out * cos + across * sin;
                self.patch(it, end, at + normal * rod.radius, normal, rod.radius * turn * step, layers);
            }
        }
    }

    /// The half that is seen, in patches of one size: zones of a ball are as large as they are high.
    fn of_ball(&self, it: &Transducer, end: &End, ball: &Ball, layers: &mut Layers) {
        let Some(out) = (end.at - ball.centre).try_normalize(ball.radius) else { return };
        let right = out.cross(&V3::z()).try_normalize(1e-6).unwrap_or_else(V3::x);
        let up = right.cross(&out);
        let area = 2.0 * PI * ball.radius * ball.radius / (RINGS_OF_BALL * SPOKES_OF_BALL) as f64;
        for ring in 0..RINGS_OF_BALL {
            let cos = (ring as f64 + 0.5) / RINGS_OF_BALL as f64;
            let sin = (1.0 - cos * cos).sqrt();
            for spoke in 0..SPOKES_OF_BALL {
                let (y, x) = (spoke as f64 * 2.0 * PI / SPOKES_OF_BALL as f64).sin_cos();
                let normal = out * cos + (right * x + up * y) * sin;
                self.patch(it, end, ball.centre + normal * ball.radius, normal, area, layers);
            }
        }
    }

    /// A small patch, if the main lobe meets it from its free side.
    fn patch(&self, it: &Transducer, end: &End, place: V3, normal: V3, area: f64, layers: &mut Layers) {
        let view = end.view(&place);
        let cos = -view.to.dot(&normal);
        if cos > COS_MIN && view.cos >= self.cone.0 && view.way_m <= layers.far_m {
            let solid = area * cos / (view.way_m * view.way_m);
            layers.add(view.way_m, cos, it.piston.far(view.sin, view.cos).powi(4) * solid, place, normal);
        }
    }
}

/// What comes back in the time of half a ping.
struct Layer {
    key: i64,
    power: f64,
    /// The power of the strongest patch, where it is, and which way it faces.
    most: f64,
    place: V3,
    free: V3,
}

impl Layer {
    fn bounce(&self, body: u32, end: &End) -> Bounce {
        Bounce {
            kind: EchoKind::Rough,
            body,
            way_m: 2.0 * (self.place - end.at).norm(),
            // A wave that comes straight from r has 2/r, so power 1/r² counts four times.
            share: Share::whole((4.0 * self.power).sqrt()),
            place: before(&self.place, &self.free),
        }
    }
}

/// The echo of a rough surface as it is added up.
struct Layers {
    /// s·(n+7)/8π, and n.
    scale: f64,
    n: f64,
    /// How deep a layer is, and where hearing ends [m].
    layer_m: f64,
    far_m: f64,
    found: Vec<Layer>,
}

impl Layers {
    /// Adds a patch at a distance [m] that is seen under an angle of this cosine, and holds this share B⁴·dΩ of the beam.
    fn add(&mut self, r: f64, cos: f64, share: f64, place: V3, free: V3) {
        let power = share * self.scale * cos.powf(self.n) / (r * r);
        let key = (r / self.layer_m).floor() as i64;
        match self.found.iter_mut().find(|layer| layer.key == key) {
            Some(layer) => {
                layer.power += power;
                if power > layer.most {
                    (layer.most, layer.place, layer.free) = (power, place, free);
                }
            }
            None => self.found.push(Layer { key, power, most: power, place, free }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point;
    use crate::sonar::face::Extent;
    use crate::sonar::sight::Aim;
    use crate::sonar::{Air, TransducerParams};

    fn layers(deg: f64, roughness_m: f64) -> Vec<Bounce> {
        let it = Transducer::new(TransducerParams::default(), &Air::default()).unwrap();
        let (sin, cos) = deg.to_radians().sin_cos();
        let aim = Aim { at: Point::new(0.0, 0.0, 0.0), axis: V3::new(cos, sin, 0.0) };
        let wall = Face::new(0, -V3::x(), V3::new(2.0, 0.0, 0.0), Extent::Endless, roughness_m);
        Footprint::new(&it).layers(&it, &End::straight(&aim), &Feature::Face(wall))
    }

    fn power(layers: &[Bounce]) -> f64 {
        layers.iter().map(|l| l.share.total().norm_sqr()).sum()
    }

    #[test]
    fn a_rough_wall_sends_as_much_as_its_integral() {
        // Head on, Lambert, all scattered: 4·Ω/π/r², Ω = ∫B⁴dΩ. ∫(2J1(u)/u)⁴·u·du = 0.9212 over the main lobe (Simpson).
        let steps = 2000;
        let u = |i: usize| 3.8317 * i as f64 / steps as f64;
        let f = |u: f64| if u == 0.0 { 0.0 } else { (2.0 * super::super::special::bessel(1, u) / u).powi(4) * u };
        let simpson: f64 = (0..steps / 2).map(|i| f(u(2 * i)) + 4.0 * f(u(2 * i + 1)) + f(u(2 * i + 2))).sum::<f64>();
        let integral = simpson * 3.8317 / steps as f64 / 3.0;
        let ka = std::f64::consts::TAU * 49.4e3 / 343.29 * 0.0192;
        let expected = 8.0 * PI * integral / (ka * ka) / PI / 4.0;
        let found = power(&layers(0.0, 0.2));
        assert!((found / expected - 1.0).abs() < 0.02, "{found} {expected}");
    }

    #[test]
    fn an_oblique_rough_wall_is_spread_in_range_and_a_smooth_one_is_silent() {
        let (square, oblique) = (layers(0.0, 0.1), layers(40.0, 0.1));
        assert!(square.len() <= 3 && oblique.len() >= 4, "{} {}", square.len(), oblique.len());
        assert!(power(&oblique) < power(&square));
        // Gentle roughness is heard near the normal and not askew, where the wall has −38 dB and less.
        assert!(layers(40.0, 0.0).is_empty());
        assert!(10.0 * (power(&layers(40.0, 2e-4)) * 4.0).log10() < -60.0);
    }

    /// The echo of a rough body, by rays all over the main lobe that meet it by their own equation: another sum than the
    /// patches', B⁴·s·(n+7)/8π·cosⁿψ·dΩ/r².
    fn by_rays(roughness_m: f64, meets: impl Fn(&V3) -> Option<(f64, f64)>) -> f64 {
        let it = Transducer::new(TransducerParams::default(), &Air::default()).unwrap();
        let n = it.spread(roughness_m);
        let scale = it.scattered(roughness_m) * (n + 7.0) / (8.0 * PI);
        let (edge, steps) = (12.8_f64.to_radians(), 800);
        let step = 2.0 * edge / f64::from(steps);
        let mut power = 0.0;
        for i in 0..steps {
            for j in 0..steps {
                let [y, z] = [i, j].map(|k| ((f64::from(k) + 0.5) * step - edge).tan());
                let way = V3::new(1.0, y, z).normalize();
                let (cos, sin) = (way.x, way.x.acos().sin());
                if let Some((r, facing)) = meets(&way).filter(|_| cos >= edge.cos()) {
                    // dΩ of a step of both angles: dy·dz·cos³, dy = dα/cos²α.
                    let solid = step * step * (1.0 + y * y) * (1.0 + z * z) * cos.powi(3);
                    power += it.piston.far(sin, cos).powi(4) * solid * scale * facing.powf(n) / (r * r);
                }
            }
        }
        4.0 * power
    }

    fn of_body(feature: &Feature) -> f64 {
        let it = Transducer::new(TransducerParams::default(), &Air::default()).unwrap();
        let aim = Aim { at: Point::new(0.0, 0.0, 0.0), axis: V3::x() };
        power(&Footprint::new(&it).layers(&it, &End::straight(&aim), feature))
    }

    #[test]
    fn rough_rods_and_balls_send_what_rays_that_meet_them_send() {
        for (distance, aside, radius) in [(1.5, 0.0, 0.17), (2.0, 0.25, 0.17), (1.0, 0.05, 0.06)] {
            let rod = Rod {
                body: 0,
                from: V3::new(distance, aside, -5.0),
                along: V3::z(),
                length: 10.0,
                radius,
                roughness_m: 4e-3,
            };
            let found = of_body(&Feature::Rod(rod));
            let expected = by_rays(4e-3, |way| {
                let (flat, off) = (way.xy().norm(), way.xy().normalize());
                let middle = nalgebra::Vector2::new(distance, aside);
                let along = off.dot(&middle);
                let inside = radius * radius - (middle.norm_squared() - along * along);
                let r = along - (inside >= 0.0).then(|| inside.sqrt())?;
                Some((r / flat, -((off * r - middle) / radius).dot(&off) * flat))
            });
            assert!((found / expected - 1.0).abs() < 0.05, "rod {distance} {radius}: {found} {expected}");
            let centre = V3::new(distance, aside, 0.0);
            let found = of_body(&Feature::Ball(Ball { body: 0, centre, radius, roughness_m: 4e-3 }));
            let expected = by_rays(4e-3, |way| {
                let along = way.dot(&centre);
                let inside = radius * radius - (centre.norm_squared() - along * along);
                let r = along - (inside >= 0.0).then(|| inside.sqrt())?;
                Some((r, -((way * r - centre) / radius).dot(way)))
            });
            assert!((found / expected - 1.0).abs() < 0.08, "ball {distance} {radius}: {found} {expected}");
        }
    }
}
