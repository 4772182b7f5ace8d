//! Everything that parses, fed with damaged input: it may refuse, it must not panic, hang or swell.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use metromap::calibration::points::{LengthUnit, Rows};
use metromap::sources::range_table::RangeTable;
use metromap::sources::replay::Replay;
use metromap::sources::{Scenario, arm_poses, images, marks, rig_file, slits};
use metromap::world::{load_mesh, load_sdf};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const ROUNDS: usize = 300;
/// What breaks parsers when it stands where a number or a name stood.
const NASTY: [&str; 14] = [
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "-1e-308",
    "99999999999999999999",
    "\"\"",
    "[",
    "]]",
    "<",
    "&",
    "\0",
    "\u{fffd}",
];

/// The same damage for the same round.
fn damaged(sound: &[u8], round: usize) -> Vec<u8> {
    let mut random = ChaCha8Rng::seed_from_u64(round as u64);
    let mut bytes = sound.to_vec();
    for _ in 0..random.random_range(1..4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let end = (at + random.random_range(1..40)).min(bytes.len());
        match random.random_range(0..6) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes.truncate(at),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
            _ => {
                // The word around `at`.
                let is_word = |b: &u8| b.is_ascii_alphanumeric() || b"._-+".contains(b);
                let from = bytes[..at].iter().rposition(|b| !is_word(b)).map_or(0, |i| i + 1);
                let to = bytes[at..].iter().position(|b| !is_word(b)).map_or(bytes.len(), |i| at + i);
                let nasty = NASTY[random.random_range(0..NASTY.len())];
                bytes.splice(from..to.max(from), nasty.bytes());
            }
        }
    }
    bytes
}

/// Writes damaged files and hands them to a parser; some of them must have been refused.
fn survives(sound: &[u8], name: &str, parse: impl Fn(&Path) -> bool) {
    let dir = TempDir::new().unwrap();
    let path = dir.path().join(name);
    fs::write(&path, sound).unwrap();
    assert!(parse(&path), "{name} is not sound to begin with");
    let mut refused = 0;
    for round in 0..ROUNDS {
        fs::write(&path, damaged(sound, round)).unwrap();
        refused += usize::from(!parse(&path));
    }
    assert!(refused > ROUNDS / 10, "{name}: only {refused} of {ROUNDS} refused");
}

fn read(below: &str) -> Vec<u8> {
    fs::read(Path::new(ROOT).join(below)).unwrap()
}

#[test]
fn scenarios() {
    survives(&read("worlds/corridor.toml"), "world.toml", |path| Scenario::load(path, &[]).is_ok());
}

#[test]
fn rigs() {
    survives(&read("tests/rigs/robot_floor.toml"), "rig.toml", |path| rig_file::load(path).is_ok());
    let yaml = b"image_width: 640\nimage_height: 480\ncamera_name: cam\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [514.4, 0, 329.8, 0, 685.9, 237.7, 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  \
        cols: 5\n  data: [-0.35, 0.158, 0.0007, -0.0002, 0]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  data: [658, 0, 326, 0, 0, 658, 240, 0, 0, 0, 1, 0]\n";
    survives(yaml, "camera.yaml", |path| rig_file::camera_info(path).is_ok());
}

#[test]
fn rigs_with_a_covariance() {
    let rig = String::from_utf8(read("tests/rigs/robot_floor.toml")).unwrap();
    let covariance = "\n[covariance]\nparameters = [\"tilt_rad\", \"fx_px\"]\nmatrix = [[1e-6, 1e-5], [1e-5, 0.25]]\n";
    survives((rig + covariance).as_bytes(), "rig.toml", |path| rig_file::load(path).is_ok());
}

#[test]
fn what_calibrations_read() {
    let marks_file = b"# x y z u v\n0 0 0 100.5 200.25\n40 0 0 150.5 201\n0 40 0 99 250\n40 40 10.5 151 252\n";
    survives(marks_file, "points.txt", |path| marks::load(path, LengthUnit::Mm, Rows::FromTop).is_ok());
    let poses = b"im1 0.1 0.2 0.5 0 0 0 1\nim2 0.3 -0.2 0.5 0 0.7071067811865476 0 0.7071067811865476\n";
    survives(poses, "poses.txt", |path| arm_poses::load(path).is_ok());
    let slit_file =
        b"version = 1\nassume = \"paper\"\ncolumns = 16\nknown = { beam_zero_rad = 8e-5, roll_rad = \"exactly\" }\n\
        [camera]\nf_mm = [11.434, 0.019]\nscale_u = [1.095, 2e-4]\nk_per_mm2 = [0.00335, 6e-5]\ncu_px = [256, 2.5]\n\
        cv_px = [239, 2.5]\n[[walls]]\nmark_m = 1.05\nsquare_sigma_rad = 0.01\n\
        [[slits]]\nmirror_pulse = 130\non = \"floor\"\nmark_m = 0.0\npeaks = [{ u = 256, v = 437.8, sigma = 0.1 }]\n\
        [[slits]]\nmirror_pulse = 49\non = { wall = 0 }\npeaks = [{ u = 256, v = 244.9, sigma = 0.1 }]\n";
    survives(slit_file, "slits.toml", |path| slits::load(path, None).is_ok());
    let table =
        b"name,on,mirror_pulse,mark_m,u,v,sigma\na,floor,130,0.0,256,437.85,0.1\nb,floor,49,0.6,256,244.94,0.1\n\
        b,floor,49,0.6,300,244.9,0.1\n";
    survives(table, "slits.csv", |path| slits::load(path, None).is_ok());
}

#[test]
fn ranges_of_a_ring() {
    let table =
        b"S1,S2,S3,OUTPUT\n0.438,0.498,3.625,Slight-Right-Turn\n0.44,5.000,3.648,Sharp-Left-Turn\n1.0,0.5,2.332,Move\n";
    survives(table, "ranges.csv", |path| RangeTable::load(path, 3).is_ok());
}

#[test]
fn sdf_worlds_and_meshes() {
    let world = b"<sdf version='1.6'><world name='w'><model name='m'><pose>1 2 0 0 0 0.5</pose><static>1</static><link name='l'>\
        <collision name='b'><geometry><box><size>1 2 0.5</size></box></geometry></collision>\
        <collision name='c'><pose>0 0 1 0 0 0</pose><geometry><cylinder><radius>0.1</radius><length>1</length></cylinder></geometry>\
        </collision></link></model></world></sdf>";
    survives(world, "w.world", |path| load_sdf(path, &[]).is_ok());
    survives(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1/1 2/2 4/3\n", "m.obj", |path| load_mesh(path).is_ok());
    let stl = b"solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid s\n";
    survives(stl, "m.stl", |path| load_mesh(path).is_ok());
    let dae = b"<COLLADA><asset><unit meter='0.01'/></asset><library_geometries><geometry id='g'><mesh>\
        <source id='p'><float_array id='a' count='9'>0 0 0 1 0 0 0 1 0</float_array><technique_common>\
        <accessor source='#a' count='3' stride='3'/></technique_common></source><vertices id='v'>\
        <input semantic='POSITION' source='#p'/></vertices><triangles count='1'>\
        <input semantic='VERTEX' source='#v' offset='0'/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>\
        <library_visual_scenes><visual_scene id='s'><node><translate>1 2 3</translate><instance_geometry url='#g'/></node>\
        </visual_scene></library_visual_scenes><scene><instance_visual_scene url='#s'/></scene></COLLADA>";
    survives(dae, "m.dae", |path| load_mesh(path).is_ok());
}

#[test]
fn pictures() {
    let mut png = Cursor::new(Vec::new());
    image::GrayImage::from_fn(40, 30, |x, y| image::Luma([(x * y) as u8]))
        .write_to(&mut png, image::ImageFormat::Png)
        .unwrap();
    survives(&png.into_inner(), "a.png", |path| images::read_image(path, images::Channel::Gray, 255).is_ok());
}

#[test]
fn recordings() {
    let sound = read("recordings/corridor_no_images.mcap");
    // The first part is enough, and quick; what is cut off is a loss, not a refusal.
    let part = &sound[..200_000];
    for round in 0..60 {
        let bytes = damaged(part, round);
        if let Ok(mut replay) = Replay::new(Cursor::new(bytes), false) {
            let mut captures = 0;
            while let Ok(Some(_)) = replay.next_capture() {
                captures += 1;
            }
            assert!(captures < 10_000);
        }
    }
}
