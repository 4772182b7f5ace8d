//! The slit optics: a laser beam spread into a sheet by two pairs of cylindrical lenses, eq. (11)–(18).
//!
//! Two forms stand beside each other. The *printed* one reproduces Table 2 of the paper in every figure, with its
//! mistakes (`paper.md` 5.1, 5.2): θ1 from the focal length of one lens instead of the pair's, θ2 with the wrong sign, D
//! as if the light entered the second pair collimated. The *correct* one, which everything else uses, treats both pairs as
//! thin diverging lenses and follows the edge ray of the beam.
//!
//! Millimetres and degrees, as in the paper's tables; [`SlitOptics::sheet`] gives the SI form.

use serde::{Deserialize, Serialize};

use super::sheet::Sheet;
use crate::fault::{Fault, Result, number_within, positive};

/// Two lenses in line, as one thin lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LensPair {
    /// Focal length of the first lens [mm]; negative diverges.
    pub first_mm: f64,
    /// Focal length of the second lens [mm]; negative diverges.
    pub second_mm: f64,
    /// Distance d between the principal planes that face each other [mm].
    pub gap_mm: f64,
}

impl LensPair {
    /// Equivalent focal length (11): 1/feq = 1/f1 + 1/f2 − d/(f1·f2) [mm]; infinite for a pair without power.
    pub fn focal_mm(&self) -> f64 {
        1.0 / (1.0 / self.first_mm + 1.0 / self.second_mm - self.gap_mm / (self.first_mm * self.second_mm)) // (11)
    }

    /// Refuses what is no pair of diverging lenses.
    pub fn validated(self, what: &str) -> Result<Self> {
        for (name, focal) in [("first_mm", self.first_mm), ("second_mm", self.second_mm)] {
            number_within(&format!("{what}.{name}"), focal, -1e6, -1e-3)?;
        }
        number_within(&format!("{what}.gap_mm"), self.gap_mm, 0.0, 1e4)?;
        Ok(self)
    }
}

/// Radius of the curved side of a plano-concave lens [mm], from its focal length [mm] and index: R = (n − 1)·|f|.
pub fn radius_mm(focal_mm: f64, index: f64) -> f64 {
    (index - 1.0) * focal_mm.abs()
}

/// The gap d of two plano lenses with an air space of `air_mm` between them, of which `glass_mm` of glass of index n lie
/// between the principal planes: d = air + glass/n. The paper's (12) cannot be read in the scan; this is the distance that
/// (11) needs, and a back focal length measured from a flat side is f − glass/n.
pub fn gap_mm(air_mm: f64, glass_mm: f64, index: f64) -> f64 {
    air_mm + glass_mm / index
}

/// The paper's lenses, index 1.516.
pub const INDEX: f64 = 1.516;

/// The optics that make the sheet.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SlitOptics {
    /// The pair that the laser meets first.
    pub set1: LensPair,
    /// The pair that throws the sheet.
    pub set2: LensPair,
    /// Diameter of the laser beam (1/e²) [mm].
    pub laser_mm: f64,
    /// Distance lm between the two pairs [mm].
    pub between_mm: f64,
}

impl Default for SlitOptics {
    /// METRO-I: lenses that give exactly Table 1, and the shortest lm of Table 2.
    fn default() -> Self {
        Self {
            set1: LensPair { first_mm: -6.35, second_mm: -6.35, gap_mm: 4.420 },
            set2: LensPair { first_mm: -12.7, second_mm: -19.0, gap_mm: 4.354 },
            laser_mm: 0.8,
            between_mm: 15.0,
        }
    }
}

/// One row of Table 2.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fan {
    /// Half angle behind the first pair θ1 [°].
    pub theta1_deg: f64,
    /// Half angle of the sheet θ2 [°].
    pub theta2_deg: f64,
    /// Full width of the sheet D at the distance asked for [mm].
    pub width_mm: f64,
}

impl SlitOptics {
    /// METRO-I's with another distance between the pairs [mm].
    pub fn metro_i(between_mm: f64) -> Self {
        Self { between_mm, ..Self::default() }
    }

    /// Refuses what makes no sheet.
    pub fn validated(self) -> Result<Self> {
        self.set1.validated("optics.set1")?;
        self.set2.validated("optics.set2")?;
        positive("optics.laser_mm", self.laser_mm)?;
        number_within("optics.between_mm", self.between_mm, 0.0, 1e5)?;
        for (name, pair) in [("optics.set1", self.set1), ("optics.set2", self.set2)] {
            let focal = pair.focal_mm();
            if !(focal.is_finite() && focal < 0.0) {
                return Err(Fault::new(name, format!("a focal length of {focal} mm"), "a pair that diverges"));
            }
        }
        Ok(self)
    }

    /// |feq1| and |feq2| to the three decimals of Table 1, which the paper computes on with [mm].
    fn rounded(&self) -> (f64, f64) {
        let rounded = |pair: LensPair| (pair.focal_mm().abs() * 1e3).round() / 1e3;
        (rounded(self.set1), rounded(self.set2))
    }

    /// The correct sheet at a distance `range_mm` from the second pair, feq as in Table 1: behind the first pair the edge
    /// ray leaves at tanθ1 = Dlaser/(2·feq1) (14), meets the second at D'/2 (17) and is bent outward by D'/(2·feq2).
    pub fn fan(&self, range_mm: f64) -> Fan {
        let (f1, f2) = self.rounded();
        let entering = self.laser_mm / (2.0 * f1); // (14): tanθ1
        let width = (f1 + self.between_mm) / f1 * self.laser_mm; // (17): D'
        let leaving = width / (2.0 * f2) + entering; // (15), (16), (13): a diverging lens adds, paper.md 5.2
        Fan {
            theta1_deg: entering.atan().to_degrees(),
            theta2_deg: leaving.atan().to_degrees(),
            width_mm: width + 2.0 * leaving * range_mm, // D'(1 + l/feq2) + l·Dlaser/feq1
        }
    }

    /// What the paper prints in Table 2 (`paper.md` 5.1, 5.2).
    pub fn printed_fan(&self, range_mm: f64) -> Fan {
        let (exact1, exact2) = (self.set1.focal_mm().abs(), self.set2.focal_mm().abs());
        let entering = self.laser_mm / self.set1.first_mm.abs(); // not (14): 0.8/6.35
        let width = (exact1 + self.between_mm) / exact1 * self.laser_mm; // (17), feq unrounded
        let leaving = width / (2.0 * exact2) - self.laser_mm / (2.0 * exact1); // (16) with |feq|: a wrong sign
        let (f1, f2) = self.rounded();
        Fan {
            theta1_deg: entering.atan().to_degrees(),
            theta2_deg: leaving.atan().to_degrees(),
            width_mm: (f1 + self.between_mm) * (f2 + range_mm) / (f1 * f2) * self.laser_mm, // (18)
        }
    }

    /// The light of this optics as the finder's sheet: width where it opens and growth a metre; wavelength, power and
    /// waist as in `light`.
    ///
    /// Errors: lenses that make no sheet.
    pub fn sheet(&self, light: Sheet) -> Result<Sheet> {
        let (here, metre) = (self.validated()?.fan(0.0), self.fan(1000.0));
        let width_at_origin_m = here.width_mm * 1e-3;
        Sheet { width_at_origin_m, width_per_m: metre.width_mm * 1e-3 - width_at_origin_m, ..light }.validated()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Table 2 as printed: lm, θ1, θ2, D.
    const TABLE_2: [[f64; 4]; 5] = [
        [15.0, 7.18, 15.14, 2648.45],
        [20.0, 7.18, 21.68, 3411.47],
        [30.0, 7.18, 33.07, 4937.51],
        [40.0, 7.18, 42.14, 6463.56],
        [50.0, 7.18, 49.20, 7989.60],
    ];

    #[test]
    fn table_1_to_three_decimals() {
        let optics = SlitOptics::default();
        assert_eq!(format!("{:.3}", optics.set1.focal_mm()), "-2.355");
        assert_eq!(format!("{:.3}", optics.set2.focal_mm()), "-6.693");
        assert!((optics.set1.focal_mm() + 2.355286).abs() < 1e-6 && (optics.set2.focal_mm() + 6.692739).abs() < 1e-6);
    }

    #[test]
    fn table_2_as_printed_and_beside_it_the_correct_one() {
        // paper.md 5.2
        let correct = [[31.39, 3667.6], [36.40, 4430.6], [44.74, 5956.6], [51.22, 7482.7], [56.28, 9008.7]];
        for ([lm, theta1, theta2, width], [right_theta2, right_width]) in TABLE_2.into_iter().zip(correct) {
            let optics = SlitOptics::metro_i(lm).validated().unwrap();
            let printed = optics.printed_fan(3000.0);
            assert!((printed.theta1_deg - theta1).abs() <= 0.01, "{printed:?}");
            assert!((printed.theta2_deg - theta2).abs() <= 0.01, "{printed:?}");
            assert!((printed.width_mm - width).abs() <= 0.01, "{printed:?}");
            let fan = optics.fan(3000.0);
            assert!((fan.theta1_deg - 9.64).abs() < 0.005, "{fan:?}");
            assert!((fan.theta2_deg - right_theta2).abs() < 0.005, "{fan:?}");
            assert!((fan.width_mm - right_width).abs() < 0.051, "{fan:?}");
        }
    }

    #[test]
    fn the_default_sheet_is_that_of_lm_15() {
        let sheet = SlitOptics::default().sheet(Sheet::default()).unwrap();
        let known = Sheet::default();
        assert!((sheet.width_at_origin_m - known.width_at_origin_m).abs() < 1e-6, "{sheet:?}");
        assert!((sheet.width_per_m - known.width_per_m).abs() < 1e-4, "{sheet:?}");
        assert_eq!((sheet.power_w, sheet.waist_m), (known.power_w, known.waist_m));
        // The middle of the line holds P·√(2/π)/(D/2), on a line as wide as Table 2's correct column says.
        let line = sheet.line_power_w_per_m(3.0, 0.0);
        assert!((line - 7e-3 * (2.0 / std::f64::consts::PI).sqrt() / (3.6676 / 2.0)).abs() < 1e-6);
    }

    #[test]
    fn lenses_that_make_no_sheet_are_refused() {
        let good = SlitOptics::default();
        let converging = SlitOptics { set1: LensPair { first_mm: 6.35, ..good.set1 }, ..good };
        assert!(converging.validated().unwrap_err().to_string().contains("optics.set1.first_mm"));
        assert!(SlitOptics { between_mm: f64::NAN, ..good }.validated().is_err());
        assert!(SlitOptics { laser_mm: 0.0, ..good }.sheet(Sheet::default()).is_err());
    }

    #[test]
    fn glass_shortens_the_gap() {
        // 2 mm of air and 3.7 mm of glass of index 1.516 make the gap of set 1 to 0.03 mm.
        assert!((gap_mm(2.0, 3.67, INDEX) - 4.420).abs() < 0.01);
        assert!((radius_mm(-6.35, INDEX) - 3.2766).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn the_edge_ray_of_four_lenses_is_that_of_two_pairs(
            f in prop::array::uniform4(2.0..40.0f64), gap in prop::array::uniform2(0.0..6.0f64), lm in 0.0..60.0f64
        ) {
            // Independent: the ray transfer of the pair's principal planes, [y, tanθ] → lens [y, tanθ + y/|f|].
            let pair = |a: f64, b: f64, gap_mm: f64| LensPair { first_mm: -a, second_mm: -b, gap_mm };
            let (set1, set2) = (pair(f[0], f[1], gap[0]), pair(f[2], f[3], gap[1]));
            // A pair's power is what it does to a parallel ray: y = 1 through both lenses.
            for (pair, a, b, gap) in [(set1, f[0], f[1], gap[0]), (set2, f[2], f[3], gap[1])] {
                let slope = 1.0 / a;
                let slope = slope + (1.0 + gap * slope) / b;
                prop_assert!((slope + 1.0 / pair.focal_mm()).abs() < 1e-12);
            }
            let optics = SlitOptics { set1, set2, laser_mm: 0.8, between_mm: lm };
            let (f1, f2) = optics.rounded();
            let slope = 0.4 / f1;
            let height = 0.4 + lm * slope;
            let slope = slope + height / f2;
            let fan = optics.fan(3000.0);
            prop_assert!((fan.width_mm - 2.0 * (height + 3000.0 * slope)).abs() < 1e-9 * fan.width_mm);
        }
    }
}
