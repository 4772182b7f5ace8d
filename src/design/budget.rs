//! Where a range's error comes from, over range (`instrument.md` 3).

use serde::Serialize;

use super::bench::{Bench, EXACT, Sight, V3};
use super::detector::Detector;
use super::params::{DesignParams, Instrument};
use crate::optics::Uncertainty;

/// A step stands out if it is this many standard deviations high [A]: one false alarm in some two million points.
pub const STANDS_OUT: f64 = 5.0;
/// A stripe is found if its peak is this many times the noise of a pixel [A] ...
pub const FOUND: f64 = 4.0;
/// ... and at least this level, as the extraction has it [levels].
pub const LEVEL_MIN: f64 = 0.75;

/// Names of the terms, in the order of [`Terms::list`]: as in JSON, and for people.
pub const TERMS: [(&str, &str); 8] = [
    ("pixel_noise", "pixel noise"),
    ("speckle", "speckle"),
    ("mirror_stop", "mirror stop"),
    ("encoder", "encoder"),
    ("column", "column width"),
    ("calibration", "calibration"),
    ("pose", "pose of the robot"),
    ("timing", "timing"),
];
/// How many of them are the instrument's own; the others come with the robot.
const INSTRUMENT: usize = 6;

/// Standard deviations along one axis [mm].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Terms {
    /// Shot noise, read noise and quantisation: the Cramér–Rao bound of the stripe's row.
    pub pixel_noise_mm: f64,
    /// Speckle, C·λN/π on the sensor.
    pub speckle_mm: f64,
    /// Where the mirror's servo truly stops.
    pub mirror_stop_mm: f64,
    /// Reading of the encoders: rounding, play, zero; for the cylinder, which turns sideways, too.
    pub encoder_mm: f64,
    /// Where in its column a point lies, 1/√12 of it: sideways.
    pub column_mm: f64,
    /// Calibrated pitch of the camera and zero of the beam.
    pub calibration_mm: f64,
    /// Position, heading and pitch of the robot.
    pub pose_mm: f64,
    /// Time of the image against the odometry's, at the given speed.
    pub timing_mm: f64,
    /// All of the instrument: without pose and timing.
    pub instrument_mm: f64,
    /// All of them.
    pub total_mm: f64,
}

impl Terms {
    /// In the order of [`TERMS`] [mm].
    pub fn list(&self) -> [f64; 8] {
        [
            self.pixel_noise_mm,
            self.speckle_mm,
            self.mirror_stop_mm,
            self.encoder_mm,
            self.column_mm,
            self.calibration_mm,
            self.pose_mm,
            self.timing_mm,
        ]
    }

    fn new(
        [pixel_noise_mm, speckle_mm, mirror_stop_mm, encoder_mm, column_mm, calibration_mm, pose_mm, timing_mm]: [f64;
            8],
    ) -> Self {
        let sum = |terms: &[f64]| terms.iter().map(|t| t * t).sum::<f64>().sqrt();
        let all =
            [pixel_noise_mm, speckle_mm, mirror_stop_mm, encoder_mm, column_mm, calibration_mm, pose_mm, timing_mm];
        Self {
            pixel_noise_mm,
            speckle_mm,
            mirror_stop_mm,
            encoder_mm,
            column_mm,
            calibration_mm,
            pose_mm,
            timing_mm,
            instrument_mm: sum(&all[..INSTRUMENT]),
            total_mm: sum(&all),
        }
    }

    /// The largest of the instrument's own terms: its place in [`TERMS`] and its share of their variance.
    pub fn dominant(&self) -> (usize, f64) {
        let list = self.list();
        let best = (0..INSTRUMENT).max_by(|a, b| list[*a].total_cmp(&list[*b])).unwrap_or(0);
        (best, (list[best] / self.instrument_mm).powi(2))
    }
}

/// All about one place in the middle of the image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Row {
    /// X from the robot's centre [m].
    pub range_m: f64,
    /// X' from the camera's foot [m]: the range of Table 5.
    pub from_camera_m: f64,
    /// Height over the floor [m].
    pub height_m: f64,
    /// Beam angle below the horizontal [°].
    pub beam_deg: f64,
    /// The mirror's encoder there, not rounded; null where the sheet stands still.
    pub pulse: Option<f64>,
    /// Row of the stripe from the top [px].
    pub row_px: f64,
    /// Range a pixel.
    pub mm_per_px: f64,
    /// Range a pulse of the mirror, the pixel staying.
    pub mm_per_pulse: f64,
    /// Range a milliradian of the camera's pitch.
    pub mm_per_mrad_pitch: f64,
    /// Sideways, a column.
    pub mm_per_column: f64,
    /// Along the floor from one pulse's line to the next; null off the floor.
    pub floor_mm_per_pulse: Option<f64>,
    /// RMS width of the stripe in the image before the pixel's own [px].
    pub stripe_px: f64,
    /// Electrons in a column.
    pub electrons: f64,
    /// Highest level over the background, not clipped.
    pub peak_level: f64,
    /// Whether the sensor is full there.
    pub saturated: bool,
    /// Whether the stripe stands out of the noise.
    pub found: bool,
    /// Bound of the row by noise [px].
    pub pixel_noise_px: f64,
    /// Speckle's part [px].
    pub speckle_px: f64,
    /// Errors of X.
    pub range: Terms,
    /// Errors of Y.
    pub lateral: Terms,
    /// Errors of Z.
    pub height: Terms,
    /// The largest of the instrument's terms of X, as a key of the terms.
    pub dominant: &'static str,
    /// Its share of the instrument's variance.
    pub dominant_share: f64,
    /// Lowest step that stands out of the noise between lines: 5 σ of Z.
    pub smallest_step_mm: f64,
    /// The same between neighbours in one line, which share the mirror's error: 5·√2 σ of noise and speckle.
    pub smallest_step_in_line_mm: f64,
}

/// Computes rows for an instrument.
pub(super) struct Budget<'a> {
    pub bench: &'a Bench<'a>,
    pub instrument: &'a Instrument,
    pub params: &'a DesignParams,
    pub detector: Detector,
}

impl<'a> Budget<'a> {
    pub fn new(bench: &'a Bench<'a>, instrument: &'a Instrument, params: &'a DesignParams) -> Self {
        let detector = Detector::new(bench.image, bench.background(params.ambient_w_per_m2));
        Self { bench, instrument, params, detector }
    }

    /// The floor at X, each with the beam that meets it; `None` where camera or beam do not reach.
    pub fn floor(&self, x_m: f64) -> Option<Row> {
        let axis = self.bench.beam()?; // a sheet that stands still meets the floor in one line
        let point = self.bench.floor_at(x_m)?;
        let beam = self.bench.beam_to(&point)?;
        let sight = self.bench.look(&point, &V3::z(), beam)?;
        let mut row = self.row(&sight)?;
        let pulse = axis.rad_per_pulse.abs();
        let ahead = point - self.bench.source;
        // X = lA/tanθB: dX = (X² + lA²)/lA·dθB.
        row.floor_mm_per_pulse = Some((ahead.x * ahead.x + ahead.z * ahead.z) / ahead.z.abs() * pulse * 1e3);
        Some(row)
    }

    /// An upright target at X, cut by one beam's sheet; `None` where that lies under the floor or out of view.
    pub fn upright(&self, beam_rad: f64, x_m: f64) -> Option<Row> {
        let point = self.bench.sheet_at(beam_rad, x_m)?;
        if point.z < -1e-9 {
            return None;
        }
        let sight = self.bench.look(&point, &-V3::x(), beam_rad)?;
        self.row(&sight)
    }

    /// Share of speckle in a stripe's row: C·λN/π on the sensor, C = 1 [px].
    pub fn speckle_px(&self) -> f64 {
        let image = self.bench.image;
        let pitch = image.focal_length_m / self.bench.rig.camera.fy;
        self.bench.rig.sheet.wavelength_m * image.f_number / std::f64::consts::PI / pitch
    }

    fn row(&self, sight: &Sight) -> Option<Row> {
        if !(sight.in_image && sight.in_fan && sight.in_travel) {
            return None;
        }
        let (bench, params) = (self.bench, self.params);
        let electrons = sight.electrons * params.albedo;
        let per = |sigma: Uncertainty| bench.spread(sight, &sigma).map(|s| s * 1e3);
        let per_u = per(Uncertainty { u_px: 1.0, ..EXACT })?;
        let per_v = per(Uncertainty { v_px: 1.0, ..EXACT })?;
        let per_beam = per(Uncertainty { beam_rad: 1.0, ..EXACT })?;
        let per_cylinder = per(Uncertainty { cylinder_rad: 1.0, ..EXACT })?;
        let per_pitch = bench.by_pitch(sight)? * 1e3;
        let pixel_noise_px = self.detector.row_bound_px(electrons, sight.stripe_px);
        let speckle_px = self.speckle_px();
        let pulse = bench.beam().map_or(0.0, |axis| axis.rad_per_pulse.abs());
        let cylinder = bench.rig.cylinder_sigma_rad;
        let pose = [
            params.position_sigma_m,
            params.position_sigma_m.hypot(sight.point.x * params.heading_sigma_rad),
            sight.point.x * params.tilt_sigma_rad,
        ];
        let moved = [params.speed_m_s, sight.point.x * params.turn_rad_s, 0.0];
        let terms = |i: usize| {
            let encoder = (per_beam[i] * self.instrument.encoder_sigma_rad()).hypot(per_cylinder[i] * cylinder);
            Terms::new([
                per_v[i] * pixel_noise_px,
                per_v[i] * speckle_px,
                per_beam[i] * self.instrument.mirror_sigma_rad(),
                encoder,
                per_u[i] / 12f64.sqrt(),
                (per_pitch[i] * params.pitch_sigma_rad).hypot(per_beam[i] * params.beam_zero_sigma_rad),
                pose[i] * 1e3,
                moved[i] * params.timing_sigma_s * 1e3,
            ])
        };
        let (range, lateral, height) = (terms(0), terms(1), terms(2));
        let (dominant, dominant_share) = range.dominant();
        let peak_level = self.detector.peak_levels(electrons, sight.stripe_px);
        let threshold = (FOUND * self.detector.noise_levels()).max(LEVEL_MIN);
        Some(Row {
            range_m: sight.point.x,
            from_camera_m: sight.point.x - bench.eye.x,
            height_m: sight.point.z,
            beam_deg: sight.beam_rad.to_degrees(),
            pulse: bench.pulse(sight.beam_rad),
            row_px: sight.pixel[1],
            mm_per_px: per_v.x,
            mm_per_pulse: per_beam.x * pulse,
            mm_per_mrad_pitch: per_pitch.x.abs() * 1e-3,
            mm_per_column: sight.column_m * 1e3,
            floor_mm_per_pulse: None,
            stripe_px: sight.stripe_px,
            electrons,
            peak_level,
            saturated: self.detector.is_full(electrons, sight.stripe_px),
            found: peak_level >= threshold && pixel_noise_px.is_finite(),
            pixel_noise_px,
            speckle_px,
            range,
            lateral,
            height,
            dominant: TERMS[dominant].0,
            dominant_share,
            smallest_step_mm: STANDS_OUT * height.instrument_mm,
            smallest_step_in_line_mm: STANDS_OUT * 2f64.sqrt() * height.pixel_noise_mm.hypot(height.speckle_mm),
        })
    }
}
