//! Direct sun on parts of the world, in blocks of pixels: light that has no edge finer than a block.

use super::super::noise::Light;
use super::{Renderer, V3};
use crate::optics::Rig;
use crate::world::{Scene, Sunlit, Surfaces};

/// Side of a block [px].
const BLOCK_PX: usize = 16;

/// What the sun does to an image.
#[derive(Clone, Debug)]
pub(super) struct Sun {
    patches: Vec<Sunlit>,
    /// For each block, row by row: the line of sight through its middle in the camera's frame, and what a white surface
    /// there gives a pixel in it [electrons for 1 W/m²].
    blocks: Vec<Option<(V3, f64)>>,
    /// Blocks in a row.
    across: usize,
}

impl Sun {
    /// The sun of a scene; `electrons_per_w_m2` is what a white surface under 1 W/m² gives a pixel in the image's middle.
    pub fn new(rig: &Rig, scene: &Scene, vignetting: f64, electrons_per_w_m2: f64) -> Self {
        let (across, down) = (rig.camera.width.div_ceil(BLOCK_PX), rig.camera.height.div_ceil(BLOCK_PX));
        let middle = |block: usize| (block * BLOCK_PX) as f64 + (BLOCK_PX as f64 - 1.0) / 2.0;
        let block = |i: usize| {
            let ray = rig.camera.ray(middle(i % across), middle(i / across))?;
            Some((ray, electrons_per_w_m2 * ray.norm().powf(-vignetting)))
        };
        let blocks = if scene.sunlit.is_empty() { Vec::new() } else { (0..across * down).map(block).collect() };
        Self { patches: scene.sunlit.clone(), blocks, across }
    }
}

impl Renderer {
    /// Adds the sunlight that the camera sees from `eye`; `world_from_camera` turns its rays.
    pub(super) fn shine_sun(
        &self,
        surfaces: &Surfaces,
        eye: &V3,
        world_from_camera: &nalgebra::Matrix3<f64>,
        light: &mut Light,
    ) {
        for (i, block) in self.sun.blocks.iter().enumerate() {
            let Some((ray, electrons_per_w)) = block else { continue };
            let direction = world_from_camera * ray;
            let Some(hit) = surfaces.cast((*eye).into(), &direction, self.params.reach_m) else { continue };
            let at = eye + direction.normalize() * hit.range_m;
            let irradiance: f64 = self.sun.patches.iter().filter(|patch| patch.holds(&at)).map(|p| p.w_per_m2).sum();
            let albedo = self.materials.get(hit.body).map_or(0.0, |material| material.albedo);
            let electrons = irradiance * albedo * electrons_per_w;
            if electrons > 0.0 {
                let (column, row) = (i % self.sun.across * BLOCK_PX, i / self.sun.across * BLOCK_PX);
                light.add_block([column, row], BLOCK_PX, electrons);
            }
        }
    }
}
