//! A hint at the class of IEC 60825-1 (edition 3, 2014), for a continuous visible laser seen as a point. A hint: it is no
//! classification.
//!
//! Limits for 400–700 nm with C6 = 1: class 1 what the eye may take for 100 s through a pupil of 7 mm, class 2 what it may
//! take in the 0.25 s of the aversion response (1 mW), class 3R five times class 2, class 3B 500 mW. The exposure limits
//! behind the first two stand in Directive 2006/25/EC, Annex II (<https://www.legislation.gov.uk/eudr/2006/25/annex/II>):
//! E = 10 W/m² for long exposures, C_B·1 W/m² where blue light is the stricter (C_B = 10^(0.02·(λ/nm − 450)) from 450 nm),
//! H = 18·t^0.75 J/m² for short ones; times the pupil's 38.5 mm² that is 0.385 mW, 0.0385 mW·C_B and 0.98 mW, which the
//! standard has as 0.39, 0.039·C3 and 1 mW. The factor of five and 500 mW: <http://www.scitec.uk.com/lasers/laser_classification.php>.
//!
//! Measured through 7 mm at 100 mm from the reference point (condition 3), which for a line is the vertex of its fan, and
//! through 50 mm at 2 m for whoever looks through binoculars (condition 1: the M in 1M and 2M). That a line is a wide source, and may
//! have more for it, some six times: <https://www.seibersdorf-laboratories.at/blog/artikel/what-are-line-lasers>.

use serde::Serialize;

use super::detector::normal;
use crate::optics::Sheet;

/// Diameter of the aperture and its distance from the reference point [m]: the naked eye, and binoculars.
const EYE: (f64, f64) = (7e-3, 0.1);
const BINOCULARS: (f64, f64) = (50e-3, 2.0);

/// What passes the apertures, and the class that this hints at.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Emission {
    /// Total power [mW].
    pub power_mw: f64,
    /// Through 7 mm at 100 mm [mW].
    pub through_7_mm_mw: f64,
    /// Through 50 mm at 2 m [mW].
    pub through_50_mm_mw: f64,
    /// The class that this hints at: 1, 1M, 2, 2M, 3R, 3B or 4.
    pub class: &'static str,
    /// Total power up to which it would be class 2, by the naked eye [mW].
    pub power_for_class_2_mw: f64,
}

/// The hint.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Safety {
    /// Wavelength [nm].
    pub wavelength_nm: f64,
    /// Upper limits of the classes 1, 2, 3R and 3B [mW]; null outside 400–700 nm, where no hint is given.
    pub limits_mw: Option<[f64; 4]>,
    /// The sheet, the mirror standing still; null where no hint is given.
    pub line: Option<Emission>,
    /// The beam if the optics that fan it out fall off; null where no hint is given.
    pub bare_beam: Option<Emission>,
    /// What the hint leaves out.
    pub leaves_out: Vec<&'static str>,
}

/// Upper limits of the classes 1, 2, 3R and 3B [W]; `None` outside 400–700 nm.
pub fn limits_w(wavelength_m: f64) -> Option<[f64; 4]> {
    let nm = wavelength_m * 1e9;
    if !(400.0..=700.0).contains(&nm) {
        return None;
    }
    let blue = 0.039e-3 * 10f64.powf(0.02 * (nm - 450.0).max(0.0)); // C3
    Some([blue.min(0.39e-3), 1e-3, 5e-3, 0.5])
}

/// The hint for a sheet, and for the bare beam of `source_w` [W] that it is made of.
pub fn safety(sheet: &Sheet, source_w: f64) -> Safety {
    let limits = limits_w(sheet.wavelength_m);
    let line = |limits: [f64; 4]| {
        let share = |(diameter, distance)| through_line(sheet, diameter, distance);
        emission(limits, sheet.power_w, share(EYE), share(BINOCULARS))
    };
    let beam = |limits: [f64; 4]| {
        let share = |(diameter, distance): (f64, f64)| {
            let radius = sheet.thickness_m(distance);
            1.0 - (-2.0 * (diameter / 2.0 / radius).powi(2)).exp()
        };
        emission(limits, source_w, share(EYE), share(BINOCULARS))
    };
    Safety {
        wavelength_nm: sheet.wavelength_m * 1e9,
        limits_mw: limits.map(|limits| limits.map(|w| w * 1e3)),
        line: limits.map(line),
        bare_beam: limits.map(beam),
        leaves_out: vec![
            "It is no classification: that takes a measurement by the standard's own text, of the finished product.",
            "The source is taken as a point (C6 = 1). A line is a wide source for the eye and may have more power.",
            "Faults: what a single fault can let out counts. A fan lens that falls off lets out the bare beam; the \
             mirror is taken to stand still, so no safeguard by scanning is counted on.",
            "A beam that is pulsed or modulated, other wavelengths beside this one, and all outside 400 to 700 nm.",
            "Mirrors and glass in the room, which send the line where nobody expects it.",
            "The class is that of light that can be reached: a housing or an interlock may lower it, servicing raises it.",
        ],
    }
}

/// Share of the line's power through a round aperture in its middle, this far from the vertex of the fan.
fn through_line(sheet: &Sheet, diameter_m: f64, distance_m: f64) -> f64 {
    // The vertex lies behind where the fan opens; nearer than that opening nobody can measure.
    let behind = sheet.width_at_origin_m / sheet.width_per_m;
    let range = (distance_m - behind).max(0.0);
    let (sigma_y, sigma_z) = (sheet.width_m(range) / 4.0, sheet.thickness_m(range) / 2.0);
    let steps = 400;
    let step = diameter_m / f64::from(steps);
    (0..steps)
        .map(|i| {
            let y = (f64::from(i) + 0.5) * step - diameter_m / 2.0;
            let half = (diameter_m * diameter_m / 4.0 - y * y).max(0.0).sqrt();
            let along = normal((y + step / 2.0) / sigma_y) - normal((y - step / 2.0) / sigma_y);
            along * (2.0 * normal(half / sigma_z) - 1.0)
        })
        .sum()
}

fn emission(limits: [f64; 4], power_w: f64, eye: f64, binoculars: f64) -> Emission {
    let (naked, aided) = (power_w * eye, power_w * binoculars);
    let [one, two, three_r, three_b] = limits;
    let class = match naked {
        p if p <= one => {
            if aided <= one {
                "1"
            } else {
                "1M"
            }
        }
        p if p <= two => {
            if aided <= two {
                "2"
            } else {
                "2M"
            }
        }
        p if p <= three_r => "3R",
        p if p <= three_b => "3B",
        _ => "4",
    };
    Emission {
        power_mw: power_w * 1e3,
        through_7_mm_mw: naked * 1e3,
        through_50_mm_mw: aided * 1e3,
        class,
        power_for_class_2_mw: two / eye * 1e3,
    }
}
