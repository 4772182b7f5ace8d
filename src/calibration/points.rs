//! Point files in, camera files out.
//!
//! A point file has a mark a line: `x y z u v`, position on the target and pixel in the image, separated by blanks, tabs or
//! commas; a sixth number is the image it was seen in (0 without it). `#` starts a comment; empty lines are skipped.

use serde::{Deserialize, Serialize};

use super::Target;
use crate::fault::{Fault, Result};
use crate::geometry::Point;
use crate::optics::{Camera, Distortion};

/// Most marks that are read.
const MARKS_MAX: usize = 1_000_000;

/// A mark of a target, seen in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Where it is on the target.
    pub target: Point<Target>,
    /// Its column [px].
    pub u_px: f64,
    /// Its row from the top [px].
    pub v_px: f64,
    /// Which image it was seen in.
    pub image: u32,
    /// The line of the file it stands on, from 1; otherwise its number, from 1.
    pub line: usize,
}

/// The unit of the positions in a point file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthUnit {
    /// Metres.
    #[default]
    M,
    /// Millimetres.
    Mm,
}

impl LengthUnit {
    fn metres(self) -> f64 {
        match self {
            Self::M => 1.0,
            Self::Mm => 1e-3,
        }
    }
}

/// How the image's rows are counted in a point file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rows {
    /// From the top, as everywhere in this crate.
    #[default]
    FromTop,
    /// From the bottom of an image of this many rows, as the paper's frame memory.
    FromBottom(usize),
}

/// Reads a point file.
///
/// Errors, with the line: fewer than five or more than six numbers, text, numbers that are not finite, an image number
/// that is none. An empty file is refused.
pub fn parse(text: &str, unit: LengthUnit, rows: Rows) -> Result<Vec<Mark>> {
    let mut marks = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let content = line.split('#').next().unwrap_or_default();
        let mut words = content.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty()).peekable();
        if words.peek().is_none() {
            continue;
        }
        if marks.len() == MARKS_MAX {
            return Err(Fault::new("point file", format!("more than {MARKS_MAX} marks"), "fewer").at_line(i + 1));
        }
        marks.push(mark(words, unit, rows, i + 1).map_err(|fault| fault.at_line(i + 1))?);
    }
    if marks.is_empty() {
        return Err(Fault::new("point file", "no marks", "lines of x y z u v"));
    }
    Ok(marks)
}

fn mark<'a>(words: impl Iterator<Item = &'a str>, unit: LengthUnit, rows: Rows, line: usize) -> Result<Mark> {
    const NAMES: [&str; 6] = ["x", "y", "z", "u", "v", "image"];
    let mut numbers = [0.0; 6];
    let mut count = 0;
    for word in words {
        let Some(slot) = numbers.get_mut(count) else {
            return Err(Fault::new("mark", "more than 6 numbers", "x y z u v and perhaps the image"));
        };
        let number = word.parse::<f64>().ok().filter(|n| n.is_finite() && n.abs() < 1e9);
        *slot = number.ok_or_else(|| Fault::new(NAMES[count], shortened(word), "a finite number"))?;
        count += 1;
    }
    if count < 5 {
        return Err(Fault::new("mark", format!("{count} numbers"), "x y z u v and perhaps the image"));
    }
    let [x, y, z, u_px, v, image] = numbers;
    if image.fract() != 0.0 || !(0.0..=1e6).contains(&image) {
        return Err(Fault::new("image", image, "a whole number from 0 to 1000000"));
    }
    let v_px = match rows {
        Rows::FromTop => v,
        Rows::FromBottom(height) => height as f64 - 1.0 - v,
    };
    let metres = unit.metres();
    Ok(Mark { target: Point::new(x * metres, y * metres, z * metres), u_px, v_px, image: image as u32, line })
}

fn shortened(word: &str) -> String {
    if word.chars().count() > 24 {
        format!("{}…", word.chars().take(24).collect::<String>())
    } else {
        word.to_string()
    }
}

/// The `[camera]` table of a `rig.toml`.
pub fn camera_toml(camera: &Camera) -> String {
    #[derive(Serialize)]
    struct Document<'a> {
        camera: &'a Camera,
    }
    // Numbers and names: nothing that TOML cannot hold.
    toml::to_string(&Document { camera }).unwrap_or_default()
}

/// A camera as a ROS `camera_info` file.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// The text of the file.
    pub yaml: String,
    /// How far the file's model is from the camera's own within the image, RMS [px]: 0 unless Tsai's had to be rewritten.
    pub difference_rms_px: f64,
    /// The same, at the worst pixel.
    pub difference_max_px: f64,
}

/// A camera as ROS `camera_info` YAML, model `plumb_bob`. Tsai's model is not among ROS's: its nearest k1, k2, k3 are
/// fitted over the image, and the difference is stated.
///
/// Errors: a camera whose model ends within its image.
pub fn camera_info(camera: &Camera, name: &str) -> Result<CameraInfo> {
    let (plumb_bob, difference_rms_px, difference_max_px) = as_plumb_bob(camera)?;
    let [k1, k2, p1, p2, k3] = match plumb_bob.distortion {
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => [k1, k2, p1, p2, k3],
        Distortion::Pinhole | Distortion::Tsai { .. } => [0.0; 5],
    };
    let Camera { width, height, fx, fy, cx, cy, .. } = plumb_bob;
    // Only letters, digits, - and _: nothing that YAML would read as anything but text.
    let name: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '_' }).collect();
    let yaml = format!(
        "image_width: {width}\nimage_height: {height}\ncamera_name: \"{name}\"\n\
         camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{fx:?}, 0.0, {cx:?}, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 1.0]\n\
         distortion_model: plumb_bob\n\
         distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{k1:?}, {k2:?}, {p1:?}, {p2:?}, {k3:?}]\n\
         rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n\
         projection_matrix:\n  rows: 3\n  cols: 4\n  \
         data: [{fx:?}, 0.0, {cx:?}, 0.0, 0.0, {fy:?}, {cy:?}, 0.0, 0.0, 0.0, 1.0, 0.0]\n"
    );
    Ok(CameraInfo { yaml, difference_rms_px, difference_max_px })
}

/// The nearest Brown–Conrady camera, and its RMS and largest distance from the given one over the image [px].
fn as_plumb_bob(camera: &Camera) -> Result<(Camera, f64, f64)> {
    let Distortion::Tsai { .. } = camera.distortion else {
        let (k1, k2, p1, p2, k3) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let distortion = match camera.distortion {
            Distortion::Pinhole => Distortion::BrownConrady { k1, k2, p1, p2, k3 },
            other => other,
        };
        return Ok((Camera { distortion, ..*camera }, 0.0, 0.0));
    };
    // r_d/r_u = 1 + k1·r_u² + k2·r_u⁴ + k3·r_u⁶ is linear in the coefficients; a row a pixel of a grid, weighted with r_u
    // so that the sum is of squared shifts.
    let mut normal = nalgebra::Matrix3::<f64>::zeros();
    let mut right = nalgebra::Vector3::<f64>::zeros();
    let rays = grid_rays(camera)?;
    for (bent, ideal) in &rays {
        let r = ideal.norm();
        let row = nalgebra::Vector3::new(r.powi(3), r.powi(5), r.powi(7));
        normal += row * row.transpose();
        right += row * (bent.norm() - r);
    }
    let no_rays = || Fault::new("camera", "an image within a pixel of its centre", "a wider one");
    let [k1, k2, k3]: [f64; 3] = normal.pseudo_inverse(1e-30).map_err(|_| no_rays())?.tr_mul(&right).into();
    let fitted = Camera { distortion: Distortion::BrownConrady { k1, k2, p1: 0.0, p2: 0.0, k3 }, ..*camera };
    let (mut squares, mut worst) = (0.0, 0.0f64);
    for (_, ideal) in &rays {
        let line = ideal.push(1.0);
        let (Some([u, v]), Some([nu, nv])) = (camera.project(&line), fitted.project(&line)) else {
            return Err(Fault::new("camera", "a distortion that no plumb_bob follows", "a milder one"));
        };
        let off = (u - nu).hypot(v - nv);
        squares += off * off;
        worst = worst.max(off);
    }
    Ok((fitted, (squares / rays.len() as f64).sqrt(), worst))
}

/// For a grid of pixels: the coordinates with distortion, and without.
fn grid_rays(camera: &Camera) -> Result<Vec<(nalgebra::Vector2<f64>, nalgebra::Vector2<f64>)>> {
    const ACROSS: usize = 40;
    let mut rays = Vec::with_capacity((ACROSS + 1) * (ACROSS + 1));
    for j in 0..=ACROSS {
        for i in 0..=ACROSS {
            let u = (camera.width - 1) as f64 * i as f64 / ACROSS as f64;
            let v = (camera.height - 1) as f64 * j as f64 / ACROSS as f64;
            let ray = camera.ray(u, v).ok_or_else(|| {
                Fault::new(
                    "camera",
                    format!("a distortion that folds over at pixel ({u:.0}, {v:.0})"),
                    "one that holds",
                )
            })?;
            let bent = nalgebra::Vector2::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy);
            rays.push((bent, ray.xy()));
        }
    }
    Ok(rays)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_point_file_is_read_with_comments_and_blank_lines() {
        let text = "# x y z u v\n\n 10 20 0  1.5 2.5 # first\n1e1,2e1,-5,3,4,2\n";
        let marks = parse(text, LengthUnit::Mm, Rows::FromTop).unwrap();
        assert_eq!(marks.len(), 2);
        assert_eq!((marks[0].line, marks[0].image, marks[0].v_px), (3, 0, 2.5));
        assert_eq!((marks[1].line, marks[1].image), (4, 2));
        assert!((marks[1].target.xyz - nalgebra::Vector3::new(0.01, 0.02, -0.005)).norm() < 1e-15);
        let marks = parse("0 0 0 7 0", LengthUnit::M, Rows::FromBottom(480)).unwrap();
        assert_eq!(marks[0].v_px, 479.0);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let fault = |text: &str| parse(text, LengthUnit::M, Rows::FromTop).unwrap_err().to_string();
        assert_eq!(
            fault("0 0 0 1 1\n0 0 0 1\n"),
            "line 2: mark: found 4 numbers, expected x y z u v and perhaps the image"
        );
        assert_eq!(fault("0 0 0 1 NaN"), "line 1: v: found NaN, expected a finite number");
        assert_eq!(fault("\n0 inf 0 1 1"), "line 2: y: found inf, expected a finite number");
        assert!(fault("0 0 0 1e300 1").starts_with("line 1: u"));
        assert!(fault("a b c d e").starts_with("line 1: x: found a"));
        assert!(fault("0 0 0 1 1 0.5").contains("whole number"));
        assert!(fault("0 0 0 1 1 1 1").contains("more than 6"));
        assert_eq!(fault("# nothing\n"), "point file: found no marks, expected lines of x y z u v");
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_parser(text in ".{0,200}") {
            let _ = parse(&text, LengthUnit::Mm, Rows::FromTop);
        }
    }

    #[test]
    fn the_camera_table_reads_back_bit_for_bit() {
        #[derive(Deserialize)]
        struct Document {
            camera: Camera,
        }
        let camera = Camera::metro_i();
        let back: Document = toml::from_str(&camera_toml(&camera)).unwrap();
        assert_eq!(back.camera, camera);
    }

    #[test]
    fn tsai_becomes_plumb_bob_within_a_hundredth_of_a_pixel() {
        let camera = Camera::metro_i();
        let (fitted, rms, max) = as_plumb_bob(&camera).unwrap();
        assert!(rms < 0.005 && max < 0.02, "{rms} {max}");
        // x_u = x_d·(1 + k·r_d²) undone: x_d = x_u·(1 − k·r_u² + 3k²·r_u⁴ …).
        let (Distortion::BrownConrady { k1, .. }, Distortion::Tsai { k }) = (fitted.distortion, camera.distortion)
        else {
            panic!("models");
        };
        assert!((k1 / -k - 1.0).abs() < 0.01, "{k1}");
        let info = camera_info(&camera, "metro: i").unwrap();
        assert_eq!(info.difference_rms_px, rms);
        assert!(info.yaml.contains("camera_name: \"metro__i\"") && info.yaml.contains("plumb_bob"));
    }

    #[test]
    fn brown_conrady_is_written_as_it_is() {
        let distortion = Distortion::BrownConrady { k1: -0.35, k2: 0.158, p1: 7e-4, p2: -2e-4, k3: 0.0 };
        let info = camera_info(&Camera { distortion, ..Camera::metro_i() }, "c").unwrap();
        assert!(info.yaml.contains("data: [-0.35, 0.158, 0.0007, -0.0002, 0.0]"), "{}", info.yaml);
        assert_eq!(info.difference_max_px, 0.0);
    }
}
