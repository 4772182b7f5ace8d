//! The floor of a finder that was knocked hard, far from where it should be.

use super::floor::{Candidates, Floor};
use super::{DriftWatch, Look};

/// The largest shifts that are tried: so many steps to both sides, and never more than 0.3 rad or 0.3 m.
const FARTHEST: f64 = 0.3;
/// Shifts are compared on so many captures, evenly over those there are.
const CAPTURES: usize = 40;
/// So many of the best are looked at closely.
const CLOSELY: usize = 3;
/// A floor that is found far off must hold this share of all blocks.
const SHARE_MIN: f64 = 0.25;

/// The floor about where one shift, whichever, puts it; `None` where no shift shows one.
pub(super) fn found(watch: &DriftWatch) -> Option<Floor<'_>> {
    let every = watch.looks.len().div_ceil(CAPTURES).max(1);
    let looks: Vec<&Look> = watch.looks.iter().step_by(every).collect();
    let mut tried = Vec::new();
    for suspect in watch.shifts.suspects() {
        let steps = (FARTHEST / suspect.step).floor();
        let steps = if steps.is_finite() { steps as i32 } else { 0 };
        for step in (-steps..=steps).filter(|step| *step != 0) {
            let by = f64::from(step) * suspect.step;
            let rig = watch.shifts.moved(suspect.name, by);
            tried.push((Candidates::of(watch, &rig, looks.iter().copied()).most_alike(), suspect.name, by));
        }
    }
    tried.sort_by_key(|(alike, ..)| std::cmp::Reverse(*alike));
    (tried.into_iter().take(CLOSELY))
        .filter_map(|(_, name, by)| Floor::about(watch, Some((name, by))))
        .filter(|floor| floor.share >= SHARE_MIN)
        .max_by_key(Floor::readings)
}
