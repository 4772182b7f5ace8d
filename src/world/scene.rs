//! The `[world]` table of a scenario: what a user writes, checked, and built into a [`Scene`].
//!
//! Lengths are metres, angles degrees (`_deg`). Boxes, cylinders, spheres and tables stand on their `position`:
//! `[x, y]` puts their lowest point on z = 0, `[x, y, z]` on z, however they are turned. Ramps, height fields and
//! meshes have their own origin there: the middle of a ramp's base, the middle of a height field at height 0.

mod build;
mod source;
mod spec;

use std::collections::BTreeMap;

use serde::Deserialize;
use toml::Spanned;

pub use self::source::{Source, toml_fault};

use self::build::Builder;
use self::spec::{
    BoxSpec, Common, CylinderSpec, GroundSpec, HeightfieldSpec, MaterialSpec, MeshSpec, MoverSpec, Number, SphereSpec,
    SunlitSpec, TableSpec,
};
use super::body::{Scene, Shape};
use super::sdf;
use crate::fault::{Fault, Result};

/// Ambient irradiance of a lit room within the camera's 10 nm band-pass (W/m²) (instrument.md 1).
pub const AMBIENT_W_PER_M2: f64 = 0.06;

/// The `[world]` table of a scenario, as written.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldSpec {
    ambient_w_per_m2: Option<Number>,
    ground: Option<Spanned<GroundSpec>>,
    sdf: Option<Spanned<String>>,
    material: BTreeMap<String, Spanned<MaterialSpec>>,
    r#box: Vec<BoxSpec>,
    step: Vec<BoxSpec>,
    cylinder: Vec<CylinderSpec>,
    sphere: Vec<SphereSpec>,
    ramp: Vec<BoxSpec>,
    table: Vec<TableSpec>,
    heightfield: Vec<HeightfieldSpec>,
    mesh: Vec<MeshSpec>,
    mover: Vec<MoverSpec>,
    sunlit: Vec<SunlitSpec>,
}

impl WorldSpec {
    /// Checks everything and builds the scene. Its bodies stand in the order of the file, after those of the SDF world; its
    /// name is the file's stem.
    ///
    /// # Errors
    /// The first thing that is wrong, with file and line: a number out of range, a name used twice, an unknown
    /// material, a file that is missing or broken.
    pub fn build(&self, source: &Source) -> Result<Scene> {
        let mut builder = Builder::new(source, &self.material)?;
        let mut scene = Scene { ambient_w_per_m2: AMBIENT_W_PER_M2, ..Default::default() };
        if let Some(path) = &self.sdf {
            let file = source.beside(path.get_ref());
            if !file.exists() {
                let fault = Fault::new("world.sdf", format!("no file `{}`", file.display()), "a file that exists");
                return Err(source.locate(fault, &path.span()));
            }
            scene = sdf::load(&file, &source.model_path)?;
        }
        if let Some(ambient) = &self.ambient_w_per_m2 {
            scene.ambient_w_per_m2 = builder.within("world.ambient_w_per_m2", ambient, 0.0, 2000.0)?;
        }
        scene.name = source.file.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        builder.ground(self.ground.as_ref())?;
        for spec in &self.mover {
            builder.mover(spec)?;
        }
        for spec in &self.sunlit {
            scene.sunlit.push(builder.sunlit(spec)?);
        }
        for spec in &self.r#box {
            builder.upright(&spec.common("box"), false, |b, c| b.cuboid(c, &spec.size))?;
        }
        for spec in &self.step {
            builder.upright(&spec.common("step"), true, |b, c| b.cuboid(c, &spec.size))?;
        }
        for spec in &self.cylinder {
            builder.upright(&spec.common("cylinder"), false, |b, c| {
                let (radius, length) = (b.length(c, "radius", &spec.radius)?, b.length(c, "height", &spec.height)?);
                Ok(Shape::Cylinder { radius, length })
            })?;
        }
        for spec in &self.sphere {
            let shape = |b: &Builder, c: &Common| Ok(Shape::Sphere { radius: b.length(c, "radius", &spec.radius)? });
            builder.upright(&spec.common("sphere"), false, shape)?;
        }
        for spec in &self.ramp {
            builder.ramp(spec)?;
        }
        for spec in &self.table {
            builder.table(spec)?;
        }
        for spec in &self.heightfield {
            builder.heightfield(spec)?;
        }
        for spec in &self.mesh {
            builder.mesh(spec)?;
        }
        builder.finish(scene)
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use nalgebra::{Point3, Vector3};
    use proptest::prelude::*;

    use super::super::{Body, Motion};
    use super::*;

    #[derive(Deserialize)]
    struct Scenario {
        world: WorldSpec,
    }

    fn source(text: &str) -> Source {
        Source { file: PathBuf::from("worlds/test.toml"), text: text.to_string(), model_path: Vec::new() }
    }

    fn built(source: &Source) -> Result<Scene> {
        let scenario: Scenario = toml::from_str(&source.text).map_err(|error| toml_fault(source, &error))?;
        scenario.world.build(source)
    }

    #[track_caller]
    fn scene(text: &str) -> Scene {
        built(&source(text)).unwrap()
    }

    fn refused(text: &str) -> String {
        built(&source(text)).unwrap_err().to_string()
    }

    /// The bounds of a body in the world.
    fn bounds(body: &Body) -> (Vector3<f64>, Vector3<f64>) {
        let corners = body.shape.tessellate(100.0).vertices.into_iter().map(|v| body.pose * Point3::from(v));
        let start = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        corners.fold(start, |(low, high), p| (low.inf(&p.coords), high.sup(&p.coords)))
    }

    #[track_caller]
    fn close(found: Vector3<f64>, expected: [f64; 3]) {
        assert!((found - Vector3::from(expected)).norm() < 1e-9, "{found} {expected:?}");
    }

    #[test]
    fn bodies_stand_on_their_position() {
        let scene = scene(
            "[world]\nground = true\n\
             [[world.box]]\nname = 'a'\nposition = [1, 2]\nsize = [0.4, 0.2, 0.6]\nyaw_deg = 90\n\
             [[world.cylinder]]\nname = 'log'\nposition = [0, 0, 0.5]\nradius = 0.25\nheight = 2\nrpy_deg = [0, 90, 0]\n\
             [[world.sphere]]\nname = 'rock'\nposition = [3, 0, -0.3]\nradius = 0.3\n\
             [[world.box]]\nname = 'tilted'\nposition = [0, 0]\nsize = [1, 1, 1]\nrpy_deg = [45, 0, 0]\nmass_kg = 2\n\
             [[world.ramp]]\nname = 'ramp'\nposition = [5, 0]\nsize = [1, 0.6, 0.15]\nyaw_deg = 180\n",
        );
        assert_eq!(scene.name, "test");
        assert_eq!(scene.ambient_w_per_m2, AMBIENT_W_PER_M2);
        let names: Vec<_> = scene.bodies.iter().map(|body| body.name.as_str()).collect();
        assert_eq!(names, ["ground", "a", "log", "rock", "tilted", "ramp"]);
        let (low, high) = bounds(&scene.bodies[1]);
        close(low, [0.9, 1.8, 0.0]);
        close(high, [1.1, 2.2, 0.6]);
        let (low, high) = bounds(&scene.bodies[2]);
        close(low, [-1.0, -0.25, 0.5]);
        close(high, [1.0, 0.25, 1.0]);
        let (low, high) = bounds(&scene.bodies[3]);
        assert!((low.z + 0.3).abs() < 1e-9 && (high.z - 0.3).abs() < 1e-9);
        let (low, high) = bounds(&scene.bodies[4]);
        assert!(low.z.abs() < 1e-9 && (high.z - 2.0_f64.sqrt()).abs() < 1e-9);
        assert_eq!(scene.bodies[4].motion, Motion::Dynamic { mass_kg: 2.0 });
        // Turned round, the ramp is high at its small x.
        let ramp = &scene.bodies[5];
        let Shape::Mesh(mesh) = &ramp.shape else { panic!() };
        let top = mesh.vertices.iter().find(|v| v.z > 0.1).unwrap();
        assert!(((ramp.pose * Point3::from(*top)).x - 4.5).abs() < 1e-9);
        assert_eq!(scene.bodies.iter().map(|b| b.ground).collect::<Vec<_>>(), [true, false, false, false, false, true]);
    }

    #[test]
    fn bodies_ride_on_their_mover() {
        let text = "[[world.mover]]\nname = 'w'\npath = [[1, 2], [1, 5]]\nspeed_m_s = 1.5\nloop = true\n\
             [[world.box]]\nname = 'rider'\nposition = [0.5, 0]\nsize = [0.2, 0.2, 0.2]\nmover = 'w'\n\
             [[world.sunlit]]\nfrom = [0, 0]\nto = [1, 2]\n";
        let found = scene(text);
        assert_eq!(found.movers.len(), 1);
        assert_eq!((found.movers[0].bodies.as_slice(), found.bodies[0].motion), ([0].as_slice(), Motion::Scripted));
        // Its path heads along y: what is ahead of the mover is there, too.
        close(found.bodies[0].pose.translation.vector, [1.0, 2.5, 0.1]);
        let later = found.movers[0].moved(1.0) * found.bodies[0].pose;
        close(later.translation.vector, [1.0, 4.0, 0.1]);
        assert!(
            found.sunlit[0].holds(&Vector3::new(0.5, 1.0, 9.0)) && !found.sunlit[0].holds(&Vector3::new(1.5, 1.0, 0.0))
        );
        assert_eq!(found.sunlit[0].w_per_m2, 14.0);
        for (from, to, expected) in [
            ("mover = 'w'", "mover = 'v'", "test.toml:10: world.box `rider`: mover: found `v`, expected one of `w`"),
            ("mover = 'w'", "mover = 'w'\nmass_kg = 1", "mass_kg"),
            ("mover = 'w'\n", "", "test.toml:2: world.mover `w`: found no body"),
            ("speed_m_s = 1.5", "speed_m_s = 0", "test.toml:3: world.mover `w`: speed_m_s: found 0"),
            ("speed_m_s = 1.5", "", "one of the two"),
            ("[1, 5]", "[1]", "path: found 1 numbers"),
            ("[1, 5]", "[1, nan]", "path: found NaN"),
            ("to = [1, 2]", "to = [-1, 2]", "world.sunlit: to"),
            ("from = [0, 0]", "from = [0]", "world.sunlit: from: found 1 numbers"),
        ] {
            let fault = refused(&text.replacen(from, to, 1));
            assert!(fault.contains(expected), "{fault}");
        }
    }

    #[test]
    fn a_table_is_a_top_that_overhangs_four_legs() {
        let scene = scene(
            "[[world.table]]\nname = 't'\nposition = [1, 1]\nyaw_deg = 90\nsize = [0.9, 0.5, 0.42]\nleg_inset = 0.1\n\
             material = 'oak'\n[world.material.oak]\nalbedo = 0.3\n",
        );
        let names: Vec<_> = scene.bodies.iter().map(|body| body.name.as_str()).collect();
        assert_eq!(names, ["t/top", "t/leg1", "t/leg2", "t/leg3", "t/leg4"]);
        let (low, high) = bounds(&scene.bodies[0]);
        close(low, [0.75, 0.55, 0.38]);
        close(high, [1.25, 1.45, 0.42]);
        for leg in &scene.bodies[1..] {
            let (low, high) = bounds(leg);
            assert!(low.z.abs() < 1e-9 && (high.z - 0.38).abs() < 1e-9);
            let middle = (low + high) / 2.0;
            assert!(((middle.x - 1.0).abs() - 0.15).abs() < 1e-9 && ((middle.y - 1.0).abs() - 0.35).abs() < 1e-9);
            assert_eq!(leg.material.albedo, 0.3);
        }
    }

    #[test]
    fn height_fields_follow_their_function_and_their_seed() {
        let field = |heights: &str| {
            let text = format!(
                "[[world.heightfield]]\nname = 'h'\nposition = [0, 0, 1]\nsize = [4, 2]\nspacing = 0.5\n{heights}"
            );
            let Shape::Mesh(mesh) = scene(&text).bodies[0].shape.clone() else { panic!() };
            mesh
        };
        let waves = field("waves = [{ amplitude = 0.1, wavelength = 4, direction_deg = 90, phase_deg = 90 }]");
        assert_eq!(waves.vertices.len(), 9 * 5);
        for v in &waves.vertices {
            assert!((v.z - 0.1 * (v.y * std::f64::consts::TAU / 4.0).cos()).abs() < 1e-12);
        }
        let noise = |seed| field(&format!("noise = {{ amplitude = 0.1, wavelength = 1, seed = {seed} }}"));
        assert_eq!(noise(1), noise(1));
        assert_ne!(noise(1), noise(2));
        assert!(noise(3).vertices.iter().all(|v| v.z.abs() <= 0.1));
    }

    #[test]
    fn images_meshes_and_sdf_worlds_are_found_beside_the_scenario() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
        write("h.pgm", b"P5 3 2 255\n\x00\x01\x02\x03\x04\xff");
        write("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
        write("none.obj", b"v 0 0 0\n");
        write(
            "w.sdf",
            b"<sdf version='1.6'><world name='w'><model name='m'><static>1</static><link name='l'><collision name='c'>\
            <geometry><sphere><radius>0.5</radius></sphere></geometry></collision></link></model></world></sdf>",
        );
        let text = "[world]\nsdf = 'w.sdf'\nambient_w_per_m2 = 1\n\
            [[world.heightfield]]\nname = 'h'\nposition = [0, 0]\nimage = { file = 'h.pgm', m_per_level = 0.01, m_per_pixel = 2 }\n\
            [[world.mesh]]\nname = 'm'\nposition = [0, 0, 1]\nfile = 'm.obj'\nscale = 2\nmass_kg = 1\n";
        let source =
            |text: &str| Source { file: folder.path().join("s.toml"), text: text.to_string(), model_path: Vec::new() };
        let scene = built(&source(text)).unwrap();
        let names: Vec<_> = scene.bodies.iter().map(|body| body.name.as_str()).collect();
        assert_eq!(names, ["m/l/c", "h", "m"]);
        assert_eq!(scene.ambient_w_per_m2, 1.0);
        let (low, high) = bounds(&scene.bodies[1]);
        close(low, [-2.0, -1.0, 0.0]);
        close(high, [2.0, 1.0, 2.55]);
        close(bounds(&scene.bodies[2]).1, [2.0, 2.0, 1.0]);
        for (from, to, expected) in [
            ("m.obj", "none.obj", "s.toml:11: "),
            ("m.obj", "none.obj", "none.obj: mesh: found 0 triangles"),
            ("m.obj", "gone.obj", "gone.obj`, expected a file that exists"),
            ("m.obj", "gone.obj", "s.toml:11: world.mesh `m`: file"),
            ("scale = 2", "scale = [1, 0, 1]", "s.toml:12: scale: found 0"),
            ("scale = 2", "scale = [1, 0]", "s.toml:12: scale: found"),
            ("h.pgm", "m.obj", "s.toml:7: "),
            ("h.pgm", "gone.pgm", "gone.pgm"),
            ("sdf = 'w.sdf'", "sdf = 'gone.sdf'", "s.toml:2: world.sdf: found no file"),
            ("name = 'm'", "name = 'm/l/c'", "already used in the SDF world"),
        ] {
            let message = built(&source(&text.replace(from, to))).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn what_is_wrong_is_named_with_file_line_found_and_expected() {
        let body = "[world]\n[[world.box]]\nname = 'a'\nposition = [0, 0]\nsize = [1, 1, 1]\n";
        assert!(built(&source(body)).is_ok());
        let cases = [
            (format!("{body}sise = 2\n"), "test.toml:6: key `sise`: found a key that is not known here, expected"),
            (body.replace("[1, 1, 1]", "[1, -1, 1]"), "test.toml:5: world.box `a`: size: found -1, expected a number greater than 0"),
            (body.replace("[1, 1, 1]", "[1, 1]"), "test.toml:5: world.box `a`: size: found 2 numbers, expected 3 numbers"),
            (body.replace("[1, 1, 1]", "[1, 1, inf]"), "test.toml:5: world.box `a`: size: found inf"),
            (body.replace("[1, 1, 1]", "[1, 1, 1e300]"), "test.toml:5: world.box `a`: size: found 1e300"),
            (body.replace("[1, 1, 1]", "'big'"), "test.toml:5: size: found string \"big\", expected"),
            (body.replace("size = [1, 1, 1]\n", ""), "test.toml:2: key `size`: found no such key"),
            (body.replace("[0, 0]", "[0, nan]"), "test.toml:4: world.box `a`: position: found NaN"),
            (body.replace("[0, 0]", "[0]"), "test.toml:4: world.box `a`: position: found 1 numbers, expected [x, y] or [x, y, z]"),
            (body.replace("'a'", "''"), "test.toml:3: world.box: name: found an empty name"),
            (format!("{body}yaw_deg = 1\nrpy_deg = [0, 0, 0]\n"), "test.toml:6: world.box `a`: yaw_deg"),
            (format!("{body}yaw_deg = nan\n"), "test.toml:6: world.box `a`: yaw_deg: found NaN"),
            (format!("{body}rpy_deg = [0, 1]\n"), "test.toml:6: world.box `a`: rpy_deg: found 2 numbers"),
            (format!("{body}mass_kg = 0\n"), "test.toml:6: world.box `a`: mass_kg: found 0"),
            (format!("{body}mass_kg = '2'\n"), "test.toml:6: mass_kg: found string \"2\", expected f64"),
            (format!("{body}material = 'oak'\n"), "test.toml:6: world.box `a`: material: found `oak`, expected a table"),
            (format!("{body}{}", body.replace("[world]\n", "")), "test.toml:7: name: found `a`, already used in line 3"),
            (format!("{body}[world.material.m]\nalbedo = 0.7\ngloss = 0.4\n"), "test.toml:8: material `m`: albedo + gloss + transmission: found 1.1"),
            (format!("{body}[world.material.m]\nalbedo = 1.2\n"), "test.toml:7: material `m`: albedo: found 1.2"),
            (format!("{body}[world.material.m]\nshiny = 1\n"), "test.toml:7: key `shiny`"),
            (format!("{body}[world.material.m]\ncolour = [1, 2, 300]\n"), "test.toml:7: colour: found integer `300`, expected u8"),
            (format!("{body}[[world.sphere]]\nname = 'b'\nposition = [0, 0]\nradius = 0\n"), "test.toml:9: world.sphere `b`: radius"),
            ("[world]\nground = { height = 1 }\n".into(), "test.toml:2: key `height`"),
            ("[world]\nground = 3\n".into(), "test.toml:2: ground: found integer `3`, expected true, false or a table"),
            ("[world]\nground = { material = 'x' }\n".into(), "test.toml:2: world.ground: material: found `x`"),
            ("[world]\nambient_w_per_m2 = -1\n".into(), "test.toml:2: world.ambient_w_per_m2: found -1"),
            ("[[world.table]]\nname = 't'\nposition = [0, 0]\nsize = [0.1, 1, 1]\n".into(), "test.toml:4: world.table `t`: size"),
            ("[[world.table]]\nname = 't'\nposition = [0, 0]\nsize = [1, 1, 1]\nmass_kg = 1\n".into(), "test.toml:5: world.table `t`: mass_kg"),
            ("[[world.heightfield]]\nname = 'h'\nposition = [0, 0]\nsize = [1, 1]\n".into(), "test.toml:2: world.heightfield `h`: heights"),
            (
                "[[world.heightfield]]\nname = 'h'\nposition = [0, 0]\nsize = [1e5, 1e5]\nspacing = 1e-9\nnoise = { amplitude = 1, wavelength = 1 }\n".into(),
                "test.toml:5: height field: found",
            ),
            ("[world]\nground = true\n[[world.box]]\nname = 'ground'\nposition = [0, 0]\nsize = [1, 1, 1]\n".into(), "test.toml:4: name"),
            ("[world]\na b\n".into(), "test.toml:2: "),
            ("[world]\nground = true\nground = true\n".into(), "test.toml:3: ground: found duplicate key"),
            ("world = 1\n".into(), "test.toml:1: world: found integer `1`"),
            ("".into(), "test.toml"),
        ];
        for (text, expected) in cases {
            let message = refused(&text);
            assert!(message.contains(expected), "{message}\n  wanted {expected}");
            assert!(message.contains(": found ") && message.contains(", expected "), "{message}");
        }
    }

    #[test]
    fn offsets_become_lines() {
        let source = source("a\nb\n\nc");
        let lines: Vec<_> = [0, 1, 2, 3, 4, 5, 99].iter().map(|at| source.line_of(*at)).collect();
        assert_eq!(lines, [1, 1, 2, 2, 3, 4, 4]);
    }

    /// A world of this repository, whose text also has parts that are not this module's.
    fn shipped(name: &str) -> Scene {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("worlds").join(name);
        let source = Source::read(&file, &[]).unwrap();
        built(&source).unwrap()
    }

    /// The least distance of a body's bounds from the rectangle (±2, ±1) in the plane.
    fn from_lane(body: &Body) -> f64 {
        let (low, high) = bounds(body);
        let on_lane = (0..4000).map(|i| {
            let (side, t) = (i / 1000, f64::from(i % 1000) / 500.0 - 1.0);
            [(2.0 * t, 1.0), (2.0 * t, -1.0), (2.0, t), (-2.0, t)][side as usize]
        });
        let away = |x: f64, low: f64, high: f64| (low - x).max(x - high).max(0.0);
        on_lane.map(|(x, y)| away(x, low.x, high.x).hypot(away(y, low.y, high.y))).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn the_lab_leaves_its_lane_free() {
        let lab = shipped("lab.toml");
        assert!(lab.bodies.len() > 20);
        for body in lab.bodies.iter().filter(|body| body.name != "ground") {
            let distance = from_lane(body);
            assert!(distance >= 0.6, "{} {distance}", body.name);
            let (low, high) = bounds(body);
            assert!(low.z >= -1e-9 && high.z <= 1.0 + 1e-9, "{}", body.name);
            if !body.name.starts_with("wall") {
                assert!(low.x > -4.0 && high.x < 4.0 && low.y > -3.0 && high.y < 3.0, "{}", body.name);
            }
        }
        let moving: Vec<_> = lab.bodies.iter().filter(|b| b.motion != Motion::Static).collect();
        assert_eq!(moving.len(), 1);
        assert_eq!(moving[0].motion, Motion::Dynamic { mass_kg: 2.0 });
    }

    #[test]
    fn the_corridor_leaves_its_middle_free() {
        let corridor = shipped("corridor.toml");
        for body in corridor.bodies.iter().filter(|body| body.name != "ground") {
            let (low, high) = bounds(body);
            let is_end = body.name == "wall_east" || body.name == "wall_west";
            assert!(is_end || low.y >= 0.5 || high.y <= -0.5, "{}", body.name);
        }
    }

    #[test]
    fn the_terrain_is_gentle_and_its_rocks_are_half_sunk() {
        let terrain = shipped("terrain.toml");
        let Shape::Mesh(soil) = &terrain.bodies[0].shape else { panic!() };
        let corner = |i: u32| soil.vertices[i as usize];
        let steepest = soil
            .triangles
            .iter()
            .map(|&[a, b, c]| (corner(b) - corner(a)).cross(&(corner(c) - corner(a))).normalize().z.acos().to_degrees())
            .fold(0.0, f64::max);
        assert!((5.0..10.0).contains(&steepest), "{steepest}");
        let (low, high) = bounds(&terrain.bodies[0]);
        assert!(low.z > -0.15 && high.z < 0.15 && high.z - low.z > 0.15, "{} {}", low.z, high.z);
        let ground_at = |x: f64, y: f64| {
            let near = |v: &&Vector3<f64>| (v.x - x).hypot(v.y - y) < 0.0708;
            soil.vertices.iter().filter(near).map(|v| v.z).next().unwrap()
        };
        assert!(terrain.bodies.len() > 5);
        for body in &terrain.bodies[1..] {
            let middle = body.pose.translation.vector;
            let above = middle.z - ground_at(middle.x, middle.y);
            match body.shape {
                Shape::Sphere { radius } => assert!(above.abs() < radius / 3.0, "{} {above}", body.name),
                Shape::Cylinder { radius, .. } => assert!((above - radius).abs() < 0.06, "{} {above}", body.name),
                _ => panic!("{}", body.name),
            }
            assert!(from_lane(body) >= 0.6, "{}", body.name);
        }
    }

    proptest! {
        #[test]
        fn however_it_is_turned_a_body_stands_on_its_position(
            x in -9.0..9.0_f64, y in -9.0..9.0_f64, z in -1.0..1.0_f64,
            roll in -180.0..180.0_f64, pitch in -180.0..180.0_f64, yaw in -180.0..180.0_f64,
        ) {
            let place = format!("position = [{x:?}, {y:?}, {z:?}]\nrpy_deg = [{roll:?}, {pitch:?}, {yaw:?}]\n");
            let scene = scene(&format!(
                "[[world.box]]\nname = 'b'\nsize = [0.3, 0.5, 0.9]\n{place}\
                 [[world.sphere]]\nname = 's'\nradius = 0.4\n{place}"
            ));
            let (low, high) = bounds(&scene.bodies[0]);
            prop_assert!((low.z - z).abs() < 1e-9);
            prop_assert!(((low + high) / 2.0 - Vector3::new(x, y, 0.0)).xy().norm() < 1e-9);
            let lowest = scene.bodies[1].pose.translation.z - 0.4;
            prop_assert!((lowest - z).abs() < 1e-9);
        }

        #[test]
        fn no_text_makes_the_reader_panic(text in "(\\[world\\]|\\[\\[world.box\\]\\]|name|size|=|\\{|\\}|\\[|\\]|'|1|-|nan|\n| ){0,40}") {
            let _ = built(&source(&text));
        }
    }
}
