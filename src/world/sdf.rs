//! Worlds of the Simulation Description Format as they are: the collision shapes of a `.world` or `.sdf` file and of all
//! it includes, placed through the whole chain of poses.
//!
//! What the format can say and this program does not do is listed in [`Scene::absent`], once a kind, with its count.

mod files;
mod pose;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use roxmltree::Node;

use self::files::{Found, Lookup, SourceFile, description_in, is_ground_plane};
use self::pose::{node_pose, pose_numbers, relative_to};
use super::body::{Body, Material, Mesh, Motion, Scene, Shape};
use super::mesh;
use super::scene::AMBIENT_W_PER_M2;
use super::xml::{self, child, children, elements, exactly, fault, line_of, required, tag, trimmed};
use crate::fault::{Fault, Result, positive};

/// Includes in all: files that include one another twice each multiply without bound.
const INCLUDES_MAX: usize = 10_000;

/// Collision shapes in all.
const BODIES_MAX: usize = 1_000_000;

/// Models within models, and frames relative to frames.
const DEPTH_MAX: usize = 50;

/// Reads a `.world` or `.sdf` file, gzip'ed or not, and the models it includes.
///
/// `model://NAME` is looked up beside the file, in the folder above, in the `models` folders of all folders above, and in
/// `model_path`, in this order; includes that are nowhere and URIs of the network are listed as absent.
///
/// # Errors
/// A file that cannot be read or breaks the format; a mesh of a collision that is missing or broken; includes that
/// include themselves.
pub fn load(path: &Path, model_path: &[PathBuf]) -> Result<Scene> {
    let file = SourceFile::open(path)?;
    let mut loader = Loader { lookup: Lookup::new(&file, model_path), ..Default::default() };
    loader.scene.ambient_w_per_m2 = AMBIENT_W_PER_M2;
    loader.chain.push(file.identity.clone());
    let text = file.text()?;
    let document = xml::parse(&text).map_err(|fault| fault.in_file(path))?;
    loader.root(document.root_element(), &file).map_err(|fault| fault.in_file(path))?;
    Ok(loader.finished())
}

/// What an `<include>` says of the model it brings in, or a model of the world around it.
#[derive(Default)]
struct Override {
    name: Option<String>,
    /// Parent from model.
    pose: Option<Isometry3<f64>>,
    is_static: Option<bool>,
}

/// Where in the world and under what name something stands.
struct Place {
    world_from_parent: Isometry3<f64>,
    /// Names from the outermost model on, each followed by `/`.
    prefix: String,
    is_static: bool,
    depth: usize,
}

#[derive(Default)]
struct Loader {
    lookup: Lookup,
    scene: Scene,
    absent: BTreeMap<String, usize>,
    names: BTreeMap<String, usize>,
    used_names: BTreeSet<String>,
    meshes: BTreeMap<(PathBuf, [u64; 3]), Arc<Mesh>>,
    /// The files being read, outermost first.
    chain: Vec<PathBuf>,
    includes: usize,
}

/// A length or mass: one number greater than 0.
fn measure(parent: Node, name: &'static str) -> Result<f64> {
    let node = required(parent, name)?;
    let [value] = exactly(node)?;
    positive(name, value).map_err(|fault| fault.at_line(line_of(node)))
}

fn boolean(node: Node) -> Result<bool> {
    match trimmed(node).as_str() {
        "1" | "true" | "True" => Ok(true),
        "0" | "false" | "False" => Ok(false),
        other => Err(fault(node, tag(node), format!("`{other}`"), "`true` or `false`")),
    }
}

fn name_of<'a>(node: Node<'a, '_>) -> Result<&'a str> {
    let name = node.attribute("name").map(str::trim).filter(|name| !name.is_empty());
    name.ok_or_else(|| fault(node, tag(node), "no name", "an attribute `name`"))
}

impl Loader {
    fn finished(mut self) -> Scene {
        let counted = |(what, count): (String, usize)| if count == 1 { what } else { format!("{what} (x{count})") };
        self.scene.absent = self.absent.into_iter().map(counted).collect();
        self.scene
    }

    fn absent(&mut self, what: impl Into<String>) {
        *self.absent.entry(what.into()).or_default() += 1;
    }

    /// Lists an element that is not understood under its parent's name.
    fn absent_element(&mut self, parent: &str, node: Node) {
        self.absent(format!("<{}> in <{parent}>", tag(node)));
    }

    fn root(&mut self, root: Node, file: &SourceFile) -> Result<()> {
        if tag(root) != "sdf" && tag(root) != "gazebo" {
            return Err(fault(root, "root element", format!("<{}>", tag(root)), "<sdf>"));
        }
        let outermost =
            Place { world_from_parent: Isometry3::identity(), prefix: String::new(), is_static: false, depth: 0 };
        let mut found = false;
        for node in elements(root) {
            match tag(node) {
                "world" if !found => {
                    found = true;
                    self.scene.name = node.attribute("name").unwrap_or_default().to_string();
                    self.world(node, &outermost, file)?;
                }
                "model" if !found => {
                    found = true;
                    self.scene.name = node.attribute("name").unwrap_or_default().to_string();
                    self.model(node, None, &outermost, file, Override::default())?;
                }
                _ => self.absent_element("sdf", node),
            }
        }
        if found { Ok(()) } else { Err(fault(root, "sdf", "no <world> and no <model>", "one of them")) }
    }

    fn world(&mut self, world: Node, place: &Place, file: &SourceFile) -> Result<()> {
        for node in elements(world) {
            match tag(node) {
                "model" => self.model(node, Some(world), place, file, Override::default())?,
                "include" => self.include(node, world, place, file)?,
                // A named frame does nothing by itself.
                "frame" => {}
                _ => self.absent_element("world", node),
            }
        }
        Ok(())
    }

    /// A model within `scope` (the world or model that holds it; `None` for the root of an included file).
    fn model(
        &mut self,
        model: Node,
        scope: Option<Node>,
        place: &Place,
        file: &SourceFile,
        over: Override,
    ) -> Result<()> {
        if place.depth >= DEPTH_MAX {
            return Err(fault(model, "model", "models within models without end", "at most 50 deep"));
        }
        for attribute in model.attributes().filter(|a| !matches!(a.name(), "name" | "canonical_link")) {
            self.absent(format!("attribute `{}` of <model>", attribute.name()));
        }
        let name = over.name.map_or_else(|| name_of(model).map(str::to_string), Ok)?;
        let parent_from_model = match over.pose {
            Some(pose) => pose,
            None => self.pose_within(model, scope, 0)?,
        };
        let own_static = child(model, "static").map(boolean).transpose()?;
        let here = Place {
            world_from_parent: place.world_from_parent * parent_from_model,
            prefix: format!("{}{name}/", place.prefix),
            is_static: place.is_static || over.is_static.or(own_static).unwrap_or(false),
            depth: place.depth + 1,
        };
        let motion = self.motion(model, here.is_static)?;
        for node in elements(model) {
            match tag(node) {
                "link" => self.link(node, model, &here, motion, file)?,
                "model" => self.model(node, Some(model), &here, file, Override::default())?,
                "include" => self.include(node, model, &here, file)?,
                "pose" | "static" | "frame" => {}
                _ => self.absent_element("model", node),
            }
        }
        Ok(())
    }

    /// A body here has one shape: so only a model of one link with one collision can move.
    fn motion(&mut self, model: Node, is_static: bool) -> Result<Motion> {
        let links = || children(model, "link");
        let collisions = || links().flat_map(|link| children(link, "collision"));
        let (Some(link), Some(collision)) = (links().next(), collisions().next()) else { return Ok(Motion::Static) };
        if is_static {
            return Ok(Motion::Static);
        }
        if links().count() > 1 || collisions().count() > 1 {
            self.absent("motion of a model with several links or collisions: it stands still");
            return Ok(Motion::Static);
        }
        if child(collision, "geometry").is_some_and(|g| child(g, "plane").is_some() || child(g, "heightmap").is_some())
        {
            self.absent("motion of a plane or heightmap: it stands still");
            return Ok(Motion::Static);
        }
        let mass = child(link, "inertial").filter(|inertial| child(*inertial, "mass").is_some());
        // The format's own default mass is 1 kg.
        Ok(Motion::Dynamic { mass_kg: mass.map_or(Ok(1.0), |inertial| measure(inertial, "mass"))? })
    }

    fn link(&mut self, link: Node, model: Node, place: &Place, motion: Motion, file: &SourceFile) -> Result<()> {
        let model_from_link = self.pose_within(link, Some(model), 0)?;
        let prefix = format!("{}{}/", place.prefix, name_of(link)?);
        for node in elements(link) {
            match tag(node) {
                "collision" => {
                    let relative = node_pose(node).and_then(|pose| relative_to(pose, "relative_to"));
                    let model_from_parent = match relative.filter(|frame| Some(*frame) != link.attribute("name")) {
                        Some(frame) => self.frame(frame, model, 0)?.unwrap_or(model_from_link),
                        None => model_from_link,
                    };
                    let world_from_parent = place.world_from_parent * model_from_parent;
                    self.collision(node, world_from_parent, &prefix, motion, file)?;
                }
                "inertial" => self.absent("<inertial> in <link>, all but the mass"),
                "pose" => {}
                _ => self.absent_element("link", node),
            }
        }
        Ok(())
    }

    fn collision(
        &mut self,
        collision: Node,
        world_from_parent: Isometry3<f64>,
        prefix: &str,
        motion: Motion,
        file: &SourceFile,
    ) -> Result<()> {
        let name = format!("{prefix}{}", name_of(collision)?);
        for node in elements(collision).filter(|node| !matches!(tag(*node), "pose" | "geometry")) {
            self.absent_element("collision", node);
        }
        self.list_pose_attributes(collision);
        let own = node_pose(collision).map_or(Ok(Isometry3::identity()), pose_numbers)?;
        let geometry = required(collision, "geometry")?;
        let Some(form) = elements(geometry).next() else {
            return Err(fault(geometry, "geometry", "nothing", "a box, cylinder, sphere, plane, mesh or heightmap"));
        };
        let Some((shape, parent_from_shape)) = self.shape(form, file)? else { return Ok(()) };
        let is_ground = match &shape {
            Shape::Plane => true,
            Shape::Box { .. } | Shape::Mesh(_) => tag(form) == "heightmap" || names_ground(&name),
            Shape::Cylinder { .. } | Shape::Sphere { .. } => false,
        };
        let shape = shape.validated().map_err(|fault| fault.at_line(line_of(form)))?;
        let pose = world_from_parent * own * parent_from_shape;
        self.add(name, shape, pose, motion, is_ground).map_err(|fault| fault.at_line(line_of(form)))
    }

    fn add(&mut self, name: String, shape: Shape, pose: Isometry3<f64>, motion: Motion, ground: bool) -> Result<()> {
        if self.scene.bodies.len() >= BODIES_MAX {
            return Err(Fault::new("world", "too many collisions", format!("at most {BODIES_MAX}")));
        }
        let name = self.unique(name);
        self.scene.bodies.push(Body { name, shape, pose, material: Material::default(), motion, ground });
        Ok(())
    }

    /// The name itself, or with the first free number behind it.
    fn unique(&mut self, name: String) -> String {
        let mut candidate = name.clone();
        while !self.used_names.insert(candidate.clone()) {
            let count = self.names.entry(name.clone()).or_insert(1);
            *count += 1;
            candidate = format!("{name}-{count}");
        }
        candidate
    }

    /// The form of a `<geometry>` and where it is in the collision's frame; `None` if it is not understood (and listed).
    fn shape(&mut self, form: Node, file: &SourceFile) -> Result<Option<(Shape, Isometry3<f64>)>> {
        let mut offset = Isometry3::identity();
        let known: &[&str] = match tag(form) {
            "box" => &["size"],
            "cylinder" => &["radius", "length"],
            "sphere" => &["radius"],
            // The size of a plane is how far it is drawn: to collide with, it has no end.
            "plane" => &["normal", "size"],
            "mesh" => &["uri", "scale"],
            "heightmap" => &["uri", "size", "pos"],
            _ => &[],
        };
        let shape = match tag(form) {
            "box" => Shape::Box { size: exactly::<3>(required(form, "size")?)?.into() },
            "cylinder" => Shape::Cylinder { radius: measure(form, "radius")?, length: measure(form, "length")? },
            "sphere" => Shape::Sphere { radius: measure(form, "radius")? },
            "plane" => {
                let normal = child(form, "normal").map_or(Ok([0.0, 0.0, 1.0]), exactly)?;
                offset.rotation = upright_to(normal.into())
                    .ok_or_else(|| fault(form, "normal", "a vector of length 0", "a direction"))?;
                Shape::Plane
            }
            "mesh" => match self.mesh(form, file)? {
                Some(mesh) => Shape::Mesh(mesh),
                None => return Ok(None),
            },
            "heightmap" => match self.heightmap(form, file)? {
                Some((mesh, position)) => {
                    offset.translation = Translation3::from(position);
                    Shape::from(mesh)
                }
                None => return Ok(None),
            },
            unknown => {
                self.absent(format!("<{unknown}> as the form of a <collision>: the collision is left out"));
                return Ok(None);
            }
        };
        for node in elements(form).filter(|node| !known.contains(&tag(*node))) {
            let note = if tag(node) == "submesh" { ": the whole mesh is taken" } else { "" };
            self.absent(format!("<{}> in <{}>{note}", tag(node), tag(form)));
        }
        Ok(Some((shape, offset)))
    }

    /// The file a `<uri>` names, which a collision cannot do without; `None` for the network.
    fn needed_file(&mut self, form: Node, file: &SourceFile) -> Result<Option<PathBuf>> {
        let uri_node = required(form, "uri")?;
        let uri = trimmed(uri_node);
        match self.lookup.resolve(&uri, file).map_err(|fault| fault.at_line(line_of(uri_node)))? {
            Found::Path(path) => Ok(Some(path)),
            Found::Network => {
                self.absent(format!("{uri}: URIs of the network are not fetched; the collision is left out"));
                Ok(None)
            }
            Found::Nowhere => {
                let found = format!("no file for `{uri}`");
                Err(fault(uri_node, tag(form), found, "a file beside the world, in its `models` or in the model path"))
            }
        }
    }

    fn mesh(&mut self, form: Node, file: &SourceFile) -> Result<Option<Arc<Mesh>>> {
        let scale = child(form, "scale").map_or(Ok([1.0; 3]), exactly)?;
        let Some(path) = self.needed_file(form, file)? else { return Ok(None) };
        let key = (path, scale.map(f64::to_bits));
        if let Some(mesh) = self.meshes.get(&key) {
            return Ok(Some(mesh.clone()));
        }
        let mesh = mesh::load(&key.0).and_then(|mesh| mesh.scaled(scale)).and_then(Mesh::validated);
        let mesh = Arc::new(mesh.map_err(|fault| asked_for_at(line_of(form), &key.0, fault))?);
        self.meshes.insert(key, mesh.clone());
        Ok(Some(mesh))
    }

    /// A heightmap and the place of its middle. White is as high as `<size>` says.
    fn heightmap(&mut self, form: Node, file: &SourceFile) -> Result<Option<(Mesh, Vector3<f64>)>> {
        let size_node = child(form, "size");
        let [x, y, z] = size_node.map_or(Ok([1.0; 3]), exactly)?;
        let position: [f64; 3] = child(form, "pos").map_or(Ok([0.0; 3]), exactly)?;
        for side in [x, y] {
            positive("heightmap size", side).map_err(|fault| fault.at_line(line_of(size_node.unwrap_or(form))))?;
        }
        let Some(path) = self.needed_file(form, file)? else { return Ok(None) };
        let levels = mesh::load_levels(&path).map_err(|fault| asked_for_at(line_of(form), &path, fault))?;
        let heights: Vec<f64> = levels.levels.iter().map(|level| level / levels.white * z).collect();
        let spacing = [x / (levels.columns - 1) as f64, y / (levels.rows - 1) as f64];
        let mesh = Mesh::height_field(&heights, levels.columns, levels.rows, spacing)
            .map_err(|fault| fault.at_line(line_of(form)))?;
        Ok(Some((mesh, position.into())))
    }

    fn include(&mut self, include: Node, scope: Node, place: &Place, file: &SourceFile) -> Result<()> {
        self.includes += 1;
        if self.includes > INCLUDES_MAX {
            return Err(fault(include, "include", "includes without end", "at most 10000 in all"));
        }
        for node in elements(include).filter(|node| !matches!(tag(*node), "uri" | "pose" | "name" | "static")) {
            self.absent_element("include", node);
        }
        let over = Override {
            name: child(include, "name").map(trimmed).filter(|name| !name.is_empty()),
            pose: node_pose(include).map(|_| self.pose_within(include, Some(scope), 0)).transpose()?,
            is_static: child(include, "static").map(boolean).transpose()?,
        };
        let uri_node = required(include, "uri")?;
        let uri = trimmed(uri_node);
        let found = self.lookup.resolve(&uri, file).map_err(|fault| fault.at_line(line_of(uri_node)))?;
        let (path, reason) = match found {
            Found::Path(path) => (Some(path), ""),
            Found::Network => (None, "URIs of the network are not fetched"),
            Found::Nowhere => (None, "found neither beside the world nor in the model path"),
        };
        let Some(path) = path else {
            if is_ground_plane(&uri) {
                self.absent(format!("include {uri}: {reason}; an endless ground plane stands in for it"));
                let pose = place.world_from_parent * over.pose.unwrap_or_else(Isometry3::identity);
                let name = format!("{}{}", place.prefix, over.name.as_deref().unwrap_or("ground_plane"));
                return self.add(name, Shape::Plane, pose, Motion::Static, true);
            }
            self.absent(format!("include {uri}: {reason}; it is left out"));
            return Ok(());
        };
        self.included_file(&path, place, over).map_err(|fault| match fault.file {
            // A line belongs to one file only.
            Some(_) => fault,
            None => fault.at_line(line_of(uri_node)).in_file(&file.path),
        })
    }

    fn included_file(&mut self, path: &Path, place: &Place, over: Override) -> Result<()> {
        let path = if path.is_dir() { description_in(path)? } else { path.to_path_buf() };
        let file = SourceFile::open(&path)?;
        let again = self.chain.contains(&file.identity);
        self.chain.push(file.identity.clone());
        if again {
            let chain: Vec<_> = self.chain.iter().map(|path| path.display().to_string()).collect();
            return Err(Fault::new("include", chain.join(" → "), "files that do not include themselves"));
        }
        let text = file.text()?;
        let document = xml::parse(&text).map_err(|fault| fault.in_file(&path))?;
        self.included_root(document.root_element(), place, over, &file).map_err(|fault| fault.in_file(&path))?;
        self.chain.pop();
        Ok(())
    }

    fn included_root(&mut self, root: Node, place: &Place, over: Override, file: &SourceFile) -> Result<()> {
        let mut over = Some(over);
        for node in elements(root) {
            match (tag(node), over.take()) {
                ("model", Some(over)) => self.model(node, None, place, file, over)?,
                ("world", _) => return Err(fault(node, "included file", "a <world>", "a <model>")),
                (_, unused) => {
                    over = unused;
                    self.absent_element("included sdf", node);
                }
            }
        }
        Ok(())
    }
}

/// A fault in a file that a line of another file asks for: the user has to find both.
pub(super) fn asked_for_at(line: usize, path: &Path, fault: Fault) -> Fault {
    let place = match fault.line {
        Some(line) => format!("{}:{line}", path.display()),
        None => path.display().to_string(),
    };
    Fault::new(format!("{place}: {}", fault.what), fault.found, fault.expected).at_line(line)
}

/// Whether a name speaks of the ground: `ground_plane`, `GroundB_01`, but not `playground`.
fn names_ground(name: &str) -> bool {
    let lower = name.to_ascii_lowercase();
    lower.match_indices("ground").any(|(at, _)| {
        let before = name[..at].chars().next_back();
        let starts_with_capital = name[at..].starts_with('G') && !before.is_some_and(|c| c.is_ascii_uppercase());
        starts_with_capital || !before.is_some_and(char::is_alphabetic)
    })
}

/// The rotation that turns z upright into this direction.
fn upright_to(normal: Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let normal = normal.try_normalize(1e-12)?;
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Some(UnitQuaternion::rotation_between(&Vector3::z(), &normal).unwrap_or(half_turn))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use nalgebra::{Matrix4, Point3};
    use proptest::prelude::*;
    use roxmltree::Document;

    use super::super::shapes::Bounds;
    use super::*;

    const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/worlds");

    fn data(path: &str) -> Option<PathBuf> {
        let path = Path::new(DATA).join(path);
        if !path.exists() {
            eprintln!("skipped: ../shared/data is absent");
        }
        path.exists().then_some(path)
    }

    fn find<'a>(scene: &'a Scene, end: &str) -> &'a Body {
        scene.bodies.iter().find(|body| body.name.ends_with(end)).unwrap_or_else(|| panic!("{end}"))
    }

    fn bounds(body: &Body) -> Bounds {
        let vertices = body.shape.tessellate(1.0).vertices;
        let placed = vertices.into_iter().map(|v| (body.pose * Point3::from(v)).coords).collect();
        Mesh { vertices: placed, triangles: Vec::new() }.bounds().unwrap()
    }

    #[track_caller]
    fn close(found: Bounds, expected: Bounds, tolerance: f64, name: &str) {
        for axis in 0..3 {
            let off = (found.0[axis] - expected.0[axis]).abs().max((found.1[axis] - expected.1[axis]).abs());
            assert!(off < tolerance, "{name}: {found:?} {expected:?}");
        }
    }

    // --- An independent reading: plain matrices from the XML text, by another route than the loader's. ---

    fn matrix(pose: &str) -> Matrix4<f64> {
        let n: Vec<f64> = pose.split_whitespace().map(|word| word.parse().unwrap()).collect();
        let [x, y, z, roll, pitch, yaw] = n.try_into().unwrap_or([0.0; 6]);
        let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
        Matrix4::new(
            cy * cp,
            cy * sp * sr - sy * cr,
            cy * sp * cr + sy * sr,
            x, //
            sy * cp,
            sy * sp * sr + cy * cr,
            sy * sp * cr - cy * sr,
            y, //
            -sp,
            cp * sr,
            cp * cr,
            z, //
            0.0,
            0.0,
            0.0,
            1.0,
        )
    }

    fn text_at<'a>(node: Node<'a, '_>, path: &[&str]) -> Option<&'a str> {
        let mut node = node;
        for name in path {
            node = node.children().find(|n| n.has_tag_name(*name))?;
        }
        node.text()
    }

    /// Bounds of every collision below a model node, in document order, given the model's own transform.
    fn expected_bounds(model: Node, world_from_model: Matrix4<f64>, models: &Path, out: &mut Vec<Bounds>) {
        let placed = |node: Node| matrix(text_at(node, &["pose"]).unwrap_or(""));
        for node in model.children() {
            if node.has_tag_name("model") {
                expected_bounds(node, world_from_model * placed(node), models, out);
            }
            if !node.has_tag_name("link") {
                continue;
            }
            let world_from_link = world_from_model * placed(node);
            for collision in node.children().filter(|n| n.has_tag_name("collision")) {
                let world = world_from_link * placed(collision);
                let numbers = |path: &[&str]| -> Vec<f64> {
                    let text = text_at(collision, path).unwrap_or("");
                    text.split_whitespace().map(|word| word.parse().unwrap()).collect()
                };
                let mut points = Vec::new();
                if let [x, y, z] = numbers(&["geometry", "box", "size"])[..] {
                    for corner in 0..8 {
                        let sign = |bit: i32| if corner & bit == 0 { -0.5 } else { 0.5 };
                        points.push(Vector3::new(x * sign(1), y * sign(2), z * sign(4)));
                    }
                } else if let [radius] = numbers(&["geometry", "cylinder", "radius"])[..] {
                    let half = numbers(&["geometry", "cylinder", "length"])[0] / 2.0;
                    for step in 0..64 {
                        let (sin, cos) = (f64::from(step) * std::f64::consts::TAU / 64.0).sin_cos();
                        points.extend([-half, half].map(|z| Vector3::new(radius * cos, radius * sin, z)));
                    }
                } else {
                    let uri = text_at(collision, &["geometry", "mesh", "uri"]).unwrap();
                    let mesh = mesh::load(&models.join(uri.trim().strip_prefix("model://").unwrap())).unwrap();
                    let scale = numbers(&["geometry", "mesh", "scale"]);
                    let scale = if scale.is_empty() { vec![1.0; 3] } else { scale };
                    points.extend(
                        mesh.vertices.iter().map(|v| Vector3::new(v.x * scale[0], v.y * scale[1], v.z * scale[2])),
                    );
                }
                let vertices = points.iter().map(|p| (world * p.push(1.0)).xyz()).collect();
                out.push(Mesh { vertices, triangles: Vec::new() }.bounds().unwrap());
            }
        }
    }

    /// Every collision of a model file, placed by its own pose, against the scene's bodies whose names start so.
    fn compare(scene: &Scene, prefix: &str, model_file: &Path, models: &Path) -> usize {
        let text = fs::read_to_string(model_file).unwrap();
        let document = Document::parse(&text).unwrap();
        let model = document.root_element().children().find(|n| n.has_tag_name("model")).unwrap();
        let mut expected = Vec::new();
        let own = text_at(model, &["pose"]).unwrap_or("");
        expected_bounds(model, matrix(own), models, &mut expected);
        let ours: Vec<_> = scene.bodies.iter().filter(|body| body.name.starts_with(prefix)).collect();
        assert_eq!(ours.len(), expected.len(), "{prefix}");
        for (body, expected) in ours.iter().zip(&expected) {
            close(bounds(body), *expected, 1e-9, &body.name);
            assert_eq!(body.motion, Motion::Static, "{}", body.name);
        }
        ours.len()
    }

    #[test]
    fn the_turtlebot_house_stands_where_its_file_says() {
        let Some(path) = data("turtlebot3/worlds/turtlebot3_house.world") else { return };
        let scene = load(&path, &[]).unwrap();
        let models = Path::new(DATA).join("turtlebot3/models");
        let count = compare(&scene, "turtlebot3_house/", &models.join("turtlebot3_house/model.sdf"), &models);
        assert_eq!(count + 1, scene.bodies.len(), "all but the ground plane");
        let document = fs::read_to_string(models.join("turtlebot3_house/model.sdf")).unwrap();
        assert_eq!(count, document.matches("<collision").count());
        // By hand: Wall_101 is 4.5 x 0.15 x 2.5 at (-0.05, 3.1), turned by -90°, its box raised by 1.25.
        let wall = bounds(find(&scene, "/Wall_101/Wall_101_Collision"));
        close(wall, ([-0.125, 0.85, 0.0], [0.025, 5.35, 2.5]), 1e-4, "Wall_101");
        // The table is 0.25 of its mesh, whose bounds another loader found.
        let marble = find(&scene, "table_marble/link/collision");
        let Shape::Mesh(mesh) = &marble.shape else { panic!() };
        let (low, high) = mesh.bounds().unwrap();
        assert!((low[0] + 5.2249 / 4.0).abs() < 1e-3 && (high[2] - 1.267 / 4.0).abs() < 1e-3);
        let listed = |part: &str| scene.absent.iter().any(|line| line.contains(part));
        assert!(listed("Ground Plane: URIs of the network are not fetched; an endless ground plane stands in for it"));
        assert!(listed("models/Sun: URIs of the network"));
        assert!(listed("<plugin> in <world> (x5)"));
        assert!(scene.bodies.iter().filter(|body| body.ground).all(|body| body.shape == Shape::Plane));
    }

    #[test]
    fn the_turtlebot_arenas_stand_where_their_files_say() {
        let Some(path) = data("turtlebot3/worlds/turtlebot3_world.world") else { return };
        let models = Path::new(DATA).join("turtlebot3/models");
        let scene = load(&path, &[]).unwrap();
        let count = compare(&scene, "turtlebot3_world/", &models.join("turtlebot3_world/model.sdf"), &models);
        assert_eq!((count, scene.bodies.len()), (15, 16));
        let pillar = find(&scene, "one_three");
        assert_eq!(pillar.shape, Shape::Cylinder { radius: 0.15, length: 0.5 });
        assert_eq!(pillar.pose.translation.vector, Vector3::new(-1.1, 1.1, 0.25));

        let stage = load(&Path::new(DATA).join("turtlebot3/worlds/turtlebot3_dqn_stage4.world"), &[]).unwrap();
        let arena = models.join("turtlebot3_dqn_world");
        let outer = compare(&stage, "turtlebot3_square/", &arena.join("model.sdf"), &models);
        let inner = compare(&stage, "inner_walls/", &arena.join("inner_walls/model.sdf"), &models);
        assert_eq!(outer + inner + 1, stage.bodies.len());
        // By hand: inner wall 2 is 1 x 0.15 x 0.5 at (-0.5, -2), turned by -90°.
        let wall = bounds(find(&stage, "inner_wall_2_collision"));
        close(wall, ([-0.575, -2.5, 0.0], [-0.425, -1.5, 0.5]), 1e-4, "inner_wall_2");
        let missing =
            "include model://turtlebot3_dqn_world/obstacle1: found neither beside the world nor in the model path";
        assert!(stage.absent.iter().any(|line| line.starts_with(missing)), "{:?}", stage.absent);
    }

    #[test]
    fn the_warehouses_stand_where_their_files_say() {
        for name in ["small_warehouse", "no_roof_small_warehouse"] {
            let Some(path) = data(&format!("aws_small_warehouse/worlds/{name}.world")) else { return };
            let scene = load(&path, &[]).unwrap();
            let text = fs::read_to_string(&path).unwrap();
            let document = Document::parse(&text).unwrap();
            let world = document.root_element().children().find(|n| n.has_tag_name("world")).unwrap();
            let models = Path::new(DATA).join("aws_small_warehouse/models");
            let mut expected = Vec::new();
            for model in world.children().filter(|n| n.has_tag_name("model")) {
                let uri = text_at(model, &["include", "uri"]).unwrap().strip_prefix("model://").unwrap();
                let text = fs::read_to_string(models.join(uri).join("model.sdf")).unwrap();
                let included = Document::parse(&text).unwrap();
                let inner = included.root_element().children().find(|n| n.has_tag_name("model")).unwrap();
                let world_from_inner =
                    matrix(text_at(model, &["pose"]).unwrap()) * matrix(text_at(inner, &["pose"]).unwrap_or(""));
                expected_bounds(inner, world_from_inner, &models, &mut expected);
            }
            assert_eq!(scene.bodies.len(), expected.len());
            assert!(expected.len() >= 20);
            for (body, expected) in scene.bodies.iter().zip(&expected) {
                close(bounds(body), *expected, 1e-9, &body.name);
                assert_eq!(body.motion, Motion::Static);
                assert_eq!(body.ground, body.name.contains("GroundB"), "{}", body.name);
            }
            let (low, high) = bounds(find(&scene, "ShelfD_01_001/aws_robomaker_warehouse_ShelfD_01/link/collision"));
            assert!((high[2] - 2.643).abs() < 1e-3 && (0.0..0.05).contains(&low[2]), "{low:?} {high:?}");
            assert!((high[0] - low[0] - 3.918).abs() < 1e-3 || (high[1] - low[1] - 3.918).abs() < 1e-3);
        }
    }

    #[test]
    fn the_barn_worlds_are_their_cylinders() {
        let Some(folder) = data("barn") else { return };
        let mut worlds: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        worlds.retain(|path| path.extension().is_some_and(|e| e == "gz"));
        worlds.sort();
        assert_eq!(worlds.len(), 25);
        let mut total = 0;
        for path in worlds {
            let scene = load(&path, &[]).unwrap();
            let mut text = String::new();
            let file = fs::File::open(&path).unwrap();
            std::io::Read::read_to_string(&mut flate2::read::GzDecoder::new(file), &mut text).unwrap();
            // Not by XML: by the text between the tags.
            let state = text.find("<state").unwrap();
            let mut expected = Vec::new();
            for model in text[..state].split("<model name='").skip(1) {
                let (name, rest) = model.split_once('\'').unwrap();
                if name == "ground_plane" {
                    continue;
                }
                let pose = rest.split_once("<pose frame=''>").unwrap().1.split_once('<').unwrap().0;
                let place: Vec<f64> = pose.split(' ').map(|word| word.parse().unwrap()).collect();
                expected.push((format!("{name}/link/collision"), [place[0], place[1], place[2]]));
            }
            let cylinders: Vec<_> = scene.bodies.iter().filter(|body| body.shape != Shape::Plane).collect();
            assert_eq!(cylinders.len() + 1, scene.bodies.len());
            assert!((184..=341).contains(&cylinders.len()), "{}", cylinders.len());
            assert_eq!(cylinders.len(), expected.len());
            for (body, (name, place)) in cylinders.iter().zip(&expected) {
                assert_eq!(&body.name, name);
                assert_eq!(body.shape, Shape::Cylinder { radius: 0.075, length: 1.0 });
                assert_eq!(<[f64; 3]>::from(body.pose.translation.vector), *place);
                assert_eq!((body.motion, body.ground), (Motion::Static, false));
            }
            total += cylinders.len();
            assert!(find(&scene, "ground_plane/link/collision").ground);
            assert!(scene.absent.iter().any(|line| line == "<state> in <world>"));
        }
        assert_eq!(total, 6015);
    }

    // --- Small worlds, for what the real ones do not have. ---

    fn world(content: &str) -> String {
        format!("<?xml version='1.0'?>\n<sdf version='1.9'>\n<world name='w'>\n{content}\n</world>\n</sdf>\n")
    }

    fn collision(form: &str) -> String {
        format!("<link name='l'><collision name='c'><geometry>{form}</geometry></collision></link>")
    }

    const BALL: &str = "<sphere><radius>0.5</radius></sphere>";

    fn read(text: &str) -> Result<Scene> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.sdf");
        fs::write(&path, text).unwrap();
        load(&path, &[])
    }

    fn place(scene: &Scene, end: &str) -> [f64; 3] {
        let place = find(scene, end).pose.translation.vector;
        place.map(|x| (x * 1e9).round() / 1e9 + 0.0).into()
    }

    #[test]
    fn poses_chain_and_frames_are_followed() {
        let quarter = std::f64::consts::FRAC_PI_2;
        let scene = read(&world(&format!(
            "<frame name='corner'><pose>10 0 0 0 0 {quarter}</pose></frame>\n\
             <model name='a'><static>1</static><pose relative_to='corner'>1 0 0 0 0 0</pose>\n\
             <model name='b'><pose degrees='true'>1 0 0 0 0 90</pose>\n\
             <link name='base'><pose rotation_format='quat_xyzw'>1 0 0 0 0 1 0</pose>\n\
             <collision name='c'><pose>1 0 0 0 0 0</pose><geometry>{BALL}</geometry></collision></link>\n\
             <link name='arm'><pose relative_to='base'>0 1 0 0 0 0</pose>\n\
             <collision name='own'><pose/><geometry>{BALL}</geometry></collision>\n\
             <collision name='other'><pose relative_to='base'>0 0 2 0 0 0</pose><geometry>{BALL}</geometry></collision>\n\
             <collision name='model'><pose relative_to='__model__'>0 0 3 0 0 0</pose><geometry>{BALL}</geometry></collision>\n\
             <collision name='lost'><pose relative_to='nobody'>0 0 0 0 0 0</pose><geometry>{BALL}</geometry></collision>\n\
             </link></model></model>"
        )))
        .unwrap();
        // corner: (10,0) facing +y; a: (10,1); b: (10,2) facing −x; base: (9,2) facing +x (half a turn); c: (10,2).
        assert_eq!(place(&scene, "a/b/base/c"), [10.0, 2.0, 0.0]);
        // arm: one to the left of base.
        assert_eq!(place(&scene, "a/b/arm/own"), [9.0, 3.0, 0.0]);
        assert_eq!(place(&scene, "arm/other"), [9.0, 2.0, 2.0]);
        assert_eq!(place(&scene, "arm/model"), [10.0, 2.0, 3.0]);
        assert_eq!(place(&scene, "arm/lost"), [9.0, 3.0, 0.0]);
        assert_eq!(scene.absent, ["pose relative to `nobody`: taken as relative to its parent"]);
        let circle = "<model name='a'><link name='x'><pose relative_to='y'/></link><link name='y'><pose relative_to='x'/></link></model>";
        assert!(read(&world(circle)).unwrap_err().to_string().contains("in a circle"));
    }

    #[test]
    fn only_simple_models_move_and_the_rest_is_said() {
        let link = |mass: &str| collision(BALL).replace("<collision", &format!("{mass}<collision"));
        let heavy = link("<inertial><mass>2.5</mass></inertial>");
        let scene = read(&world(&format!(
            "<model name='free'>{heavy}</model>\n<model name='default'>{}</model>\n\
             <model name='fixed'><static>true</static>{heavy}</model>\n\
             <model name='holder'><static>1</static><model name='held'>{heavy}</model></model>\n\
             <model name='two'>{heavy}{}</model>\n<model name='free'>{heavy}</model>",
            link(""),
            heavy.replace("name='l'", "name='m'")
        )))
        .unwrap();
        let motion = |end| find(&scene, end).motion;
        assert_eq!(motion("free/l/c"), Motion::Dynamic { mass_kg: 2.5 });
        assert_eq!(motion("default/l/c"), Motion::Dynamic { mass_kg: 1.0 });
        for still in ["fixed/l/c", "holder/held/l/c", "two/l/c", "two/m/c"] {
            assert_eq!(motion(still), Motion::Static, "{still}");
        }
        assert_eq!(motion("free/l/c-2"), Motion::Dynamic { mass_kg: 2.5 });
        assert!(scene.absent.iter().any(|line| line.contains("several links or collisions")));
    }

    #[test]
    fn planes_heightmaps_and_unknown_forms() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.sdf");
        let pixels = image::GrayImage::from_raw(3, 3, vec![255, 0, 0, 0, 0, 0, 0, 0, 51]).unwrap();
        pixels.save(folder.path().join("h.png")).unwrap();
        let wall = "<plane><normal>1 0 0</normal><size>1 1</size></plane>";
        let ceiling = "<plane><normal>0 0 -2</normal></plane>";
        let hills = "<heightmap><uri>file://h.png</uri><size>4 4 10</size><pos>1 0 0</pos><texture/></heightmap>";
        let model =
            |name: &str, form: &str| format!("<model name='{name}'><static>1</static>{}</model>\n", collision(form));
        let text = world(
            &[
                model("wall", wall),
                model("ceiling", ceiling),
                model("hills", hills),
                model("odd", "<capsule/>"),
                model("odd2", "<capsule/>"),
                model("web", "<mesh><uri>https://example.org/a.dae</uri></mesh>"),
                model("playground", "<box><size>1 1 1</size></box>"),
                model("MyGround", "<box><size>1 1 1</size></box>"),
            ]
            .concat(),
        );
        fs::write(&path, text).unwrap();
        let scene = load(&path, &[]).unwrap();
        let up = |end| <[f64; 3]>::from((find(&scene, end).pose.rotation * Vector3::z()).map(f64::round));
        assert_eq!((up("wall/l/c"), up("ceiling/l/c")), ([1.0, 0.0, 0.0], [0.0, 0.0, -1.0]));
        let hills = find(&scene, "hills/l/c");
        close(bounds(hills), ([-1.0, -2.0, 0.0], [3.0, 2.0, 10.0]), 1e-9, "hills");
        let Shape::Mesh(mesh) = &hills.shape else { panic!() };
        // The image's first pixel is its north-west, its last the south-east.
        assert_eq!(mesh.vertices.iter().find(|v| v.z == 10.0).unwrap().xy(), nalgebra::Vector2::new(-2.0, 2.0));
        assert_eq!(mesh.vertices.iter().find(|v| v.z == 2.0).unwrap().xy(), nalgebra::Vector2::new(2.0, -2.0));
        let ground: Vec<_> = scene.bodies.iter().filter(|b| b.ground).map(|b| b.name.as_str()).collect();
        assert_eq!(ground, ["wall/l/c", "ceiling/l/c", "hills/l/c", "MyGround/l/c"]);
        assert_eq!(
            scene.absent,
            [
                "<capsule> as the form of a <collision>: the collision is left out (x2)",
                "<texture> in <heightmap>",
                "https://example.org/a.dae: URIs of the network are not fetched; the collision is left out",
            ]
        );
    }

    /// A folder of models: `models/box/model.sdf`, with a mesh in another folder on the model path.
    fn library() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        for dir in ["worlds", "models/box", "models/loop", "elsewhere/part/meshes"] {
            fs::create_dir_all(root.join(dir)).unwrap();
        }
        let mesh = collision("<mesh><uri>model://part/meshes/t.stl</uri><scale>2 2 2</scale></mesh>");
        let sdf = |model: &str| format!("<sdf version='1.6'>\n<model name='own'>\n{model}\n</model></sdf>");
        fs::write(root.join("models/box/other.sdf"), sdf(&format!("<pose>0 0 5 0 0 0</pose><static>0</static>{mesh}")))
            .unwrap();
        fs::write(root.join("models/box/model.sdf"), "not read").unwrap();
        let config = "<model><sdf version='1.10'>other.sdf</sdf><sdf version='1.9'>model.sdf</sdf></model>";
        fs::write(root.join("models/box/model.config"), config).unwrap();
        fs::write(root.join("models/loop/model.sdf"), sdf("<include><uri>model://loop</uri></include>")).unwrap();
        let stl = "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n";
        fs::write(root.join("elsewhere/part/meshes/t.stl"), stl).unwrap();
        folder
    }

    #[test]
    fn includes_are_found_named_and_placed() {
        let folder = library();
        let path = folder.path().join("worlds/w.world");
        let text = world(
            "<include><uri>model://box</uri></include>\n\
             <include><uri>model://box</uri><name>second</name><pose>1 2 0 0 0 0</pose><static>1</static><plugin/></include>\n\
             <include><uri>../models/box/other.sdf</uri><name>third</name></include>\n\
             <include><uri>model://sun</uri></include>\n\
             <include><uri>model://ground_plane</uri><pose>0 0 -1 0 0 0</pose></include>",
        );
        fs::write(&path, text).unwrap();
        let models = [folder.path().join("elsewhere")];
        let scene = load(&path, &models).unwrap();
        let names: Vec<_> = scene.bodies.iter().map(|body| body.name.as_str()).collect();
        assert_eq!(names, ["own/l/c", "second/l/c", "third/l/c", "ground_plane"]);
        // The include's pose replaces the model's own.
        assert_eq!(place(&scene, "own/l/c"), [0.0, 0.0, 5.0]);
        assert_eq!(place(&scene, "second/l/c"), [1.0, 2.0, 0.0]);
        assert_eq!(place(&scene, "ground_plane"), [0.0, 0.0, -1.0]);
        assert_eq!(find(&scene, "own/l/c").motion, Motion::Dynamic { mass_kg: 1.0 });
        assert_eq!(find(&scene, "second/l/c").motion, Motion::Static);
        let (Shape::Mesh(a), Shape::Mesh(b)) = (&scene.bodies[0].shape, &scene.bodies[1].shape) else { panic!() };
        assert!(Arc::ptr_eq(a, b), "read once");
        assert_eq!(a.bounds().unwrap().1, [2.0, 2.0, 0.0]);
        assert_eq!(scene.absent.len(), 3, "{:?}", scene.absent);

        let message = load(&path, &[]).unwrap_err().to_string();
        assert!(message.contains("other.sdf:3: mesh: found no file for `model://part/meshes/t.stl`"), "{message}");
        fs::write(folder.path().join("elsewhere/part/meshes/t.stl"), "solid\nvertex 0 0\nendsolid").unwrap();
        let message = load(&path, &models).unwrap_err().to_string();
        assert!(message.contains("other.sdf:3: ") && message.contains("t.stl:2: vertex: found too few"), "{message}");
        fs::write(&path, world("<include><uri>model://loop</uri></include>")).unwrap();
        let message = load(&path, &[]).unwrap_err().to_string();
        assert!(message.contains("model.sdf:3: include: found"), "{message}");
        assert!(message.matches("loop/model.sdf").count() >= 2 && message.contains(" → "), "{message}");
    }

    #[test]
    fn gzip_is_unpacked_in_bounds_and_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.world.gz");
        let pack = |bytes: &[u8]| {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
            std::io::Write::write_all(&mut encoder, bytes).unwrap();
            encoder.finish().unwrap()
        };
        let packed = pack(world(&format!("<model name='m'>{}</model>", collision(BALL))).as_bytes());
        fs::write(&path, &packed).unwrap();
        assert_eq!(load(&path, &[]).unwrap().bodies.len(), 1);
        fs::write(&path, &packed[..packed.len() - 9]).unwrap();
        assert!(load(&path, &[]).unwrap_err().to_string().contains("a whole gzip file"));
        fs::write(&path, pack(&vec![b' '; 65 << 20])).unwrap();
        assert!(load(&path, &[]).unwrap_err().to_string().contains("unpacked size"));
    }

    proptest! {
        #[test]
        fn a_damaged_world_never_makes_the_reader_panic(at in 0..400_usize, with in "[-0-9.<>/ '\"a-z]{0,3}") {
            let form = "<plane><normal>0 0 1</normal></plane>";
            let mut text = world(&format!("<model name='m'><pose relative_to='x'>0 0 1 0 0 0</pose>{}</model>", collision(form)));
            let at = at.min(text.len() - 1);
            text.replace_range(at..=at, &with);
            let _ = read(&text);
        }
    }

    #[test]
    fn broken_worlds_name_file_and_line() {
        let good = world(&format!(
            "<model name='m'>\n<pose>0 0 0 0 0 0</pose>\n{}\n</model>",
            collision("\n<sphere><radius>0.5</radius></sphere>")
        ));
        assert!(read(&good).is_ok());
        let cases = [
            ("0 0 0 0 0 0", "0 0 0 0 0", "w.sdf:5: pose: found 5 numbers, expected 6 numbers"),
            ("0 0 0 0 0 0", "0 0 0 0 0 nan", "w.sdf:5: pose: found `nan`"),
            ("0 0 0 0 0 0", "0 0 1e300 0 0 0", "w.sdf:5: pose: found 1e300"),
            ("0 0 0 0 0 0", "x 0 0 0 0 0", "w.sdf:5: pose: found `x`"),
            ("<radius>0.5</radius>", "", "w.sdf:7: sphere: found no <radius>"),
            ("0.5", "-0.5", "w.sdf:7: radius: found -0.5, expected a number greater than 0"),
            ("0.5", "", "w.sdf:7: radius: found 0 numbers, expected 1 number"),
            ("<sphere><radius>0.5</radius></sphere>", "", "w.sdf:6: geometry: found nothing"),
            (
                "<sphere><radius>0.5</radius></sphere>",
                "<mesh><uri>a.dae</uri></mesh>",
                "w.sdf:7: mesh: found no file for `a.dae`",
            ),
            (
                "<sphere><radius>0.5</radius></sphere>",
                "<mesh><uri>ftp://a.dae</uri></mesh>",
                "w.sdf:7: uri: found `ftp://a.dae`",
            ),
            ("<sphere><radius>0.5</radius></sphere>", "<mesh><uri>model://../a.dae</uri></mesh>", "without `..`"),
            ("<sphere><radius>0.5</radius></sphere>", "<plane><normal>0 0 0</normal></plane>", "w.sdf:7: normal"),
            (
                "<sphere><radius>0.5</radius></sphere>",
                "<box><size>1 1</size></box>",
                "w.sdf:7: size: found 2 numbers, expected 3",
            ),
            (
                "<sphere><radius>0.5</radius></sphere>",
                "<box><size>1 1 0</size></box>",
                "w.sdf:7: size along z: found 0",
            ),
            ("model name='m'", "model", "w.sdf:4: model: found no name"),
            ("</model>", "<static>maybe</static></model>", "w.sdf:8: static: found `maybe`"),
            ("<sdf", "<dsf", "well-formed XML"),
            ("world", "wrld", "w.sdf:2: sdf: found no <world> and no <model>"),
        ];
        for (from, to, expected) in cases {
            let message = read(&good.replace(from, to)).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}\n  wanted {expected}");
        }
        for cut in 0..good.len() - 1 {
            assert!(read(&good[..cut]).is_err());
        }
        assert!(load(Path::new("/nowhere.world"), &[]).unwrap_err().to_string().contains("a file that exists"));
        let deep = format!("{}{}", "<model name='m'>".repeat(200), "</model>".repeat(200));
        assert!(read(&world(&deep)).unwrap_err().to_string().contains("at most 50 deep"));
    }
}
