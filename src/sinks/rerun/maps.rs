//! Maps in the viewer: voxels, terrain and plan view, only what changed.

use nalgebra::Vector3;
use rerun::components::{Colormap, ImageFormat};
use rerun::{Boxes3D, ChannelDatatype, Clear, ColorModel, FillMode, GridMap, Mesh3D};

use super::Out;
use super::draw::HeightColours;
use crate::fault::Result;
use crate::maps::{MapChanges, PlanView, TerrainMesh};

/// The plan view lies this much under the floor, so that what is on the floor is seen [m].
const PLAN_UNDER_M: f64 = 0.05;

/// Draws what changed.
pub(super) fn draw(out: &Out, changes: &MapChanges, colours: &HeightColours) -> Result<()> {
    for ([i, j, k], centres) in &changes.blocks {
        let entity = format!("/world/occupancy/{i}_{j}_{k}");
        if centres.is_empty() {
            out.log(entity, &Clear::flat())?;
            continue;
        }
        let half = changes.voxel_m as f32 / 2.0;
        let voxels = Boxes3D::from_centers_and_half_sizes(centres, centres.iter().map(|_| [half; 3]))
            .with_colors(centres.iter().map(|c| colours.at(c[2])))
            .with_fill_mode(FillMode::Solid);
        out.log(entity, &voxels)?;
    }
    for ([i, j], tile) in &changes.tiles {
        let entity = format!("/world/terrain/{i}_{j}");
        if tile.triangles.is_empty() {
            out.log(entity, &Clear::flat())?;
        } else {
            out.log(entity, &terrain(tile, colours))?;
        }
    }
    if let Some(plan) = &changes.plan {
        draw_plan(out, "/plan", plan)?;
    }
    let Some(layers) = &changes.layers else { return Ok(()) };
    draw_plan(out, "/plan_ultrasonic", &layers.ultrasonic)?;
    draw_plan(out, "/plan_fused", &layers.fused)
}

fn terrain(tile: &TerrainMesh, colours: &HeightColours) -> Mesh3D {
    Mesh3D::new(&tile.vertices)
        .with_triangle_indices(&tile.triangles)
        .with_vertex_normals(vertex_normals(&tile.vertices, &tile.triangles))
        .with_vertex_colors(tile.vertices.iter().map(|v| colours.at(v[2])))
}

/// The normal at each vertex: the mean of its triangles' normals, weighted by their area; up where there is none.
pub(super) fn vertex_normals(vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut sums = vec![Vector3::<f32>::zeros(); vertices.len()];
    for triangle in triangles {
        let corner = |n: usize| vertices.get(triangle[n] as usize).map(|v| Vector3::from(*v));
        let (Some(a), Some(b), Some(c)) = (corner(0), corner(1), corner(2)) else { continue };
        let normal = (b - a).cross(&(c - a)); // twice the area long
        for index in triangle {
            sums[*index as usize] += normal;
        }
    }
    sums.iter().map(|sum| sum.try_normalize(1e-20).unwrap_or_else(Vector3::z).into()).collect()
}

fn draw_plan(out: &Out, entity: &str, plan: &PlanView) -> Result<()> {
    let rows = plan.cells.chunks_exact(plan.width.max(1));
    // The viewer takes the top row first; −1 becomes 255, which its map colours take for unknown.
    let cells: Vec<u8> = rows.rev().flatten().map(|cell| *cell as u8).collect();
    if cells.is_empty() || cells.len() != plan.cells.len() {
        return out.log(entity, &Clear::flat());
    }
    let size = [plan.width as u32, plan.height as u32];
    let format = ImageFormat::from_color_model(size, ColorModel::L, ChannelDatatype::U8);
    let [x, y] = plan.origin_m;
    let map = GridMap::new(cells, format, plan.resolution_m as f32)
        .with_translation([x as f32, y as f32, -PLAN_UNDER_M as f32])
        .with_colormap(Colormap::RvizMap);
    out.log(entity, &map)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_of_a_roof_lean_away_from_its_ridge() {
        // Two slopes that meet in a ridge along y at x = 0, and one vertex without a triangle.
        let vertices = [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 0.0], [9.0, 9.0, 9.0]];
        let normals = vertex_normals(&vertices, &[[0, 1, 2], [1, 3, 2], [0, 1, 99]]);
        let slope = std::f32::consts::FRAC_1_SQRT_2;
        assert!((normals[0][0] + slope).abs() < 1e-6 && (normals[0][2] - slope).abs() < 1e-6, "{normals:?}");
        assert!((normals[3][0] - slope).abs() < 1e-6, "{normals:?}");
        assert!(normals[1][0].abs() < 1e-6 && normals[1][2] > 0.99, "{normals:?}");
        assert_eq!(normals[4], [0.0, 0.0, 1.0]);
    }
}
