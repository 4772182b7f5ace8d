//! The terrain as a mesh: ground between its cells, and nothing where none was seen.

use std::collections::BTreeMap;

use super::TerrainMesh;
use super::ground::{Ground, TerrainParams};
use super::mask::Mask;
use super::terrain::{Face, Sample, Tin};
use crate::fault::Result;

/// Side of a tile of the mesh for the viewer [m].
const TILE_M: f64 = 4.0;

/// The mesh over the ground, with its promise: no cell of ground that it covers is farther from it than allowed.
pub struct Surface {
    cell_m: f64,
    error_m_max: f64,
    /// In cells: cell (i, j) is at (i, j), heights in metres.
    tin: Option<Tin>,
    /// By the number of the face: whether ground was seen under it.
    kept: Vec<bool>,
}

impl Surface {
    /// A surface over nothing.
    pub fn empty(params: &TerrainParams) -> Self {
        Self { cell_m: params.cell_m, error_m_max: params.error_m_max, tin: None, kept: Vec::new() }
    }

    /// The mesh over what is ground.
    pub fn new(ground: &Ground, params: &TerrainParams) -> Result<Self> {
        let samples = ground.cells.iter().map(|(key, um)| Sample { at: key.map(f64::from), height: *um as f64 * 1e-6 });
        let hole_cells = (params.hole_m_max / params.cell_m + 1e-9).floor();
        let outline = Outline::new(ground, hole_cells);
        let mut tin = Tin::new(samples.collect())?;
        tin.refine(params.error_m_max)?;
        loop {
            // A triangle that reaches over what was not seen is split at the edge of what was.
            let splits: Vec<usize> = tin.faces().filter_map(|face| outline.split(&tin, &face)).collect();
            if splits.is_empty() {
                break;
            }
            splits.into_iter().try_for_each(|sample| tin.insert(sample))?;
            tin.refine(params.error_m_max)?;
        }
        let mut kept = vec![false; tin.face_ids()];
        tin.faces().for_each(|face| kept[face.id] = outline.keeps(&tin, &face));
        Ok(Self { cell_m: params.cell_m, error_m_max: params.error_m_max, tin: Some(tin), kept })
    }

    /// The height of the mesh at (x, y) in the world [m]; `None` where no ground was seen.
    pub fn height_at(&self, x_m: f64, y_m: f64) -> Option<f64> {
        let at = [x_m, y_m].map(|c| c / self.cell_m - 0.5);
        self.tin.as_ref()?.height_at(at, |face| self.keeps(face))
    }

    /// How far in height the farthest cell of ground is from the mesh over it [m].
    pub fn max_error_m(&self) -> f64 {
        let errors = self.tin.iter().flat_map(|tin| self.faces().map(|face| tin.error(face.id)));
        errors.fold(0.0, f64::max)
    }

    /// The whole mesh: vertices in the order of their cells.
    pub fn mesh(&self) -> TerrainMesh {
        self.mesh_of(self.faces())
    }

    /// The mesh in tiles of 4 m: a triangle is in the tile that its middle lies in.
    pub fn tiles(&self) -> BTreeMap<[i32; 2], TerrainMesh> {
        let mut tiles = BTreeMap::<[i32; 2], Vec<Face>>::new();
        for face in self.faces() {
            let middle = self.tin.iter().flat_map(|tin| face.corners.map(|corner| tin.sample(corner).at));
            let sum = middle.fold([0.0, 0.0], |sum, at| [sum[0] + at[0], sum[1] + at[1]]);
            let key = sum.map(|c| ((c / 3.0 + 0.5) * self.cell_m / TILE_M).floor() as i32);
            tiles.entry(key).or_default().push(face);
        }
        tiles.into_iter().map(|(key, faces)| (key, self.mesh_of(faces.into_iter()))).collect()
    }

    /// Checks what must always hold: the triangulation, and the promise for every cell of ground under a triangle.
    /// Returns the share of the cells of ground that the mesh covers.
    pub fn check(&self, ground: &Ground) -> std::result::Result<f64, String> {
        self.tin.iter().try_for_each(Tin::check)?;
        let mut covered = 0;
        for (key, um) in &ground.cells {
            let [x, y] = key.map(|c| (f64::from(c) + 0.5) * self.cell_m);
            let Some(height) = self.height_at(x, y) else { continue };
            covered += 1;
            let error = (height - *um as f64 * 1e-6).abs();
            if error > self.error_m_max + 1e-6 {
                return Err(format!("cell {key:?} is {error} m from the mesh"));
            }
        }
        if self.max_error_m() > self.error_m_max {
            return Err(format!("the error is {} m", self.max_error_m()));
        }
        Ok(if ground.cells.is_empty() { 1.0 } else { f64::from(covered) / ground.cells.len() as f64 })
    }

    fn keeps(&self, face: usize) -> bool {
        self.kept.get(face).copied().unwrap_or(false)
    }

    fn faces(&self) -> impl Iterator<Item = Face> {
        self.tin.iter().flat_map(Tin::faces).filter(|face| self.keeps(face.id))
    }

    fn mesh_of(&self, faces: impl Iterator<Item = Face>) -> TerrainMesh {
        let Some(tin) = &self.tin else { return TerrainMesh::default() };
        let faces: Vec<Face> = faces.collect();
        let mut corners: Vec<usize> = faces.iter().flat_map(|face| face.corners).collect();
        corners.sort_unstable();
        corners.dedup();
        let number = |corner: &usize| corners.partition_point(|c| c < corner) as u32;
        let triangles = faces.iter().map(|face| face.corners.each_ref().map(number)).collect();
        let vertex = |corner: &usize| {
            let Sample { at: [x, y], height } = tin.sample(*corner);
            [(x + 0.5) * self.cell_m, (y + 0.5) * self.cell_m, height].map(|c| c as f32)
        };
        TerrainMesh { vertices: corners.iter().map(vertex).collect(), triangles }
    }
}

/// Where ground was seen, gaps filled.
struct Outline {
    seen: Mask,
    /// Which samples are at the edge of it.
    edge: Vec<bool>,
    /// Triangles with no longer side than this are kept: what they span is a gap [cells].
    hole_cells: f64,
}

/// How many cells a triangle covers, and over how many of them ground was seen.
struct Cover {
    cells: u64,
    seen: u64,
}

impl Outline {
    fn new(ground: &Ground, hole_cells: f64) -> Self {
        let seen = Mask::new(ground.cells.iter().map(|(key, _)| *key)).closed((hole_cells / 2.0) as i32);
        let beside = |[x, y]: [i32; 2]| [[x + 1, y], [x - 1, y], [x, y + 1], [x, y - 1]];
        let edge = ground.cells.iter().map(|(key, _)| !beside(*key).into_iter().all(|cell| seen.has(cell))).collect();
        Self { seen, edge, hole_cells }
    }

    /// The sample at which to split a triangle that reaches over too much unseen: the one farthest from its corners, at
    /// the edge of what was seen if there is one.
    fn split(&self, tin: &Tin, face: &Face) -> Option<usize> {
        let within = tin.within(face.id);
        if within.is_empty() || self.is_small(tin, face) || self.is_seen(&self.cover(tin, face)) {
            return None;
        }
        let spread = |sample: &usize| {
            let at = tin.sample(*sample).at;
            let far = face.corners.map(|corner| distance_2(tin.sample(corner).at, at));
            far.into_iter().fold(f64::INFINITY, f64::min)
        };
        within.iter().copied().max_by(|a, b| {
            let order = self.edge[*a].cmp(&self.edge[*b]);
            order.then(spread(a).total_cmp(&spread(b))).then(b.cmp(a))
        })
    }

    fn keeps(&self, tin: &Tin, face: &Face) -> bool {
        if self.is_small(tin, face) {
            return true;
        }
        let cover = self.cover(tin, face);
        self.is_seen(&cover) && 2 * cover.seen >= cover.cells
    }

    fn is_small(&self, tin: &Tin, face: &Face) -> bool {
        let [a, b, c] = face.corners.map(|corner| tin.sample(corner).at);
        let longest = distance_2(a, b).max(distance_2(b, c)).max(distance_2(c, a));
        longest <= self.hole_cells * self.hole_cells
    }

    /// Whether what is unseen under a triangle is less than a quarter of the largest hole.
    fn is_seen(&self, cover: &Cover) -> bool {
        ((cover.cells - cover.seen) as f64) <= (self.hole_cells / 2.0).powi(2)
    }

    fn cover(&self, tin: &Tin, face: &Face) -> Cover {
        let corners = face.corners.map(|corner| tin.sample(corner).at);
        let low = corners.iter().map(|at| at[0]).fold(f64::INFINITY, f64::min) as i32;
        let high = corners.iter().map(|at| at[0]).fold(f64::NEG_INFINITY, f64::max) as i32;
        let mut cover = Cover { cells: 0, seen: 0 };
        for x in low..=high {
            let Some((from, to)) = across(&corners, f64::from(x)) else { continue };
            cover.cells += u64::try_from(to - from + 1).unwrap_or(0);
            cover.seen += self.seen.count(x, from, to);
        }
        cover
    }
}

/// The whole y within a triangle at x: the lowest and the highest, which is lower than the lowest where there is none.
fn across(corners: &[[f64; 2]; 3], x: f64) -> Option<(i32, i32)> {
    let mut range: Option<(f64, f64)> = None;
    let mut reach = |y: f64| range = Some(range.map_or((y, y), |(low, high)| (low.min(y), high.max(y))));
    for i in 0..3 {
        let ([ax, ay], [bx, by]) = (corners[i], corners[(i + 1) % 3]);
        if ax == x {
            reach(ay);
        } else if (ax < x) != (bx < x) && bx != x {
            reach(ay + (by - ay) * (x - ax) / (bx - ax));
        }
    }
    range.map(|(low, high)| ((low - 1e-9).ceil() as i32, (high + 1e-9).floor() as i32))
}

fn distance_2(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ground(cells: impl IntoIterator<Item = ([i32; 2], f64)>) -> Ground {
        let mut cells: Vec<_> = cells.into_iter().map(|(key, height)| (key, (height * 1e6).round() as i64)).collect();
        cells.sort_unstable();
        Ground { cell_m: 0.05, cells }
    }

    fn surface(ground: &Ground) -> Surface {
        Surface::new(ground, &TerrainParams::default()).unwrap()
    }

    fn grid(x: std::ops::Range<i32>, y: std::ops::Range<i32>) -> impl Iterator<Item = [i32; 2]> {
        x.flat_map(move |i| y.clone().map(move |j| [i, j]))
    }

    fn noise([x, y]: [i32; 2]) -> f64 {
        let mixed = ((i64::from(x) << 32) ^ i64::from(y)).wrapping_mul(0x1e37_79b9_7f4a_7c15) as u64 >> 40;
        (mixed as f64 / f64::from(1 << 24) - 0.5) * 0.01
    }

    #[test]
    fn nothing_spans_what_was_not_seen() {
        // A ring of floor around a robot that has not moved, with a box of 1 m and a gap of 0.3 m in it.
        let seen = |[x, y]: &[i32; 2]| {
            let range = f64::from(x * x + y * y).sqrt() * 0.05;
            let boxed = (44..64).contains(x) && (-10..10).contains(y);
            let gap = (-50..-44).contains(x);
            (1.4..3.7).contains(&range) && !boxed && !gap
        };
        let ground = ground(grid(-80..80, -80..80).filter(seen).map(|key| (key, noise(key))));
        let surface = surface(&ground);
        let covered = surface.check(&ground).unwrap();
        let mesh = surface.mesh();
        assert!(covered > 0.995, "{covered}");
        assert!(mesh.vertices.len() < 400);
        assert_eq!(surface.height_at(0.0, 0.0), None);
        assert_eq!(surface.height_at(0.0, 1.0), None);
        assert_eq!(surface.height_at(2.7, 0.0), None); // on the box
        assert_eq!(surface.height_at(3.5, 3.5), None); // beyond the ring
        assert!(surface.height_at(-2.35, 0.0).unwrap().abs() < 0.02); // in the gap
        assert!(surface.height_at(0.0, 2.0).unwrap().abs() < 0.02);
        // No place of the mesh is far from what was seen.
        let mask = Mask::new(ground.cells.iter().map(|(key, _)| *key));
        let mut stray = 0;
        for [x, y] in grid(-80..80, -80..80) {
            let near = (x - 5..=x + 5).any(|x| mask.count(x, y - 5, y + 5) > 0);
            let meshed = surface.height_at((f64::from(x) + 0.5) * 0.05, (f64::from(y) + 0.5) * 0.05).is_some();
            stray += usize::from(meshed && !near);
        }
        assert_eq!(stray, 0);
    }

    #[test]
    fn tiles_are_the_mesh_cut_up() {
        let hill =
            |key: [i32; 2]| 0.3 * (f64::from(key[0]) * 0.05).sin() * (f64::from(key[1]) * 0.03).cos() + noise(key);
        let ground = ground(grid(-100..100, -60..60).map(|key| (key, hill(key))));
        let surface = surface(&ground);
        assert!(surface.check(&ground).unwrap() > 0.999);
        let (mesh, tiles) = (surface.mesh(), surface.tiles());
        assert_eq!(tiles.values().map(|tile| tile.triangles.len()).sum::<usize>(), mesh.triangles.len());
        assert!(tiles.len() >= 6 && tiles.len() <= 12, "{:?}", tiles.keys());
        for ([i, j], tile) in &tiles {
            for triangle in &tile.triangles {
                let corner = |n: usize, axis: usize| f64::from(tile.vertices[triangle[n] as usize][axis]);
                let middle = [0, 1].map(|axis| (corner(0, axis) + corner(1, axis) + corner(2, axis)) / 3.0 / TILE_M);
                assert!(
                    (middle[0] - f64::from(*i) - 0.5).abs() <= 0.5001
                        && (middle[1] - f64::from(*j) - 0.5).abs() <= 0.5001
                );
                let area = (corner(1, 0) - corner(0, 0)) * (corner(2, 1) - corner(0, 1))
                    - (corner(1, 1) - corner(0, 1)) * (corner(2, 0) - corner(0, 0));
                assert!(area > 0.0, "a triangle is seen from below");
            }
        }
        assert!(surface.max_error_m() > 0.0 && surface.max_error_m() <= 0.02);
    }

    #[test]
    fn little_ground_makes_little_mesh() {
        for cells in [vec![], vec![[3, 4]], (0..40).map(|i| [i, 2 * i]).collect(), (0..40).map(|i| [0, i]).collect()] {
            let ground = ground(cells.into_iter().map(|key| (key, 0.1)));
            let surface = surface(&ground);
            assert!(surface.check(&ground).is_ok());
            assert_eq!((surface.mesh(), surface.tiles().len()), (TerrainMesh::default(), 0));
            assert_eq!((surface.height_at(0.1, 0.1), surface.max_error_m()), (None, 0.0));
        }
        assert_eq!(Surface::empty(&TerrainParams::default()).mesh(), TerrainMesh::default());
    }

    #[test]
    fn cells_of_a_triangle_are_counted_once() {
        let corners = [[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]];
        let lines: Vec<_> = (-1..=5).map(|x| across(&corners, f64::from(x))).collect();
        assert_eq!(lines, [None, Some((0, 4)), Some((0, 3)), Some((0, 2)), Some((0, 1)), Some((0, 0)), None]);
        assert_eq!(across(&[[0.0, 0.2], [4.0, 0.4], [8.0, 0.3]], 2.0), Some((1, 0))); // between the cells
    }

    proptest! {
        #[test]
        fn any_ground_is_covered_within_the_promise(
            cells in prop::collection::btree_map(prop::array::uniform2(-25..25i32), -0.3..0.3f64, 0..200),
        ) {
            let ground = ground(cells);
            let surface = surface(&ground);
            prop_assert!(surface.check(&ground).is_ok(), "{:?}", surface.check(&ground));
        }
    }
}
