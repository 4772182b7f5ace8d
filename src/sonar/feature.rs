//! What of a body sends sound back: faces, edges, corners between faces, upright and lying rods, balls and rims.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Point3};

use super::face::{Extent, Face, V3};
use super::weld;
use crate::world::{Body, Shape};

/// A line where two faces meet and stand out: sound bends around it.
#[derive(Clone, Debug)]
pub(super) struct Edge {
    pub body: u32,
    pub from: V3,
    /// Unit vector to its other end, `length` [m] away.
    pub along: V3,
    pub length: f64,
    /// In the first face, away from the edge; and that face's outward normal.
    pub into: V3,
    pub normal: V3,
    /// Free angle about the edge over π, 1 to 2.
    pub n: f64,
    pub roughness_m: f64,
}

/// A line where two faces meet and enclose free space: sound that comes from there goes back there.
#[derive(Clone, Debug)]
pub(super) struct Corner {
    pub body: u32,
    pub from: V3,
    pub along: V3,
    pub length: f64,
    /// Numbers of both faces, their normals, and the ways into them from the line.
    pub faces: [u32; 2],
    pub normals: [V3; 2],
    pub into: [V3; 2],
    /// How far both faces go on from the line [m].
    pub reach: [f64; 2],
    pub roughness_m: [f64; 2],
}

/// The mantle of a cylinder.
#[derive(Clone, Debug)]
pub(super) struct Rod {
    pub body: u32,
    pub from: V3,
    pub along: V3,
    pub length: f64,
    pub radius: f64,
    pub roughness_m: f64,
}

/// A ball.
#[derive(Clone, Debug)]
pub(super) struct Ball {
    pub body: u32,
    pub centre: V3,
    pub radius: f64,
    pub roughness_m: f64,
}

/// The round edge of a cylinder's lid; `axis` is the lid's outward normal.
#[derive(Clone, Debug)]
pub(super) struct Rim {
    pub body: u32,
    pub centre: V3,
    pub axis: V3,
    pub radius: f64,
    pub roughness_m: f64,
}

/// Any of them.
#[derive(Clone, Debug)]
pub(super) enum Feature {
    Face(Face),
    Edge(Edge),
    Corner(Corner),
    Rod(Rod),
    Ball(Ball),
    Rim(Rim),
}

impl Edge {
    /// The direction at this angle about the edge, from its first face through the free space [rad].
    pub fn about(&self, angle: f64) -> V3 {
        self.into * angle.cos() + self.normal * angle.sin()
    }

    /// The bearing of a point about the edge [rad], 0 to 2π.
    pub fn bearing(&self, p: &V3) -> f64 {
        let v = p - self.from;
        let angle = v.dot(&self.normal).atan2(v.dot(&self.into));
        if angle < 0.0 { angle + 2.0 * PI } else { angle }
    }
}

impl Feature {
    /// The features of a body in its own frame. A convex mesh edge is one of its creases.
    pub fn all_of(body: &Body, number: u32) -> Vec<Self> {
        let roughness_m = body.material.acoustic_roughness_m;
        match &body.shape {
            Shape::Plane => {
                vec![Self::Face(Face::new(number, V3::z(), V3::zeros(), Extent::Endless, roughness_m))]
            }
            Shape::Box { .. } => weld::features(&body.shape.tessellate(1.0), number, roughness_m, false),
            Shape::Mesh(mesh) => weld::features(mesh, number, roughness_m, true),
            Shape::Sphere { radius } => {
                vec![Self::Ball(Ball { body: number, centre: V3::zeros(), radius: *radius, roughness_m })]
            }
            Shape::Cylinder { radius, length } => {
                let from = V3::z() * (-length / 2.0);
                let (along, length, radius) = (V3::z(), *length, *radius);
                let mut all = vec![Self::Rod(Rod { body: number, from, along, length, radius, roughness_m })];
                for (centre, axis) in [(from, -along), (-from, along)] {
                    let lid = Extent::Disc { centre, radius };
                    all.push(Self::Face(Face::new(number, axis, centre, lid, roughness_m)));
                    all.push(Self::Rim(Rim { body: number, centre, axis, radius, roughness_m }));
                }
                all
            }
        }
    }

    pub fn moved(&self, pose: &Isometry3<f64>) -> Self {
        let place = |p: &V3| (pose * Point3::from(*p)).coords;
        let turn = |v: &V3| pose.rotation * v;
        match self {
            Self::Face(face) => Self::Face(face.moved(pose)),
            Self::Edge(e) => Self::Edge(Edge {
                from: place(&e.from),
                along: turn(&e.along),
                into: turn(&e.into),
                normal: turn(&e.normal),
                ..e.clone()
            }),
            Self::Corner(c) => Self::Corner(Corner {
                from: place(&c.from),
                along: turn(&c.along),
                normals: c.normals.each_ref().map(turn),
                into: c.into.each_ref().map(turn),
                ..c.clone()
            }),
            Self::Rod(r) => Self::Rod(Rod { from: place(&r.from), along: turn(&r.along), ..r.clone() }),
            Self::Ball(b) => Self::Ball(Ball { centre: place(&b.centre), ..b.clone() }),
            Self::Rim(r) => Self::Rim(Rim { centre: place(&r.centre), axis: turn(&r.axis), ..r.clone() }),
        }
    }

    /// The corners of a box that holds it; `None` for what has no end.
    pub fn bounds(&self) -> Option<(V3, V3)> {
        let around = |centre: &V3, reach: f64| (centre.add_scalar(-reach), centre.add_scalar(reach));
        let line = |from: &V3, along: &V3, length: f64, wide: f64| {
            let to = from + along * length;
            (from.inf(&to).add_scalar(-wide), from.sup(&to).add_scalar(wide))
        };
        let bounds = match self {
            Self::Face(face) => match &face.extent {
                Extent::Endless => return None,
                Extent::Disc { centre, radius } => around(centre, *radius),
                Extent::Patch(triangles) => {
                    let corners = || triangles.iter().flatten();
                    let start = (V3::repeat(f64::INFINITY), V3::repeat(f64::NEG_INFINITY));
                    corners().fold(start, |(low, high), c| (low.inf(c), high.sup(c)))
                }
            },
            Self::Edge(e) => line(&e.from, &e.along, e.length, 0.0),
            Self::Corner(c) => line(&c.from, &c.along, c.length, 0.0),
            Self::Rod(r) => line(&r.from, &r.along, r.length, r.radius),
            Self::Ball(b) => around(&b.centre, b.radius),
            Self::Rim(r) => around(&r.centre, r.radius),
        };
        Some(bounds)
    }

    pub fn face(&self) -> Option<&Face> {
        match self {
            Self::Face(face) => Some(face),
            _ => None,
        }
    }
}
