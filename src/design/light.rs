//! What light comes back: electrons and levels over range, where the sensor is full and where the stripe drowns.

use serde::Serialize;

use super::bench::Bench;
use super::budget::{FOUND, LEVEL_MIN};
use super::detector::Detector;
use super::params::DesignParams;

/// Direct sun within the filter's 10 nm [W/m²] (`instrument.md` 1).
pub const SUN_W_PER_M2: f64 = 14.0;
/// Targets: name and albedo.
pub const TARGETS: [(&str, f64); 3] = [("white", 0.9), ("grey", 0.18), ("black", 0.02)];
/// Farthest range that is tried [m].
const FAR_M: f64 = 30.0;

/// A target that faces the camera, at one distance from both camera and laser.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Facing {
    /// Distance [m].
    pub distance_m: f64,
    /// Electrons in a column from a target of albedo 0.5.
    pub electrons: f64,
    /// Highest level over the background, not clipped, of the same.
    pub peak_level: f64,
    /// RMS width of the stripe before the pixel's own [px].
    pub stripe_px: f64,
    /// Irradiance in the middle of the line [W/m²].
    pub irradiance_w_per_m2: f64,
}

/// How far a target is seen in one light.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reach {
    /// What it is.
    pub target: &'static str,
    /// Its albedo.
    pub albedo: f64,
    /// The light: `indoors` (as given) or `sun`.
    pub ambient: &'static str,
    /// Exposure time used [ms]: shorter than the camera's where the background alone would fill half of the well.
    pub exposure_ms: f64,
    /// Full up to this distance [m]; null: nowhere.
    pub saturated_to_m: Option<f64>,
    /// Facing the camera, found up to this distance by light alone [m]; null: not even at 0.2 m.
    pub found_to_m: Option<f64>,
    /// On the floor, found up to this X within what the camera sees [m]; null: nowhere on it.
    pub floor_found_to_m: Option<f64>,
}

/// The light that comes back.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Light {
    /// Level of a pixel without the laser, indoors.
    pub background_level: f64,
    /// The same in direct sun with the camera's own exposure, not clipped.
    pub background_level_sun: f64,
    /// Level of a full pixel.
    pub white_level: f64,
    /// RMS noise of a pixel that the laser does not light, indoors [levels].
    pub noise_level: f64,
    /// Peak level from which a stripe is found, indoors.
    pub found_level: f64,
    /// Half angle of the sheet [°].
    pub half_angle_deg: f64,
    /// Over distance.
    pub facing: Vec<Facing>,
    /// Over targets and lights.
    pub reach: Vec<Reach>,
}

/// What the stripe on a target of albedo 1 that faces the camera is at this distance: electrons, RMS width [px].
fn facing(bench: &Bench, distance_m: f64) -> (f64, f64) {
    let camera = &bench.rig.camera;
    let power_w = bench.rig.sheet.line_power_w_per_m(distance_m, 0.0) * distance_m / camera.fx; // p·Δy, Δy = R·du/lf
    (power_w * bench.electrons_per_watt(distance_m), bench.stripe_px(distance_m, distance_m, camera.fy / distance_m))
}

fn found(detector: &Detector, electrons: f64, stripe_px: f64) -> bool {
    let least = (FOUND * detector.noise_levels()).max(LEVEL_MIN);
    let full = detector.background >= detector.well;
    !full && detector.peak_levels(electrons, stripe_px) >= least && detector.row_bound_px(electrons, stripe_px) < 1.0
}

pub(super) fn light(bench: &Bench, params: &DesignParams, floor_m: Option<[f64; 2]>) -> Light {
    let room = Detector::new(bench.image, bench.background(params.ambient_w_per_m2));
    let rows = (2..=80).map(|i| f64::from(i) / 10.0).map(|distance_m| {
        let (white, stripe_px) = facing(bench, distance_m);
        let electrons = 0.5 * white;
        let sheet = &bench.rig.sheet;
        let thick = sheet.thickness_m(distance_m);
        let across = (2.0 / std::f64::consts::PI).sqrt() / thick;
        Facing {
            distance_m,
            electrons,
            peak_level: room.peak_levels(electrons, stripe_px),
            stripe_px,
            irradiance_w_per_m2: sheet.line_power_w_per_m(distance_m, 0.0) * across,
        }
    });
    let lights = [("indoors", params.ambient_w_per_m2), ("sun", SUN_W_PER_M2)];
    let reach =
        lights.iter().flat_map(|&(name, ambient)| TARGETS.map(|target| reach(bench, target, name, ambient, floor_m)));
    Light {
        background_level: room.background * room.gain,
        background_level_sun: bench.background(SUN_W_PER_M2) * room.gain,
        white_level: room.well * room.gain,
        noise_level: room.noise_levels(),
        found_level: (FOUND * room.noise_levels()).max(LEVEL_MIN),
        half_angle_deg: (bench.rig.sheet.width_per_m / 2.0).atan().to_degrees(),
        facing: rows.collect(),
        reach: reach.collect(),
    }
}

fn reach(
    bench: &Bench,
    (target, albedo): (&'static str, f64),
    ambient: &'static str,
    w_per_m2: f64,
    floor_m: Option<[f64; 2]>,
) -> Reach {
    // Where the background alone would fill more than half of the well, whoever uses the camera shortens the exposure.
    let shorter = (0.5 * bench.image.well_electrons / bench.background(w_per_m2)).min(1.0);
    let image = crate::scanner::ImageParams {
        exposure_s: bench.image.exposure_s * shorter,
        dark_electrons: bench.image.dark_electrons * shorter,
        ..*bench.image
    };
    let bench = Bench::new(bench.rig, &image);
    let detector = Detector::new(&image, bench.background(w_per_m2));
    let steps = |near: f64, far: f64| (0..=600).map(move |i| near * (far / near).powf(f64::from(i) / 600.0));
    let stripe = |distance: f64| {
        let (white, stripe_px) = facing(&bench, distance);
        (albedo * white, stripe_px)
    };
    let on_floor = |x: &f64| {
        let point = bench.floor_at(*x)?;
        let sight = bench.look(&point, &super::bench::V3::z(), bench.beam_to(&point)?)?;
        Some((albedo * sight.electrons, sight.stripe_px))
    };
    let seen = |(electrons, stripe_px)| found(&detector, electrons, stripe_px);
    let floor =
        floor_m.and_then(|[near, far]| steps(near, far.max(near * 1.000_001)).rfind(|x| on_floor(x).is_some_and(seen)));
    Reach {
        target,
        albedo,
        ambient,
        exposure_ms: image.exposure_s * 1e3,
        saturated_to_m: steps(0.2, FAR_M).rfind(|d| {
            let (electrons, stripe_px) = stripe(*d);
            detector.is_full(electrons, stripe_px)
        }),
        found_to_m: steps(0.2, FAR_M).rfind(|d| seen(stripe(*d))),
        floor_found_to_m: floor,
    }
}
