//! A triangle mesh over samples of height: greedy insertion into a Delaunay triangulation until no sample is farther from
//! the mesh than promised (Garland and Heckbert 1995). The only file that names spade.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use spade::handles::FixedVertexHandle;
use spade::{DelaunayTriangulation, HasPosition, Point2, PositionInTriangulation, Triangulation};

use crate::fault::{Fault, Result};

/// A height at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Where, in the plane.
    pub at: [f64; 2],
    /// How high [m].
    pub height: f64,
}

/// A vertex of the triangulation: a sample that was inserted.
#[derive(Clone, Copy, Debug)]
struct Vertex {
    sample: usize,
    at: [f64; 2],
    height: f64,
}

impl HasPosition for Vertex {
    type Scalar = f64;
    fn position(&self) -> Point2<f64> {
        Point2::new(self.at[0], self.at[1])
    }
}

/// A triangle of the mesh, counter-clockwise.
#[derive(Clone, Debug, PartialEq)]
pub struct Face {
    /// Its number: stable until the next insertion.
    pub id: usize,
    /// The samples at its corners.
    pub corners: [usize; 3],
}

/// The sample of a face that is farthest from it.
#[derive(Clone, Copy, Debug)]
struct Worst {
    error: f64,
    sample: usize,
    face: usize,
}

impl PartialEq for Worst {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal // also where the error is no number
    }
}
impl Eq for Worst {}
impl PartialOrd for Worst {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Worst {
    fn cmp(&self, other: &Self) -> Ordering {
        let order = |w: &Self| (Reverse(w.sample), Reverse(w.face));
        self.error.total_cmp(&other.error).then(order(self).cmp(&order(other)))
    }
}

/// What is known of a face beside its corners.
#[derive(Clone, Debug)]
struct Patch {
    /// The samples in it or on its edges that are no vertices.
    samples: Vec<usize>,
    worst: Option<Worst>,
    /// A corner: where the search for a point in it starts.
    corner: FixedVertexHandle,
}

/// A triangle seen from its first corner, with the plane through it.
struct Wedge {
    face: usize,
    origin: Sample,
    /// From the first corner to the second and to the third.
    sides: [[f64; 2]; 2],
    /// Rise of the plane along x and y.
    rise: [f64; 2],
}

impl Wedge {
    fn new(face: usize, [origin, b, c]: [Sample; 3]) -> Self {
        let sides = [b, c].map(|s| [s.at[0] - origin.at[0], s.at[1] - origin.at[1]]);
        let (db, dc) = (b.height - origin.height, c.height - origin.height);
        let det = cross(sides[0], sides[1]);
        let rise = [(db * sides[1][1] - dc * sides[0][1]) / det, (dc * sides[0][0] - db * sides[1][0]) / det];
        Self { face, origin, sides, rise }
    }

    fn height(&self, at: [f64; 2]) -> f64 {
        self.origin.height + self.rise[0] * (at[0] - self.origin.at[0]) + self.rise[1] * (at[1] - self.origin.at[1])
    }

    /// How far inside the angle at the first corner a point is (negative: outside).
    fn inside_angle(&self, at: [f64; 2]) -> f64 {
        let from = [at[0] - self.origin.at[0], at[1] - self.origin.at[1]];
        cross(self.sides[0], from).min(cross(from, self.sides[1]))
    }

    /// How far inside the triangle a point is (negative: outside).
    fn inside(&self, at: [f64; 2]) -> f64 {
        let far = [at[0] - self.origin.at[0] - self.sides[0][0], at[1] - self.origin.at[1] - self.sides[0][1]];
        let last = [self.sides[1][0] - self.sides[0][0], self.sides[1][1] - self.sides[0][1]];
        self.inside_angle(at).min(cross(last, far))
    }
}

/// A mesh over samples. Every sample is a vertex or belongs to the face it lies in.
pub struct Tin {
    samples: Vec<Sample>,
    mesh: DelaunayTriangulation<Vertex>,
    /// By the number of the face; the outer face's is unused.
    patches: Vec<Patch>,
    /// The face each sample belongs to; `None` once it is a vertex.
    home: Vec<Option<usize>>,
    queue: BinaryHeap<Worst>,
}

impl Tin {
    /// The coarsest mesh over samples, no two of them at the same place: that of their convex hull. It has no faces where
    /// all samples are on one line.
    ///
    /// Errors: a sample that is not finite, or too large or too small for exact arithmetic.
    pub fn new(samples: Vec<Sample>) -> Result<Self> {
        if let Some(bad) = samples.iter().find(|s| !(s.height.is_finite() && s.at.iter().all(|c| c.is_finite()))) {
            return Err(Fault::new("height sample", format!("{:?}, {}", bad.at, bad.height), "finite numbers"));
        }
        let home = vec![None; samples.len()];
        let mesh = DelaunayTriangulation::new();
        let mut tin = Self { samples, mesh, patches: Vec::new(), home, queue: BinaryHeap::new() };
        let hull = convex_hull(&tin.samples);
        for sample in &hull {
            let vertex = tin.vertex_of(*sample);
            tin.mesh.insert(vertex).map_err(refused)?;
        }
        tin.hand_out(&hull);
        Ok(tin)
    }

    /// Inserts the worst sample again and again until none is farther from the mesh than `error_max` [m].
    pub fn refine(&mut self, error_max: f64) -> Result<()> {
        while let Some(worst) = self.queue.peek().copied() {
            if self.patches[worst.face].worst != Some(worst) {
                self.queue.pop(); // the face changed since
                continue;
            }
            // Written so that an error that is no number is inserted too.
            if worst.error <= error_max {
                break;
            }
            self.queue.pop();
            self.insert(worst.sample)?;
        }
        Ok(())
    }

    /// Makes a sample a vertex; nothing happens if it is one already.
    pub fn insert(&mut self, sample: usize) -> Result<()> {
        let Some(face) = self.home.get(sample).copied().flatten() else { return Ok(()) };
        let corner = self.patches[face].corner;
        let vertex = self.mesh.insert_with_hint(self.vertex_of(sample), corner).map_err(refused)?;
        self.home[sample] = None;
        // Everything that changed is now a face around the new vertex: old numbers are kept, new ones follow.
        let empty = Patch { samples: Vec::new(), worst: None, corner: vertex };
        self.patches.resize(self.mesh.num_all_faces(), empty);
        let mut star = Vec::with_capacity(8);
        let mut moving = Vec::new();
        for edge in self.mesh.vertex(vertex).out_edges() {
            let Some(face) = edge.face().as_inner() else { continue };
            let corners = [edge.from(), edge.to(), edge.next().to()].map(|v| *v.data());
            star.push(Wedge::new(face.index(), corners.map(|v| Sample { at: v.at, height: v.height })));
            let patch = &mut self.patches[face.index()];
            moving.append(&mut patch.samples);
            patch.worst = None;
            patch.corner = vertex;
        }
        moving.sort_unstable();
        for sample in moving.into_iter().filter(|moving| *moving != sample) {
            let at = self.samples[sample].at;
            let inside = star.iter().find(|wedge| wedge.inside_angle(at) >= 0.0);
            // Rounding may leave a sample just outside all; on whole numbers it never does.
            let nearest = || star.iter().max_by(|a, b| a.inside_angle(at).total_cmp(&b.inside_angle(at)));
            let Some(wedge) = inside.or_else(nearest) else { continue };
            self.give(sample, wedge);
        }
        self.queue.extend(star.iter().filter_map(|wedge| self.patches[wedge.face].worst));
        Ok(())
    }

    /// All triangles, in the order of their numbers.
    pub fn faces(&self) -> impl Iterator<Item = Face> {
        self.mesh.inner_faces().map(|face| Face { id: face.index(), corners: face.vertices().map(|v| v.data().sample) })
    }

    /// Numbers of faces are below this.
    pub fn face_ids(&self) -> usize {
        self.mesh.num_all_faces()
    }

    /// The samples that lie in a face and are not in the mesh.
    pub fn within(&self, face: usize) -> &[usize] {
        self.patches.get(face).map_or(&[], |patch| &patch.samples)
    }

    /// How far the worst sample of a face is from it [m].
    pub fn error(&self, face: usize) -> f64 {
        self.patches.get(face).and_then(|patch| patch.worst).map_or(0.0, |worst| worst.error)
    }

    /// A sample it was made with.
    pub fn sample(&self, at: usize) -> Sample {
        self.samples[at]
    }

    /// How many vertices the mesh has.
    pub fn vertices(&self) -> usize {
        self.mesh.num_vertices()
    }

    /// The height of the mesh at a place [m], if a face lies there that `keep` keeps.
    pub fn height_at(&self, at: [f64; 2], keep: impl Fn(usize) -> bool) -> Option<f64> {
        if !at.iter().all(|c| c.abs() < 1e9) {
            return None;
        }
        let mesh = &self.mesh;
        let kept = |face: spade::handles::FaceHandle<'_, spade::handles::InnerTag, Vertex, (), (), ()>| {
            let corners = face.vertices().map(|v| Sample { at: v.data().at, height: v.data().height });
            keep(face.index()).then(|| Wedge::new(face.index(), corners).height(at))
        };
        match mesh.locate(Point2::new(at[0], at[1])) {
            PositionInTriangulation::OnFace(face) => kept(mesh.face(face)),
            PositionInTriangulation::OnEdge(edge) => {
                let edge = mesh.directed_edge(edge);
                [edge, edge.rev()].into_iter().filter_map(|edge| edge.face().as_inner()).find_map(kept)
            }
            PositionInTriangulation::OnVertex(vertex) => {
                let around = mesh.vertex(vertex).out_edges();
                around.filter_map(|edge| edge.face().as_inner()).any(|face| keep(face.index())).then_some(())?;
                Some(mesh.vertex(vertex).data().height)
            }
            PositionInTriangulation::OutsideOfConvexHull(_) | PositionInTriangulation::NoTriangulation => None,
        }
    }

    /// Checks what must always hold: every triangle counter-clockwise and with an area, no vertex inside the circle of a
    /// neighbouring triangle, every sample a vertex or in the one face that lists it.
    pub fn check(&self) -> std::result::Result<(), String> {
        for face in self.mesh.inner_faces() {
            let [a, b, c] = face.vertices().map(|v| v.data().at);
            let area = cross([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]);
            // The triangulation itself is exact: rounding here must not cry wolf.
            if area < -1e-9 * extent(&[a, b, c]) {
                return Err(format!("triangle {a:?} {b:?} {c:?} has the area {}", area / 2.0));
            }
        }
        for edge in self.mesh.undirected_edges() {
            let edge = edge.as_directed();
            let (Some(left), Some(right)) = (edge.opposite_vertex(), edge.rev().opposite_vertex()) else { continue };
            let corners = [edge.from(), edge.to(), left, right].map(|v| v.data().at);
            if in_circle(corners) > 1e-9 * extent(&corners).powi(2) {
                return Err(format!("{:?} is in the circle of {:?}", corners[3], &corners[..3]));
            }
        }
        let mut seen = vec![0; self.samples.len()];
        self.mesh.vertices().for_each(|v| seen[v.data().sample] += 1);
        for (face, patch) in self.patches.iter().enumerate() {
            for sample in &patch.samples {
                seen[*sample] += 1;
                if self.home[*sample] != Some(face) {
                    return Err(format!("sample {sample} is in face {face}, not in {:?}", self.home[*sample]));
                }
            }
        }
        if self.mesh.num_inner_faces() > 0 && seen.iter().any(|count| *count != 1) {
            return Err("a sample is lost, or in two faces".into());
        }
        Ok(())
    }

    fn vertex_of(&self, sample: usize) -> Vertex {
        let Sample { at, height } = self.samples[sample];
        Vertex { sample, at, height }
    }

    /// Gives every sample but the vertices to the face it lies in.
    fn hand_out(&mut self, vertices: &[usize]) {
        let Some(first) = self.mesh.fixed_vertices().next() else { return };
        self.patches = vec![Patch { samples: Vec::new(), worst: None, corner: first }; self.mesh.num_all_faces()];
        let mut wedges = Vec::with_capacity(self.mesh.num_inner_faces());
        for face in self.mesh.inner_faces() {
            self.patches[face.index()].corner = face.vertices()[0].fix();
            let corners = face.vertices().map(|v| Sample { at: v.data().at, height: v.data().height });
            wedges.push(Wedge::new(face.index(), corners));
        }
        let mut is_vertex = vec![false; self.samples.len()];
        vertices.iter().for_each(|sample| is_vertex[*sample] = true);
        let mut last = 0;
        for sample in (0..self.samples.len()).filter(|sample| !is_vertex[*sample]) {
            let at = self.samples[sample].at;
            if wedges.get(last).is_none_or(|wedge| wedge.inside(at) < 0.0) {
                let best = (0..wedges.len()).max_by(|a, b| wedges[*a].inside(at).total_cmp(&wedges[*b].inside(at)));
                let Some(best) = best else { return };
                last = best;
            }
            self.give(sample, &wedges[last]);
        }
        self.queue = self.patches.iter().filter_map(|patch| patch.worst).collect();
    }

    /// Gives a sample to a face, and keeps the worst one.
    fn give(&mut self, sample: usize, wedge: &Wedge) {
        let Sample { at, height } = self.samples[sample];
        let candidate = Worst { error: (wedge.height(at) - height).abs(), sample, face: wedge.face };
        let patch = &mut self.patches[wedge.face];
        patch.samples.push(sample);
        patch.worst = patch.worst.max(Some(candidate));
        self.home[sample] = Some(wedge.face);
    }
}

/// What spade does not take.
fn refused(error: spade::InsertionError) -> Fault {
    Fault::new("height sample", error, "coordinates from 1e-42 to 1e60, or 0")
}

/// a × b: twice the area between two directions.
fn cross(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

/// The square of how far points reach from the first.
fn extent(points: &[[f64; 2]]) -> f64 {
    points.iter().map(|p| (p[0] - points[0][0]).powi(2) + (p[1] - points[0][1]).powi(2)).fold(0.0, f64::max)
}

/// Positive if the last point is inside the circle through the first three (counter-clockwise).
fn in_circle([a, b, c, d]: [[f64; 2]; 4]) -> f64 {
    let [a, b, c] = [a, b, c].map(|p| [p[0] - d[0], p[1] - d[1]]);
    let square = |p: [f64; 2]| p[0] * p[0] + p[1] * p[1];
    square(a) * cross(b, c) + square(b) * cross(c, a) + square(c) * cross(a, b)
}

/// The corners of the convex hull, counter-clockwise (Andrew's monotone chain).
fn convex_hull(samples: &[Sample]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..samples.len()).collect();
    let place = |i: usize| samples[i].at;
    order.sort_unstable_by(|a, b| {
        let ([ax, ay], [bx, by]) = (place(*a), place(*b));
        ax.total_cmp(&bx).then(ay.total_cmp(&by)).then(a.cmp(b))
    });
    let half = |order: &mut dyn Iterator<Item = usize>| {
        let mut chain: Vec<usize> = Vec::new();
        for next in order {
            while let [.., a, b] = chain[..] {
                let (a, b, c) = (place(a), place(b), place(next));
                if cross([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]]) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(next);
        }
        chain
    };
    let mut hull = half(&mut order.iter().copied());
    let back = half(&mut order.iter().rev().copied());
    hull.extend(back.iter().skip(1).take(back.len().saturating_sub(2)));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn tin(samples: &[([f64; 2], f64)]) -> Tin {
        Tin::new(samples.iter().map(|(at, height)| Sample { at: *at, height: *height }).collect()).unwrap()
    }

    /// A field of whole numbers with a smooth height and noise.
    fn field(width: i32, depth: i32) -> Vec<Sample> {
        let height = |x: f64, y: f64| {
            0.3 * (x * 0.05).sin() * (y * 0.04).cos() + 0.004 * ((x * 12.9 + y * 78.2).sin() * 43758.5).fract()
        };
        let place = |i: i32| [f64::from(i % width), f64::from(i / width)];
        (0..width * depth).map(place).map(|[x, y]| Sample { at: [x, y], height: height(x, y) }).collect()
    }

    fn area(tin: &Tin) -> f64 {
        let twice = |face: Face| {
            let [a, b, c] = face.corners.map(|i| tin.sample(i).at);
            cross([b[0] - a[0], b[1] - a[1]], [c[0] - a[0], c[1] - a[1]])
        };
        tin.faces().map(twice).sum::<f64>() / 2.0
    }

    #[test]
    fn the_promised_error_is_kept_everywhere_and_not_overdone() {
        let samples = field(160, 150);
        let mut tin = Tin::new(samples.clone()).unwrap();
        tin.refine(0.02).unwrap();
        assert_eq!(tin.check(), Ok(()));
        let error = |s: &Sample| (tin.height_at(s.at, |_| true).unwrap() - s.height).abs();
        let worst = samples.iter().map(error).fold(0.0, f64::max);
        assert!(worst <= 0.02 + 1e-12, "{worst}");
        assert!(tin.vertices() < 400, "{} vertices", tin.vertices());
        assert_eq!(area(&tin), 159.0 * 149.0);
    }

    #[test]
    fn a_plane_needs_no_more_than_its_corners() {
        let slope = |s: Sample| Sample { height: 0.1 * s.at[0] - 0.2 * s.at[1], ..s };
        let mut tin = Tin::new(field(50, 40).into_iter().map(slope).collect()).unwrap();
        tin.refine(1e-6).unwrap();
        assert_eq!((tin.vertices(), tin.faces().count()), (4, 2));
    }

    #[test]
    fn degenerate_samples_make_no_faces_and_no_panic() {
        for samples in [
            vec![],
            vec![([0.0, 0.0], 1.0)],
            vec![([0.0, 0.0], 1.0), ([1.0, 0.0], 2.0)],
            (0..50).map(|i| ([f64::from(i), f64::from(2 * i)], f64::from(i % 7))).collect(),
        ] {
            let mut tin = tin(&samples);
            tin.refine(0.0).unwrap();
            assert_eq!((tin.faces().count(), tin.check()), (0, Ok(())));
            assert_eq!(tin.height_at([0.5, 1.0], |_| true), None);
        }
        for bad in [[f64::NAN, 0.0], [f64::INFINITY, 0.0], [1e100, 0.0], [1e-100, 1e-100]] {
            assert!(Tin::new(vec![Sample { at: bad, height: 0.0 }]).is_err());
        }
        let square = tin(&[([0.0, 0.0], 1.0), ([4.0, 0.0], 1.0), ([0.0, 4.0], 1.0), ([4.0, 4.0], 1.0)]);
        assert_eq!(square.height_at([f64::NAN, 1.0], |_| true), None);
        assert_eq!(square.height_at([1e300, 1.0], |_| true), None);
        assert_eq!(square.height_at([1.0, 1.0], |_| false), None);
        for at in [[1.0, 1.0], [2.0, 2.0], [4.0, 0.0], [2.0, 0.0]] {
            assert_eq!(square.height_at(at, |_| true), Some(1.0)); // in a face, on an edge, a vertex, the hull
        }
    }

    proptest! {
        #[test]
        fn what_must_hold_holds_after_each_insertion(
            cells in prop::collection::btree_map(prop::array::uniform2(-9..9i32), -1.0..1.0f64, 0..80),
            picks in prop::collection::vec(0..80usize, 0..30), error_max in 0.0..0.5f64,
        ) {
            let samples: Vec<_> = cells.iter().map(|(at, height)| (at.map(f64::from), *height)).collect();
            let mut tin = tin(&samples);
            prop_assert_eq!(tin.check(), Ok(()));
            for pick in picks {
                tin.insert(pick).unwrap();
                prop_assert_eq!(tin.check(), Ok(()));
            }
            tin.refine(error_max).unwrap();
            prop_assert_eq!(tin.check(), Ok(()));
            if tin.faces().next().is_some() {
                for (at, height) in &samples {
                    let mesh = tin.height_at(*at, |_| true);
                    prop_assert!(mesh.is_some_and(|mesh| (mesh - height).abs() <= error_max + 1e-9), "{mesh:?} {height}");
                }
            }
            tin.refine(-1.0).unwrap(); // no error is so small: all are inserted
            prop_assert!(tin.faces().next().is_none() || tin.vertices() == samples.len());
            prop_assert_eq!(tin.check(), Ok(()));
        }
    }

    #[test]
    fn a_mountain_takes_as_many_vertices_as_it_takes_others() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/terrain/fuji_terrain_rgb.png");
        let Ok(picture) = ::image::open(path) else {
            eprintln!("skipped: ../shared/data is absent");
            return;
        };
        let height =
            |[r, g, b]: [u8; 3]| (f64::from(r) * 65536.0 + f64::from(g) * 256.0 + f64::from(b)) / 10.0 - 10000.0;
        let place = |(x, y, pixel): (u32, u32, &::image::Rgb<u8>)| Sample {
            at: [f64::from(x), f64::from(y)],
            height: height(pixel.0),
        };
        let samples: Vec<Sample> = picture.to_rgb8().enumerate_pixels().map(place).collect();
        // Delatin, the same greedy insertion by another hand, needs 2618 and 27 096.
        for (error_max, delatin) in [(50.0, 2618.0), (10.0, 27_096.0)] {
            let mut tin = Tin::new(samples.clone()).unwrap();
            tin.refine(error_max).unwrap();
            assert_eq!(tin.check(), Ok(()));
            assert!(
                (tin.vertices() as f64 / delatin - 1.0).abs() < 0.005,
                "{} vertices at {error_max} m",
                tin.vertices()
            );
            let error = |s: &Sample| (tin.height_at(s.at, |_| true).unwrap() - s.height).abs();
            assert!(samples.iter().map(error).fold(0.0, f64::max) <= error_max + 1e-6);
        }
    }

    #[test]
    fn degenerate_point_sets_of_others_triangulate() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/delaunay/");
        if !std::path::Path::new(folder).exists() {
            eprintln!("skipped: ../shared/data is absent");
            return;
        }
        for (name, triangles) in [("issue13", None), ("issue43", None), ("robustness1", None), ("ukraine", Some(1711))]
        {
            let text = std::fs::read_to_string(format!("{folder}{name}.json")).unwrap();
            let mut points: Vec<[f64; 2]> = serde_json::from_str(&text).unwrap();
            points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
            points.dedup();
            let samples: Vec<Sample> = points.iter().map(|at| Sample { at: *at, height: 0.0 }).collect();
            let mut tin = Tin::new(samples).unwrap();
            let coarse = area(&tin);
            tin.refine(-1.0).unwrap();
            assert_eq!(tin.check(), Ok(()), "{name}");
            assert_eq!(tin.vertices(), points.len(), "{name}");
            assert!((area(&tin) / coarse - 1.0).abs() < 1e-12, "{name}: {} for {coarse}", area(&tin));
            if let Some(triangles) = triangles {
                assert_eq!(tin.faces().count(), triangles, "{name}");
            }
        }
    }
}
