//! What cannot be right, told before anything is fitted: slits that say nothing, and numbers counted the other way.

use nalgebra::Vector3;

use super::measured::{Observations, Slit, Surface};
use super::model::slit_line;
use super::simulate::row_at;
use crate::fault::{Fault, Result};
use crate::geometry::Plane;
use crate::optics::{Laser, Rig};

/// Beams closer together than this are as good as one [rad]: some ten pulses.
const SPREAD_RAD: f64 = 0.015;
/// Two readings run the same way or against each other if their correlation is beyond this.
const CORRELATED: f64 = 0.5;

/// Refuses slits that a finder like `nominal` cannot have drawn, with the likely slip.
pub(super) fn plausible(nominal: &Rig, seen: &Observations) -> Result<()> {
    inside_the_image(nominal, seen)?;
    let Laser::Mirror(mirror) = nominal.laser else { return Ok(()) }; // refused by the model, with its reason
    let gain = mirror.beam.rad_per_pulse;
    let floor: Vec<&Slit> = seen.slits.iter().filter(|slit| slit.on == Surface::Floor).collect();
    let (low, high) = floor
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), s| (l.min(s.mirror_pulse), h.max(s.mirror_pulse)));
    // A wall at another distance moves the slit without the mirror, the floor does not.
    if floor.len() > 1 && (high - low) * gain.abs() < SPREAD_RAD {
        let found = format!("all on the floor from {low} to {high}");
        let expected = format!(
            "slits at least {:.0} pulses apart: at one place they say nothing (and pulses, not radians or degrees)",
            (SPREAD_RAD / gain.abs().max(1e-12)).ceil()
        );
        return Err(Fault::new("mirror_pulse", found, expected));
    }
    directions(nominal, seen, gain)
}

fn inside_the_image(nominal: &Rig, seen: &Observations) -> Result<()> {
    let camera = &nominal.camera;
    for (i, slit) in seen.slits.iter().enumerate() {
        let ends = slit.end.iter().map(|end| (end.u, 0.0));
        for (u, v) in slit.peaks.iter().map(|peak| (peak.u, peak.v)).chain(ends) {
            for (what, at, size) in [("column", u, camera.width), ("row", v, camera.height)] {
                if !(-0.5..size as f64 - 0.5).contains(&at) {
                    let expected = format!("a {what} of the rig's image, 0 to {}, in pixels", size - 1);
                    return Err(Fault::new(format!("{}: {what}", slit.title(i)), at, expected));
                }
            }
        }
    }
    Ok(())
}

/// Marks, rows and pulses must run the same way as in the nominal finder. On slits on the floor, straight ahead.
fn directions(nominal: &Rig, seen: &Observations, gain: f64) -> Result<()> {
    let floor: Vec<&Slit> =
        seen.slits.iter().filter(|slit| slit.on == Surface::Floor && slit.cylinder_pulse.abs() < 1.0).collect();
    // The beam grows as it tilts down: marks nearer, rows lower in the image.
    let marks = correlation(floor.iter().filter_map(|slit| Some((slit.mirror_pulse * gain, -slit.mark_m?))));
    let rows = correlation(floor.iter().filter_map(|slit| {
        let peak = slit.peaks.first()?;
        Some((slit.mirror_pulse * gain, peak.v))
    }));
    let against = |r: Option<f64>| r.is_some_and(|r| r < -CORRELATED);
    let along = |r: Option<f64>| r.is_some_and(|r| r > CORRELATED);
    let (what, found, expected) = if against(marks) && against(rows) {
        let expected = "pulses that grow as the beam tilts down, towards the robot: count the other way, or give the rig a \
                        negative laser.beam.rad_per_pulse";
        ("mirror_pulse", "pulses that grow outwards, away from the robot", expected)
    } else if against(rows) && (along(marks) || marks.is_none()) && predicted_rows_grow(nominal, &floor) {
        let expected = "rows from the top of the image (v = height - 1 - Vf), where a nearer slit lies lower";
        ("peaks", "rows that get smaller as the slit comes nearer", expected)
    } else if against(marks) && !against(rows) {
        ("mark_m", "marks that grow towards the robot", "a tape that is read outwards, in metres")
    } else {
        return Ok(());
    };
    Err(Fault::new(what, found, expected))
}

/// Whether in the image of the nominal finder a nearer slit on the floor lies lower, as it does where the camera looks down.
fn predicted_rows_grow(nominal: &Rig, floor: &[&Slit]) -> bool {
    let Some(surface) = Plane::new(Vector3::z(), 0.0) else { return false };
    let row = |slit: &&Slit| {
        let line = slit_line(nominal, slit.mirror_pulse, slit.cylinder_pulse, &surface)?;
        Some((slit.mirror_pulse, row_at(nominal, &line, slit.peaks.first()?.u)?))
    };
    correlation(floor.iter().filter_map(row)).is_none_or(|r| r > 0.0)
}

/// Pearson's correlation of three pairs or more that are not all the same.
fn correlation(pairs: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let pairs: Vec<(f64, f64)> = pairs.collect();
    let count = pairs.len() as f64;
    let (x, y) = pairs.iter().fold((0.0, 0.0), |(x, y), (a, b)| (x + a / count, y + b / count));
    let (xx, yy, xy) = pairs.iter().fold((0.0, 0.0, 0.0), |(xx, yy, xy), (a, b)| {
        (xx + (a - x).powi(2), yy + (b - y).powi(2), xy + (a - x) * (b - y))
    });
    let r = xy / (xx * yy).sqrt();
    (pairs.len() >= 3 && r.is_finite()).then_some(r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::finder::{Assumptions, Procedure, calibrate};
    use rand::SeedableRng;
    use rand_chacha::ChaCha12Rng;

    fn measured() -> Observations {
        let procedure = Procedure::on_marks(Rig::metro_i(), 1.5, [0.0, 0.3, 0.6, 0.9, 1.2]);
        procedure.measure(&mut ChaCha12Rng::seed_from_u64(1)).unwrap()
    }

    /// What `calibrate` says of these slits after `spoil`.
    fn refused(spoil: impl Fn(&mut Slit)) -> String {
        let mut seen = measured();
        seen.slits.iter_mut().for_each(spoil);
        calibrate(&Rig::metro_i(), &seen, &Assumptions::paper()).unwrap_err().to_string()
    }

    #[test]
    fn what_is_counted_the_other_way_is_named() {
        let told = refused(|slit| slit.mirror_pulse = -slit.mirror_pulse);
        assert!(told.starts_with("mirror_pulse: found pulses that grow outwards"), "{told}");
        let told = refused(|slit| slit.peaks.iter_mut().for_each(|peak| peak.v = 479.0 - peak.v));
        assert!(told.starts_with("peaks: found rows that get smaller"), "{told}");
        let told = refused(|slit| slit.mark_m = slit.mark_m.map(|mark| 1.2 - mark));
        assert!(told.starts_with("mark_m: found marks that grow towards the robot"), "{told}");
    }

    #[test]
    fn slits_at_one_place_and_pixels_of_another_image_are_refused() {
        let told = refused(|slit| slit.mirror_pulse = 49.0 + slit.mark_m.unwrap_or(0.0));
        assert!(told.contains("slits at least 10 pulses apart"), "{told}");
        // Radians for pulses look the same.
        let told = refused(|slit| slit.mirror_pulse *= std::f64::consts::TAU / 4000.0);
        assert!(told.contains("not radians"), "{told}");
        let told = refused(|slit| slit.peaks[0].u = 700.0);
        assert_eq!(told, "slit 1: column: found 700, expected a column of the rig's image, 0 to 511, in pixels");
        let told = refused(|slit| slit.peaks[0].v = -3.0);
        assert!(told.contains("slit 1: row: found -3"), "{told}");
    }

    #[test]
    fn what_runs_as_it_should_is_let_through() {
        assert!(plausible(&Rig::metro_i(), &measured()).is_ok());
        // A finder whose encoder counts the other way, read so.
        let mut rig = Rig::metro_i();
        if let Laser::Mirror(mirror) = &mut rig.laser {
            mirror.beam.rad_per_pulse *= -1.0;
            (mirror.beam.pulse_min, mirror.beam.pulse_max) = (-300, 190);
        }
        let mut seen = measured();
        seen.slits.iter_mut().for_each(|slit| slit.mirror_pulse *= -1.0);
        assert!(plausible(&rig.validated().unwrap(), &seen).is_ok());
    }
}
