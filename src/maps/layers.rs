//! Laser, ultrasonic and both together, as three views of one plane.
//!
//! The two sensors err for different reasons (light is swallowed where it is dark and passes glass; sound is mirrored away by
//! smooth walls and widened by its beam), so what they say of a cell is taken as independent: log-odds add. But a surface
//! that the laser has found stays: an ultrasonic range tells that the height of its beam is free, not the whole column of a
//! table top or a step, and its cone of 30° is wider than a pole. What the laser calls free the sound may fill: so glass
//! comes into the map.

use super::PlanView;
use super::grid::{State, UNSEEN};
use super::plan_view::{Columns, cut, known, shown};
use super::ultrasonic::Ultrasonic;

/// Three views with the same cells: same origin, width, and height.
#[derive(Clone, Debug, PartialEq)]
pub struct Layers {
    /// The laser's: the plan view.
    pub laser: PlanView,
    /// The ultrasonic layer.
    pub ultrasonic: PlanView,
    /// Both together.
    pub fused: PlanView,
}

impl Layers {
    /// Checks what must always hold.
    pub(super) fn check(&self) -> Result<(), String> {
        let Self { laser, ultrasonic, fused } = self;
        let place = |view: &PlanView| (view.origin_m, view.width, view.height, view.cells.len());
        if place(laser) != place(fused) || place(ultrasonic) != place(fused) {
            return Err(format!("layers at {:?}, {:?}, {:?}", place(laser), place(ultrasonic), place(fused)));
        }
        let cells = laser.cells.iter().zip(&ultrasonic.cells).zip(&fused.cells);
        for (at, ((laser, sound), both)) in cells.enumerate() {
            let right = match (*laser, *sound) {
                (100, _) => *both == 100,
                (0, 100) => *both != -1,
                (-1, other) | (other, -1) => *both == other,
                (said, _) => *both == said,
            };
            if !right {
                return Err(format!("cell {at}: laser {laser}, ultrasonic {sound}, fused {both}"));
            }
        }
        Ok(())
    }
}

/// The views over columns that hold all of the layer; `None` where nothing is known.
pub(super) fn layers(columns: &Columns, ultrasonic: &Ultrasonic, cell_m: f64) -> Option<Layers> {
    let Columns { window, log_odds } = columns;
    let sound = (0..window.height).flat_map(|row| (0..window.width).map(move |column| [column, row]));
    let sound: Vec<i16> = sound
        .map(|[column, row]| ultrasonic.log_odds([window.low[0] + column as i32, window.low[1] + row as i32]))
        .collect();
    let fused: Vec<i8> = log_odds.iter().zip(&sound).map(|(laser, sound)| shown(fuse(*laser, *sound))).collect();
    let part = known(window, &fused)?;
    let view = |log_odds: &[i16]| {
        let cells: Vec<i8> = log_odds.iter().map(|log_odds| shown(*log_odds)).collect();
        cut(window, &cells, part, cell_m)
    };
    Some(Layers { laser: view(log_odds), ultrasonic: view(&sound), fused: cut(window, &fused, part, cell_m) })
}

/// The log-odds of both [thousandths].
fn fuse(laser: i16, sound: i16) -> i16 {
    match (laser, sound) {
        (UNSEEN, other) | (other, UNSEEN) => other,
        _ if State::of(laser) == State::Occupied => laser.saturating_add(sound.max(0)),
        _ => laser.saturating_add(sound).max(UNSEEN + 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_odds_add_but_sound_frees_nothing_that_the_laser_found() {
        assert_eq!(fuse(UNSEEN, UNSEEN), UNSEEN);
        assert_eq!((fuse(UNSEEN, -300), fuse(-400, UNSEEN)), (-300, -400));
        assert_eq!((fuse(850, -2000), fuse(850, 700)), (850, 1550));
        assert_eq!((fuse(-2000, 1386), fuse(-2000, 2772)), (-614, 772));
        assert_eq!((fuse(i16::MAX, i16::MAX), fuse(-20_000, -20_000)), (i16::MAX, UNSEEN + 1));
    }
}
