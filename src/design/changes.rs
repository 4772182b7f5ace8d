//! What a small change of the rig would do.

use serde::Serialize;

use super::beams::seen_turned;
use super::bench::{Bench, V3, pitched};
use super::budget::Budget;
use super::params::{DesignParams, Instrument};
use super::view;
use crate::optics::{Laser, Rig};

/// One change and its consequences.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// What is changed.
    pub what: &'static str,
    /// Share of the volume that is seen, the cylinder turned as need be; null where the change makes no finder.
    pub seen: Option<f64>,
    /// X between which the floor is seen [m].
    pub floor_m: Option<[f64; 2]>,
    /// Error of X by the instrument, on the floor in the middle of the volume [mm]; null where that is not seen.
    pub range_mm: Option<f64>,
}

type Turn = fn(&mut Instrument);

/// As it is first, then each change alone.
pub(super) fn changes(instrument: &Instrument, params: &DesignParams) -> Vec<Change> {
    let all: [(&str, Turn); 11] = [
        ("as it is", |_| {}),
        ("camera tilted 5° more", |i| i.rig = pitched(&i.rig, 5f64.to_radians())),
        ("camera tilted 5° less", |i| i.rig = pitched(&i.rig, -5f64.to_radians())),
        ("camera 0.1 m higher", |i| raise_camera(&mut i.rig, 0.1)),
        ("camera 0.1 m lower", |i| raise_camera(&mut i.rig, -0.1)),
        ("camera 0.2 m farther back", |i| i.rig.sensor_from_camera.iso.translation.vector.x -= 0.2),
        ("mirror 0.1 m lower: longer baseline", |i| raise_mirror(&mut i.rig, -0.1)),
        ("mirror 0.1 m higher: shorter baseline", |i| raise_mirror(&mut i.rig, 0.1)),
        ("focal length × 0.75: wider", |i| zoom(i, 0.75)),
        ("focal length × 1.33: narrower", |i| zoom(i, 4.0 / 3.0)),
        ("twice the pulses a turn of the mirror", |i| finer(i)),
    ];
    let has_mirror = matches!(instrument.rig.laser, Laser::Mirror(_));
    let possible = |what: &str| has_mirror || !what.contains("mirror");
    all.into_iter()
        .filter(|(what, _)| possible(what))
        .map(|(what, turn)| change(instrument, params, what, turn))
        .collect()
}

fn change(instrument: &Instrument, params: &DesignParams, what: &'static str, turn: Turn) -> Change {
    let mut changed = instrument.clone();
    changed.optics = None; // the sheet is already theirs
    turn(&mut changed);
    let nothing = Change { what, seen: None, floor_m: None, range_mm: None };
    let Ok(changed) = changed.validated() else { return nothing };
    let bench = Bench::new(&changed.rig, &changed.image);
    let Ok(view) = view::view(&bench, params) else { return nothing };
    let budget = Budget::new(&bench, &changed, params);
    let middle = (params.volume.x_m[0] + params.volume.x_m[1]) / 2.0;
    Change {
        what,
        seen: Some(seen_turned(&bench, &params.volume)),
        floor_m: view.floor_m,
        range_mm: budget.floor(middle).map(|row| row.range.instrument_mm).filter(|mm| mm.is_finite()),
    }
}

fn raise_camera(rig: &mut Rig, by_m: f64) {
    rig.sensor_from_camera.iso.translation.vector += V3::z() * by_m;
}

fn raise_mirror(rig: &mut Rig, by_m: f64) {
    if let Laser::Mirror(mirror) = &mut rig.laser {
        mirror.mirror_m[2] += by_m;
    }
}

/// Another lens before the same sensor; the lens' distortion stays what it is on the sensor's normalised coordinates.
fn zoom(instrument: &mut Instrument, factor: f64) {
    instrument.rig.camera.fx *= factor;
    instrument.rig.camera.fy *= factor;
    instrument.image.focal_length_m *= factor;
}

/// Half the angle a pulse, and half the error of where the mirror stops.
fn finer(instrument: &mut Instrument) {
    if let Laser::Mirror(mirror) = &mut instrument.rig.laser {
        mirror.beam.rad_per_pulse /= 2.0;
        mirror.beam.pulse_min = mirror.beam.pulse_min.saturating_mul(2);
        mirror.beam.pulse_max = mirror.beam.pulse_max.saturating_mul(2);
    }
    instrument.rig.beam_sigma_rad /= 2.0;
}
