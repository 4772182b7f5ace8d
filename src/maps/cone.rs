//! What an ultrasonic range says about the cells of a plane: the inverse model of Moravec and Elfes (1985; Elfes 1987).
//!
//! An echo from R frees the cone in front of it, most on its axis, and fills a band of ±ε about R across it (`instrument.md`
//! 6). That there was no echo says nothing: a smooth wall that is not square to the beam gives none either.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within};

/// Cells of one reading, at most: 20 m at 1 cm would be far more.
const CELLS_MAX: f64 = 4e6;

/// The inverse model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConeParams {
    /// Half width of the band in which the echo may lie, ε [m] [A].
    pub band_m: f64,
    /// Readings beyond this are not used [m] [A].
    pub range_m_max: f64,
    /// How certain a cell is free where P_E = 1: its probability of being occupied is (1 − this)/2 [A].
    pub free_certainty: f64,
    /// How certain a cell is occupied where P_O = 1: its probability is (1 + this)/2 [A].
    pub occupied_certainty: f64,
}

impl Default for ConeParams {
    fn default() -> Self {
        Self { band_m: 0.075, range_m_max: 5.0, free_certainty: 0.4, occupied_certainty: 0.6 }
    }
}

impl ConeParams {
    /// Refuses values that make no model; faults are named `cone.…`.
    pub fn validated(self) -> Result<Self> {
        number_within("cone.band_m", self.band_m, 0.001, 5.0)?;
        number_within("cone.range_m_max", self.range_m_max, 0.01, 20.0)?;
        number_within("cone.free_certainty", self.free_certainty, 0.0, 0.999)?;
        number_within("cone.occupied_certainty", self.occupied_certainty, 0.0, 0.999)?;
        Ok(self)
    }

    /// The log-odds that a range in a cone adds at distance `delta_m` and angle `theta_rad` from its axis, if it says anything.
    pub fn log_odds(&self, cone: &Cone, range_m: f64, delta_m: f64, theta_rad: f64) -> Option<f64> {
        let half = cone.view_rad / 2.0;
        if theta_rad.abs() >= half || delta_m < cone.range_m_min || range_m > self.range_m_max {
            return None;
        }
        let across = 1.0 - (theta_rad / half).powi(2);
        let from_echo = (delta_m - range_m) / self.band_m;
        let odds = |p: f64| ((1.0 + p) / (1.0 - p)).ln();
        if from_echo.abs() < 1.0 {
            let occupied = (1.0 - from_echo * from_echo) * across;
            Some(odds(self.occupied_certainty * occupied))
        } else if from_echo < 0.0 {
            let along = (delta_m - cone.range_m_min) / (range_m - self.band_m - cone.range_m_min);
            Some(-odds(self.free_certainty * (1.0 - along * along) * across))
        } else {
            None
        }
    }
}

/// Where a range was measured, in the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// Its apex [m].
    pub origin_m: [f64; 2],
    /// Its axis, counter-clockwise from x [rad].
    pub bearing_rad: f64,
    /// Its full angle, ω [rad].
    pub view_rad: f64,
    /// Nothing is said of what is nearer, Rmin [m].
    pub range_m_min: f64,
}

impl Cone {
    fn validated(self) -> Result<Self> {
        number_within("bearing of a cone", self.bearing_rad, -1e6, 1e6)?;
        number_within("angle of a cone", self.view_rad, 0.0, std::f64::consts::PI)?;
        number_within("least range", self.range_m_min, 0.0, 1e6)?;
        Ok(self)
    }
}

/// What one reading says about one cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// The cell: floor of its coordinates over the side of a cell.
    pub cell: [i32; 2],
    /// Log-odds to be added, in thousandths; never 0.
    pub log_odds: i16,
}

/// What a range [m] in a cone says about the cells of a grid with this side [m]: those whose middle lies in the cone, row by
/// row from the lowest y, along x in each.
///
/// # Errors
/// A number that is not finite, a cone of more than 180°, a side that is not from 1 mm to 10 m, more than four million cells,
/// a place beyond 10 000 km.
pub fn evidence(params: &ConeParams, cell_m: f64, cone: &Cone, range_m: f64) -> Result<Vec<Evidence>> {
    let params = params.validated()?;
    let Cone { origin_m, bearing_rad, view_rad, .. } = cone.validated()?;
    number_within("side of a cell", cell_m, 1e-3, 10.0)?;
    number_within("range", range_m, 0.0, 1e6)?;
    let reach = range_m + params.band_m;
    let count = (reach / cell_m).powi(2);
    if range_m > params.range_m_max {
        return Ok(Vec::new());
    }
    if count > CELLS_MAX {
        return Err(Fault::new("cells of a reading", format!("{count:.0}"), format!("at most {CELLS_MAX:.0}")));
    }
    for at in origin_m {
        number_within("origin", at / cell_m, -2e9, 2e9)?;
    }
    let (sin, cos) = bearing_rad.sin_cos();
    let rows = |axis: usize| {
        // The box around the cone: its apex, its ends, and its top where an axis runs through it.
        let half = view_rad / 2.0;
        let angles = [-half, half].into_iter().chain(within(bearing_rad, half).map(|turn| turn - bearing_rad));
        let tips = angles.map(|turn| {
            let (y, x) = (bearing_rad + turn).sin_cos();
            reach * if axis == 0 { x } else { y }
        });
        let (low, high) = tips.fold((0.0_f64, 0.0_f64), |(low, high), tip| (low.min(tip), high.max(tip)));
        let key = |v: f64| ((origin_m[axis] + v) / cell_m).floor() as i32;
        key(low)..=key(high)
    };
    let columns = rows(0);
    let mut out = Vec::new();
    for row in rows(1) {
        for column in columns.clone() {
            let middle = [column, row].map(|key| (f64::from(key) + 0.5) * cell_m);
            let (x, y) = (middle[0] - origin_m[0], middle[1] - origin_m[1]);
            let (ahead, aside) = (x * cos + y * sin, y * cos - x * sin);
            let said = params.log_odds(cone, range_m, x.hypot(y), aside.atan2(ahead));
            let thousandths = said.map_or(0, |log_odds| (log_odds * 1000.0).round() as i16);
            if thousandths != 0 {
                out.push(Evidence { cell: [column, row], log_odds: thousandths });
            }
        }
    }
    Ok(out)
}

/// The quarter turns [rad] within a half angle about a bearing.
fn within(bearing: f64, half: f64) -> impl Iterator<Item = f64> {
    let quarter = std::f64::consts::FRAC_PI_2;
    let first = ((bearing - half) / quarter).ceil() as i64;
    let last = ((bearing + half) / quarter).floor() as i64;
    (first..=last).map(move |turn| turn as f64 * quarter)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    fn cone(origin_m: [f64; 2], bearing_rad: f64) -> Cone {
        Cone { origin_m, bearing_rad, view_rad: 30_f64.to_radians(), range_m_min: 0.41 }
    }

    fn cells(origin: [f64; 2], bearing: f64, range: f64) -> Vec<Evidence> {
        evidence(&ConeParams::default(), 0.05, &cone(origin, bearing), range).unwrap()
    }

    #[test]
    fn the_model_has_the_values_of_its_formula() {
        let (model, ahead) = (ConeParams::default(), cone([0.0; 2], 0.0));
        // Halfway from Rmin to R − ε, on the axis: P_E = 1 − 1/4; beside it by ω/4: times 1 − 1/4.
        let (low, high) = (0.41, 2.0 - 0.075);
        let halfway = (low + high) / 2.0;
        let free = |p: f64| ((1.0 - 0.4 * p) / (1.0 + 0.4 * p)).ln();
        let close = |a: Option<f64>, b: f64| assert!((a.unwrap() - b).abs() < 1e-12, "{a:?} {b}");
        close(model.log_odds(&ahead, 2.0, halfway, 0.0), free(0.75));
        close(model.log_odds(&ahead, 2.0, halfway, 7.5_f64.to_radians()), free(0.75 * 0.75));
        close(model.log_odds(&ahead, 2.0, low, 0.0), free(1.0));
        let occupied = |p: f64| ((1.0 + 0.6 * p) / (1.0 - 0.6 * p)).ln();
        close(model.log_odds(&ahead, 2.0, 2.0, 0.0), occupied(1.0));
        close(model.log_odds(&ahead, 2.0, 2.0 + 0.0375, 0.0), occupied(0.75));
        close(model.log_odds(&ahead, 2.0, 2.0, -7.5_f64.to_radians()), occupied(0.75));
        for (delta, deg) in [(0.4, 0.0), (2.08, 0.0), (1.0, 15.0), (1.0, 180.0)] {
            assert_eq!(model.log_odds(&ahead, 2.0, delta, f64::to_radians(deg)), None);
        }
        assert_eq!(model.log_odds(&ahead, 5.1, 2.0, 0.0), None);
    }

    #[test]
    fn a_reading_frees_the_cone_and_fills_its_end() {
        let found = cells([1.0, 1.0], 0.0, 2.0);
        for e in &found {
            let [x, y] = e.cell.map(|key| (f64::from(key) + 0.5) * 0.05 - 1.0);
            assert_eq!(e.log_odds > 0, (x.hypot(y) - 2.0).abs() < 0.075, "{e:?}");
            assert!(y.atan2(x).abs() < 15_f64.to_radians());
        }
        // The sector from 0.41 to 2.075 m of 30°, in cells of 0.05 m.
        let area = (2.075_f64.powi(2) - 0.41_f64.powi(2)) * 15_f64.to_radians();
        assert!((found.len() as f64 * 0.0025 / area - 1.0).abs() < 0.05, "{}", found.len());
        let order: Vec<[i32; 2]> = found.iter().map(|e| [e.cell[1], e.cell[0]]).collect();
        assert!(order.windows(2).all(|pair| pair[0] < pair[1]), "row by row");
    }

    #[test]
    fn what_is_no_reading_is_refused_or_says_nothing() {
        let (model, ahead) = (ConeParams::default(), cone([0.0; 2], 0.0));
        assert!(cells([0.0, 0.0], 0.3, 9.0).is_empty());
        assert!(evidence(&model, 0.05, &ahead, f64::NAN).is_err());
        assert!(evidence(&model, 0.05, &cone([f64::INFINITY, 0.0], 0.0), 1.0).is_err());
        assert!(evidence(&model, 0.05, &cone([1e12, 0.0], 0.0), 1.0).is_err());
        assert!(evidence(&model, 0.05, &cone([0.0; 2], f64::NAN), 1.0).is_err());
        assert!(evidence(&model, 0.05, &Cone { view_rad: 7.0, ..ahead }, 1.0).is_err());
        assert!(evidence(&model, 0.05, &Cone { range_m_min: f64::NAN, ..ahead }, 1.0).is_err());
        assert!(evidence(&model, 0.0, &ahead, 1.0).is_err());
        assert!(evidence(&model, 0.001, &ahead, 4.9).is_err());
        let fault = ConeParams { band_m: 400.0, ..model }.validated().unwrap_err();
        assert!(fault.to_string().starts_with("cone.band_m: found 400"));
        assert!(ConeParams { range_m_max: 0.0, ..model }.validated().is_err());
    }

    proptest! {
        #[test]
        fn no_cell_of_the_cone_is_missed(
            x in -3.0..3.0f64, y in -3.0..3.0f64, bearing in -7.0..7.0f64, range in 0.3..3.0f64,
        ) {
            // Held against all cells of a square around the origin.
            let model = ConeParams::default();
            let found: BTreeMap<[i32; 2], i16> = cells([x, y], bearing, range).iter().map(|e| (e.cell, e.log_odds)).collect();
            for column in -130..130 {
                for row in -130..130 {
                    let (dx, dy) = ((f64::from(column) + 0.5) * 0.05 - x, (f64::from(row) + 0.5) * 0.05 - y);
                    let off = dy.atan2(dx) - bearing;
                    let off = off.sin().atan2(off.cos());
                    let said = model.log_odds(&cone([x, y], bearing), range, dx.hypot(dy), off).map_or(0, |l| (l * 1000.0).round() as i16);
                    let there = found.get(&[column, row]).copied().unwrap_or(0);
                    prop_assert!((said - there).abs() <= 1, "{column} {row}: {said} {there}");
                }
            }
        }

        #[test]
        fn turning_by_a_right_angle_turns_the_cells(range in 0.5..3.0f64) {
            let straight = cells([0.0, 0.0], 0.1, range);
            let turned = cells([0.0, 0.0], 0.1 + std::f64::consts::FRAC_PI_2, range);
            let sum = |cells: &[Evidence]| cells.iter().map(|e| i64::from(e.log_odds)).sum::<i64>();
            prop_assert!((straight.len() as i64 - turned.len() as i64).abs() <= 2);
            prop_assert!((sum(&straight) - sum(&turned)).abs() <= 50);
        }
    }
}
