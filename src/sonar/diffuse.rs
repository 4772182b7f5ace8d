//! Rough surfaces: what the beam lights of them comes back from everywhere, weak and spread over time.
//!
//! A surface patch dA at distance r under the angle ψ takes B²·cosψ·dA/r² of the power and sends s·(n+7)/8π·cosⁿψ of it
//! back into each steradian, of which the transducer takes B²/r²: with dA = r²·dΩ/cosψ this is B⁴·s·(n+7)/8π·cosⁿψ·dΩ/r².
//! (n+7)/8π is Lambert's 1/π for n = 1, and n/8π for a narrow lobe: that of facets, which turn sound by twice their tilt.
//! Patches whose ways differ by more than half a ping do not overlap: each such layer is an echo of its own.

use super::beam::Share;
use super::face::{Face, V3};
use super::reflect::{Bounce, EchoKind};
use super::sight::{End, before};
use super::transducer::Transducer;

/// Rings and spokes of the footprint.
const RINGS: usize = 12;
const SPOKES: usize = 24;

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
        let (step, turn) = (edge / RINGS as f64, std::f64::consts::TAU / SPOKES as f64);
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

    /// The layers of echo from a rough face.
    pub fn layers(&self, it: &Transducer, end: &End, face: &Face) -> Vec<Bounce> {
        let scattered = it.scattered(face.roughness_m);
        let height = face.height(&end.at);
        let side = if face.two_sided { height.signum() } else { 1.0 };
        if scattered < 1e-4 || height * side <= 0.0 || !self.lights(end, &face.centre, face.reach) {
            return Vec::new();
        }
        let n = it.spread(face.roughness_m);
        let scale = scattered * (n + 7.0) / (8.0 * std::f64::consts::PI);
        let right = end.axis.cross(&V3::z()).try_normalize(1e-6).unwrap_or_else(V3::x);
        let up = right.cross(&end.axis);
        let layer_m = it.params.cycles / it.params.frequency_hz * it.sound_m_s / 2.0;
        // Layer, power, and its strongest place.
        let mut layers: Vec<(i64, f64, f64, V3)> = Vec::new();
        for (ray, share) in &self.rays {
            let way = right * ray.x + up * ray.y + end.axis * ray.z;
            let cos = -way.dot(&face.normal) * side;
            let r = height * side / cos;
            let place = end.at + way * r;
            if cos <= 1e-3 || r > 2.0 * it.params.range_m_max || !face.holds(&place) {
                continue;
            }
            let power = share * scale * cos.powf(n) / (r * r);
            let key = (r / layer_m).floor() as i64;
            match layers.iter_mut().find(|layer| layer.0 == key) {
                Some((_, sum, most, at)) => {
                    *sum += power;
                    if power > *most {
                        (*most, *at) = (power, place);
                    }
                }
                None => layers.push((key, power, power, place)),
            }
        }
        let echo = |(_, power, _, place): (i64, f64, f64, V3)| Bounce {
            kind: EchoKind::Rough,
            body: face.body,
            way_m: 2.0 * (place - end.at).norm(),
            // A wave that comes straight from r has 2/r, so power 1/r² counts four times.
            share: Share::whole((4.0 * power).sqrt()),
            place: before(&place, &(face.normal * side)),
        };
        layers.into_iter().map(echo).collect()
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
        Footprint::new(&it).layers(&it, &End::straight(&aim), &wall)
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
        let expected = 4.0 * std::f64::consts::TAU * integral / (ka * ka) / std::f64::consts::PI / 4.0;
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
}
