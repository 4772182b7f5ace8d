//! The paper's tables and figures beside ours: what is printed, what the printed formula gives, and what is right.
//!
//! Pure: data structures and strings of SVG and HTML. Slit images come through [`SlitImages`], so that this module knows
//! no renderer; without them Figures 8, 9 and 12 hold what geometry alone says.

mod figures;
mod page;
mod pictures;
mod repeats;
mod tables;

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

use crate::fault::{Fault, Result};
use crate::image::Image;
use crate::report::Plot;

pub use page::page;

/// What stands before the finder, at the robot's heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scene {
    /// A flat floor.
    Floor,
    /// An upright target across the heading, its face at this distance from the robot's origin [m].
    Upright(f64),
    /// The object of Fig. 12 on the floor: the paper does not say what it was [A].
    Object,
}

/// Takes slit images with METRO-I's finder, the cylinder straight ahead.
pub trait SlitImages {
    /// An image with the beam at θB [rad]; the same arguments give the same image.
    fn take(&mut self, scene: Scene, beam_rad: f64, frame: u64) -> Result<Image>;
}

/// How much is simulated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effort {
    /// How often the paper's procedures of Tables 3 and 4 are repeated.
    pub repeats: u32,
    /// Images for each row of Table 5.
    pub frames: u32,
    /// The same seed gives the same numbers.
    pub seed: u64,
}

impl Default for Effort {
    fn default() -> Self {
        Self { repeats: 500, frames: 20, seed: 1996 }
    }
}

/// Told of every piece of work that is done; [`Effort::pieces`] make the whole.
pub type Progress<'a> = &'a (dyn Fn(u64) + Sync);

impl Effort {
    /// How many pieces of work there are: repeats of two procedures, and the frames of four rows.
    pub fn pieces(&self) -> u64 {
        2 * u64::from(self.repeats) + 4 * u64::from(self.frames)
    }
}

/// What many simulated repeats of a procedure gave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Simulated {
    /// How many.
    pub repeats: u32,
    /// Root mean square of found minus true.
    pub rms_error: f64,
    /// Root mean square of the σ that the procedure reported of itself.
    pub sigma: f64,
    /// Share of repeats in which the truth lay within ±1.96 σ.
    pub inside_95: f64,
}

/// One number, three times.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// What it is, with its unit as suffix.
    pub quantity: &'static str,
    /// Where: distance, lens distance, case.
    pub at: BTreeMap<&'static str, Value>,
    /// What the paper prints.
    pub paper: Option<f64>,
    /// What the paper's formula or constants give as printed, where that differs from ours.
    pub printed_form: Option<f64>,
    /// What is right.
    pub ours: f64,
    /// What an independent computation says that ours must be.
    pub expected: Option<f64>,
    /// Whether print and printed form (or ours, if there is no other), and ours and expected, are equal within their
    /// tolerances; nothing where there is nothing to compare.
    pub agrees: Option<bool>,
    /// What many repeats gave.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simulated: Option<Simulated>,
    /// What must be said.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<&'static str>,
}

impl Row {
    fn new(quantity: &'static str, ours: f64) -> Self {
        let at = BTreeMap::new();
        let (paper, printed_form, expected, agrees) = (None, None, None, None);
        Self { quantity, at, paper, printed_form, ours, expected, agrees, simulated: None, note: None }
    }

    fn at(mut self, name: &'static str, value: impl Into<Value>) -> Self {
        self.at.insert(name, value.into());
        self
    }

    /// The printed form; to be given before `paper`.
    fn printed(mut self, value: f64) -> Self {
        self.printed_form = Some(value);
        self
    }

    fn paper(mut self, value: f64, tolerance: f64) -> Self {
        self.paper = Some(value);
        let near = (self.printed_form.unwrap_or(self.ours) - value).abs() <= tolerance;
        self.holds(near)
    }

    fn expected(mut self, value: f64, tolerance: f64) -> Self {
        self.expected = Some(value);
        let near = (self.ours - value).abs() <= tolerance;
        self.holds(near)
    }

    /// What an independent computation says of the printed form.
    fn expected_printed(self, value: f64, tolerance: f64) -> Self {
        let near = self.printed_form.is_some_and(|printed| (printed - value).abs() <= tolerance);
        self.holds(near)
    }

    fn holds(mut self, holds: bool) -> Self {
        self.agrees = Some(self.agrees.unwrap_or(true) && holds);
        self
    }

    fn simulated(mut self, simulated: Simulated) -> Self {
        self.simulated = Some(simulated);
        self
    }

    fn note(mut self, note: &'static str) -> Self {
        self.note = Some(note);
        self
    }
}

/// A place where the print is wrong or cannot be read, with both values.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Misprint {
    /// Where in the paper.
    pub place: &'static str,
    /// What is compared, with its unit.
    pub quantity: &'static str,
    /// What the print gives.
    pub printed: f64,
    /// What is right.
    pub correct: f64,
    /// What is wrong.
    pub why: &'static str,
}

/// A picture of a figure, as PNG.
#[derive(Clone, Debug)]
pub struct Picture {
    /// What it shows.
    pub caption: String,
    /// The file.
    pub png: Vec<u8>,
    /// Its size [px].
    pub size: [usize; 2],
}

/// What is drawn for a figure.
#[derive(Clone, Debug, Default)]
pub struct Drawn {
    /// Images.
    pub pictures: Vec<Picture>,
    /// Plots.
    pub plots: Vec<Plot>,
}

/// Everything, as `metromap reproduce --json` prints it.
#[derive(Clone, Debug, Serialize)]
pub struct Reproduction {
    /// Tables 1 to 5, and `text` for numbers of the running text.
    pub tables: BTreeMap<&'static str, Vec<Row>>,
    /// Figures 8 to 13.
    pub figures: BTreeMap<&'static str, Vec<Row>>,
    /// Points that an independent computation gives for pixels (`paper.md` 6): exact, and with eq. (5) as printed.
    pub points: Vec<Row>,
    /// Where the print is wrong.
    pub misprints: Vec<Misprint>,
    /// Whether everything that can be compared agrees.
    pub agrees: bool,
    /// How much was simulated.
    #[serde(skip)]
    pub effort: Effort,
    /// What is drawn, by figure or table.
    #[serde(skip)]
    pub drawn: BTreeMap<&'static str, Drawn>,
}

impl Reproduction {
    /// All rows, each with the name of its table or figure.
    pub fn rows(&self) -> impl Iterator<Item = (String, &Row)> {
        let tables = self.tables.iter().flat_map(|(n, rows)| rows.iter().map(move |row| (format!("table {n}"), row)));
        let figures =
            self.figures.iter().flat_map(|(n, rows)| rows.iter().map(move |row| (format!("figure {n}"), row)));
        tables.chain(figures).chain(self.points.iter().map(|row| ("points".to_string(), row)))
    }
}

/// Computes all tables and figures; the same effort gives the same bits, however many cores there are.
///
/// Errors: images that cannot be taken; no repeats.
pub fn reproduce(effort: Effort, images: Option<&mut dyn SlitImages>, progress: Progress) -> Result<Reproduction> {
    if !(10..=100_000).contains(&effort.repeats) || !(1..=10_000).contains(&effort.frames) {
        let found = format!("{} repeats, {} frames", effort.repeats, effort.frames);
        return Err(Fault::new("effort", found, "10 to 100000 repeats, 1 to 10000 frames"));
    }
    let mut drawn = BTreeMap::new();
    let mut tables = BTreeMap::from([
        ("1", tables::table_1()),
        ("2", tables::table_2()),
        ("3", repeats::table_3(effort, &mut drawn, progress)?),
        ("4", tables::table_4()?),
        ("5", tables::table_5()?),
        ("text", tables::text()),
    ]);
    tables.entry("4").or_default().extend(repeats::table_4(effort, &mut drawn, progress)?);
    let mut figures = figures::by_geometry(&mut drawn)?;
    if let Some(images) = images {
        tables.entry("5").or_default().extend(pictures::table_5(images, effort, progress)?);
        pictures::slits(images, &mut figures, &mut drawn)?;
        pictures::object(images, &mut figures, &mut drawn)?;
    }
    let points = tables::points()?;
    let misprints = tables::misprints()?;
    let mut all = Reproduction { tables, figures, points, misprints, agrees: false, effort, drawn };
    let agrees = all.rows().all(|(_, row)| row.agrees != Some(false));
    all.agrees = agrees;
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quick() -> Reproduction {
        reproduce(Effort { repeats: 20, frames: 1, seed: 7 }, None, &|_| ()).unwrap()
    }

    fn ours(rows: &[Row], quantity: &str, at: &[(&str, f64)]) -> (f64, f64) {
        let here = |row: &&Row| {
            row.quantity == quantity && at.iter().all(|(k, v)| row.at.get(k).and_then(Value::as_f64) == Some(*v))
        };
        let row = rows.iter().find(here).unwrap();
        (row.ours, row.printed_form.unwrap_or(f64::NAN))
    }

    #[test]
    fn everything_that_can_be_compared_agrees() {
        let all = quick();
        let off: Vec<_> = all.rows().filter(|(_, row)| row.agrees == Some(false)).collect();
        assert!(off.is_empty() && all.agrees, "{off:#?}");
        assert!(all.rows().filter(|(_, row)| row.agrees == Some(true)).count() > 80);
    }

    #[test]
    fn the_numbers_asked_for_are_there() {
        let all = quick();
        let within = |value: f64, known: f64, by: f64| assert!((value - known).abs() <= by, "{value} for {known}");
        let four = &all.tables["4"];
        within(ours(four, "mirror_height_mm", &[]).0, 817.244, 5e-4);
        within(ours(four, "nearest_slit_mm", &[]).0, 1504.209, 5e-4);
        within(ours(four, "camera_distance_mm", &[]).0, 2197.878, 5e-4);
        within(ours(four, "camera_depression_rad", &[]).0, 0.489647, 5e-7);
        within(ours(four, "x0_mm", &[]).0, -164.585, 5e-4);
        for (x, recovered, printed) in
            [(1500.0, 8.99, 9.02), (1800.0, 12.6, 12.67), (2100.0, 16.9, 16.94), (2400.0, 21.7, 21.83)]
        {
            let (found, found_printed) = ours(&all.tables["5"], "mm_per_px", &[("x_mm", x)]);
            within(found, recovered, 0.05);
            within(found_printed, printed, 5e-3);
        }
        let pulses: Vec<f64> = all.figures["11"].iter().map(|row| row.ours).collect();
        assert_eq!(pulses, [46.0, 81.0, 108.0, 130.0]);
        within(ours(&all.points, "y_mm", &[("uf_px", 356.0)]).0, -184.3697, 1e-3);
        within(ours(&all.points, "y_mm", &[("uf_px", 356.0)]).1, -189.4313, 1e-3);
        within(ours(&all.tables["2"], "theta2_deg", &[("lm_mm", 50.0)]).0, 56.28, 5e-3);
        within(ours(&all.tables["2"], "theta2_deg", &[("lm_mm", 50.0)]).1, 49.20, 0.01);
        assert!(
            all.misprints.len() >= 10 && all.misprints.iter().all(|m| m.printed.is_finite() && m.printed != m.correct)
        );
    }

    #[test]
    fn the_json_has_the_agreed_keys_and_the_same_seed_the_same_bytes() {
        let text = serde_json::to_string(&quick()).unwrap();
        assert_eq!(text, serde_json::to_string(&quick()).unwrap());
        let json: Value = serde_json::from_str(&text).unwrap();
        assert_eq!(json["agrees"], true);
        for table in ["1", "2", "3", "4", "5"] {
            let rows = json["tables"][table].as_array().unwrap();
            assert!(
                !rows.is_empty() && rows.iter().all(|row| row.get("paper").is_some() && row["ours"].is_f64()),
                "{table}"
            );
        }
        assert!(["8", "10", "11", "13"].iter().all(|figure| json["figures"][figure].is_array()));
    }

    #[test]
    fn the_page_is_whole_and_alone() {
        let html = page(&quick());
        assert!(html.starts_with("<!doctype html>") && html.ends_with("</html>"));
        for tag in ["section", "table", "svg", "figure", "tr", "td", "div", "p"] {
            let (open, close) = (format!("<{tag}"), format!("</{tag}>"));
            let opened =
                html.match_indices(&open).filter(|(i, _)| html[i + open.len()..].starts_with([' ', '>'])).count();
            assert_eq!(opened, html.matches(&close).count(), "{tag}");
        }
        let linked = html.replace("http://www.w3.org/2000/svg", "");
        assert!(!linked.contains("http") && !linked.contains("<script") && !linked.contains("NaN"));
    }

    #[test]
    fn no_repeats_are_no_statistics() {
        assert!(reproduce(Effort { repeats: 0, ..Effort::default() }, None, &|_| ()).is_err());
    }
}
