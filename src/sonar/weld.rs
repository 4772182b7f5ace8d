//! From triangles to features: coplanar neighbours become one face, creases become edges.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use super::face::{Extent, Face, V3};
use super::feature::{Edge, Feature};
use crate::world::Mesh;

/// Vertices nearer than this are one [m].
const WELD_M: f64 = 1e-5;
/// Neighbours whose normals differ by less lie in one plane [rad].
const FLAT_RAD: f64 = 1e-3;
/// A crease that bends less sends nothing back [rad].
const CREASE_RAD: f64 = 0.035;

/// The faces and creases of a mesh, in its own frame.
pub(super) fn features(mesh: &Mesh, body: u32, roughness_m: f64, two_sided: bool) -> Vec<Feature> {
    let triangles = welded(mesh);
    let borders = borders(&triangles);
    let root = flat_pieces(&triangles, &borders);
    let mut pieces = BTreeMap::<usize, Vec<[V3; 3]>>::new();
    for (triangle, root) in triangles.iter().zip(&root) {
        pieces.entry(*root).or_default().push(triangle.corners);
    }
    let mut out = Vec::new();
    for (root, piece) in pieces {
        let triangle = &triangles[root];
        let face = Face::new(body, triangle.normal, triangle.corners[0], Extent::Patch(piece), roughness_m);
        out.push(Feature::Face(Face { two_sided, ..face }));
    }
    for (_, sides) in borders {
        if let Some(edge) = crease(&triangles, &root, &sides, body, roughness_m) {
            out.push(Feature::Edge(edge));
        }
    }
    chained(out)
}

/// A triangle with its welded vertices.
struct Piece {
    names: [usize; 3],
    corners: [V3; 3],
    normal: V3,
}

/// The sides of triangles between two vertices: triangle, and which of its sides.
type Borders = BTreeMap<[usize; 2], Vec<(usize, usize)>>;

/// The triangles that have an area.
fn welded(mesh: &Mesh) -> Vec<Piece> {
    let mut names = BTreeMap::<[i64; 3], usize>::new();
    let named: Vec<usize> = mesh
        .vertices
        .iter()
        .map(|v| {
            let next = names.len();
            *names.entry([v.x, v.y, v.z].map(|c| (c / WELD_M).round() as i64)).or_insert(next)
        })
        .collect();
    let piece = |t: &[u32; 3]| {
        let at = |i: u32| mesh.vertices.get(i as usize).copied();
        let corners = [at(t[0])?, at(t[1])?, at(t[2])?];
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])).try_normalize(1e-12)?;
        Some(Piece { names: t.map(|i| named[i as usize]), corners, normal })
    };
    mesh.triangles.iter().filter_map(piece).collect()
}

fn borders(triangles: &[Piece]) -> Borders {
    let mut borders = Borders::new();
    for (index, triangle) in triangles.iter().enumerate() {
        for side in 0..3 {
            let (a, b) = (triangle.names[side], triangle.names[(side + 1) % 3]);
            borders.entry([a.min(b), a.max(b)]).or_default().push((index, side));
        }
    }
    borders
}

/// For each triangle the first of those that lie in one plane with it and hang together.
fn flat_pieces(triangles: &[Piece], borders: &Borders) -> Vec<usize> {
    let mut root: Vec<usize> = (0..triangles.len()).collect();
    fn top(root: &mut [usize], mut i: usize) -> usize {
        while root[i] != i {
            root[i] = root[root[i]];
            i = root[i];
        }
        i
    }
    for sides in borders.values().filter(|sides| sides.len() == 2) {
        let (a, b) = (top(&mut root, sides[0].0), top(&mut root, sides[1].0));
        // Held against the first triangle of both, so that a gentle bend is not followed around.
        if a != b && triangles[a].normal.dot(&triangles[b].normal) > 1.0 - FLAT_RAD * FLAT_RAD / 2.0 {
            root[a.max(b)] = a.min(b);
        }
    }
    (0..triangles.len()).map(|i| top(&mut root, i)).collect()
}

/// The edge on a border, if its two faces stand out there, or if it is the end of a sheet.
fn crease(triangles: &[Piece], root: &[usize], sides: &[(usize, usize)], body: u32, roughness_m: f64) -> Option<Edge> {
    let &(first, side) = sides.first()?;
    let triangle = &triangles[first];
    let (from, to) = (triangle.corners[side], triangle.corners[(side + 1) % 3]);
    let length = (to - from).norm();
    let along = (to - from).try_normalize(1e-9)?;
    let normal = triangles[root[first]].normal;
    let into = normal.cross(&along); // counter-clockwise: the face is on the left of its border
    let n = match sides {
        [_] => 2.0, // the end of a sheet
        [_, (second, _)] if root[first] != root[*second] => {
            let other = triangles[root[*second]].normal;
            let bend = normal.cross(&other).dot(&along).atan2(normal.dot(&other));
            if bend < CREASE_RAD {
                return None; // flat or a corner
            }
            1.0 + bend / PI
        }
        _ => return None,
    };
    Some(Edge { body, from, along, length, into, normal, n, roughness_m })
}

/// Direction, foot from the origin and normal of an edge, in millimetres.
type Line = ([i64; 3], [i64; 3], [i64; 3]);

/// Edges of the same two faces that follow one another become one: a box cut into many triangles has twelve.
fn chained(features: Vec<Feature>) -> Vec<Feature> {
    let (mut edges, mut out): (Vec<Edge>, Vec<Feature>) = (Vec::new(), Vec::new());
    for feature in features {
        match feature {
            Feature::Edge(edge) => edges.push(edge),
            other => out.push(other),
        }
    }
    // Edges on one line, side by side: sorted by line, then by place on it.
    let near = |a: f64, b: f64| (a - b).abs() < 1e-4;
    let key = |e: &Edge| {
        let foot = e.from - e.along * e.from.dot(&e.along);
        let round = |v: V3| [v.x, v.y, v.z].map(|c| (c * 1e3).round() as i64);
        (round(e.along), round(foot), round(e.normal))
    };
    let mut keyed: Vec<_> = edges.into_iter().map(|e| (key(&e), e.from.dot(&e.along), e)).collect();
    keyed.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut last: Option<(Line, f64, Edge)> = None;
    for (key, start, edge) in keyed {
        match &mut last {
            Some((line, from, chain)) if *line == key && near(start, *from + chain.length) && near(edge.n, chain.n) => {
                chain.length = start + edge.length - *from;
            }
            _ => {
                out.extend(last.take().map(|(_, _, chain)| Feature::Edge(chain)));
                last = Some((key, start, edge));
            }
        }
    }
    out.extend(last.map(|(_, _, chain)| Feature::Edge(chain)));
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::Shape;

    fn count(features: &[Feature]) -> (usize, usize) {
        let faces = features.iter().filter(|f| f.face().is_some()).count();
        (faces, features.len() - faces)
    }

    #[test]
    fn a_box_has_six_faces_and_twelve_right_angled_edges() {
        let mesh = Shape::Box { size: V3::new(1.0, 2.0, 3.0) }.tessellate(1.0);
        let features = features(&mesh, 7, 0.0, false);
        assert_eq!(count(&features), (6, 12));
        for feature in &features {
            match feature {
                Feature::Edge(e) => {
                    assert!((e.n - 1.5).abs() < 1e-12 && e.body == 7);
                    // The free space is where the bisector points: away from the middle.
                    let middle = e.from + e.along * (e.length / 2.0);
                    assert!(e.about(0.75 * PI).dot(&middle) > 0.0);
                    assert!((e.about(e.n * PI) - e.about(0.0)).norm() > 1.0);
                    assert!((e.bearing(&(middle + e.about(2.0))) - 2.0).abs() < 1e-9);
                }
                Feature::Face(f) => assert!(f.offset > 0.0 && f.holds(&(f.normal * f.offset))),
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn creases_of_a_finely_cut_box_are_still_twelve() {
        // Each side of a plate cut into 4 x 4 squares.
        let heights = vec![0.0; 25];
        let plate = Mesh::height_field(&heights, 5, 5, [0.25, 0.25]).unwrap();
        let features = features(&plate, 0, 0.0, true);
        // One face, and the four ends of the sheet.
        assert_eq!(count(&features), (1, 4));
        for feature in &features {
            if let Feature::Edge(e) = feature {
                assert!((e.length - 1.0).abs() < 1e-9 && e.n == 2.0);
            }
        }
    }

    #[test]
    fn a_valley_is_no_edge_and_a_roof_is_one() {
        for (height, edges) in [(0.5, 7), (-0.5, 6)] {
            let strip = Mesh::height_field(&[0.0, height, 0.0, 0.0, height, 0.0], 3, 2, [1.0, 1.0]).unwrap();
            assert_eq!(count(&features(&strip, 0, 0.0, true)), (2, edges));
        }
    }

    #[test]
    fn triangles_without_area_or_vertices_are_left_out() {
        let mesh = Mesh { vertices: vec![V3::zeros(), V3::x()], triangles: vec![[0, 1, 1], [0, 1, 9]] };
        assert!(features(&mesh, 0, 0.0, true).is_empty());
    }
}
