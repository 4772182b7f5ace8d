//! Point files: marks of a calibration target with the pixels they were seen at.

use std::path::Path;

use super::files::read_text;
use crate::calibration::points::{LengthUnit, Mark, Rows, parse};
use crate::fault::Result;

/// Largest file that is read [bytes].
const FILE_BYTES_MAX: u64 = 1 << 28;

/// Reads a point file: `x y z u v`, a mark a line. Errors name file and line.
pub fn load(path: &Path, unit: LengthUnit, rows: Rows) -> Result<Vec<Mark>> {
    parse(&read_text(path, FILE_BYTES_MAX)?, unit, rows).map_err(|fault| fault.in_file(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::points::camera_info;
    use crate::optics::{Camera, Distortion};
    use crate::sources::rig_file;

    #[test]
    fn a_file_that_is_wrong_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.txt");
        std::fs::write(&path, "0 0 0 1 2\n0 0 NaN 1 2\n").unwrap();
        let fault = load(&path, LengthUnit::Mm, Rows::FromTop).unwrap_err().to_string();
        assert!(fault.contains("points.txt:2: z: found NaN"), "{fault}");
        assert!(load(Path::new("none.txt"), LengthUnit::Mm, Rows::FromTop).is_err());
    }

    #[test]
    fn a_camera_info_file_that_was_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera_info.yaml");
        let distortion = Distortion::BrownConrady { k1: -0.35, k2: 0.158, p1: 7e-4, p2: -2.5e-5, k3: 1e-7 };
        let camera = Camera { distortion, fx: 514.123_456_789_012_3, ..Camera::metro_i() };
        std::fs::write(&path, camera_info(&camera, "a: #c").unwrap().yaml).unwrap();
        assert_eq!(rig_file::load_camera(&path).unwrap(), camera);
        // Tsai's model is not among those of ROS: another one comes back, close to it in the image.
        std::fs::write(&path, camera_info(&Camera::metro_i(), "c").unwrap().yaml).unwrap();
        let near = rig_file::load_camera(&path).unwrap();
        let line = Camera::metro_i().ray(40.0, 30.0).unwrap();
        let [u, v] = near.project(&line).unwrap();
        assert!((u - 40.0).abs() < 0.05 && (v - 30.0).abs() < 0.05, "{u} {v}");
    }
}
