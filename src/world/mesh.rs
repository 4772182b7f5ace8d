//! Mesh files (OBJ, STL, COLLADA) and grey images of heights, read into bounded memory.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use nalgebra::Vector3;

use super::body::Mesh;
use super::collada;
use super::shapes::{height_samples, triangulate_polygon};
use crate::fault::{Fault, Result};

/// The largest mesh file that is read (bytes).
pub const MESH_FILE_BYTES_MAX: u64 = 512 << 20;

/// The largest image of heights that is read (bytes).
const IMAGE_FILE_BYTES_MAX: u64 = 256 << 20;

/// Reads a mesh file; its ending tells the format: `.obj`, `.stl` (text or binary) or `.dae`. Lengths are metres as
/// they stand in OBJ and STL; COLLADA says its own unit. Axes stay as they lie in the file.
///
/// # Errors
/// A file that cannot be read, is larger than 512 MB, breaks its format, or holds no triangles.
pub fn load(path: &Path) -> Result<Mesh> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let parse: fn(&[u8]) -> Result<Mesh> = match ending.as_str() {
        "obj" => |bytes| obj(utf8(bytes)?),
        "stl" => stl,
        "dae" => |bytes| collada::parse(utf8(bytes)?),
        _ => return Err(Fault::new("mesh format", format!("`.{ending}`"), "`.obj`, `.stl` or `.dae`").in_file(path)),
    };
    let bytes = read_bounded(path, MESH_FILE_BYTES_MAX)?;
    parse(&bytes).and_then(Mesh::validated).map_err(|fault| fault.in_file(path))
}

/// The whole of a regular file of at most `bytes_max`.
pub(super) fn read_bounded(path: &Path, bytes_max: u64) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| Fault::io(path, &e))?;
    let metadata = file.metadata().map_err(|e| Fault::io(path, &e))?;
    if !metadata.is_file() {
        return Err(Fault::new("file", "a directory or device", "a file").in_file(path));
    }
    let too_large = || Fault::new("file size", "more", format!("at most {bytes_max} bytes")).in_file(path);
    if metadata.len() > bytes_max {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    // The file may grow while it is read.
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(|e| Fault::io(path, &e))?;
    if bytes.len() as u64 > bytes_max {
        return Err(too_large());
    }
    Ok(bytes)
}

pub(super) fn utf8(bytes: &[u8]) -> Result<&str> {
    std::str::from_utf8(bytes)
        .map(|text| text.trim_start_matches('\u{feff}'))
        .map_err(|error| Fault::new("text", format!("byte {} is not UTF-8", error.valid_up_to()), "UTF-8 text"))
}

/// Builds a mesh in which equal positions are one vertex.
#[derive(Default)]
struct Welder {
    mesh: Mesh,
    index_of: HashMap<[u64; 3], u32>,
}

impl Welder {
    fn vertex(&mut self, [x, y, z]: [f64; 3]) -> u32 {
        let next = self.mesh.vertices.len() as u32;
        // Adding zero makes −0 the same place as 0.
        let index = *self.index_of.entry([x, y, z].map(|c| (c + 0.0).to_bits())).or_insert(next);
        if index == next {
            self.mesh.vertices.push(Vector3::new(x, y, z));
        }
        index
    }
}

fn number(word: &str, what: &str, line: usize) -> Result<f64> {
    word.parse::<f64>()
        .ok()
        .filter(|x| x.is_finite())
        .ok_or_else(|| Fault::new(what, format!("`{word}`"), "a finite number").at_line(line))
}

/// Three numbers from the words of a line.
fn three<'a>(mut words: impl Iterator<Item = &'a str>, what: &str, line: usize) -> Result<[f64; 3]> {
    let mut numbers = [0.0; 3];
    for slot in &mut numbers {
        let word = words.next().ok_or_else(|| Fault::new(what, "too few numbers", "three").at_line(line))?;
        *slot = number(word, what, line)?;
    }
    Ok(numbers)
}

/// Wavefront OBJ: its positions and faces. Texture, normals, colours, materials, groups, points and lines have no
/// surface of their own and are passed over.
fn obj(text: &str) -> Result<Mesh> {
    let mut mesh = Mesh::default();
    for (line, content) in (1..).zip(text.lines()) {
        let mut words = content.split_whitespace();
        match words.next() {
            Some("v") => mesh.vertices.push(three(words, "vertex", line)?.into()),
            Some("f") => obj_face(&mut mesh, words, line)?,
            Some("curv" | "curv2" | "surf" | "vp") => {
                return Err(Fault::new("OBJ element", "a free-form curve or surface", "polygons").at_line(line));
            }
            _ => {}
        }
    }
    Ok(mesh)
}

fn obj_face<'a>(mesh: &mut Mesh, words: impl Iterator<Item = &'a str>, line: usize) -> Result<()> {
    let count = mesh.vertices.len();
    let mut corners = Vec::new();
    for word in words {
        let index = word.split('/').next().and_then(|first| first.parse::<i64>().ok());
        // Positive numbers count from 1, negative ones from the latest vertex back.
        let index = match index {
            Some(i) if i > 0 => usize::try_from(i - 1).ok(),
            Some(i) if i < 0 => usize::try_from(i.unsigned_abs()).ok().and_then(|back| count.checked_sub(back)),
            _ => None,
        };
        let known = index.filter(|i| *i < count).and_then(|i| u32::try_from(i).ok());
        let expected = || format!("one of the {count} vertices above");
        corners.push(known.ok_or_else(|| Fault::new("face", format!("vertex `{word}`"), expected()).at_line(line))?);
    }
    if corners.len() < 3 {
        return Err(Fault::new("face", format!("{} corners", corners.len()), "at least 3").at_line(line));
    }
    let places: Vec<_> = corners.iter().map(|&i| mesh.vertices[i as usize]).collect();
    let triangles = triangulate_polygon(&places).map_err(|fault| fault.at_line(line))?;
    mesh.triangles.extend(triangles.into_iter().map(|t| t.map(|i| corners[i])));
    Ok(())
}

/// STL. Binary ones are known by their length, since some of them too begin with `solid`.
fn stl(bytes: &[u8]) -> Result<Mesh> {
    const HEADER: usize = 84;
    const FACET: usize = 50;
    let stated = bytes.get(80..HEADER).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let held = bytes.len().saturating_sub(HEADER) / FACET;
    if let Some(stated) = stated
        && bytes.len() == HEADER + held * FACET
        && stated as usize == held
    {
        return Ok(binary_stl(&bytes[HEADER..]));
    }
    if bytes.trim_ascii_start().starts_with(b"solid")
        && let Ok(text) = utf8(bytes)
    {
        return text_stl(text);
    }
    let found = match stated {
        Some(stated) => format!("{} bytes for {stated} stated triangles", bytes.len()),
        None => format!("{} bytes", bytes.len()),
    };
    Err(Fault::new("STL", found, "84 bytes and 50 for each stated triangle, or text that begins with `solid`"))
}

fn binary_stl(facets: &[u8]) -> Mesh {
    let mut welder = Welder::default();
    for facet in facets.chunks_exact(50) {
        // Each facet: a normal, three corners, two bytes without meaning.
        let mut floats = facet.chunks_exact(4).skip(3).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
        let mut coordinate = || floats.next().unwrap_or_default();
        let triangle = [(); 3].map(|()| [coordinate(), coordinate(), coordinate()]).map(|v| welder.vertex(v));
        welder.mesh.triangles.push(triangle);
    }
    welder.mesh
}

fn text_stl(text: &str) -> Result<Mesh> {
    let mut welder = Welder::default();
    let mut corners = Vec::with_capacity(3);
    let mut open = false;
    for (line, content) in (1..).zip(text.lines()) {
        let mut words = content.split_whitespace();
        match words.next() {
            Some("vertex") => corners.push(welder.vertex(three(words, "vertex", line)?)),
            Some("endfacet") => {
                let triangle = corners
                    .as_slice()
                    .try_into()
                    .map_err(|_| Fault::new("facet", format!("{} corners", corners.len()), "three").at_line(line))?;
                welder.mesh.triangles.push(triangle);
                corners.clear();
            }
            Some("solid") => open = true,
            Some("endsolid") => open = false,
            Some("facet" | "outer" | "endloop") | None => {}
            Some(word) => return Err(Fault::new("STL", format!("`{word}`"), "a keyword of STL").at_line(line)),
        }
    }
    if open || !corners.is_empty() {
        return Err(Fault::new("STL", "the end of the file", "`endsolid`"));
    }
    Ok(welder.mesh)
}

/// Grey levels of an image, from its lowest row up: the order of [`Mesh::height_field`].
#[derive(Clone, Debug, PartialEq)]
pub struct Levels {
    /// Samples along x.
    pub columns: usize,
    /// Samples along y.
    pub rows: usize,
    /// The levels: whole numbers from 0 to `white`.
    pub levels: Vec<f64>,
    /// The level of white: 255 or 65535.
    pub white: f64,
}

/// Reads the levels of a grey image (PNG, PGM, JPEG, BMP; 8 or 16 bits). Images that store grey as three equal
/// colours count as grey.
///
/// # Errors
/// A file that cannot be read, is no image, holds colours, or has too few or too many pixels.
pub fn load_levels(path: &Path) -> Result<Levels> {
    let bytes = read_bounded(path, IMAGE_FILE_BYTES_MAX)?;
    levels(bytes).map_err(|fault| fault.in_file(path))
}

fn levels(bytes: Vec<u8>) -> Result<Levels> {
    use image::DynamicImage::{ImageLuma8, ImageLuma16, ImageRgb8, ImageRgba8};
    let broken = |e: &dyn std::fmt::Display| Fault::new("image of heights", e, "a PNG, PGM, JPEG or BMP image");
    let reader = |bytes| image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| broken(&e));
    let bytes = bytes.as_slice();
    let (width, height) = reader(bytes)?.into_dimensions().map_err(|e| broken(&e))?;
    let (columns, rows) = (width as usize, height as usize);
    height_samples(columns, rows)?;
    let grey = |r: u8, g: u8, b: u8| (r == g && g == b).then_some(f64::from(r));
    let image = reader(bytes)?.decode().map_err(|e| broken(&e))?;
    let (levels, white): (Option<Vec<f64>>, f64) = match &image {
        ImageLuma8(pixels) => (Some(pixels.iter().map(|l| f64::from(*l)).collect()), 255.0),
        ImageLuma16(pixels) => (Some(pixels.iter().map(|l| f64::from(*l)).collect()), 65535.0),
        ImageRgb8(pixels) => (pixels.pixels().map(|p| grey(p[0], p[1], p[2])).collect(), 255.0),
        ImageRgba8(pixels) => (pixels.pixels().map(|p| grey(p[0], p[1], p[2])).collect(), 255.0),
        _ => (None, 0.0),
    };
    let found = || format!("{:?} pixels with colours", image.color());
    let top_down = levels.ok_or_else(|| Fault::new("image of heights", found(), "grey, 8 or 16 bits"))?;
    let levels = top_down.chunks_exact(columns).rev().flatten().copied().collect();
    Ok(Levels { columns, rows, levels, white })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use proptest::prelude::*;

    use super::*;

    fn refused(bytes: &[u8], ending: &str) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("thing.{ending}"));
        std::fs::write(&path, bytes).unwrap();
        let fault = load(&path).unwrap_err();
        assert!(fault.file.as_deref().is_some_and(|f| f.contains("thing")), "{fault}");
        fault.to_string()
    }

    const SQUARE: &str = "# a square and a quad of negative indices\nmtllib none.mtl\no thing\nv 0 0 0\nv 1 0 0 1.0\n\
        v 1 1 0 0.1 0.2 0.3\nv 0 1 0\nvn 0 0 1\nvt 0 0\nusemtl red\nf 1/1/1 2//1 3/1\nf -4 -2 -1\nl 1 2\n";

    #[test]
    fn obj_agrees_with_tobj() {
        let ours = obj(SQUARE).unwrap();
        assert_eq!(ours.triangles, [[0, 1, 2], [0, 2, 3]]);
        let plain = "v 0 0 0\nv 1.5 0 0\nv 1 1 0.25\nv 0 1 0\nv 3 -2 1e-1\nf 1 2 3 4\nf 1/2/3 5 2\nf -1 -2 -3\n";
        let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
        let text = plain.replace("/2/3", "");
        let (models, _) = tobj::load_obj_buf(&mut text.as_bytes(), &options, |_| Ok(Default::default())).unwrap();
        let corner = |i: u32| {
            let at = 3 * i as usize;
            Vector3::from_iterator(models[0].mesh.positions[at..at + 3].iter().map(|c| f64::from(*c)))
        };
        let theirs: Vec<_> = models[0].mesh.indices.iter().map(|i| corner(*i)).collect();
        let ours = obj(plain).unwrap();
        let ours: Vec<_> = ours.triangles.iter().flatten().map(|i| ours.vertices[*i as usize]).collect();
        assert_eq!(ours.len(), theirs.len());
        assert!(ours.iter().zip(&theirs).all(|(a, b)| (a - b).norm() < 1e-6));
    }

    #[test]
    fn broken_obj_files_name_the_line() {
        let cases = [
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "obj:4: face: found vertex `4`"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "obj:4: face: found vertex `0`"),
            ("v 0 0 0\nf 1 -2 1\n", "obj:2: face: found vertex `-2`"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "obj:4: face: found 2 corners"),
            ("v 0 0\n", "obj:1: vertex: found too few numbers"),
            ("v 0 nan 0\n", "obj:1: vertex: found `nan`"),
            ("v 0 0 0\n", "0 triangles"),
            ("", "0 triangles"),
            ("f 9223372036854775807 1 1\n", "obj:1: face"),
            ("f -9223372036854775808 1 1\n", "obj:1: face"),
        ];
        for (text, expected) in cases {
            let message = refused(text.as_bytes(), "obj");
            assert!(message.contains(expected), "{message}");
        }
        assert!(refused(b"v \xff", "obj").contains("not UTF-8"));
        assert!(refused(b"", "fbx").contains("`.fbx`"));
        assert!(load(&PathBuf::from("/nowhere/a.obj")).unwrap_err().to_string().contains("a file that exists"));
        assert!(load(&std::env::temp_dir().join("a.d.stl")).is_err());
    }

    /// A tetrahedron written by `stl_io`, as binary and as text.
    fn tetrahedron() -> (Vec<u8>, String, stl_io::IndexedMesh) {
        let corner = [[0.0, 0.0, 0.0_f32], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.5]].map(stl_io::Vertex::new);
        let faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let facets: Vec<_> = faces
            .iter()
            .map(|f| stl_io::Triangle { normal: stl_io::Normal::new([0.0; 3]), vertices: f.map(|i| corner[i]) })
            .collect();
        let mut binary = Vec::new();
        stl_io::write_stl(&mut binary, facets.iter()).unwrap();
        let mut text = "solid thing with a name\n".to_string();
        for facet in &facets {
            text += "facet normal 0 0 0\n outer loop\n";
            for v in facet.vertices {
                text += &format!("  vertex {} {} {}\n", v[0], v[1], v[2]);
            }
            text += " endloop\nendfacet\n";
        }
        text += "endsolid thing with a name\n";
        let theirs = stl_io::read_stl(&mut Cursor::new(&binary)).unwrap();
        (binary, text, theirs)
    }

    #[test]
    fn stl_agrees_with_stl_io_in_both_forms() {
        let (mut binary, text, theirs) = tetrahedron();
        let ours = stl(&binary).unwrap();
        assert_eq!(ours.vertices.len(), theirs.vertices.len());
        for (ours_face, theirs_face) in ours.triangles.iter().zip(&theirs.faces) {
            for (a, b) in ours_face.iter().zip(theirs_face.vertices) {
                let b = theirs.vertices[b].0.map(f64::from);
                assert_eq!(ours.vertices[*a as usize], Vector3::from(b));
            }
        }
        assert_eq!(stl(text.as_bytes()).unwrap(), ours);
        // The trap: a binary file whose free header begins as a text file does.
        binary[..6].copy_from_slice(b"solid ");
        assert_eq!(stl(&binary).unwrap(), ours);
        // Names are optional, and a file may hold several solids.
        let nameless = text.replace(" thing with a name", "");
        assert_eq!(stl(format!("{nameless}{text}").as_bytes()).unwrap().triangles.len(), 8);
    }

    #[test]
    fn broken_stl_files_are_refused() {
        let (binary, text, _) = tetrahedron();
        let mut lying = binary.clone();
        lying[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(refused(&lying, "stl").contains("4294967295 stated triangles"));
        assert!(refused(&binary[..binary.len() - 1], "stl").contains("STL"));
        assert!(refused(b"", "stl").contains("0 bytes"));
        assert!(refused(text.replacen("  vertex 0 0 0\n", "", 1).as_bytes(), "stl").contains("found 2 corners"));
        assert!(refused(&text.as_bytes()[..text.len() / 2], "stl").contains("STL") || text.len() < 10);
        assert!(refused(b"solid a\nendsolid a\n", "stl").contains("0 triangles"));
        let mut not_a_number = binary;
        not_a_number[96..100].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(refused(&not_a_number, "stl").contains("NaN"));
    }

    #[test]
    fn grey_images_are_read_from_the_bottom_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("heights.png");
        image::GrayImage::from_raw(3, 2, vec![1, 2, 3, 4, 5, 6]).unwrap().save(&path).unwrap();
        let levels = load_levels(&path).unwrap();
        assert_eq!((levels.columns, levels.rows, levels.white), (3, 2, 255.0));
        assert_eq!(levels.levels, [4.0, 5.0, 6.0, 1.0, 2.0, 3.0]);
        let deep = folder.path().join("deep.png");
        let pixels = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(2, 2, vec![0_u16, 1000, 65535, 7]).unwrap();
        pixels.save(&deep).unwrap();
        assert_eq!(load_levels(&deep).unwrap().levels, [65535.0, 7.0, 0.0, 1000.0]);
        let colour = folder.path().join("colour.png");
        image::RgbImage::from_pixel(2, 2, image::Rgb([1, 2, 3])).save(&colour).unwrap();
        assert!(load_levels(&colour).unwrap_err().to_string().contains("grey"));
        let broken = folder.path().join("broken.png");
        std::fs::write(&broken, b"P5 2 2 255 a").unwrap();
        assert!(load_levels(&broken).is_err());
    }

    proptest! {
        #[test]
        fn no_bytes_make_a_parser_panic(bytes: Vec<u8>, text in "(v|f|vertex|solid|facet|endfacet|endsolid|[-0-9. /\n]){0,60}") {
            let _ = (stl(&bytes), stl(text.as_bytes()), obj(&text), collada::parse(&text), levels(bytes));
        }
    }
}
