//! Where the robot was at each image of a folder: steps, a table, or a TUM trajectory.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::files::read_text;
use super::images::{ImagesSpec, number_of};
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Odom, Robot, Transform};
use crate::time::Stamp;

/// Largest file of poses [bytes].
const FILE_BYTES_MAX: u64 = 1 << 29;

/// Where and when one image was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    pub stamp: Stamp,
    pub odom_from_robot: Transform<Odom, Robot>,
    pub cylinder_pulse: i32,
    pub mirror_pulse: i32,
}

/// One entry a file; `None` where nothing is known of it.
#[derive(Clone, Debug)]
pub(super) struct Poses(Vec<Option<Place>>);

impl Poses {
    /// For the `files` in their order; paths in `spec` are relative to the rig file.
    pub fn read(spec: &ImagesSpec, rig_path: &Path, files: &[PathBuf]) -> Result<Self> {
        let beside = |path: &PathBuf| rig_path.parent().unwrap_or(Path::new("")).join(path);
        if let Some(table) = &spec.table {
            return from_table(&beside(table), spec, files);
        }
        if let Some(trajectory) = &spec.trajectory {
            return from_trajectory(&beside(trajectory), spec, files);
        }
        let step = spec.step_m.unwrap_or_default();
        let places = files.iter().map(|file| {
            let number = numbered(file)?;
            Ok(Some(Place::fixed(stamp_of(spec, number), Transform::planar(number * step, 0.0, 0.0))))
        });
        Ok(Self(places.collect::<Result<_>>()?))
    }

    /// The place of the file at `index`.
    pub fn of(&self, index: usize) -> Option<Place> {
        self.0.get(index).copied().flatten()
    }
}

impl Place {
    fn fixed(stamp: Stamp, odom_from_robot: Transform<Odom, Robot>) -> Self {
        Self { stamp, odom_from_robot, cylinder_pulse: 0, mirror_pulse: 0 }
    }
}

fn numbered(file: &Path) -> Result<f64> {
    let number = number_of(file).ok_or_else(|| {
        Fault::new("file name", file.display(), "digits in it: the image's number gives its time and place")
    })?;
    Ok(number as f64)
}

fn stamp_of(spec: &ImagesSpec, number: f64) -> Stamp {
    Stamp::from_secs(spec.start_s + number * spec.period_s.unwrap_or_default())
}

/// Lines of `name tx ty tz qx qy qz qw [stamp_s [cylinder_pulse mirror_pulse]]`.
fn from_table(path: &Path, spec: &ImagesSpec, files: &[PathBuf]) -> Result<Poses> {
    let mut by_name = BTreeMap::new();
    for (line, words) in lines(path)? {
        let wrong = |fault: Fault| fault.in_file(path).at_line(line);
        if !matches!(words.len(), 8 | 9 | 11) {
            let expected =
                "name tx ty tz qx qy qz qw, with a stamp or a stamp and two pulse counts or nothing after them";
            return Err(wrong(Fault::new("words", words.len(), expected)));
        }
        let odom_from_robot = pose(&words[1..8]).map_err(wrong)?;
        let stamp = match words.get(8) {
            Some(word) => Some(stamp(word).map_err(wrong)?),
            None => None,
        };
        let pulse = |i: usize, what: &str| match words.get(i) {
            Some(word) => word.parse::<i32>().map_err(|_| wrong(Fault::new(what, word, "a whole number"))),
            None => Ok(0),
        };
        let (cylinder_pulse, mirror_pulse) = (pulse(9, "cylinder pulse")?, pulse(10, "mirror pulse")?);
        let entry = (stamp, Place { stamp: Stamp::default(), odom_from_robot, cylinder_pulse, mirror_pulse });
        if by_name.insert(words[0].clone(), entry).is_some() {
            return Err(wrong(Fault::new("name", &words[0], "one line an image")));
        }
    }
    let mut places = Vec::with_capacity(files.len());
    for file in files {
        let name = file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let place = match by_name.get(&name) {
            None => None,
            Some((Some(stamp), place)) => Some(Place { stamp: *stamp, ..*place }),
            Some((None, place)) if spec.period_s.is_some() => {
                Some(Place { stamp: stamp_of(spec, numbered(file)?), ..*place })
            }
            Some((None, _)) => {
                let expected = "a stamp in the table, or images.period_s in the rig file";
                return Err(Fault::new(format!("stamp of {name}"), "nothing", expected).in_file(path));
            }
        };
        places.push(place);
    }
    Ok(Poses(places))
}

/// Lines of `timestamp tx ty tz qx qy qz qw`, times growing.
fn from_trajectory(path: &Path, spec: &ImagesSpec, files: &[PathBuf]) -> Result<Poses> {
    let mut track: Vec<Place> = Vec::new();
    for (line, words) in lines(path)? {
        let wrong = |fault: Fault| fault.in_file(path).at_line(line);
        if words.len() != 8 {
            return Err(wrong(Fault::new("words", words.len(), "8: timestamp tx ty tz qx qy qz qw")));
        }
        let place = Place::fixed(stamp(&words[0]).map_err(wrong)?, pose(&words[1..8]).map_err(wrong)?);
        if track.last().is_some_and(|last| last.stamp >= place.stamp) {
            return Err(wrong(Fault::new("timestamp", &words[0], "a later one than in the line before")));
        }
        track.push(place);
    }
    if spec.period_s.is_none() {
        if track.len() != files.len() {
            let expected = format!("{}, one an image, or images.period_s in the rig file", files.len());
            return Err(Fault::new("lines", track.len(), expected).in_file(path));
        }
        return Ok(Poses(track.into_iter().map(Some).collect()));
    }
    let places = files.iter().map(|file| {
        let stamp = stamp_of(spec, numbered(file)?);
        Ok(at_time(&track, stamp).map(|odom_from_robot| Place::fixed(stamp, odom_from_robot)))
    });
    Ok(Poses(places.collect::<Result<_>>()?))
}

/// The pose at a time, along the arc between the two nearest; `None` outside the track.
fn at_time(track: &[Place], stamp: Stamp) -> Option<Transform<Odom, Robot>> {
    let after = track.partition_point(|place| place.stamp < stamp);
    let end = track.get(after)?;
    if end.stamp == stamp {
        return Some(end.odom_from_robot);
    }
    let start = track.get(after.checked_sub(1)?)?;
    let t = (stamp - start.stamp).as_secs() / (end.stamp - start.stamp).as_secs();
    Some(start.odom_from_robot.along_arc(&end.odom_from_robot, t))
}

/// The lines with something in them (`#` begins a comment), with their numbers, as words parted by blanks or commas.
fn lines(path: &Path) -> Result<Vec<(usize, Vec<String>)>> {
    let text = read_text(path, FILE_BYTES_MAX)?;
    let words = |line: &str| -> Vec<String> {
        let said = line.split('#').next().unwrap_or_default();
        said.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty()).map(String::from).collect()
    };
    Ok(text.lines().enumerate().map(|(i, line)| (i + 1, words(line))).filter(|(_, words)| !words.is_empty()).collect())
}

fn number(what: &str, word: &str, limit: f64) -> Result<f64> {
    let value = word.parse::<f64>().map_err(|_| Fault::new(what, word, "a number"))?;
    number_within(what, value, -limit, limit)
}

fn stamp(word: &str) -> Result<Stamp> {
    Ok(Stamp::from_secs(number("timestamp", word, 9e9)?))
}

/// tx ty tz [m] qx qy qz qw; the quaternion is brought to length 1, as TUM files are rounded.
fn pose(words: &[String]) -> Result<Transform<Odom, Robot>> {
    const NAMES: [&str; 7] = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"];
    let mut v = [0.0; 7];
    for ((value, word), name) in v.iter_mut().zip(words).zip(NAMES) {
        *value = number(name, word, 1e6)?;
    }
    let quaternion = Quaternion::new(v[6], v[3], v[4], v[5]);
    if (quaternion.norm() - 1.0).abs() > 0.01 {
        return Err(Fault::new("qx qy qz qw", format!("length {}", quaternion.norm()), "a unit quaternion"));
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion);
    Ok(Isometry3::from_parts(Translation3::new(v[0], v[1], v[2]), rotation).into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::images::ImagesSpec;

    fn files() -> Vec<PathBuf> {
        [1, 2, 3].map(|i| PathBuf::from(format!("folder/img{i}.png"))).to_vec()
    }

    fn read(text: &str, spec: impl Fn(PathBuf) -> ImagesSpec) -> Result<Poses> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("poses.txt"), text).unwrap();
        Poses::read(&spec("poses.txt".into()), &folder.path().join("rig.toml"), &files())
    }

    fn table(path: PathBuf) -> ImagesSpec {
        ImagesSpec { table: Some(path), ..ImagesSpec::default() }
    }

    fn trajectory(path: PathBuf) -> ImagesSpec {
        ImagesSpec { trajectory: Some(path), ..ImagesSpec::default() }
    }

    fn timed(path: PathBuf) -> ImagesSpec {
        ImagesSpec { trajectory: Some(path), period_s: Some(0.5), ..ImagesSpec::default() }
    }

    #[test]
    fn a_table_gives_poses_times_and_pulses_by_name() {
        let text = "# name tx ty tz qx qy qz qw stamp cylinder mirror\n\
                    img3.png 3 0 0 0 0 0 1 9.5 7 -8\n\nimg1.png, 1, 2, 3, 0, 0, 0.70710678, 0.70710678, 2.5  # turned\n";
        let poses = read(text, table).unwrap();
        let first = poses.of(0).unwrap();
        assert_eq!((first.stamp, first.odom_from_robot.xyz().z), (Stamp::from_secs(2.5), 3.0));
        assert!((first.odom_from_robot.yaw() - std::f64::consts::FRAC_PI_2).abs() < 1e-7);
        assert_eq!(poses.of(1), None);
        assert_eq!(poses.of(2).map(|p| (p.cylinder_pulse, p.mirror_pulse)), Some((7, -8)));
    }

    #[test]
    fn a_trajectory_is_taken_line_by_line_or_interpolated_in_time() {
        let text = "0.4 0 0 0 0 0 0 1\n0.9 0.5 0 0 0 0 0 1\n1.4 0.5 1 0 0 0 0 1\n";
        let by_line = read(text, trajectory).unwrap();
        assert_eq!(by_line.of(1).unwrap().stamp, Stamp::from_secs(0.9));
        let by_time = read(text, timed).unwrap(); // images at 0.5, 1.0 and 1.5 s
        assert!((by_time.of(0).unwrap().odom_from_robot.xyz().x - 0.1).abs() < 1e-9);
        assert!((by_time.of(1).unwrap().odom_from_robot.xyz().y - 0.2).abs() < 1e-9);
        assert_eq!(by_time.of(2), None);
    }

    #[test]
    fn a_bad_line_is_named() {
        for (text, line, word) in [
            ("img1.png 1 2 3", 1, "words"),
            ("# a\nimg1.png 1 2 x 0 0 0 1 0", 2, "tz"),
            ("img1.png 1 2 nan 0 0 0 1 0", 1, "tz"),
            ("img1.png 1 2 3 0 0 0 2 0", 1, "unit quaternion"),
            ("img1.png 1 2 3 0 0 0 1 1e300", 1, "timestamp"),
            ("img1.png 1 2 3 0 0 0 1 0 5 1.5", 1, "mirror"),
            ("img1.png 1 2 3 0 0 0 1 0\nimg1.png 1 2 3 0 0 0 1 0", 2, "one line an image"),
        ] {
            let fault = read(text, table).unwrap_err();
            assert_eq!(fault.line, Some(line), "{fault}");
            assert!(fault.to_string().contains(word) && fault.to_string().contains("poses.txt"), "{fault}");
        }
        assert!(read("img1.png 1 2 3 0 0 0 1", table).unwrap_err().to_string().contains("period_s"));
        assert!(read("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", trajectory).unwrap_err().to_string().contains("later"));
        assert!(read("1 0 0 0 0 0 0 1", trajectory).unwrap_err().to_string().contains("one an image"));
        assert!(read("1 0 0 0 0 0 1", trajectory).is_err());
        assert!(read("", timed).unwrap().of(0).is_none());
        let absent = Poses::read(&table("none.txt".into()), Path::new("rig.toml"), &files()).unwrap_err();
        assert!(absent.to_string().contains("none.txt"));
        let nameless = Poses::read(&ImagesSpec::default(), Path::new("rig.toml"), &["a.png".into()]).unwrap_err();
        assert!(nameless.to_string().contains("digits"));
    }
}
