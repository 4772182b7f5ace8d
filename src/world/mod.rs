//! The simulated world: bodies with shapes and materials, read from `worlds/*.toml` or SDF, moved by rapier, cut by planes.

mod body;
mod collada;
mod mesh;
mod movers;
mod physics;
mod scene;
mod sdf;
mod shapes;
mod slice;
mod surfaces;
mod touch;
mod xml;

pub use body::{Body, Material, Mesh, Motion, Scene, Shape, Sunlit};
pub use mesh::load as load_mesh;
pub use movers::{Mover, Track};
pub use physics::{Physics, RobotBody, RobotVelocity, Rolling};
pub use scene::{Source, WorldSpec, toml_fault};
pub use sdf::load as load_sdf;
pub use slice::{Curve, Cut};
pub use surfaces::{Hit, Surfaces};
