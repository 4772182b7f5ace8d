//! Where a transducer is and looks, straight or by one mirror, and whether it sees a place.

use super::face::{Face, V3};
use super::targets::Targets;
use crate::geometry::{Point, World};

/// Places on surfaces are looked at from this far before them [m].
const STEP_M: f64 = 1e-3;

/// A transducer in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aim {
    /// Middle of its face [m].
    pub at: Point<World>,
    /// Unit vector along its axis, outwards.
    pub axis: nalgebra::Vector3<f64>,
}

/// One end of a way of sound: a transducer, or its mirror image.
#[derive(Clone, Copy, Debug)]
pub(super) struct End<'a> {
    pub at: V3,
    pub axis: V3,
    /// Where the transducer itself is.
    real: V3,
    pub mirror: Option<&'a Face>,
}

/// How a place is seen from an end.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub way_m: f64,
    /// Unit vector to it.
    pub to: V3,
    pub sin: f64,
    pub cos: f64,
}

impl<'a> End<'a> {
    pub fn straight(aim: &Aim) -> Self {
        Self { at: aim.at.xyz, axis: aim.axis, real: aim.at.xyz, mirror: None }
    }

    /// The image in a face; `self` must be straight.
    pub fn mirrored(&self, face: &'a Face) -> Self {
        let axis = self.axis - face.normal * (2.0 * face.normal.dot(&self.axis));
        Self { at: face.mirror(&self.at), axis, real: self.real, mirror: Some(face) }
    }

    pub fn view(&self, place: &V3) -> View {
        let way = place - self.at;
        let way_m = way.norm().max(1e-9);
        let to = way / way_m;
        let cos = to.dot(&self.axis);
        View { way_m, to, sin: (1.0 - cos * cos).max(0.0).sqrt(), cos }
    }

    /// Whether nothing stands between the end and a place before a surface.
    pub fn sees(&self, targets: &Targets, place: &V3) -> bool {
        let clear = |a: V3, b: V3| !targets.surfaces.blocked(Point::from(a), Point::from(b));
        let Some(face) = self.mirror else { return clear(self.real, *place) };
        let side = face.height(&self.real);
        let (behind, before) = (-side, face.height(place) * side.signum());
        // The place must be on the mirror's free side, and the way to it must meet the mirror itself.
        if before <= STEP_M {
            return false;
        }
        let share = behind.abs() / (behind.abs() + before);
        let bounce = self.at + (place - self.at) * share;
        let lifted = bounce + face.normal * (STEP_M * side.signum());
        face.holds(&bounce) && clear(self.real, lifted) && clear(lifted, *place)
    }
}

/// A place moved off its surface, to the free side.
pub(super) fn before(place: &V3, free: &V3) -> V3 {
    place + free * STEP_M
}
