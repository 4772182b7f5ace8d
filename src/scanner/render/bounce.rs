//! One specular bounce: the sheet that falls on a flat glossy surface is thrown on others as if it came from the laser's
//! mirror image. The camera sees that line where no surface is: a false one.
//!
//! The mirrored sheet keeps the fan's divergence and thickness over the whole way, and spreads by the material's lobe
//! from the mirror on. Curved surfaces spread it so far that nothing is seen of it: they throw none.

use super::trace::Trace;
use super::{Beam, V3, View};
use crate::geometry::{Plane, Point, World};
use crate::optics::LaserPlane;
use crate::world::{Curve, Cut, Surfaces};

/// Mirrors of one sheet that are followed: those that most of the fan falls on.
const MIRRORS_MAX: usize = 8;
/// A shorter stripe on a mirror throws no line worth the time [m].
const STRIPE_M_MIN: f64 = 0.02;
/// How far off the mirror the thrown line begins, so that it is not thrown on the mirror itself [m].
const OFF_M: f64 = 1e-3;

/// The stripe on a glossy surface, as a mirror.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mirror {
    /// The ends of the stripe.
    ends: [V3; 2],
    /// Unit normal of the surface, towards the laser.
    normal: V3,
    /// The laser itself.
    source: Point<World>,
    /// Its mirror image.
    image: V3,
    spread_rad: f64,
}

impl View<'_> {
    /// The mirror images of the sheet.
    pub fn bounces(&self, trace: &Trace) -> Vec<Beam> {
        if !self.renderer.is_glossy || !self.renderer.params.bounce {
            return Vec::new();
        }
        let mut beams: Vec<(f64, Beam)> = trace.cuts.iter().filter_map(|cut| self.bounce(cut)).collect();
        beams.sort_by(|a, b| b.0.total_cmp(&a.0));
        beams.truncate(MIRRORS_MAX);
        beams.into_iter().map(|(_, beam)| beam).collect()
    }

    /// The mirror image in the surface of one cut, and how much of the fan falls on it.
    fn bounce(&self, cut: &Cut) -> Option<(f64, Beam)> {
        let material = self.renderer.materials.get(cut.body).filter(|material| material.gloss > 0.0)?;
        let Curve::Segment { a, b } = cut.curve else { return None };
        let (outward, sheet) = (cut.normal(0.0), &self.beam.sheet);
        let height = outward.dot(&(sheet.origin.xyz - a));
        let is_flat = outward.dot(&cut.normal(1.0)) > 1.0 - 1e-9;
        if !is_flat || (b - a).norm() < STRIPE_M_MIN || (height <= 0.0 && !cut.two_sided) {
            return None;
        }
        let normal = outward * height.signum();
        let turned = |way: &V3| way - normal * (2.0 * normal.dot(way));
        let image = sheet.origin.xyz - normal * (2.0 * height.abs());
        let plane = Plane::through(Point::from(image), turned(&sheet.plane.normal))?;
        let mirrored = LaserPlane {
            plane,
            origin: image.into(),
            forward: turned(&sheet.forward),
            lateral: turned(&sheet.lateral),
        };
        let angle = (a - sheet.origin.xyz).angle(&(b - sheet.origin.xyz));
        let mirror =
            Mirror { ends: [a, b], normal, source: sheet.origin, image, spread_rad: material.gloss_spread_rad };
        let share = self.beam.share * material.gloss;
        Some((share * angle, Beam { sheet: mirrored, share, thinness: self.beam.thinness, mirror: Some(mirror) }))
    }
}

impl Mirror {
    /// Clips a cut to what the mirror throws light on: in front of it, and between the rays through the stripe's ends.
    pub fn clip(&self, cut: Cut, bound: usize, out: &mut Vec<Cut>) {
        let [a, b] = self.ends.map(|end| end - self.image);
        let across = a.cross(&b);
        let (normal, offset) = match bound {
            0 => (self.normal, self.normal.dot(&self.ends[0]) + OFF_M),
            1 => (across.cross(&a), across.cross(&a).dot(&self.image)),
            2 => (b.cross(&across), b.cross(&across).dot(&self.image)),
            _ => return out.push(cut),
        };
        cut.clipped(&normal, offset, |part| self.clip(part, bound + 1, out));
    }

    /// Whether light goes from the laser by the mirror to a point.
    pub fn lights(&self, surfaces: &Surfaces, point: &V3) -> bool {
        let Some(at) = self.place(point) else { return false };
        !surfaces.blocked_to_light(self.source, at.into()) && !surfaces.blocked_to_light(at.into(), (*point).into())
    }

    /// RMS half thickness that the material's lobe adds to the sheet on its way from the mirror to a point [m].
    pub fn spread_m(&self, point: &V3) -> f64 {
        self.place(point).map_or(0.0, |at| (point - at).norm() * self.spread_rad)
    }

    /// Where on the mirror the light for a point comes from.
    fn place(&self, point: &V3) -> Option<V3> {
        let way = point - self.image;
        let t = self.normal.dot(&(self.ends[0] - self.image)) / self.normal.dot(&way);
        (t > 0.0 && t < 1.0).then(|| self.image + way * t)
    }
}
