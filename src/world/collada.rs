//! COLLADA (`.dae`) as Gazebo reads it: all surfaces of the scene, with their whole chain of node transforms, in metres.
//!
//! The file's unit scales everything, translations included. Its `up_axis` is ignored, as Gazebo ignores it: models
//! made for Gazebo stand upright as they lie in the file.

use std::collections::BTreeMap;

use nalgebra::{Matrix4, Rotation3, Unit, Vector3};
use roxmltree::Node;

use super::body::Mesh;
use super::shapes::triangulate_polygon;
use super::xml::{self, child, children, exactly, fault, floats, line_of, text_of};
use crate::fault::{Fault, Result, positive};

/// Nodes within nodes: real files have a handful.
const DEPTH_MAX: usize = 100;

/// Nodes placed in all: instances of instances can multiply without bound.
const NODES_PLACED_MAX: usize = 1_000_000;

/// Triangles placed in all.
const TRIANGLES_MAX: usize = 50_000_000;

/// Reads the text of a COLLADA file into one mesh (m). Only the vertices that a triangle uses are kept.
///
/// # Errors
/// What is not well-formed XML or breaks COLLADA; surfaces this reader does not know (skins, splines, holes), since
/// leaving them out would leave an obstacle out.
pub(super) fn parse(text: &str) -> Result<Mesh> {
    let document = xml::parse(text)?;
    let root = document.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err(fault(root, "root element", format!("<{}>", root.tag_name().name()), "<COLLADA>"));
    }
    let mut by_id = BTreeMap::new();
    for node in root.descendants() {
        if let Some(id) = node.attribute("id") {
            by_id.entry(id).or_insert(node);
        }
    }
    let mut reader = Reader { by_id, geometries: BTreeMap::new(), mesh: Mesh::default(), nodes_placed: 0 };
    let scene = match child(root, "scene").and_then(|scene| child(scene, "instance_visual_scene")) {
        Some(instance) => reader.target(instance)?,
        None => child(root, "library_visual_scenes")
            .and_then(|library| child(library, "visual_scene"))
            .ok_or_else(|| fault(root, "scene", "none", "<visual_scene>"))?,
    };
    let unit = Matrix4::new_scaling(unit_m(root)?);
    for node in children(scene, "node") {
        reader.place(node, &unit, 0)?;
    }
    Ok(reader.mesh)
}

/// Metres in the file's unit.
fn unit_m(root: Node) -> Result<f64> {
    let unit = child(root, "asset").and_then(|asset| child(asset, "unit"));
    let Some((unit, text)) = unit.and_then(|unit| Some((unit, unit.attribute("meter")?))) else {
        return Ok(1.0);
    };
    let metres = text.trim().parse().map_err(|_| fault(unit, "unit meter", format!("`{text}`"), "a number"))?;
    positive("unit meter", metres).map_err(|fault| fault.at_line(line_of(unit)))
}

fn indices(node: Node) -> Result<Vec<u32>> {
    let number = |word: &str| {
        word.parse().map_err(|_| fault(node, node.tag_name().name(), format!("`{word}`"), "whole numbers from 0"))
    };
    text_of(node).split_ascii_whitespace().map(number).collect()
}

/// The transform of a node from its own elements, in document order.
fn node_transform(node: Node) -> Result<Matrix4<f64>> {
    let mut parent_from_node = Matrix4::identity();
    for element in node.children().filter(Node::is_element) {
        parent_from_node *= match element.tag_name().name() {
            "matrix" => Matrix4::from_row_slice(&exactly::<16>(element)?),
            "translate" => Matrix4::new_translation(&exactly(element)?.into()),
            "scale" => Matrix4::new_nonuniform_scaling(&exactly(element)?.into()),
            "rotate" => {
                let [x, y, z, degrees] = exactly(element)?;
                let axis = Unit::try_new(Vector3::new(x, y, z), 1e-12)
                    .ok_or_else(|| fault(element, "rotate", "an axis of length 0", "an axis"))?;
                Rotation3::from_axis_angle(&axis, degrees.to_radians()).to_homogeneous()
            }
            unknown @ ("skew" | "lookat") => {
                return Err(fault(element, "transform", format!("<{unknown}>"), "matrix, translate, rotate or scale"));
            }
            _ => continue,
        };
    }
    Ok(parent_from_node)
}

struct Reader<'a, 'i> {
    by_id: BTreeMap<&'a str, Node<'a, 'i>>,
    geometries: BTreeMap<&'a str, Mesh>,
    mesh: Mesh,
    nodes_placed: usize,
}

impl<'a, 'i> Reader<'a, 'i> {
    /// The element that a `url` or `source` attribute names.
    fn target(&self, node: Node<'a, 'i>) -> Result<Node<'a, 'i>> {
        let what = node.tag_name().name();
        let url = node
            .attribute("url")
            .or_else(|| node.attribute("source"))
            .ok_or_else(|| fault(node, what, "no url and no source", "a reference as `#id`"))?;
        url.strip_prefix('#')
            .and_then(|id| self.by_id.get(id))
            .copied()
            .ok_or_else(|| fault(node, what, format!("`{url}`"), "the id of an element of this file"))
    }

    fn place(&mut self, node: Node<'a, 'i>, scene_from_parent: &Matrix4<f64>, depth: usize) -> Result<()> {
        self.nodes_placed += 1;
        if depth > DEPTH_MAX || self.nodes_placed > NODES_PLACED_MAX {
            return Err(fault(node, "node", "nodes within nodes without end", "at most 100 deep, 1000000 in all"));
        }
        let scene_from_node = scene_from_parent * node_transform(node)?;
        for element in node.children().filter(Node::is_element) {
            match element.tag_name().name() {
                "node" => self.place(element, &scene_from_node, depth + 1)?,
                "instance_node" => self.place(self.target(element)?, &scene_from_node, depth + 1)?,
                "instance_geometry" => self.place_geometry(element, &scene_from_node)?,
                "instance_controller" => {
                    return Err(fault(element, "surface", "<instance_controller> (a skin)", "<instance_geometry>"));
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn place_geometry(&mut self, instance: Node<'a, 'i>, scene_from_node: &Matrix4<f64>) -> Result<()> {
        let node = self.target(instance)?;
        let id = node.attribute("id").unwrap_or_default();
        if !self.geometries.contains_key(id) {
            let geometry = self.geometry(node)?;
            self.geometries.insert(id, geometry);
        }
        let Some(geometry) = self.geometries.get(id) else { return Ok(()) };
        let first = self.mesh.vertices.len();
        let fits = u32::try_from(first + geometry.vertices.len()).is_ok();
        if !fits || self.mesh.triangles.len() + geometry.triangles.len() > TRIANGLES_MAX {
            return Err(fault(instance, "scene", "too many triangles", "at most 50000000"));
        }
        let place = |v: &Vector3<f64>| (scene_from_node * v.push(1.0)).xyz();
        self.mesh.vertices.extend(geometry.vertices.iter().map(place));
        let mirrored = scene_from_node.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        self.mesh.triangles.extend(geometry.triangles.iter().map(|t| {
            let [a, b, c] = t.map(|i| i + first as u32);
            if mirrored { [a, c, b] } else { [a, b, c] }
        }));
        Ok(())
    }

    fn geometry(&self, node: Node<'a, 'i>) -> Result<Mesh> {
        let mesh = child(node, "mesh")
            .ok_or_else(|| fault(node, "geometry", "no <mesh>", "a <mesh> (splines and hulls are not read)"))?;
        let mut surface = Surface::default();
        for primitive in mesh.children().filter(Node::is_element) {
            let name = primitive.tag_name().name();
            if matches!(name, "triangles" | "polylist" | "polygons" | "tristrips" | "trifans") {
                self.primitive(primitive, name, &mut surface)?;
            }
        }
        Ok(surface.mesh)
    }

    /// Adds the polygons of one `<triangles>`, `<polylist>`, `<polygons>`, `<tristrips>` or `<trifans>`.
    fn primitive(&self, node: Node<'a, 'i>, kind: &str, surface: &mut Surface) -> Result<()> {
        let (stride, offset, positions) = self.inputs(node, kind)?;
        surface.begin(positions);
        if child(node, "ph").is_some() {
            return Err(fault(node, kind, "a polygon with holes", "polygons without holes"));
        }
        let counts = match child(node, "vcount") {
            Some(counts) if kind == "polylist" => indices(counts)?,
            _ => Vec::new(),
        };
        for p in children(node, "p") {
            let numbers = indices(p)?;
            if !numbers.len().is_multiple_of(stride) {
                return Err(fault(p, "p", format!("{} numbers", numbers.len()), "a multiple of its inputs"));
            }
            let corners: Vec<u32> = numbers.into_iter().skip(offset).step_by(stride).collect();
            surface.add_polygons(kind, &corners, &counts).map_err(|fault| fault.at_line(line_of(p)))?;
        }
        Ok(())
    }

    /// How a primitive's index list is read: numbers a corner, which of them is the vertex, and the vertices.
    fn inputs(&self, node: Node<'a, 'i>, kind: &str) -> Result<(usize, usize, Vec<Vector3<f64>>)> {
        let mut stride = 0_usize;
        let mut vertex = None;
        for input in children(node, "input") {
            let offset = match input.attribute("offset").map(str::parse::<u16>) {
                None => 0,
                Some(Ok(offset)) => usize::from(offset),
                Some(Err(_)) => return Err(fault(input, "offset", "no small whole number", "a number from 0")),
            };
            stride = stride.max(offset + 1);
            if input.attribute("semantic") == Some("VERTEX") {
                vertex = Some((input, offset));
            }
        }
        let (input, offset) = vertex.ok_or_else(|| fault(node, kind, "no input VERTEX", "an input VERTEX"))?;
        Ok((stride, offset, self.positions(input)?))
    }

    /// The positions behind an input: `<vertices>` → POSITION → `<source>` → `<accessor>` → `<float_array>`.
    fn positions(&self, input: Node<'a, 'i>) -> Result<Vec<Vector3<f64>>> {
        let vertices = self.target(input)?;
        let input = children(vertices, "input")
            .find(|input| input.attribute("semantic") == Some("POSITION"))
            .ok_or_else(|| fault(vertices, "vertices", "no input POSITION", "an input POSITION"))?;
        let source = self.target(input)?;
        let accessor = child(source, "technique_common").and_then(|technique| child(technique, "accessor"));
        let array = match accessor {
            Some(accessor) => self.target(accessor)?,
            None => child(source, "float_array").ok_or_else(|| fault(source, "source", "no array", "<float_array>"))?,
        };
        let number = |name: &str, default: usize| {
            let text = accessor.and_then(|accessor| accessor.attribute(name));
            text.map_or(Ok(default), |text| {
                text.parse().map_err(|_| fault(source, name, format!("`{text}`"), "a whole number"))
            })
        };
        let (stride, offset) = (number("stride", 3)?, number("offset", 0)?);
        if stride < 3 {
            return Err(fault(source, "stride", stride, "at least 3"));
        }
        let floats = floats(array)?;
        let held = floats.get(offset..).unwrap_or_default();
        Ok(held.chunks(stride).filter_map(|c| Some(Vector3::new(*c.first()?, *c.get(1)?, *c.get(2)?))).collect())
    }
}

/// Collects polygons, keeping only the positions they use.
#[derive(Default)]
struct Surface {
    mesh: Mesh,
    positions: Vec<Vector3<f64>>,
    kept: Vec<Option<u32>>,
}

impl Surface {
    fn begin(&mut self, positions: Vec<Vector3<f64>>) {
        self.kept = vec![None; positions.len()];
        self.positions = positions;
    }

    /// Adds the polygons of one index list; `counts` are the corners of each polygon of a polylist.
    fn add_polygons(&mut self, kind: &str, corners: &[u32], counts: &[u32]) -> Result<()> {
        let found = || format!("{} corners", corners.len());
        match kind {
            "triangles" if !corners.len().is_multiple_of(3) => Err(Fault::new(kind, found(), "a multiple of 3")),
            "triangles" => corners.chunks_exact(3).try_for_each(|triangle| self.add(triangle)),
            "polylist" => {
                let stated: u64 = counts.iter().map(|count| u64::from(*count)).sum();
                if stated != corners.len() as u64 {
                    return Err(Fault::new(kind, found(), format!("{stated}, as <vcount> says")));
                }
                let mut rest = corners.iter();
                counts.iter().try_for_each(|count| {
                    let polygon: Vec<u32> = rest.by_ref().take(*count as usize).copied().collect();
                    self.add(&polygon)
                })
            }
            "polygons" => self.add(corners),
            "tristrips" => (corners.windows(3).enumerate())
                .try_for_each(|(i, w)| self.add(&if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[1], w[0], w[2]] })),
            _ => corners.windows(2).skip(1).try_for_each(|w| self.add(&[corners[0], w[0], w[1]])),
        }
    }

    fn add(&mut self, polygon: &[u32]) -> Result<()> {
        let mut places = Vec::with_capacity(polygon.len());
        for &index in polygon {
            let place = self.positions.get(index as usize);
            let expected = || format!("one of the {} of its source", self.positions.len());
            places.push(*place.ok_or_else(|| Fault::new("p", format!("vertex {index}"), expected()))?);
        }
        for triangle in triangulate_polygon(&places)? {
            let corners = triangle.map(|i| self.keep(polygon[i]));
            self.mesh.triangles.push(corners);
        }
        Ok(())
    }

    fn keep(&mut self, index: u32) -> u32 {
        let next = self.mesh.vertices.len() as u32;
        match self.kept.get_mut(index as usize) {
            Some(Some(kept)) => *kept,
            Some(slot) => {
                *slot = Some(next);
                self.mesh.vertices.push(self.positions[index as usize]);
                next
            }
            None => next,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use proptest::prelude::*;

    use super::*;

    const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/worlds");

    #[test]
    fn real_files_have_the_bounds_another_loader_found() {
        let Ok(text) = std::fs::read_to_string(Path::new(DATA).join("mesh_bounds_m.json")) else {
            eprintln!("skipped: ../shared/data is absent");
            return;
        };
        let known: BTreeMap<String, [[f64; 3]; 2]> = serde_json::from_str(&text).unwrap();
        assert!(known.len() >= 20);
        for (name, [low, high]) in known {
            let mesh = super::super::mesh::load(&Path::new(DATA).join(&name)).unwrap();
            let (our_low, our_high) = mesh.bounds().unwrap();
            for axis in 0..3 {
                assert!((low[axis] - our_low[axis]).abs() < 1e-3, "{name}: {low:?} {our_low:?}");
                assert!((high[axis] - our_high[axis]).abs() < 1e-3, "{name}: {high:?} {our_high:?}");
            }
        }
    }

    /// A file with one triangle (0 0 0, 1 0 0, 0 1 0) as geometry `g`, and this scene.
    fn file(unit: &str, nodes: &str, library: &str) -> String {
        format!(
            r##"<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{unit}<up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 99 99 99</float_array>
<technique_common><accessor source="#a" count="4" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="1"><input semantic="VERTEX" offset="1" source="#v"/><input semantic="NORMAL" offset="0" source="#s"/>
<p>7 0 7 1 7 2</p></triangles></mesh></geometry></library_geometries>
{library}
<library_visual_scenes><visual_scene id="scene">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"##
        )
    }

    fn corners(text: &str) -> Vec<[f64; 3]> {
        let mesh = parse(text).unwrap().validated().unwrap();
        mesh.triangles.iter().flatten().map(|i| mesh.vertices[*i as usize].into()).collect()
    }

    #[track_caller]
    fn close(found: &[[f64; 3]], expected: &[[f64; 3]]) {
        assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(expected) {
            assert!((Vector3::from(*a) - Vector3::from(*b)).norm() < 1e-12, "{found:?} {expected:?}");
        }
    }

    const G: &str = r##"<instance_geometry url="#g"/>"##;

    #[test]
    fn the_unit_scales_translations_too_and_the_up_axis_is_ignored() {
        let text = file(r#"<unit meter="0.01"/>"#, &format!("<node><translate>100 200 300</translate>{G}</node>"), "");
        close(&corners(&text), &[[1.0, 2.0, 3.0], [1.01, 2.0, 3.0], [1.0, 2.01, 3.0]]);
    }

    #[test]
    fn transforms_apply_in_document_order_through_nested_nodes() {
        // Innermost first: scale (2,0,0), turn to (0,2,0), move to (10,2,0); then the parent turns it about z.
        let node = format!(
            "<node><matrix>0 -1 0 0  1 0 0 5  0 0 1 0  0 0 0 1</matrix><node><translate>10 0 0</translate>\
             <rotate>0 0 1 90</rotate><scale>2 3 1</scale>{G}</node></node>"
        );
        close(&corners(&file("", &node, "")), &[[0.0, 15.0, 0.0], [-2.0, 15.0, 0.0], [0.0, 12.0, 0.0]]);
    }

    #[test]
    fn instances_repeat_and_mirrored_ones_keep_their_outside() {
        let library =
            format!(r#"<library_nodes><node id="n"><translate>0 0 1</translate>{G}{G}</node></library_nodes>"#);
        let nodes = r##"<node><scale>-1 1 1</scale><instance_node url="#n"/></node>"##;
        let one = [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 1.0]];
        close(&corners(&file("", nodes, &library)), &[one, one].concat());
    }

    #[test]
    fn every_kind_of_polygon_is_read() {
        let square = "0 0 0 2 0 0 2 2 0 0 2 0";
        let kinds = [
            ("polylist", "<vcount>4</vcount><p>0 1 2 3</p>"),
            ("polygons", "<p>0 1 2 3</p>"),
            ("triangles", "<p>0 1 2 <!-- cut --> 0 2 3</p>"),
            ("tristrips", "<p>0 1 3 2</p>"),
            ("trifans", "<p>0 1 2 3</p>"),
        ];
        for (kind, body) in kinds {
            let text = file("", &format!("<node>{G}</node>"), "")
                .replace("0 0 0 1 0 0 0 1 0 99 99 99", square)
                .replace(
                    r##"offset="1" source="#v"/><input semantic="NORMAL" offset="0" source="#s"/>"##,
                    r##"source="#v"/>"##,
                )
                .replace("<p>7 0 7 1 7 2</p>", body)
                .replace("<triangles", &format!("<{kind}"))
                .replace("</triangles", &format!("</{kind}"));
            let corners = corners(&text);
            assert_eq!(corners.len(), 6, "{kind}");
            let doubled_area: f64 = corners
                .chunks(3)
                .map(|t| {
                    (Vector3::from(t[1]) - Vector3::from(t[0])).cross(&(Vector3::from(t[2]) - Vector3::from(t[0]))).z
                })
                .inspect(|z| assert!(*z > 0.0, "{kind}"))
                .sum();
            assert_eq!(doubled_area, 8.0, "{kind}");
        }
    }

    #[test]
    fn broken_files_name_the_line() {
        let good = file(r#"<unit meter="1"/>"#, &format!("<node>{G}</node>"), "");
        let cases = [
            (r#"meter="1""#, r#"meter="zero""#, "line 3: unit meter: found `zero`"),
            (r#"meter="1""#, r#"meter="0""#, "line 3: unit meter: found 0"),
            ("7 0 7 1 7 2", "7 0 7 1 7 9", "vertex 9"),
            ("7 0 7 1 7 2", "7 0 7 1 7", "5 numbers"),
            ("7 0 7 1 7 2", "7 0 7 1", "2 corners"),
            ("7 0 7 1 7 2", "7 0 7 1 7 -2", "`-2`"),
            ("99 99 99", "99 99 nan", "`nan`"),
            (r##"url="#g""##, r##"url="#h""##, "`#h`"),
            (r##"url="#g""##, r##"url="http://x/#g""##, "an element of this file"),
            ("COLLADA", "COLADA", "<COLADA>"),
            ("</scene>", "", "well-formed XML"),
            (r#"stride="3""#, r#"stride="0""#, "stride: found 0"),
            (r#"offset="1""#, r#"offset="99999999999""#, "offset"),
            ("<node>", "<node><skew>1 2 3</skew>", "<skew>"),
            ("<node>", "<node><rotate>0 0 0 9</rotate>", "axis"),
            ("<node>", "<node><translate>0 0</translate>", "translate: found 2 numbers, expected 3"),
            ("<node>", r#"<node><instance_controller url="x"/>"#, "skin"),
            ("<mesh>", "<mesh_>", "well-formed XML"),
        ];
        for (from, to, expected) in cases {
            let message = parse(&good.replace(from, to)).unwrap_err().to_string();
            assert!(message.contains(expected) && message.starts_with("line "), "{message}");
        }
        assert!(parse("").is_err());
        for cut in 0..good.len() {
            assert!(parse(&good[..cut]).is_err());
        }
    }

    proptest! {
        #[test]
        fn a_damaged_file_never_makes_the_reader_panic(at in 0..1300_usize, with in "[-0-9.<>/ #\"a-z]{0,3}") {
            let mut text = file(r#"<unit meter="1"/>"#, &format!("<node><rotate>0 0 1 9</rotate>{G}</node>"), "");
            let at = at.min(text.len() - 1);
            text.replace_range(at..=at, &with);
            let _ = parse(&text);
        }
    }

    #[test]
    fn nodes_that_hold_themselves_end_in_a_fault() {
        let library = r##"<library_nodes><node id="n"><instance_node url="#n"/><instance_node url="#n"/></node></library_nodes>"##;
        let nodes = r##"<node><instance_node url="#n"/></node>"##;
        let message = parse(&file("", nodes, library)).unwrap_err().to_string();
        assert!(message.contains("without end"), "{message}");
        // Twenty doublings: no loop, but a million copies.
        let doubling: String = (0..25)
            .map(|i| {
                format!(r##"<node id="n{i}"><instance_node url="#n{0}"/><instance_node url="#n{0}"/></node>"##, i + 1)
            })
            .collect();
        let library = format!(r#"<library_nodes>{doubling}<node id="n25">{G}</node></library_nodes>"#);
        let nodes = r##"<node><instance_node url="#n0"/></node>"##;
        assert!(parse(&file("", nodes, &library)).unwrap_err().to_string().contains("in all"));
    }
}
