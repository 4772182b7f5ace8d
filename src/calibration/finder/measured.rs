//! What is measured: slits on floor and walls, read by encoders, tape and camera.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within};

/// What a slit lies on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// The flat floor, z = 0.
    Floor,
    /// The wall of this number, from 0.
    Wall(usize),
}

/// A place on the line in the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlitPeak {
    /// Column [px].
    pub u: f64,
    /// Row [px] from the top.
    pub v: f64,
    /// Standard deviation of the row [px].
    pub sigma: f64,
}

/// The end of a line: at `y_m` beside the tape (left is positive), and where it is in the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlitEnd {
    /// Distance from the plane of the tape, to the left [m].
    pub y_m: f64,
    /// Column of the line's last point [px].
    pub u: f64,
    /// Standard deviation of the column [px], that of the place included.
    pub sigma: f64,
}

/// One slit: encoders, what it lies on, where, and what the camera saw of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slit {
    /// Its name, for faults and tables.
    #[serde(default)]
    pub name: String,
    /// Mirror encoder, or the mean of several readings [pulses].
    pub mirror_pulse: f64,
    /// Cylinder encoder [pulses].
    #[serde(default)]
    pub cylinder_pulse: f64,
    /// What it lies on.
    pub on: Surface,
    /// On the floor: the tape's reading where the slit crosses it [m]; the tape lies along X, its zero anywhere.
    #[serde(default)]
    pub mark_m: Option<f64>,
    /// On a wall: height over the floor where the slit crosses the plane of the tape [m], if it was measured.
    #[serde(default)]
    pub height_m: Option<f64>,
    /// Where the line ends at a known place beside the tape (a wall's edge, a board laid on the floor), if it does.
    #[serde(default)]
    pub end: Option<SlitEnd>,
    /// What the camera saw; may be empty (a slit outside its view still tells of the mirror).
    #[serde(default)]
    pub peaks: Vec<SlitPeak>,
}

/// An upright wall across the tape.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wall {
    /// Where the tape meets it [m]; without, its distance is one more unknown.
    #[serde(default)]
    pub mark_m: Option<f64>,
    /// How well it was set square to the tape, standard deviation [rad].
    pub square_sigma_rad: f64,
}

/// All that was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observations {
    /// The slits.
    pub slits: Vec<Slit>,
    /// The walls.
    #[serde(default)]
    pub walls: Vec<Wall>,
    /// Standard deviation of the mirror's reading [pulses]: 0.289 where whole pulses were read off a mirror that was turned
    /// until the slit lay on a mark, 0.1 where it was sent to a whole pulse.
    pub pulse_sigma: f64,
    /// Standard deviation of tape and ruler [m].
    pub mark_sigma_m: f64,
}

impl Observations {
    /// How many readings there are besides the encoders'.
    pub fn readings(&self) -> usize {
        self.slits.iter().map(Slit::rows).sum()
    }

    /// Refuses what cannot be measured, and tells millimetres from metres.
    pub fn validated(self) -> Result<Self> {
        number_within("pulse_sigma", self.pulse_sigma, 1e-6, 100.0)?;
        number_within("mark_sigma_m", self.mark_sigma_m, 1e-6, 0.05)
            .map_err(|fault| Fault { expected: format!("{} (metres, not millimetres)", fault.expected), ..fault })?;
        if self.slits.len() > 100_000 || self.walls.len() > 1000 {
            return Err(Fault::new("slits", self.slits.len(), "at most 100000, on at most 1000 walls"));
        }
        for (i, wall) in self.walls.iter().enumerate() {
            number_within(&format!("wall {i}: square_sigma_rad"), wall.square_sigma_rad, 1e-6, 1.0)?;
            metres(&format!("wall {i}: mark_m"), wall.mark_m)?;
        }
        for (i, slit) in self.slits.iter().enumerate() {
            let what = |field: &str| format!("{}: {field}", slit.title(i));
            number_within(&what("mirror_pulse"), slit.mirror_pulse, -1e6, 1e6)?;
            number_within(&what("cylinder_pulse"), slit.cylinder_pulse, -1e6, 1e6)?;
            metres(&what("mark_m"), slit.mark_m)?;
            metres(&what("height_m"), slit.height_m)?;
            if let Some(end) = slit.end {
                number_within(&what("end.y_m"), end.y_m, -20.0, 20.0)?;
                number_within(&what("end.u"), end.u, -1e5, 1e5)?;
                number_within(&what("end.sigma"), end.sigma, 1e-6, 1e3)?;
            }
            for peak in &slit.peaks {
                number_within(&what("u"), peak.u, -1e5, 1e5)?;
                number_within(&what("v"), peak.v, -1e5, 1e5)?;
                number_within(&what("sigma"), peak.sigma, 1e-6, 1e3)?;
            }
            match slit.on {
                Surface::Wall(wall) if wall >= self.walls.len() => {
                    return Err(Fault::new(
                        what("on"),
                        format!("wall {wall}"),
                        format!("one of {} walls", self.walls.len()),
                    ));
                }
                Surface::Wall(_) if slit.mark_m.is_some() => {
                    return Err(Fault::new(
                        what("mark_m"),
                        "a mark on a wall",
                        "the mark at the wall itself, or height_m",
                    ));
                }
                Surface::Floor if slit.height_m.is_some() => {
                    return Err(Fault::new(
                        what("height_m"),
                        "a height on the floor",
                        "mark_m for a slit on the floor",
                    ));
                }
                _ => {}
            }
        }
        Ok(self)
    }
}

fn metres(what: &str, value: Option<f64>) -> Result<()> {
    let Some(value) = value else { return Ok(()) };
    if value.is_finite() && value.abs() <= 100.0 {
        return Ok(());
    }
    Err(Fault::new(what, value, "metres, up to 100 (is this millimetres?)"))
}

impl Slit {
    /// Its name, or its number from 1.
    pub fn title(&self, index: usize) -> String {
        if self.name.is_empty() { format!("slit {}", index + 1) } else { self.name.clone() }
    }

    /// How many numbers it measures, besides the encoders.
    pub(super) fn rows(&self) -> usize {
        let alone = [self.mark_m.is_some(), self.height_m.is_some(), self.end.is_some()];
        self.peaks.len() + alone.into_iter().filter(|is| *is).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn millimetres_and_other_slips_are_told() {
        let slit = |mark: f64| Slit {
            name: String::new(),
            mirror_pulse: 0.0,
            cylinder_pulse: 0.0,
            on: Surface::Floor,
            mark_m: Some(mark),
            height_m: None,
            end: None,
            peaks: vec![],
        };
        let refused = |slit: Slit| {
            Observations { slits: vec![slit], walls: vec![], pulse_sigma: 0.3, mark_sigma_m: 1e-3 }
                .validated()
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            refused(slit(1200.0)),
            "slit 1: mark_m: found 1200, expected metres, up to 100 (is this millimetres?)"
        );
        assert!(refused(slit(f64::NAN)).contains("mark_m"));
        assert!(refused(Slit { on: Surface::Wall(0), mark_m: None, ..slit(0.0) }).contains("0 walls"));
        assert!(refused(Slit { mirror_pulse: f64::INFINITY, ..slit(0.0) }).contains("mirror_pulse"));
        assert!(refused(Slit { height_m: Some(0.1), ..slit(0.0) }).contains("height_m"));
    }

    #[test]
    fn a_file_of_slits_is_read() {
        let text = r#"
            pulse_sigma = 0.289
            mark_sigma_m = 0.0005
            walls = [{ mark_m = 1.0, square_sigma_rad = 0.01 }]
            [[slits]]
            mirror_pulse = 130
            on = "floor"
            mark_m = 0.0
            peaks = [{ u = 256, v = 438, sigma = 0.1 }]
            [[slits]]
            name = "high on the wall"
            mirror_pulse = 10.5
            cylinder_pulse = 0
            on = { wall = 0 }
            height_m = 0.31
        "#;
        let seen: Observations = toml::from_str(text).unwrap();
        let seen = seen.validated().unwrap();
        assert_eq!((seen.slits[0].on, seen.slits[1].on), (Surface::Floor, Surface::Wall(0)));
        assert_eq!((seen.readings(), seen.slits[1].title(1).as_str()), (3, "high on the wall"));
        assert!(toml::from_str::<Observations>("slits = []\npulse_sgima = 1").is_err());
    }
}
