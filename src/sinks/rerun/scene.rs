//! What stands still: the true scene, the robot's body, the camera, names of the plots, and a page on how to read it all.

use std::fmt::Write as _;

use nalgebra::Vector3;
use rerun::{
    Cylinders3D, FillMode, LineStrips3D, Mesh3D, Pinhole, SeriesLines, TextDocument, Transform3D, ViewCoordinates,
};

use super::draw::HeightColours;
use super::maps::vertex_normals;
use super::{Out, entity, f32s, sonar};
use crate::fault::Result;
use crate::geometry::Transform;
use crate::optics::{Laser, Rig};
use crate::sinks::Start;
use crate::world::Mesh;

/// METRO-I is 0.6 m wide; how high its body is nobody has published [A].
const BODY_RADIUS_M: f32 = 0.3;

/// Meshes with more triangles than this are shaded smoothly, since sharp edges cost three vertices a triangle.
const SHARP_TRIANGLES_MAX: usize = 20_000;

/// How far in front of the camera its frustum is drawn [m].
const FRUSTUM_M: f32 = 0.35;

/// Draws all that never changes.
pub(super) fn draw_start(out: &Out, start: &Start, colours: &HeightColours) -> Result<()> {
    out.log_static("/world", &ViewCoordinates::FLU())?;
    for (name, colour, mesh) in &start.scene {
        if !mesh.triangles.is_empty() {
            out.log_static(entity(&["world", "scene", name]), &body(mesh, *colour))?;
        }
    }
    if start.has_finder {
        draw_robot(out, &start.rig)?;
    }
    let series = [
        ("point_rms_mm", "point RMS [mm]", [255, 80, 60]),
        ("pose_error_mm", "pose error [mm]", [90, 170, 255]),
        ("points", "points a capture", [120, 220, 120]),
        ("dropped", "columns dropped", [230, 180, 60]),
        ("lost", "lost in all", [255, 80, 60]),
    ];
    for (name, label, colour) in series {
        let line = SeriesLines::new().with_names([label]).with_colors([colour]).with_widths([1.5]);
        out.log_static(format!("/metrics/{name}"), &line)?;
    }
    out.log_static("/about", &TextDocument::from_markdown(about(start, colours)))
}

/// A body in the world's frame, sharp-edged where that is affordable.
fn body(mesh: &Mesh, [r, g, b]: [u8; 3]) -> Mesh3D {
    let vertices: Vec<[f32; 3]> = mesh.vertices.iter().map(f32s).collect();
    let fits = |t: &&[u32; 3]| t.iter().all(|index| (*index as usize) < vertices.len());
    let triangles: Vec<[u32; 3]> = mesh.triangles.iter().filter(fits).copied().collect();
    let colour = rerun::Rgba32::from_rgb(r, g, b);
    if triangles.len() > SHARP_TRIANGLES_MAX {
        let normals = vertex_normals(&vertices, &triangles);
        return Mesh3D::new(vertices)
            .with_triangle_indices(triangles)
            .with_vertex_normals(normals)
            .with_albedo_factor(colour);
    }
    let corners: Vec<[f32; 3]> = triangles.iter().flatten().map(|index| vertices[*index as usize]).collect();
    let own: Vec<[u32; 3]> = (0..triangles.len() as u32).map(|n| [3 * n, 3 * n + 1, 3 * n + 2]).collect();
    let normals = vertex_normals(&corners, &own);
    Mesh3D::new(corners).with_triangle_indices(own).with_vertex_normals(normals).with_albedo_factor(colour)
}

/// Body and finder of the robot; a finder without a mirror is no METRO-I, and only its camera is drawn.
fn draw_robot(out: &Out, rig: &Rig) -> Result<()> {
    if let Laser::Mirror(mirror) = rig.laser {
        let height = 0.75 * mirror.mirror_m[2].max(0.1) as f32;
        let base = Cylinders3D::from_lengths_and_radii([height], [BODY_RADIUS_M])
            .with_centers([[0.0, 0.0, height / 2.0]])
            .with_colors([[70, 90, 120]])
            .with_fill_mode(FillMode::Solid);
        out.log_static("/world/robot/body", &base)?;
        // A post with an arm that holds the camera; the mirror is in the post.
        let [x, y, z] = f32s(&rig.sensor_from_camera.xyz());
        let post = vec![[0.0, 0.0, height], [0.0, 0.0, z]];
        let arm = vec![[0.0, 0.0, z], [x, y, z]];
        let mast = LineStrips3D::new([post, arm]).with_colors([[200, 205, 215]]).with_radii([0.06f32, 0.02]);
        out.log_static("/world/robot/finder/mast", &mast)?;
    }
    let camera = &rig.camera;
    let size = [camera.width as f32, camera.height as f32];
    // Rerun counts from the corner of the first pixel, this crate from its centre.
    let [cx, cy] = [camera.cx as f32 + 0.5, camera.cy as f32 + 0.5];
    let pinhole = Pinhole::new([[camera.fx as f32, 0.0, 0.0], [0.0, camera.fy as f32, 0.0], [cx, cy, 1.0]])
        .with_resolution(size)
        .with_image_plane_distance(FRUSTUM_M)
        .with_color([255, 220, 120]);
    out.log_static("/world/robot/finder/camera", &pose(&rig.sensor_from_camera))?;
    out.log_static("/world/robot/finder/camera", &pinhole)
}

/// A transform as Rerun has it.
pub(super) fn pose<To, From>(to_from: &Transform<To, From>) -> Transform3D {
    placed(&to_from.iso)
}

/// An isometry as Rerun has it.
pub(super) fn placed(iso: &nalgebra::Isometry3<f64>) -> Transform3D {
    let q = iso.rotation.quaternion();
    let quaternion = rerun::Quaternion::from_xyzw([q.i as f32, q.j as f32, q.k as f32, q.w as f32]);
    Transform3D::from_translation(f32s(&iso.translation.vector)).with_quaternion(quaternion)
}

/// A body wider or lower than this is ground that goes on and on: it says nothing about where to look [m].
const GROUND_M: (f64, f64) = (40.0, 0.02);

/// The corners of the box around all bodies but the ground, and nothing where there are none.
pub(super) fn bounds(start: &Start) -> Option<[Vector3<f64>; 2]> {
    let boxes = start.scene.iter().filter_map(|(_, _, mesh)| {
        let first = *mesh.vertices.first()?;
        Some(mesh.vertices.iter().fold([first; 2], |[low, high], v| [low.inf(v), high.sup(v)]))
    });
    let boxes = boxes.filter(|[low, high]| (high - low).norm() < GROUND_M.0 && high.z - low.z > GROUND_M.1);
    boxes.reduce(|[low, high], [l, h]| [low.inf(&l), high.sup(&h)])
}

fn about(start: &Start, colours: &HeightColours) -> String {
    let [low, high] = colours.span_m;
    let mut page = format!(
        "# {}\n\nFinder: {}.\n\n\
         - **Red sheet and red points**: the laser light and what it met in this capture.\n\
         - **Points, voxels and terrain** are coloured by height: dark blue at {low:.2} m, green at {:.2} m, yellow at {high:.2} m.\n\
         - **Orange path**: where the robot believes to have driven.{}\n\
         - **Plan view**: white is free, black occupied, grey-green unknown.\n\
         - **Camera**: brightness is the square root of the light; the line found is green.\n\
         - Time runs below: drag it to go back. Below the scene are the maps made of the points: voxels and the mesh of the ground.\n",
        start.name,
        start.rig.name,
        (low + high) / 2.0,
        if start.scene.is_empty() { "" } else { " **Magenta path**: where it truly was." },
    );
    if !start.transducers.is_empty() {
        page += sonar::LEGEND;
    }
    for (key, value) in &start.metadata {
        let _ = write!(page, "\n- {key}: `{}`", value.replace('`', "'"));
    }
    page
}
