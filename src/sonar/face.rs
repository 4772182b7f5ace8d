//! Flat pieces of surface: mirrors to sound.

use nalgebra::{Isometry3, Point3, Vector3};

pub(super) type V3 = Vector3<f64>;

/// How far beyond its border a face still counts, so that neighbours leave no gap [m].
const BORDER_M: f64 = 1e-6;

/// What a face covers of its plane.
#[derive(Clone, Debug)]
pub(super) enum Extent {
    /// All of it.
    Endless,
    /// A round lid [m].
    Disc { centre: V3, radius: f64 },
    /// Triangles.
    Patch(Vec<[V3; 3]>),
}

/// A flat piece of surface: n·x = offset, with what it reflects.
#[derive(Clone, Debug)]
pub(super) struct Face {
    pub body: u32,
    /// Number among all faces of the world.
    pub id: u32,
    pub normal: V3,
    pub offset: f64,
    pub extent: Extent,
    /// A ball around it [m].
    pub centre: V3,
    pub reach: f64,
    /// RMS height [m].
    pub roughness_m: f64,
    /// Meshes reflect from either side: theirs may be wound either way.
    pub two_sided: bool,
}

/// Stretches of a line [m].
pub(super) type Stretches = Vec<(f64, f64)>;

impl Face {
    /// A face with this outward normal; centre and reach follow from the extent.
    pub fn new(body: u32, normal: V3, at: V3, extent: Extent, roughness_m: f64) -> Self {
        let (centre, reach) = match &extent {
            Extent::Endless => (at, f64::INFINITY),
            Extent::Disc { centre, radius } => (*centre, *radius),
            Extent::Patch(triangles) => {
                let corners = || triangles.iter().flatten();
                let (low, high) = corners().fold((at, at), |(low, high), c| (low.inf(c), high.sup(c)));
                let centre = (low + high) / 2.0;
                (centre, corners().map(|c| (c - centre).norm()).fold(0.0, f64::max))
            }
        };
        Self { body, id: 0, normal, offset: normal.dot(&at), extent, centre, reach, roughness_m, two_sided: false }
    }

    pub fn moved(&self, pose: &Isometry3<f64>) -> Self {
        let place = |p: &V3| (pose * Point3::from(*p)).coords;
        let extent = match &self.extent {
            Extent::Endless => Extent::Endless,
            Extent::Disc { centre, radius } => Extent::Disc { centre: place(centre), radius: *radius },
            Extent::Patch(triangles) => Extent::Patch(triangles.iter().map(|t| t.each_ref().map(place)).collect()),
        };
        let on_it = place(&(self.normal * self.offset));
        let normal = pose.rotation * self.normal;
        let (offset, centre) = (normal.dot(&on_it), place(&self.centre));
        Self { normal, offset, extent, centre, ..self.clone() }
    }

    /// How far in front of its plane a point is [m].
    pub fn height(&self, p: &V3) -> f64 {
        self.normal.dot(p) - self.offset
    }

    /// The mirror image of a point.
    pub fn mirror(&self, p: &V3) -> V3 {
        p - self.normal * (2.0 * self.height(p))
    }

    /// Whether a point of its plane is on it.
    pub fn holds(&self, p: &V3) -> bool {
        match &self.extent {
            Extent::Endless => true,
            Extent::Disc { centre, radius } => (p - centre).norm_squared() <= radius * radius,
            Extent::Patch(triangles) => {
                let far = self.reach + BORDER_M;
                (p - self.centre).norm_squared() <= far * far && triangles.iter().any(|t| in_triangle(t, p))
            }
        }
    }

    /// Where the line from + t·along in its plane runs on it.
    pub fn stretches(&self, from: &V3, along: &V3) -> Stretches {
        let pieces = match &self.extent {
            Extent::Endless => vec![(f64::NEG_INFINITY, f64::INFINITY)],
            Extent::Disc { centre, radius } => {
                let middle = (centre - from).dot(along);
                let half = radius * radius - (from + along * middle - centre).norm_squared();
                if half > 0.0 { vec![(middle - half.sqrt(), middle + half.sqrt())] } else { vec![] }
            }
            Extent::Patch(triangles) => triangles.iter().filter_map(|t| across(t, from, along)).collect(),
        };
        joined(pieces)
    }
}

/// Whether a point of the plane of a triangle lies in it, border included.
fn in_triangle([a, b, c]: &[V3; 3], p: &V3) -> bool {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (bb, bc, cc) = (ab.norm_squared(), ab.dot(&ac), ac.norm_squared());
    let det = bb * cc - bc * bc;
    let (x, y) = (ap.dot(&ab), ap.dot(&ac));
    let (u, v) = ((cc * x - bc * y) / det, (bb * y - bc * x) / det);
    let slack = BORDER_M / bb.max(cc).sqrt();
    u >= -slack && v >= -slack && u + v <= 1.0 + slack
}

/// Where a line in the plane of a triangle runs through it.
fn across(triangle: &[V3; 3], from: &V3, along: &V3) -> Option<(f64, f64)> {
    let [a, b, c] = triangle;
    let normal = (b - a).cross(&(c - a));
    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
    for (p, q) in [(a, b), (b, c), (c, a)] {
        let inward = normal.cross(&(q - p));
        let (height, slope) = (inward.dot(&(from - p)), inward.dot(along));
        if slope.abs() <= 1e-12 * inward.norm() {
            if height < 0.0 {
                return None;
            }
        } else if slope > 0.0 {
            enter = enter.max(-height / slope);
        } else {
            leave = leave.min(-height / slope);
        }
    }
    (leave > enter).then_some((enter, leave))
}

/// Stretches that touch become one; in rising order.
pub(super) fn joined(mut pieces: Stretches) -> Stretches {
    pieces.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut out: Stretches = Vec::new();
    for (enter, leave) in pieces {
        match out.last_mut() {
            Some(last) if enter <= last.1 + BORDER_M => last.1 = last.1.max(leave),
            _ => out.push((enter, leave)),
        }
    }
    out
}

/// What two rows of stretches share.
pub(super) fn shared(a: &Stretches, b: &Stretches) -> Stretches {
    let pairs = a.iter().flat_map(|x| b.iter().map(move |y| (x.0.max(y.0), x.1.min(y.1))));
    joined(pairs.filter(|(enter, leave)| leave > enter).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Face {
        let [a, b, c, d] = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]].map(|[x, y]| V3::new(x, y, 0.5));
        Face::new(0, V3::z(), a, Extent::Patch(vec![[a, b, c], [a, c, d]]), 0.0)
    }

    #[test]
    fn a_face_holds_its_points_and_no_others() {
        let face = square();
        for (x, y, inside) in
            [(1.0, 0.5, true), (0.0, 0.0, true), (2.0, 1.0, true), (2.1, 0.5, false), (-0.1, 0.5, false)]
        {
            assert_eq!(face.holds(&V3::new(x, y, 0.5)), inside, "{x} {y}");
        }
        assert_eq!(face.height(&V3::new(9.0, 9.0, 1.5)), 1.0);
        assert_eq!(face.mirror(&V3::new(3.0, 4.0, 2.5)), V3::new(3.0, 4.0, -1.5));
        let disc = Face::new(0, V3::z(), V3::zeros(), Extent::Disc { centre: V3::zeros(), radius: 1.0 }, 0.0);
        assert!(disc.holds(&V3::new(0.6, 0.8, 0.0)) && !disc.holds(&V3::new(0.7, 0.8, 0.0)));
    }

    #[test]
    fn lines_run_on_a_face_from_border_to_border() {
        let run = square().stretches(&V3::new(-1.0, 0.25, 0.5), &V3::x());
        assert_eq!(run.len(), 1);
        assert!((run[0].0 - 1.0).abs() < 1e-9 && (run[0].1 - 3.0).abs() < 1e-9, "{run:?}");
        assert!(square().stretches(&V3::new(-1.0, 1.25, 0.5), &V3::x()).is_empty());
        assert_eq!(shared(&vec![(0.0, 2.0), (3.0, 5.0)], &vec![(1.0, 4.0)]), vec![(1.0, 2.0), (3.0, 4.0)]);
    }

    #[test]
    fn a_moved_face_holds_its_moved_points() {
        let pose = Isometry3::new(V3::new(1.0, 2.0, 3.0), V3::new(0.3, -0.2, 1.0));
        let moved = square().moved(&pose);
        let p = (pose * Point3::new(1.5, 0.5, 0.5)).coords;
        assert!(moved.height(&p).abs() < 1e-12 && moved.holds(&p));
        assert!(!moved.holds(&(pose * Point3::new(2.5, 0.5, 0.5)).coords));
    }
}
