//! The maps that each sensor made, and both together, against the truth, as files hold them.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result};
use crate::maps::PlanView;
use crate::sources::LayerVerdict;

/// A map against the truth: [`LayerVerdict`], with `None` for what there was nothing to make of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapScore {
    /// Intersection over union.
    pub iou: Option<f64>,
    /// Share of the occupied cells that are right within one cell.
    pub precision: Option<f64>,
    /// Share of the surfaces in sight of the robot's way that were found within one cell.
    pub recall: Option<f64>,
    /// Share of the free cells through which a surface passes: what a robot would run into.
    pub free_space_error: Option<f64>,
    /// Share of the truly free cells in sight that are free.
    pub free_found: Option<f64>,
    /// Share of them that are occupied: where a robot would not dare to go.
    pub free_blocked: Option<f64>,
}

impl From<LayerVerdict> for MapScore {
    fn from(verdict: LayerVerdict) -> Self {
        let of = |share: f64| share.is_finite().then_some(share);
        Self {
            iou: of(verdict.iou),
            precision: of(verdict.precision),
            recall: of(verdict.recall),
            free_space_error: of(verdict.free_space_error),
            free_found: of(verdict.free_found),
            free_blocked: of(verdict.free_blocked),
        }
    }
}

/// A plan view that fits in a file of text.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Picture {
    /// Side of a cell [m].
    pub cell_m: f64,
    /// The corner of the first cell [m].
    pub origin_m: [f64; 2],
    /// Cells along x and y.
    pub size: [usize; 2],
    /// −1 unknown, 0 free, 100 occupied, a byte each, row by row from the lowest y, in base 64.
    pub cells: String,
}

impl Picture {
    pub(super) fn of(view: &PlanView) -> Self {
        let bytes: Vec<u8> = view.cells.iter().map(|cell| cell.to_le_bytes()[0]).collect();
        let cells = STANDARD.encode(bytes);
        Self { cell_m: view.resolution_m, origin_m: view.origin_m, size: [view.width, view.height], cells }
    }

    pub(super) fn view(&self) -> Result<PlanView> {
        let bytes = STANDARD.decode(&self.cells).map_err(|e| Fault::new("cells of a map", e, "base 64"))?;
        if self.size[0].checked_mul(self.size[1]) != Some(bytes.len()) {
            let found = format!("{} cells", bytes.len());
            return Err(Fault::new("cells of a map", found, format!("{} x {}", self.size[0], self.size[1])));
        }
        Ok(PlanView {
            resolution_m: self.cell_m,
            origin_m: self.origin_m,
            width: self.size[0],
            height: self.size[1],
            cells: bytes.into_iter().map(|byte| i8::from_le_bytes([byte])).collect(),
        })
    }
}

/// What is shown of one seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shown {
    /// Truth, laser, ultrasonic and both; without a sensor also without its map and the last one.
    pub maps: Vec<Picture>,
    /// Places along the robot's way [m].
    pub way_m: Vec<[f64; 2]>,
    /// Where the obstacles are at the end.
    pub places: Vec<Place>,
}

/// Where an obstacle is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Place {
    /// What it is an example of.
    pub classes: Vec<String>,
    /// Its middle [m].
    pub at_m: [f64; 2],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_holds_its_map() {
        let cells = vec![100, -1, 0, 0, 0, 100];
        let map = PlanView { resolution_m: 0.05, origin_m: [1.0, -2.0], width: 3, height: 2, cells };
        assert_eq!(Picture::of(&map).view().unwrap(), map);
        let bad = |cells: &str| Picture { cells: cells.into(), ..Picture::of(&map) }.view().is_err();
        assert!(bad("!") && bad("AAAA"));
        assert!(Picture { size: [usize::MAX, 2], ..Picture::of(&map) }.view().is_err());
    }

    #[test]
    fn a_rate_of_nothing_is_none() {
        let nothing = LayerVerdict {
            precision: f64::NAN,
            recall: 0.0,
            iou: f64::NAN,
            free_space_error: f64::NAN,
            free_found: 0.5,
            free_blocked: 0.0,
        };
        let score = MapScore::from(nothing);
        assert_eq!((score.precision, score.recall, score.free_found), (None, Some(0.0), Some(0.5)));
    }
}
