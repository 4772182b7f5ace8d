//! Shapes as triangles: primitives, ramps, height fields, and the checks every mesh has to pass.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use nalgebra::Vector3;

use super::body::{Mesh, Shape};
use crate::fault::{Fault, Result, number_within, positive};

/// Sides of a tessellated circle. A 64-gon of radius 1 m is 1.2 mm inside its circle.
const SIDES: usize = 64;

/// The largest coordinate and the largest size in a world (m): far beyond any, near enough for `f32` physics to take.
pub const REACH_M: f64 = 1e6;

/// The most samples a height field may have: a 2 km square at 1 m, or 20 m at 1 cm.
pub const HEIGHT_SAMPLES_MAX: usize = 4_000_000;

/// The most corners of a polygon that is not convex: cutting ears takes time with up to their cube.
const CONCAVE_CORNERS_MAX: usize = 1000;

/// The two corners of a box along the axes (m): smallest and largest coordinates.
pub type Bounds = ([f64; 3], [f64; 3]);

impl Shape {
    /// The shape's surface as triangles in its own frame, counter-clockwise seen from outside. Round shapes get 64
    /// sides with every vertex on the true surface; the endless plane becomes a square reaching `plane_half_size_m`
    /// from its origin.
    pub fn tessellate(&self, plane_half_size_m: f64) -> Mesh {
        match self {
            Shape::Plane => {
                let h = plane_half_size_m;
                let vertices = [[-h, -h], [h, -h], [h, h], [-h, h]].map(|[x, y]| Vector3::new(x, y, 0.0)).to_vec();
                Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }
            }
            Shape::Box { size } => cuboid(size),
            Shape::Cylinder { radius, length } => cylinder(*radius, *length),
            Shape::Sphere { radius } => sphere(*radius),
            Shape::Mesh(mesh) => mesh.as_ref().clone(),
        }
    }

    /// The shape with every size checked: greater than zero, at most 1000 km.
    ///
    /// # Errors
    /// A size that is not; a mesh that fails [`Mesh::validated`].
    pub fn validated(self) -> Result<Self> {
        match &self {
            Shape::Plane => {}
            Shape::Box { size } => {
                for (axis, side) in ["x", "y", "z"].iter().zip(size) {
                    length_within_reach(&format!("size along {axis}"), *side)?;
                }
            }
            Shape::Cylinder { radius, length } => {
                length_within_reach("radius", *radius)?;
                length_within_reach("length", *length)?;
            }
            Shape::Sphere { radius } => {
                length_within_reach("radius", *radius)?;
            }
            Shape::Mesh(mesh) => mesh.check()?,
        }
        Ok(self)
    }

    /// The bounds in the shape's own frame (m); `None` for the endless plane and for a mesh without vertices.
    pub fn bounds(&self) -> Option<Bounds> {
        let half = match self {
            Shape::Plane => return None,
            Shape::Mesh(mesh) => return mesh.bounds(),
            Shape::Box { size } => size / 2.0,
            Shape::Cylinder { radius, length } => Vector3::new(*radius, *radius, length / 2.0),
            Shape::Sphere { radius } => Vector3::repeat(*radius),
        };
        Some(((-half).into(), half.into()))
    }
}

impl Mesh {
    /// The bounds of all vertices (m); `None` if there are none.
    pub fn bounds(&self) -> Option<Bounds> {
        let first = *self.vertices.first()?;
        let (low, high) = self.vertices.iter().fold((first, first), |(low, high), v| (low.inf(v), high.sup(v)));
        Some((low.into(), high.into()))
    }

    /// The mesh, if it is fit for use.
    ///
    /// # Errors
    /// A vertex that is not finite or beyond 1000 km, an index out of range, no triangle.
    pub fn validated(self) -> Result<Self> {
        self.check()?;
        Ok(self)
    }

    fn check(&self) -> Result<()> {
        let lost = |v: &Vector3<f64>| !v.iter().all(|x| x.abs() <= REACH_M);
        if let Some((index, vertex)) = self.vertices.iter().enumerate().find(|(_, v)| lost(v)) {
            let found = format!("({}, {}, {})", vertex.x, vertex.y, vertex.z);
            let expected = format!("three numbers from -{REACH_M} to {REACH_M}");
            return Err(Fault::new(format!("mesh vertex {index}"), found, expected));
        }
        if self.triangles.is_empty() {
            return Err(Fault::new("mesh", "0 triangles", "at least one triangle"));
        }
        let count = self.vertices.len();
        for (index, triangle) in self.triangles.iter().enumerate() {
            if let Some(corner) = triangle.iter().find(|corner| **corner as usize >= count) {
                let expected = format!("an index below the {count} vertices");
                return Err(Fault::new(format!("mesh triangle {index}"), format!("vertex {corner}"), expected));
            }
        }
        Ok(())
    }

    /// The mesh stretched along each axis; mirrored meshes keep their outside outside.
    ///
    /// # Errors
    /// A factor that is zero or not finite.
    pub fn scaled(&self, factors: [f64; 3]) -> Result<Self> {
        if let Some(factor) = factors.iter().find(|f| !f.is_finite() || **f == 0.0) {
            return Err(Fault::new("scale", factor, "finite numbers other than 0"));
        }
        let factors = Vector3::from(factors);
        let vertices = self.vertices.iter().map(|v| v.component_mul(&factors)).collect();
        let mut mesh = Self { vertices, triangles: self.triangles.clone() };
        if factors.product() < 0.0 {
            mesh.turn_inside_out();
        }
        Ok(mesh)
    }

    /// Reverses the winding of every triangle.
    pub fn turn_inside_out(&mut self) {
        for [_, b, c] in &mut self.triangles {
            std::mem::swap(b, c);
        }
    }

    /// A ramp (m): a closed wedge on the base z = 0 centred on the origin, from height 0 at x = −length/2 to `height`
    /// at x = +length/2, where it falls off upright.
    ///
    /// # Errors
    /// A size that is not finite and greater than zero.
    pub fn ramp(length: f64, width: f64, height: f64) -> Result<Self> {
        let (x, y) = (positive("ramp length", length)? / 2.0, positive("ramp width", width)? / 2.0);
        let z = positive("ramp height", height)?;
        let vertices = [[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0], [x, -y, z], [x, y, z]];
        let triangles = vec![[0, 2, 1], [0, 3, 2], [0, 4, 5], [0, 5, 3], [1, 2, 5], [1, 5, 4], [0, 1, 4], [3, 5, 2]];
        Ok(Self { vertices: vertices.map(Vector3::from).to_vec(), triangles })
    }

    /// A height field centred on the origin, open below. `heights` (m) run along x first, from the smallest y up;
    /// `spacing` (m) is the distance of samples along x and y.
    ///
    /// # Errors
    /// Fewer than 2 samples along an axis, more than 4 million in all, a number of heights that does not
    /// fit, or a height or spacing that is not finite.
    pub fn height_field(heights: &[f64], columns: usize, rows: usize, spacing: [f64; 2]) -> Result<Self> {
        let [dx, dy] = spacing;
        positive("sample spacing along x", dx)?;
        positive("sample spacing along y", dy)?;
        height_samples(columns, rows)?;
        if columns * rows != heights.len() {
            return Err(Fault::new("height field", format!("{} heights", heights.len()), columns * rows));
        }
        if let Some((index, height)) = heights.iter().enumerate().find(|(_, h)| !h.is_finite()) {
            return Err(Fault::new(format!("height {index}"), height, "a finite number"));
        }
        let (middle_x, middle_y) = ((columns - 1) as f64 / 2.0, (rows - 1) as f64 / 2.0);
        let vertices = heights
            .iter()
            .enumerate()
            .map(|(i, height)| {
                let (column, row) = ((i % columns) as f64, (i / columns) as f64);
                Vector3::new((column - middle_x) * dx, (row - middle_y) * dy, *height)
            })
            .collect();
        let mut triangles = Vec::with_capacity(2 * (columns - 1) * (rows - 1));
        for row in 0..rows - 1 {
            for column in 0..columns - 1 {
                let here = (row * columns + column) as u32;
                let above = here + columns as u32;
                triangles.push([here, here + 1, above + 1]);
                triangles.push([here, above + 1, above]);
            }
        }
        Ok(Self { vertices, triangles })
    }
}

/// Checks that a length is greater than zero and at most 1000 km.
///
/// # Errors
/// A length that is not.
pub fn length_within_reach(what: &str, length: f64) -> Result<f64> {
    positive(what, length).and_then(|length| number_within(what, length, 0.0, REACH_M))
}

/// Checks that a height field of this many samples is neither empty nor beyond reason, and returns their number.
///
/// # Errors
/// Fewer than 2 along an axis; more than [`HEIGHT_SAMPLES_MAX`].
pub fn height_samples(columns: usize, rows: usize) -> Result<usize> {
    let found = format!("{columns} x {rows} samples");
    if columns < 2 || rows < 2 {
        return Err(Fault::new("height field", found, "at least 2 x 2"));
    }
    match columns.checked_mul(rows) {
        Some(count) if count <= HEIGHT_SAMPLES_MAX => Ok(count),
        _ => Err(Fault::new("height field", found, format!("at most {HEIGHT_SAMPLES_MAX} samples"))),
    }
}

/// Smooth noise of a place (x, y) (m): random values on a square lattice of half the `wavelength` (m), joined by
/// quintic steps, so that height and slope are continuous. Between −1 and 1; the same for the same seed, everywhere.
pub fn smooth_noise(seed: u64, wavelength: f64, x: f64, y: f64) -> f64 {
    let (u, v) = (2.0 * x / wavelength, 2.0 * y / wavelength);
    let (column, row) = (u.floor(), v.floor());
    let (su, sv) = (quintic(u - column), quintic(v - row));
    // Saturating casts: places beyond the range of an i64 all get one value.
    let (i, j) = (column as i64, row as i64);
    let value = |di: i64, dj: i64| lattice_value(seed, i.wrapping_add(di), j.wrapping_add(dj));
    let low = value(0, 0) * (1.0 - su) + value(1, 0) * su;
    let high = value(0, 1) * (1.0 - su) + value(1, 1) * su;
    low * (1.0 - sv) + high * sv
}

fn quintic(t: f64) -> f64 {
    t * t * t * (t * (6.0 * t - 15.0) + 10.0)
}

/// A number in [−1, 1) for a lattice point, by the SplitMix64 finaliser.
fn lattice_value(seed: u64, i: i64, j: i64) -> f64 {
    let scramble = |mut z: u64| {
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    let step = 0x9e37_79b9_7f4a_7c15_u64;
    let hash = [seed, i as u64, j as u64].into_iter().fold(0, |z, part| scramble((z ^ part).wrapping_add(step)));
    (hash >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Cuts a flat polygon into triangles: indices into `corners`. Convex ones become a fan; others lose one ear at a time.
/// Fewer than three corners give none.
///
/// # Errors
/// A polygon that is not convex and has more than 1000 corners.
pub fn triangulate_polygon(corners: &[Vector3<f64>]) -> Result<Vec<[usize; 3]>> {
    let count = corners.len();
    if count < 3 {
        return Ok(Vec::new());
    }
    let normal = polygon_normal(corners);
    let tolerance = 1e-9 * normal.norm_squared();
    let turn = |a: usize, b: usize, c: usize| {
        let (a, b, c) = (corners[a], corners[b], corners[c]);
        (b - a).cross(&(c - b)).dot(&normal)
    };
    if (0..count).all(|i| turn(i, (i + 1) % count, (i + 2) % count) >= -tolerance) {
        return Ok((1..count - 1).map(|i| [0, i, i + 1]).collect());
    }
    if count > CONCAVE_CORNERS_MAX {
        let expected = format!("at most {CONCAVE_CORNERS_MAX}");
        return Err(Fault::new("polygon that is not convex", format!("{count} corners"), expected));
    }
    let mut rest: Vec<usize> = (0..count).collect();
    let mut triangles = Vec::with_capacity(count - 2);
    while rest.len() > 3 {
        let n = rest.len();
        let corner = |i: usize| [rest[(i + n - 1) % n], rest[i], rest[(i + 1) % n]];
        let is_ear = |i: &usize| {
            let [a, b, c] = corner(*i);
            let inside = |p: usize| turn(a, b, p) >= 0.0 && turn(b, c, p) >= 0.0 && turn(c, a, p) >= 0.0;
            turn(a, b, c) > 0.0 && !rest.iter().any(|&p| p != a && p != b && p != c && inside(p))
        };
        // A polygon that crosses itself may have no ear left: any corner will then do.
        let ear = (0..n).find(is_ear).unwrap_or(0);
        triangles.push(corner(ear));
        rest.remove(ear);
    }
    triangles.push([rest[0], rest[1], rest[2]]);
    Ok(triangles)
}

/// Newell's normal: twice the enclosed area long.
fn polygon_normal(corners: &[Vector3<f64>]) -> Vector3<f64> {
    let origin = corners[0];
    corners
        .iter()
        .zip(corners.iter().cycle().skip(1))
        .fold(Vector3::zeros(), |sum, (a, b)| sum + (a - origin).cross(&(b - origin)))
}

fn cuboid(size: &Vector3<f64>) -> Mesh {
    let half = size / 2.0;
    let sign = |bit: usize| if bit == 0 { -1.0 } else { 1.0 };
    let corner = |i: usize| Vector3::new(sign(i & 1), sign(i & 2), sign(i & 4)).component_mul(&half);
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = faces.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    Mesh { vertices: (0..8).map(corner).collect(), triangles }
}

fn cylinder(radius: f64, length: f64) -> Mesh {
    let top = length / 2.0;
    let mut vertices = vec![Vector3::new(0.0, 0.0, -top), Vector3::new(0.0, 0.0, top)];
    let mut triangles = Vec::with_capacity(4 * SIDES);
    for side in 0..SIDES {
        let (sin, cos) = (TAU * side as f64 / SIDES as f64).sin_cos();
        vertices.push(Vector3::new(radius * cos, radius * sin, -top));
        vertices.push(Vector3::new(radius * cos, radius * sin, top));
        let low = (2 + 2 * side) as u32;
        let next = (2 + 2 * ((side + 1) % SIDES)) as u32;
        triangles.extend([[low, next, next + 1], [low, next + 1, low + 1], [0, next, low], [1, low + 1, next + 1]]);
    }
    Mesh { vertices, triangles }
}

fn sphere(radius: f64) -> Mesh {
    let stacks = SIDES / 2;
    let mut vertices = vec![Vector3::new(0.0, 0.0, -radius), Vector3::new(0.0, 0.0, radius)];
    for stack in 1..stacks {
        let (ring, z) = (PI * stack as f64 / stacks as f64).sin_cos();
        for side in 0..SIDES {
            let (sin, cos) = (TAU * side as f64 / SIDES as f64).sin_cos();
            vertices.push(Vector3::new(ring * cos, ring * sin, -z) * radius);
        }
    }
    let at = |stack: usize, side: usize| (2 + (stack - 1) * SIDES + side % SIDES) as u32;
    let mut triangles = Vec::with_capacity(2 * SIDES * (stacks - 1));
    for side in 0..SIDES {
        triangles.push([0, at(1, side + 1), at(1, side)]);
        triangles.push([1, at(stacks - 1, side), at(stacks - 1, side + 1)]);
        for stack in 1..stacks - 1 {
            let (a, b, c, d) = (at(stack, side), at(stack, side + 1), at(stack + 1, side + 1), at(stack + 1, side));
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    Mesh { vertices, triangles }
}

impl From<Mesh> for Shape {
    fn from(mesh: Mesh) -> Self {
        Shape::Mesh(Arc::new(mesh))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    /// Divergence theorem: positive only if the surface is wound outwards.
    fn volume(mesh: &Mesh) -> f64 {
        let v = |i: u32| mesh.vertices[i as usize];
        mesh.triangles.iter().map(|&[a, b, c]| v(a).dot(&v(b).cross(&v(c))) / 6.0).sum()
    }

    /// In a closed surface every edge is run once each way.
    fn is_closed(mesh: &Mesh) -> bool {
        let mut edges = BTreeMap::<(u32, u32), i32>::new();
        for &[a, b, c] in &mesh.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *edges.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
            }
        }
        edges.values().all(|balance| *balance == 0)
    }

    #[test]
    fn solids_are_closed_and_wound_outwards_with_their_true_volume() {
        let cube = Shape::Box { size: Vector3::new(1.0, 2.0, 3.0) }.tessellate(1.0);
        let can = Shape::Cylinder { radius: 0.5, length: 2.0 }.tessellate(1.0);
        let ball = Shape::Sphere { radius: 0.5 }.tessellate(1.0);
        let ramp = Mesh::ramp(1.0, 0.6, 0.15).unwrap();
        let exact = [(cube, 6.0), (can, PI * 0.5), (ball, PI / 6.0), (ramp, 0.045)];
        for (mesh, truth) in exact {
            let mesh = mesh.validated().unwrap();
            assert!(is_closed(&mesh));
            let share = volume(&mesh) / truth;
            assert!((0.995..1.0 + 1e-12).contains(&share), "{share}");
        }
    }

    #[test]
    fn round_shapes_have_every_vertex_on_the_surface() {
        let ball = Shape::Sphere { radius: 0.3 }.tessellate(1.0);
        assert!(ball.vertices.iter().all(|v| (v.norm() - 0.3).abs() < 1e-12));
        let can = Shape::Cylinder { radius: 0.3, length: 1.0 }.tessellate(1.0);
        let on_mantle = |v: &Vector3<f64>| (v.xy().norm() - 0.3).abs() < 1e-12 || v.xy().norm() == 0.0;
        assert!(can.vertices.iter().all(|v| on_mantle(v) && v.z.abs() == 0.5));
        assert!(can.triangles.len() >= 4 * 64);
        let bounds = Shape::Cylinder { radius: 0.3, length: 1.0 }.bounds().unwrap();
        assert_eq!(bounds, ([-0.3, -0.3, -0.5], [0.3, 0.3, 0.5]));
        assert!(Shape::Plane.bounds().is_none());
        assert_eq!(Shape::Plane.tessellate(5.0).bounds().unwrap(), ([-5.0, -5.0, 0.0], [5.0, 5.0, 0.0]));
    }

    #[test]
    fn bad_meshes_and_sizes_are_refused_with_the_reason() {
        let triangle = |v: [f64; 3], t: [u32; 3]| Mesh {
            vertices: vec![Vector3::zeros(), Vector3::x(), Vector3::from(v)],
            triangles: vec![t],
        };
        assert!(triangle([0.0, 1.0, 0.0], [0, 1, 2]).validated().is_ok());
        let fault = triangle([0.0, f64::NAN, 0.0], [0, 1, 2]).validated().unwrap_err();
        assert!(fault.to_string().contains("mesh vertex 2: found (0, NaN, 0)"), "{fault}");
        let fault = triangle([0.0, 1.0, 0.0], [0, 1, 3]).validated().unwrap_err();
        assert!(fault.to_string().contains("vertex 3, expected an index below the 3 vertices"), "{fault}");
        let fault = Mesh::default().validated().unwrap_err();
        assert!(fault.to_string().contains("0 triangles"), "{fault}");
        for size in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(Shape::Sphere { radius: size }.validated().is_err());
            assert!(Shape::Box { size: Vector3::new(1.0, size, 1.0) }.validated().is_err());
            assert!(Shape::Cylinder { radius: 1.0, length: size }.validated().is_err());
            assert!(Mesh::ramp(1.0, 1.0, size).is_err());
        }
        assert!(Shape::from(Mesh::default()).validated().is_err());
    }

    #[test]
    fn a_height_field_is_centred_and_faces_up() {
        let heights: Vec<f64> = (0..12).map(f64::from).collect();
        let mesh = Mesh::height_field(&heights, 4, 3, [0.5, 2.0]).unwrap();
        assert_eq!(mesh.bounds().unwrap(), ([-0.75, -2.0, 0.0], [0.75, 2.0, 11.0]));
        assert_eq!(mesh.vertices[4], Vector3::new(-0.75, 0.0, 4.0));
        for &[a, b, c] in &mesh.triangles {
            let [a, b, c] = [a, b, c].map(|i| mesh.vertices[i as usize]);
            assert!((b - a).cross(&(c - a)).z > 0.0);
        }
        assert!(Mesh::height_field(&heights, 5, 3, [1.0, 1.0]).is_err());
        assert!(Mesh::height_field(&heights, 12, 1, [1.0, 1.0]).is_err());
        assert!(Mesh::height_field(&[0.0, 0.0, 0.0, f64::NAN], 2, 2, [1.0, 1.0]).is_err());
        assert!(Mesh::height_field(&[], usize::MAX, usize::MAX, [1.0, 1.0]).is_err());
    }

    #[test]
    fn a_mirrored_mesh_keeps_its_outside() {
        let ramp = Mesh::ramp(1.0, 1.0, 1.0).unwrap();
        let mirrored = ramp.scaled([-1.0, 2.0, 1.0]).unwrap();
        assert!((volume(&mirrored) - 1.0).abs() < 1e-12);
        assert!(ramp.scaled([1.0, 0.0, 1.0]).is_err());
    }

    #[test]
    fn a_concave_polygon_keeps_its_area() {
        let outline = [[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];
        for start in 0..6 {
            let corners: Vec<_> =
                (0..6).map(|i| outline[(start + i) % 6]).map(|[x, y]| Vector3::new(0.5, x, y)).collect();
            let triangles = triangulate_polygon(&corners).unwrap();
            let area: f64 = triangles
                .iter()
                .map(|t| t.map(|i| corners[i]))
                .map(|[a, b, c]| (b - a).cross(&(c - a)).x / 2.0)
                .inspect(|area| assert!(*area > 0.0))
                .sum();
            assert!((area - 5.0).abs() < 1e-12);
        }
        assert!(triangulate_polygon(&[Vector3::zeros(); 2]).unwrap().is_empty());
    }

    proptest! {
        #[test]
        fn noise_is_bounded_smooth_and_repeatable(seed: u64, x in -50.0..50.0_f64, y in -50.0..50.0_f64) {
            let h = smooth_noise(seed, 2.0, x, y);
            prop_assert!(h.abs() <= 1.0);
            prop_assert_eq!(h.to_bits(), smooth_noise(seed, 2.0, x, y).to_bits());
            // The steepest quintic step is 15/8 over one lattice distance of 1 m, between values 2 apart at most.
            let step = smooth_noise(seed, 2.0, x + 1e-4, y) - h;
            prop_assert!(step.abs() <= 1e-4 * 2.0 * 15.0 / 8.0 + 1e-12);
        }

        #[test]
        fn any_shape_is_tessellated_within_its_bounds(a in 0.01..9.0_f64, b in 0.01..9.0_f64, c in 0.01..9.0_f64) {
            let shapes = [
                Shape::Box { size: Vector3::new(a, b, c) },
                Shape::Cylinder { radius: a, length: b },
                Shape::Sphere { radius: c },
            ];
            for shape in shapes {
                let (low, high) = shape.bounds().unwrap();
                let (mesh_low, mesh_high) = shape.tessellate(1.0).bounds().unwrap();
                for axis in 0..3 {
                    prop_assert!((low[axis] - mesh_low[axis]).abs() < 1e-9);
                    prop_assert!((high[axis] - mesh_high[axis]).abs() < 1e-9);
                }
            }
        }
    }
}
