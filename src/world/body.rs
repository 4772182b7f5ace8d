//! What a world is made of.

use std::sync::Arc;

use nalgebra::{Isometry3, Vector3};
use serde::{Deserialize, Serialize};

use super::movers::Mover;

/// A triangle mesh in its body's own frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Vertices [m].
    pub vertices: Vec<Vector3<f64>>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// The form of a body, centred on its own frame (as SDF and rapier have it).
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// The endless plane z = 0 of its frame, solid below.
    Plane,
    /// A box with these full side lengths [m].
    Box {
        /// Full side lengths along x, y, z [m].
        size: Vector3<f64>,
    },
    /// An upright cylinder: axis z.
    Cylinder {
        /// Radius [m].
        radius: f64,
        /// Full length along z [m].
        length: f64,
    },
    /// A ball.
    Sphere {
        /// Radius [m].
        radius: f64,
    },
    /// Anything else: meshes, ramps, height fields. Shared, since many bodies may have the same mesh.
    Mesh(Arc<Mesh>),
}

/// How a surface answers light and sound.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Material {
    /// Share of the light scattered back diffusely, 0 to 1.
    pub albedo: f64,
    /// Share of the light mirrored, 0 to 1; albedo + gloss ≤ 1.
    pub gloss: f64,
    /// Share of the light that goes straight through, 0 to 1; albedo + gloss + transmission ≤ 1. From a half on light is not
    /// stopped: what is behind is lit and seen as if nothing stood before it [A]. Sound does not pass.
    pub transmission: f64,
    /// RMS angle by which mirrored light is off the mirror direction, one axis [rad]: 0 is a mirror, lacquer some 0.01 [A].
    pub gloss_spread_rad: f64,
    /// RMS height of the surface that sound sees [m]; 0 is a mirror to it.
    pub acoustic_roughness_m: f64,
    /// Coulomb friction.
    pub friction: f64,
    /// Colour in the viewer, sRGB.
    pub colour: [u8; 3],
}

impl Default for Material {
    fn default() -> Self {
        Self {
            albedo: 0.5,
            gloss: 0.0,
            transmission: 0.0,
            gloss_spread_rad: 0.01,
            acoustic_roughness_m: 0.0,
            friction: 0.8,
            colour: [170, 170, 170],
        }
    }
}

/// Whether a body moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// Never.
    Static,
    /// When pushed.
    Dynamic {
        /// Mass [kg].
        mass_kg: f64,
    },
    /// By script: one of the scene's movers carries it.
    Scripted,
}

/// One thing in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// Its name: unique in the scene.
    pub name: String,
    /// Its form.
    pub shape: Shape,
    /// Where its frame is in the world at the start.
    pub pose: Isometry3<f64>,
    /// Its surface.
    pub material: Material,
    /// Whether it moves.
    pub motion: Motion,
    /// Whether a robot could drive on it: ground, height field, ramp. What the terrain mesh is compared with.
    pub ground: bool,
}

/// A part of the world that direct sun falls on: all surfaces above a rectangle of the ground, as bright whichever way they
/// face [A].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sunlit {
    /// Its least x and y [m].
    pub from_m: [f64; 2],
    /// Its greatest x and y [m].
    pub to_m: [f64; 2],
    /// Irradiance within 10 nm about the laser's wavelength [W/m²].
    pub w_per_m2: f64,
}

impl Sunlit {
    /// Whether a point of the world lies in it.
    pub fn holds(&self, point: &Vector3<f64>) -> bool {
        (0..2).all(|axis| (self.from_m[axis]..=self.to_m[axis]).contains(&point[axis]))
    }
}

/// A world before anything moved.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// Its name.
    pub name: String,
    /// All bodies.
    pub bodies: Vec<Body>,
    /// Ambient irradiance within 10 nm about the laser's wavelength [W/m²].
    pub ambient_w_per_m2: f64,
    /// What moves by script.
    pub movers: Vec<Mover>,
    /// Where direct sun falls.
    pub sunlit: Vec<Sunlit>,
    /// What the file asks for and this program does not do or have: listed for the user, never dropped in silence.
    pub absent: Vec<String>,
}
