//! Whether a surface passes through a box: the truth that occupancy maps are held against.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::surfaces::{Flat, Form, Leaf, Set, Solid, Surfaces, Triangle};

type V3 = Vector3<f64>;

/// A box that may be turned; the columns of `axes` are its axes.
struct Probe {
    centre: V3,
    half: V3,
    axes: Matrix3<f64>,
}

impl Surfaces {
    /// Whether any surface passes through or touches the box from `min` to `max` (world frame, aligned with it) [m].
    /// Exact for every form; a box wholly inside a solid is not touched by its surface.
    pub fn touches(&self, min: [f64; 3], max: [f64; 3]) -> bool {
        let (min, max) = (V3::from(min), V3::from(max));
        let probe = Probe { centre: (min + max) / 2.0, half: (max - min) / 2.0, axes: Matrix3::identity() };
        self.fixed.touches(&probe)
            || self.moving.iter().any(|m| {
                let body_from_world = m.world_from_body.inverse();
                let axes = body_from_world.rotation.to_rotation_matrix().into_inner();
                let centre = (body_from_world * nalgebra::Point3::from(probe.centre)).coords;
                m.set.touches(&Probe { centre, half: probe.half, axes })
            })
    }
}

impl Set {
    fn touches(&self, probe: &Probe) -> bool {
        let reach = probe.axes.abs() * probe.half;
        let flat = |flat: &Flat| {
            let apart = (flat.normal.dot(&probe.centre) - flat.offset).abs();
            apart <= probe.axes.tr_mul(&flat.normal).abs().dot(&probe.half)
        };
        if self.flats.iter().any(flat) {
            return true;
        }
        let (min, max) = (probe.centre - reach, probe.centre + reach);
        let mut found = false;
        self.find(
            |low, high| (0..3).all(|i| low[i] <= max[i] && high[i] >= min[i]),
            |leaf| {
                found = match leaf {
                    Leaf::Triangle(triangle) => triangle.touches(probe),
                    Leaf::Solid(solid) => solid.touches(probe),
                };
                found
            },
        );
        found
    }
}

impl Triangle {
    /// Separating axes of a triangle and a box: the box's, the triangle's normal, and the nine products of edges.
    fn touches(&self, probe: &Probe) -> bool {
        let corners = self.corners.map(|c| probe.axes.tr_mul(&(c - probe.centre)));
        let [a, b, c] = corners;
        let apart = |axis: &V3| {
            let reach = axis.abs().dot(&probe.half);
            let [x, y, z] = [axis.dot(&a), axis.dot(&b), axis.dot(&c)];
            x.min(y).min(z) > reach || x.max(y).max(z) < -reach
        };
        if apart(&V3::x()) || apart(&V3::y()) || apart(&V3::z()) || apart(&(b - a).cross(&(c - a))) {
            return false;
        }
        ![b - a, c - b, a - c].iter().any(|edge| {
            let [x, y, z] = [edge.x, edge.y, edge.z];
            apart(&V3::new(0.0, -z, y)) || apart(&V3::new(z, 0.0, -x)) || apart(&V3::new(-y, x, 0.0))
        })
    }
}

impl Solid {
    /// Whether the surface passes through the probe: they overlap, and the probe is not wholly inside.
    fn touches(&self, probe: &Probe) -> bool {
        let centre = self.axes.tr_mul(&(probe.centre - self.centre));
        let axes = self.axes.tr_mul(&probe.axes);
        match self.form {
            Form::Block { half } => {
                let reach = axes.abs() * probe.half;
                let inside = (0..3).all(|i| centre[i].abs() + reach[i] < half[i]);
                !inside && blocks_overlap(&half, &centre, &axes, &probe.half)
            }
            Form::Ball { radius } => {
                let c = axes.tr_mul(&centre).abs();
                let nearest = (c - probe.half).map(|x| x.max(0.0)).norm_squared();
                nearest <= radius * radius && (c + probe.half).norm_squared() >= radius * radius
            }
            Form::Cylinder { radius, half } => cylinder_touched(radius, half, &centre, &axes, &probe.half),
        }
    }
}

/// Separating axes of the box ±`half` and the turned box at `centre` with the columns of `axes` and ±`other`.
fn blocks_overlap(half: &V3, centre: &V3, axes: &Matrix3<f64>, other: &V3) -> bool {
    let apart = |axis: &V3| {
        let reach = axis.abs().dot(half) + axes.tr_mul(axis).abs().dot(other);
        axis.dot(centre).abs() > reach * (1.0 + 1e-12)
    };
    let columns: [V3; 3] = std::array::from_fn(|i| axes.column(i).into_owned());
    let own: [V3; 3] = std::array::from_fn(|i| V3::ith(i, 1.0));
    let crossed = |axis: V3| axis.norm_squared() > 1e-18 && apart(&axis);
    !(own.iter().any(apart)
        || columns.iter().any(apart)
        || own.iter().any(|a| columns.iter().any(|b| crossed(a.cross(b)))))
}

/// Whether the surface of the cylinder (axis z, ±`half`) passes through the turned box. The part of the box between the
/// two end planes is seen along the axis: that is a convex polygon, and the question is how near it comes to the axis.
fn cylinder_touched(radius: f64, half: f64, centre: &V3, axes: &Matrix3<f64>, other: &V3) -> bool {
    let corner = |i: usize| {
        let side = |bit: usize, length: f64| if i >> bit & 1 == 1 { length } else { -length };
        centre + axes * V3::new(side(0, other.x), side(1, other.y), side(2, other.z))
    };
    let corners: [V3; 8] = std::array::from_fn(corner);
    if corners.iter().all(|p| p.z.abs() < half && p.xy().norm() < radius) {
        return false; // wholly inside
    }
    let mut kept = [Vector2::<f64>::zeros(); 32];
    let mut count = 0;
    let mut keep = |p: V3| {
        kept[count] = p.xy();
        count += 1;
    };
    corners.iter().filter(|p| p.z.abs() <= half).for_each(|p| keep(*p)); // at most 8
    for i in 0..8 {
        for j in [i | 1, i | 2, i | 4].into_iter().filter(|j| *j != i) {
            let (a, b) = (corners[i], corners[j]); // 12 edges, each cut at most twice
            for end in [-half, half] {
                if (a.z - end) * (b.z - end) < 0.0 {
                    keep(a + (b - a) * ((end - a.z) / (b.z - a.z)));
                }
            }
        }
    }
    let kept = &kept[..count];
    // The hull's edges are among the lines between all pairs.
    let mut nearest: Option<Vector2<f64>> = None;
    for (i, a) in kept.iter().enumerate() {
        for b in &kept[i..] {
            let way = b - a;
            let along =
                if way.norm_squared() > 0.0 { (-a.dot(&way) / way.norm_squared()).clamp(0.0, 1.0) } else { 0.0 };
            let p = a + way * along;
            if nearest.is_none_or(|n| p.norm_squared() < n.norm_squared()) {
                nearest = Some(p);
            }
        }
    }
    let Some(nearest) = nearest else { return false };
    let surrounds = kept.iter().any(|p| p.dot(&nearest) < nearest.norm_squared() - 1e-15);
    nearest.norm_squared() <= radius * radius || surrounds
}
