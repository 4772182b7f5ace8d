//! Features that stand together: what is buried in other bodies is cut away, what meets encloses corners, and a tree of
//! boxes finds what a beam reaches.

use nalgebra::{Isometry3, Point3};
use parry3d::bounding_volume::Aabb;
use parry3d::partitioning::{Bvh, BvhBuildStrategy, TraversalAction};

use super::face::{Face, Stretches, V3, shared};
use super::feature::{Corner, Edge, Feature};
use crate::world::{Body, Shape};

/// Faces that come nearer than this touch [m].
const TOUCH_M: f64 = 3e-3;
/// A corner or a free stretch of an edge that is shorter is none [m].
const SHORT_M: f64 = 0.01;
/// Edges are tried for burial in pieces of this length [m], of which there are at most `PIECES`.
const PIECE_M: f64 = 0.05;
const PIECES: usize = 200;

/// A solid that may bury the edges of others.
#[derive(Clone, Debug)]
pub(super) struct Solid {
    body: u32,
    body_from_world: Isometry3<f64>,
    shape: Shape,
    centre: V3,
    reach: f64,
}

impl Solid {
    /// `None` for meshes: whether a mesh is closed is not known.
    pub fn new(body: &Body, number: u32, pose: &Isometry3<f64>) -> Option<Self> {
        let reach = match &body.shape {
            Shape::Mesh(_) => return None,
            Shape::Plane => f64::INFINITY,
            Shape::Box { size } => size.norm() / 2.0,
            Shape::Cylinder { radius, length } => radius.hypot(length / 2.0),
            Shape::Sphere { radius } => *radius,
        };
        let (shape, centre) = (body.shape.clone(), pose.translation.vector);
        Some(Self { body: number, body_from_world: pose.inverse(), shape, centre, reach })
    }

    fn holds(&self, p: &V3) -> bool {
        if (p - self.centre).norm() > self.reach {
            return false;
        }
        let p = (self.body_from_world * Point3::from(*p)).coords;
        match &self.shape {
            Shape::Plane => p.z < 0.0,
            Shape::Box { size } => p.iter().zip(size).all(|(x, side)| x.abs() < side / 2.0),
            Shape::Cylinder { radius, length } => p.z.abs() < length / 2.0 && p.xy().norm() < *radius,
            Shape::Sphere { radius } => p.norm() < *radius,
            Shape::Mesh(_) => false,
        }
    }
}

/// Features with their tree.
#[derive(Clone, Debug)]
pub(super) struct Group {
    /// Those of the tree come first, then those without end.
    features: Vec<Feature>,
    bounded: usize,
    bvh: Bvh,
    /// Pairs of faces that enclose a corner, each pair in rising order.
    cornered: Vec<[u32; 2]>,
}

impl Group {
    /// Takes the features of one or more bodies in the world's frame; corners are looked for among them and with `others`.
    pub fn new(features: Vec<Feature>, solids: &[Solid], others: Option<&Group>) -> Self {
        let mut kept: Vec<Feature> = Vec::with_capacity(features.len());
        for feature in features {
            match feature {
                Feature::Edge(edge) => kept.extend(unburied(edge, solids).into_iter().map(Feature::Edge)),
                Feature::Rim(rim) => {
                    let rest = rim.centre + rim.axis * TOUCH_M;
                    if !solids.iter().any(|s| s.body != rim.body && s.holds(&rest)) {
                        kept.push(Feature::Rim(rim));
                    }
                }
                other => kept.push(other),
            }
        }
        let faces = Self::tree(kept.iter().filter(|f| f.face().is_some()).cloned().collect(), Vec::new());
        let mut corners = faces.corners_with(&faces, true);
        corners.extend(others.iter().flat_map(|others| faces.corners_with(others, false)));
        let mut cornered: Vec<[u32; 2]> =
            corners.iter().map(|c| [c.faces[0].min(c.faces[1]), c.faces[0].max(c.faces[1])]).collect();
        cornered.sort_unstable();
        cornered.dedup();
        kept.extend(corners.into_iter().map(Feature::Corner));
        Self::tree(kept, cornered)
    }

    fn tree(features: Vec<Feature>, cornered: Vec<[u32; 2]>) -> Self {
        let (mut features, endless): (Vec<_>, Vec<_>) = features.into_iter().partition(|f| f.bounds().is_some());
        let boxes: Vec<Aabb> =
            features.iter().filter_map(Feature::bounds).map(|(low, high)| outward(low, high)).collect();
        let bounded = features.len();
        features.extend(endless);
        Self { features, bounded, bvh: Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes), cornered }
    }

    /// Whether these two faces enclose a corner.
    pub fn is_corner(&self, a: u32, b: u32) -> bool {
        self.cornered.binary_search(&[a.min(b), a.max(b)]).is_ok()
    }

    /// All features.
    pub fn features(&self) -> &[Feature] {
        &self.features
    }

    /// Calls `visit` for each feature whose box, and all boxes around it, pass `near` (middle and half diagonal of the box,
    /// and its nearest and farthest corner), and for each that has no end.
    pub fn find<'a>(&'a self, near: impl Fn(&V3, &V3) -> bool, mut visit: impl FnMut(&'a Feature)) {
        self.bvh.traverse(|node| {
            let (low, high) = (node.mins(), node.maxs());
            let low = V3::new(low.x.into(), low.y.into(), low.z.into());
            let high = V3::new(high.x.into(), high.y.into(), high.z.into());
            if !near(&low, &high) {
                return TraversalAction::Prune;
            }
            if let Some(feature) = node.leaf_data().and_then(|index| self.features[..self.bounded].get(index as usize))
            {
                visit(feature);
            }
            TraversalAction::Continue
        });
        self.features[self.bounded..].iter().for_each(visit);
    }

    /// Where faces of this group enclose corners with those of another.
    fn corners_with(&self, other: &Group, itself: bool) -> Vec<Corner> {
        let mut out = Vec::new();
        for a in self.features.iter().filter_map(Feature::face) {
            let bounds = Feature::Face(a.clone()).bounds();
            let mut partners: Vec<&Face> = Vec::new();
            let near = |low: &V3, high: &V3| match &bounds {
                Some((from, to)) => (0..3).all(|i| from[i] <= high[i] + TOUCH_M && to[i] >= low[i] - TOUCH_M),
                None => true,
            };
            other.find(near, |feature| partners.extend(feature.face()));
            // The order of the tree is not that of the world.
            partners.sort_unstable_by_key(|b| b.id);
            for b in partners {
                if !itself || a.id < b.id {
                    corner(a, b, &mut out);
                }
            }
        }
        out
    }
}

/// The f32 box around `low`…`high`, rounded outward.
fn outward(low: V3, high: V3) -> Aabb {
    let down = |x: f64| ((x - 1e-6) as f32).next_down();
    let up = |x: f64| ((x + 1e-6) as f32).next_up();
    let vector = parry3d::math::Vector::new;
    Aabb::new(vector(down(low.x), down(low.y), down(low.z)), vector(up(high.x), up(high.y), up(high.z)))
}

/// The stretches of an edge about which the space is free.
fn unburied(edge: Edge, solids: &[Solid]) -> Vec<Edge> {
    let middle = edge.from + edge.along * (edge.length / 2.0);
    let near: Vec<&Solid> = solids
        .iter()
        .filter(|s| s.body != edge.body && (s.centre - middle).norm() <= s.reach + edge.length / 2.0 + TOUCH_M)
        .collect();
    if near.is_empty() {
        return vec![edge];
    }
    let pieces = ((edge.length / PIECE_M).ceil() as usize).clamp(2, PIECES);
    let step = edge.length / pieces as f64;
    let around = [1.0, 3.0, 5.0].map(|sixth| edge.about(edge.n * std::f64::consts::PI * sixth / 6.0) * (2.0 * TOUCH_M));
    let is_free = |i: usize| {
        let at = edge.from + edge.along * ((i as f64 + 0.5) * step);
        !around.iter().any(|way| near.iter().any(|s| s.holds(&(at + way))))
    };
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for i in (0..pieces).filter(|i| is_free(*i)) {
        match runs.last_mut() {
            Some((_, end)) if *end == i => *end = i + 1,
            _ => runs.push((i, i + 1)),
        }
    }
    let cut = |(first, end): (usize, usize)| Edge {
        from: edge.from + edge.along * (first as f64 * step),
        length: (end - first) as f64 * step,
        ..edge.clone()
    };
    runs.into_iter().map(cut).filter(|e| e.length >= SHORT_M).collect()
}

/// Where two faces meet and enclose free space.
fn corner(a: &Face, b: &Face, out: &mut Vec<Corner>) {
    let cos = a.normal.dot(&b.normal);
    // From 30° to 150° between them: sharper ones are slots, flatter ones bends.
    let Some(along) = a.normal.cross(&b.normal).try_normalize(0.5) else { return };
    // The line's point nearest to the world's origin.
    let det = 1.0 - cos * cos;
    let from = a.normal * ((a.offset - b.offset * cos) / det) + b.normal * ((b.offset - a.offset * cos) / det);
    // Within each face, away from the line, on the free side of the other one.
    let into = [b.normal - a.normal * cos, a.normal - b.normal * cos].map(|v| v.normalize());
    let on = |face: &Face, way: &V3| face.stretches(&(from + way * TOUCH_M), &along);
    let both: Stretches = shared(&on(a, &into[0]), &on(b, &into[1]));
    for (enter, leave) in both.into_iter().filter(|(enter, leave)| leave - enter >= SHORT_M) {
        // Two endless planes meet in an endless line; a kilometre of it is enough.
        let (enter, leave) = (enter.max(-1e3), leave.min(1e3));
        let middle = from + along * ((enter + leave) / 2.0);
        let reach = [(a, into[0]), (b, into[1])].map(|(face, way)| {
            let rows = face.stretches(&middle, &way);
            rows.iter().find(|(low, high)| *low <= TOUCH_M && *high > TOUCH_M).map_or(TOUCH_M, |(_, high)| *high)
        });
        out.push(Corner {
            body: if a.reach <= b.reach { a.body } else { b.body },
            from: from + along * enter,
            along,
            length: leave - enter,
            faces: [a.id, b.id],
            normals: [a.normal, b.normal],
            into,
            reach,
            roughness_m: [a.roughness_m, b.roughness_m],
        });
    }
}
