//! Slits as a table: the `.csv` of a finder's calibration.

use crate::calibration::finder::{Observations, Slit, SlitPeak, Surface, Wall};
use crate::fault::{Fault, Result};

/// Slits of a table: a line a row, or a slit without one.
pub(super) fn table(text: &str, walls: usize) -> Result<Vec<Slit>> {
    const KNOWN: [&str; 9] = ["name", "on", "mirror_pulse", "cylinder_pulse", "mark_m", "height_m", "u", "v", "sigma"];
    let mut lines = (text.lines().enumerate())
        .map(|(i, line)| (i + 1, line.split('#').next().unwrap_or_default().trim()))
        .filter(|(_, line)| !line.is_empty());
    let Some((at, head)) = lines.next() else {
        return Err(Fault::new("table", "nothing", format!("a first line with names of {}", KNOWN.join(", "))));
    };
    let head: Vec<&str> = head.split(',').map(str::trim).collect();
    for (i, name) in head.iter().enumerate() {
        if !KNOWN.contains(name) || head.iter().position(|n| n == name) != Some(i) {
            let expected = format!("each at most once: {}", KNOWN.join(", "));
            return Err(Fault::new("column", format!("`{name}`"), expected).at_line(at));
        }
    }
    let mut slits: Vec<Slit> = Vec::new();
    for (at, line) in lines {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        if cells.len() != head.len() {
            return Err(Fault::new("row", format!("{} cells", cells.len()), format!("{}", head.len())).at_line(at));
        }
        let row = Row { head: &head, cells: &cells };
        let (slit, peak) = row.slit(walls).map_err(|fault| fault.at_line(at))?;
        match slits.last_mut() {
            Some(last) if row.is_of(last, &slit) => last.peaks.extend(peak),
            _ => slits.push(Slit { peaks: peak.into_iter().collect(), ..slit }),
        }
    }
    Ok(slits)
}

struct Row<'a> {
    head: &'a [&'a str],
    cells: &'a [&'a str],
}

impl Row<'_> {
    fn text(&self, name: &str) -> Option<&str> {
        let at = self.head.iter().position(|n| *n == name)?;
        self.cells.get(at).copied().filter(|cell| !cell.is_empty())
    }

    fn number(&self, name: &str) -> Result<Option<f64>> {
        let Some(text) = self.text(name) else { return Ok(None) };
        let number = text.parse::<f64>().ok().filter(|n| n.is_finite());
        number.map(Some).ok_or_else(|| Fault::new(name, format!("`{text}`"), "a finite number"))
    }

    fn needed(&self, name: &str) -> Result<f64> {
        self.number(name)?.ok_or_else(|| Fault::new(name, "nothing", "a number"))
    }

    fn slit(&self, walls: usize) -> Result<(Slit, Option<SlitPeak>)> {
        let on = match self.text("on") {
            None | Some("floor") => Surface::Floor,
            Some(text) => {
                let wall = text.strip_prefix("wall").and_then(|number| number.trim().parse::<usize>().ok());
                let expected = format!("`floor`, or `wall N` with N under {walls}: walls stand in the .toml file");
                let known = wall.filter(|wall| *wall < walls);
                Surface::Wall(known.ok_or_else(|| Fault::new("on", format!("`{text}`"), expected))?)
            }
        };
        let peak = match (self.number("u")?, self.number("v")?) {
            (Some(u), Some(v)) => Some(SlitPeak { u, v, sigma: self.number("sigma")?.unwrap_or(0.1) }),
            (None, None) => None,
            _ => return Err(Fault::new("u, v", "one of them", "both, or neither")),
        };
        let slit = Slit {
            name: self.text("name").unwrap_or_default().to_string(),
            mirror_pulse: self.needed("mirror_pulse")?,
            cylinder_pulse: self.number("cylinder_pulse")?.unwrap_or(0.0),
            on,
            mark_m: self.number("mark_m")?,
            height_m: self.number("height_m")?,
            end: None,
            peaks: Vec::new(),
        };
        // Alone, so that its line is named.
        let walls = vec![Wall { mark_m: None, square_sigma_rad: 0.01 }; walls];
        let alone = Slit { peaks: peak.into_iter().collect(), ..slit.clone() };
        Observations { slits: vec![alone], walls, pulse_sigma: 1.0, mark_sigma_m: 1e-3 }.validated()?;
        Ok((slit, peak))
    }

    /// Whether this row goes on with the slit of the row before.
    fn is_of(&self, last: &Slit, slit: &Slit) -> bool {
        let same = Slit { peaks: Vec::new(), ..last.clone() } == *slit;
        same && !slit.name.is_empty()
    }
}
