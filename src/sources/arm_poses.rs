//! Poses of an arm's hand (flange) in its base, one an image.
//!
//! Either a line an image, `name tx ty tz qx qy qz qw`, or three lines an image: position, quaternion, name. Positions in metres;
//! brackets and commas are passed over, `#` starts a comment.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::files::read_text;
use crate::fault::{Fault, Result, number_within};

/// Largest file that is read [bytes].
const FILE_BYTES_MAX: u64 = 1 << 26;
/// Farther than this from its base no arm reaches [m].
const REACH_M_MAX: f64 = 20.0;

/// Reads a file of poses: base_from_hand by the name of the image.
///
/// Errors, with file and line: text for numbers, numbers that are not finite, a quaternion that is not of length 1, positions
/// that look like millimetres, a name without a pose or given twice, a file that ends within a pose.
pub fn load(path: &Path) -> Result<BTreeMap<String, Isometry3<f64>>> {
    parse(&read_text(path, FILE_BYTES_MAX)?).map_err(|fault| fault.in_file(path))
}

/// The same from text.
pub fn parse(text: &str) -> Result<BTreeMap<String, Isometry3<f64>>> {
    const EXPECTED: &str = "name tx ty tz qx qy qz qw, or three lines: tx ty tz, qx qy qz qw, name";
    let mut poses = BTreeMap::new();
    let mut numbers: Vec<f64> = Vec::new();
    let mut last_line = 0;
    for (i, line) in text.lines().enumerate() {
        let wrong = |fault: Fault| fault.at_line(i + 1);
        let said = line.split('#').next().unwrap_or_default();
        let apart = |c: char| c.is_whitespace() || matches!(c, ',' | ';' | '[' | ']' | '(' | ')');
        let words: Vec<&str> = said.split(apart).filter(|w| !w.is_empty()).collect();
        let (name, rest) = match (words.as_slice(), numbers.len()) {
            ([], _) => continue,
            ([name, rest @ ..], 0) if rest.len() == 7 => (Some(*name), rest),
            ([name], 7) => (Some(*name), &[][..]),
            (rest, 0) if rest.len() == 3 => (None, rest),
            (rest, 3) if rest.len() == 4 => (None, rest),
            _ => return Err(wrong(Fault::new("pose", format!("{} words", words.len()), EXPECTED))),
        };
        last_line = i + 1;
        for word in rest {
            let number = word.parse::<f64>().map_err(|_| wrong(Fault::new("pose", word, "a number")))?;
            numbers.push(number_within("pose", number, -1e6, 1e6).map_err(wrong)?);
        }
        if let Some(name) = name {
            let pose = pose(&numbers).map_err(wrong)?;
            numbers.clear();
            if poses.insert(name.to_string(), pose).is_some() {
                return Err(wrong(Fault::new("name", name, "one pose an image")));
            }
        }
    }
    if !numbers.is_empty() {
        return Err(Fault::new("pose", "the end of the file", EXPECTED).at_line(last_line));
    }
    if poses.is_empty() {
        return Err(Fault::new("poses", "none", EXPECTED));
    }
    Ok(poses)
}

fn pose(numbers: &[f64]) -> Result<Isometry3<f64>> {
    let &[x, y, z, qx, qy, qz, qw] = numbers else {
        return Err(Fault::new("pose", format!("{} numbers", numbers.len()), "7: tx ty tz qx qy qz qw"));
    };
    let reach = x.hypot(y).hypot(z);
    if reach > REACH_M_MAX {
        let found = format!("a hand {reach:.1} m from the base");
        return Err(Fault::new("pose", found, format!("at most {REACH_M_MAX} m: are these millimetres?")));
    }
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    if (quaternion.norm() - 1.0).abs() > 0.01 {
        return Err(Fault::new("qx qy qz qw", format!("length {}", quaternion.norm()), "a unit quaternion"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn both_forms_are_read() {
        let poses = parse("# arm\n[0.1, 0.2, 0.3]\n[0, 0, 0, 1]\nim0.png\n\nim1.png 1 2 3 0.6 0 0 0.8\n").unwrap();
        assert_eq!(poses.len(), 2);
        assert_eq!(poses["im0.png"].translation.vector.y, 0.2);
        assert!((poses["im1.png"].rotation.angle() - 2.0 * 0.6f64.asin()).abs() < 1e-12);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let fault = |text: &str| parse(text).unwrap_err().to_string();
        assert!(fault("").contains("found none"));
        assert!(fault("im0.png 1 2 3 0 0 0").starts_with("line 1: pose: found 7 words"));
        assert!(fault("\n[1, 2, 3]\n[0, 0, 0, 2]\na\n").starts_with("line 4: qx qy qz qw: found length 2"));
        assert!(fault("[1, 2, 3]\n[0, 0, 0, 1]\n").starts_with("line 2: pose: found the end"));
        assert!(fault("a 1 2 nan 0 0 0 1").contains("NaN"));
        assert!(fault("a 1 2 x 0 0 0 1").contains("found x"));
        assert!(fault("a 300 20 100 0 0 0 1").contains("millimetres"));
        assert!(fault("a 1 2 3 0 0 0 1\na 1 2 3 0 0 0 1").starts_with("line 2: name: found a"));
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_parser(text in "([-0-9.e nai#\\[\\],]|\\n){0,200}") {
            let _ = parse(&text);
        }
    }
}
