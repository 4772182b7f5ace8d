//! A calibration as it would be made: what a finder of known parameters reads from slits on floor and walls.

use nalgebra::Vector3;
use rand::{Rng, RngExt};

use super::measured::{Observations, Slit, SlitEnd, SlitPeak, Surface, Wall};
use super::model::{SlitLine, slit_line};
use crate::fault::{Fault, Result};
use crate::geometry::{Plane, Point, Robot};
use crate::optics::{Laser, Rig};

/// A normal deviate: Box–Muller, two draws each.
pub fn normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt(); // 1 − u is never 0
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A number from −half to +half.
pub fn uniform(rng: &mut impl Rng, half: f64) -> f64 {
    (2.0 * rng.random::<f64>() - 1.0) * half
}

/// How mirror and tape are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reading {
    /// The paper's way: the mirror is turned until the slit lies on the mark; the encoder shows whole pulses.
    WholePulses,
    /// The mirror is sent to the whole pulse nearest to the aim and stops this near [pulses, standard deviation]; where
    /// the slit lies is read off the tape.
    Stops(f64),
}

/// What a slit is aimed at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Aim {
    /// A mark of the tape on the floor [m].
    Mark(f64),
    /// A mark of the tape behind the robot [m, negative], the cylinder turned half round.
    Behind(f64),
    /// The floor at this distance ahead of the turned finder [m], off the tape: no mark is read. Cylinder pulses.
    Floor(f64, f64),
    /// A height on a wall [m] where the tape's plane meets it; whether a ruler reads it.
    Wall(usize, f64, bool),
}

/// A calibration that is simulated.
#[derive(Clone, Debug)]
pub struct Procedure {
    /// The true finder.
    pub finder: Rig,
    /// Where the tape begins, ahead of the cylinder's axis: xR for a tape that begins at R [m].
    pub tape_start_m: f64,
    /// True walls: distance on the tape [m], angle from square [rad].
    pub walls: Vec<[f64; 2]>,
    /// How well walls are set square, as the bundle is told [rad].
    pub square_sigma_rad: f64,
    /// The slits.
    pub aims: Vec<Aim>,
    /// How mirror and tape are read.
    pub reading: Reading,
    /// Columns whose rows are read [px].
    pub columns_px: Vec<f64>,
    /// Where lines end beside the tape, to the left [m]: a wall's edge, a board on the floor.
    pub end_y_m: Option<f64>,
    /// Noise of a row [px].
    pub row_sigma_px: f64,
    /// Noise of tape and ruler [m].
    pub mark_sigma_m: f64,
}

impl Procedure {
    /// The paper's: slits on marks of a tape, one row each.
    pub fn on_marks(finder: Rig, tape_start_m: f64, marks_m: impl IntoIterator<Item = f64>) -> Self {
        let middle = finder.camera.cx;
        Self {
            finder,
            tape_start_m,
            walls: Vec::new(),
            square_sigma_rad: 0.01,
            aims: marks_m.into_iter().map(Aim::Mark).collect(),
            reading: Reading::WholePulses,
            columns_px: vec![middle],
            end_y_m: None,
            row_sigma_px: 0.1,
            mark_sigma_m: 0.5e-3,
        }
    }

    /// Marks for `count` slits over `length_m` of tape that hold the mirror best: half of them about a third of the way out,
    /// the rest at both ends, 15 mm apart. Spread evenly they would hold it half as well again (4.1 for 2.9 mm).
    pub fn marks(count: usize, length_m: f64) -> Vec<f64> {
        const APART_M: f64 = 0.015;
        let ends = (count + 1) / 4;
        let middle = count - 2 * ends;
        let in_row = |from_m: f64, count: usize| (0..count).map(move |i| from_m + APART_M * i as f64);
        let near = in_row(0.0, ends);
        let mid = in_row(0.3 * length_m - APART_M * middle as f64 / 2.0, middle);
        near.chain(mid).chain(in_row(length_m - APART_M * ends.saturating_sub(1) as f64, ends)).collect()
    }

    /// One that holds every parameter of a METRO-I: floor slits along 2 m of tape, three walls, turns of the cylinder, ends
    /// of lines beside the tape, four columns of each line.
    pub fn thorough(finder: Rig) -> Self {
        let mut procedure = Self::on_marks(finder, 0.95, Self::marks(21, 2.0));
        procedure.walls = vec![[0.55, 0.004], [1.05, -0.006], [1.55, 0.003]];
        for (wall, [mark, _]) in procedure.walls.iter().enumerate() {
            let top = 1.0 - 0.283 * (0.95 + mark); // nothing above is seen (`instrument.md` 3)
            procedure.aims.extend([0.1, 0.5, 0.9].map(|part| Aim::Wall(wall, part * top, true)));
        }
        for turn in [500.0, 1000.0, 1500.0, 2000.0, 2500.0, 3000.0, 3500.0] {
            procedure.aims.extend([1.6, 2.6].map(|range| Aim::Floor(range, turn)));
        }
        procedure.aims.extend([-2.5, -2.9, -3.3].map(Aim::Behind));
        procedure.end_y_m = Some(0.3);
        procedure.columns_px = vec![40.0, 180.0, 330.0, 470.0];
        procedure
    }

    /// Makes all the measurements once.
    ///
    /// Errors: an aim that the mirror cannot reach.
    pub fn measure(&self, rng: &mut impl Rng) -> Result<Observations> {
        let mut slits = Vec::with_capacity(self.aims.len());
        for aim in &self.aims {
            slits.push(self.slit(*aim, rng)?);
        }
        let walls = (self.walls.iter())
            .map(|[mark, _]| Wall {
                mark_m: Some(mark + self.mark_sigma_m * normal(rng)),
                square_sigma_rad: self.square_sigma_rad,
            })
            .collect();
        let pulse_sigma = match self.reading {
            Reading::WholePulses => 1.0 / 12f64.sqrt(),
            Reading::Stops(sigma) => sigma,
        };
        Ok(Observations { slits, walls, pulse_sigma, mark_sigma_m: self.mark_sigma_m })
    }

    fn slit(&self, aim: Aim, rng: &mut impl Rng) -> Result<Slit> {
        let cylinder_pulse = match aim {
            Aim::Floor(_, pulses) => pulses,
            Aim::Behind(_) => (std::f64::consts::PI / self.finder.cylinder.rad_per_pulse).round(),
            _ => 0.0,
        };
        let exact = self.aimed(aim, cylinder_pulse)?;
        if let Laser::Mirror(mirror) = self.finder.laser {
            mirror.beam.angle("mirror encoder", exact.round() as i32)?;
        }
        let (read, true_pulse) = match self.reading {
            Reading::WholePulses => (exact.round(), exact),
            Reading::Stops(sigma) => (exact.round(), exact.round() + sigma * normal(rng)),
        };
        let (surface, on) = self.surface(aim)?;
        let line = slit_line(&self.finder, true_pulse, cylinder_pulse, &surface).ok_or_else(|| unreachable(aim))?;
        let crossing = line.at_tape();
        let mut off = || self.mark_sigma_m * normal(rng);
        let (mark_m, height_m) = match aim {
            Aim::Mark(_) | Aim::Behind(_) => (crossing.map(|at| at.x - self.tape_start_m + off()), None),
            Aim::Wall(_, _, true) => (None, crossing.map(|at| at.z + off())),
            _ => (None, None),
        };
        let sigma = self.row_sigma_px.max(self.mark_sigma_m * 300.0); // some 300 columns a metre
        let seen = self
            .end_y_m
            .filter(|_| cylinder_pulse == 0.0)
            .and_then(|y| Some((y, line.beside(&self.finder.camera, y)?)));
        let inside = |[u, v]: [f64; 2]| (4.0..508.0).contains(&u) && (4.0..475.0).contains(&v);
        let end =
            seen.filter(|(_, at)| inside(*at)).map(|(y_m, [u, _])| SlitEnd { y_m, u: u + sigma * normal(rng), sigma });
        let mut peaks = Vec::new();
        for &u in &self.columns_px {
            if let Some(v) = row_at(&self.finder, &line, u) {
                peaks.push(SlitPeak { u, v: v + self.row_sigma_px * normal(rng), sigma: self.row_sigma_px });
            }
        }
        Ok(Slit { name: String::new(), mirror_pulse: read, cylinder_pulse, on, mark_m, height_m, end, peaks })
    }

    /// The mirror's place, between pulses, that throws the slit where it is aimed: secants from a level beam downwards.
    fn aimed(&self, aim: Aim, cylinder_pulse: f64) -> Result<f64> {
        let (surface, _) = self.surface(aim)?;
        let misses = |pulse: f64| -> Option<f64> {
            let at = slit_line(&self.finder, pulse, cylinder_pulse, &surface)?;
            let miss = match aim {
                // In 1/x the floor is nearly straight over the angle.
                Aim::Mark(mark) | Aim::Behind(mark) => 1.0 / at.at_tape()?.x - 1.0 / (self.tape_start_m + mark),
                Aim::Floor(range, _) => 1.0 / at.ahead(&self.finder, cylinder_pulse)? - 1.0 / range,
                Aim::Wall(_, height, _) => at.at_tape()?.z - height,
            };
            miss.is_finite().then_some(miss)
        };
        let (mut a, mut b) = (0.0, 20.0);
        let mut at_a = misses(a).ok_or_else(|| unreachable(aim))?;
        for _ in 0..100 {
            let at_b = misses(b).ok_or_else(|| unreachable(aim))?;
            let next = b - at_b * (b - a) / (at_b - at_a);
            if (next - b).abs() < 1e-9 || at_b == at_a {
                return Ok(b);
            }
            (a, at_a, b) = (b, at_b, next);
        }
        Err(unreachable(aim))
    }

    fn surface(&self, aim: Aim) -> Result<(Plane<Robot>, Surface)> {
        let (plane, on) = match aim {
            Aim::Wall(wall, ..) => {
                let [mark, angle] = *self.walls.get(wall).ok_or_else(|| unreachable(aim))?;
                let at = Point::new(self.tape_start_m + mark, 0.0, 0.0);
                (Plane::through(at, Vector3::new(angle.cos(), angle.sin(), 0.0)), Surface::Wall(wall))
            }
            _ => (Plane::new(Vector3::z(), 0.0), Surface::Floor),
        };
        Ok((plane.ok_or_else(|| unreachable(aim))?, on))
    }
}

fn unreachable(aim: Aim) -> Fault {
    Fault::new("slit", format!("{aim:?}"), "an aim that the mirror can throw the slit on")
}

/// The row where a line crosses a column, if it is in the image.
pub(super) fn row_at(rig: &Rig, line: &SlitLine, u: f64) -> Option<f64> {
    let mut v = rig.camera.cy;
    for _ in 0..50 {
        let off = line.rows_off(&rig.camera, u, v)?;
        v -= off;
        if off.abs() < 1e-10 {
            break;
        }
    }
    let inside = line.rows_off(&rig.camera, u, v)?.abs() < 1e-6 && (4.0..rig.camera.height as f64 - 5.0).contains(&v);
    inside.then_some(v)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::finder::{ThreeSlits, closed_form};
    use rand::SeedableRng;
    use rand_chacha::ChaCha12Rng;

    #[test]
    fn without_noise_the_papers_procedure_reads_what_the_paper_read() {
        let rig = Rig::metro_i();
        let mut procedure = Procedure::on_marks(rig.clone(), 1.504_210, [0.0, 0.3, 0.6, 0.9, 1.2]);
        (procedure.row_sigma_px, procedure.mark_sigma_m) = (0.0, 0.0);
        let seen = procedure.measure(&mut ChaCha12Rng::seed_from_u64(1)).unwrap();
        let pulses: Vec<f64> = seen.slits.iter().map(|slit| slit.mirror_pulse).collect();
        assert_eq!(pulses, [130.0, 84.0, 49.0, 22.0, 0.0]); // Fig. 11 from the far end
        let rows: Vec<f64> = [0, 2, 4].map(|i| (seen.slits[i].peaks[0].v - rig.camera.cy).round()).into();
        assert_eq!(rows, [199.0, 6.0, -113.0]);
        let slits = ThreeSlits {
            spacing_m: 0.6,
            pulses_near: 81.0,
            pulses_far: 49.0,
            rad_per_pulse: std::f64::consts::TAU / 4000.0,
            rows_px: [0, 2, 4].map(|i| seen.slits[i].peaks[0].v),
        };
        assert!((closed_form(&rig.camera, &slits).unwrap().mirror_height_m - 0.81724).abs() < 1e-5);
    }

    #[test]
    fn what_cannot_be_reached_is_told() {
        let procedure = Procedure::on_marks(Rig::metro_i(), 1.5, [-1.5]);
        assert!(procedure.measure(&mut ChaCha12Rng::seed_from_u64(1)).is_err());
        let mut procedure = Procedure::on_marks(Rig::metro_i(), 1.5, []);
        procedure.aims = vec![Aim::Wall(0, 0.3, false)];
        assert!(procedure.measure(&mut ChaCha12Rng::seed_from_u64(1)).is_err());
    }
}
