//! What is asked of a design.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};
use crate::optics::{Laser, Rig, SlitOptics};
use crate::scanner::{ImageParams, SweepParams, Trigger};

/// A finder that need not exist yet.
#[derive(Clone, Debug)]
pub struct Instrument {
    /// Camera, laser, axes.
    pub rig: Rig,
    /// Lens and sensor of the camera.
    pub image: ImageParams,
    /// The lenses that make the sheet, where they are known; the rig's sheet is then theirs.
    pub optics: Option<SlitOptics>,
    /// Servos and trigger, where they are known; otherwise METRO-I's, with the rig's standard deviations.
    pub sweep: Option<SweepParams>,
    /// What was assumed about it, in sentences, for the report.
    pub assumed: Vec<String>,
}

impl Instrument {
    /// METRO-I: Tables 1, 3 and 4 of the paper, everything else assumed as in the simulation.
    pub fn metro_i() -> Self {
        Self {
            rig: Rig::metro_i(),
            image: ImageParams::default(),
            optics: Some(SlitOptics::default()),
            sweep: None,
            assumed: Vec::new(),
        }
    }

    /// Refuses what makes no finder; with lenses, the sheet becomes theirs.
    pub fn validated(mut self) -> Result<Self> {
        if let Some(optics) = self.optics {
            self.rig.sheet = optics.sheet(self.rig.sheet)?;
        }
        self.rig = self.rig.validated()?;
        self.image = self.image.validated()?;
        self.sweep = self.sweep.map(SweepParams::validated).transpose()?;
        Ok(self)
    }

    /// Standard deviation of where the mirror truly stands about its stop [rad].
    pub(super) fn mirror_sigma_rad(&self) -> f64 {
        match (&self.sweep, self.rig.laser) {
            (Some(sweep), Laser::Mirror(mirror)) => sweep.mirror.stop_sigma_pulse * mirror.beam.rad_per_pulse.abs(),
            _ => self.rig.beam_sigma_rad,
        }
    }

    /// What the reading of the mirror's encoder adds [rad]: the rounding of a mirror that is read while it moves, play, a
    /// wrong zero. Nothing for a mirror that settles on whole pulses.
    pub(super) fn encoder_sigma_rad(&self) -> f64 {
        let (Some(sweep), Laser::Mirror(mirror)) = (&self.sweep, self.rig.laser) else { return 0.0 };
        let pulse = mirror.beam.rad_per_pulse.abs();
        let rounding = if sweep.trigger == Trigger::Free { pulse / 12f64.sqrt() } else { 0.0 };
        let play = sweep.mirror.backlash_rad / 2.0;
        let zero = sweep.mirror.zero_error_pulse * pulse;
        (rounding * rounding + play * play + zero * zero).sqrt()
    }
}

/// A box before the robot, in its frame [m]; each from, to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// Ahead.
    pub x_m: [f64; 2],
    /// To the left.
    pub y_m: [f64; 2],
    /// Over the floor.
    pub z_m: [f64; 2],
}

impl Default for Volume {
    fn default() -> Self {
        Self { x_m: [1.5, 3.0], y_m: [-0.5, 0.5], z_m: [0.0, 0.5] }
    }
}

/// What a design is asked.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DesignParams {
    /// Nearest and farthest X that tables and plots show [m].
    pub range_m: [f64; 2],
    /// Beam of the upright targets, down from the horizontal [rad]; without it that of encoder 0, or the one that meets the
    /// floor in the middle of what the camera sees.
    pub beam_rad: Option<f64>,
    /// The volume to be watched.
    pub volume: Volume,
    /// How far apart lines may fall in it, on the floor and up a wall [m].
    pub resolution_m: f64,
    /// Albedo of floor and targets in the error budget.
    pub albedo: f64,
    /// Ambient light within the filter's band [W/m²]: a lit room 0.06, direct sun 14 (`instrument.md` 1).
    pub ambient_w_per_m2: f64,
    /// Power of the bare laser beam [W]; without it, what leaves the finder.
    pub source_power_w: Option<f64>,
    /// Speed of the robot while it looks [m/s].
    pub speed_m_s: f64,
    /// Turn rate of the robot while it looks [rad/s].
    pub turn_rad_s: f64,
    /// Standard deviation of an image's time against the odometry's [s] [A].
    pub timing_sigma_s: f64,
    /// Standard deviation of the robot's position, each axis [m] [A]: 1 m of dead reckoning (`instrument.md` 5).
    pub position_sigma_m: f64,
    /// Standard deviation of its heading [rad] [A]: the same.
    pub heading_sigma_rad: f64,
    /// Standard deviation of its pitch against the floor [rad] [A].
    pub tilt_sigma_rad: f64,
    /// Standard deviation of the calibrated pitch of the camera [rad]; 0: calibration taken as perfect.
    pub pitch_sigma_rad: f64,
    /// Standard deviation of the calibrated zero of the beam [rad].
    pub beam_zero_sigma_rad: f64,
    /// Radius of the robot [m].
    pub robot_radius_m: f64,
    /// Height of the example of a table top [m].
    pub table_m: f64,
}

impl Default for DesignParams {
    fn default() -> Self {
        Self {
            range_m: [1.0, 4.0],
            beam_rad: None,
            volume: Volume::default(),
            resolution_m: 0.05,
            albedo: 0.5,
            ambient_w_per_m2: 0.06,
            source_power_w: None,
            speed_m_s: 0.3,
            turn_rad_s: 0.0,
            timing_sigma_s: 1e-3,
            position_sigma_m: 3.2e-3,
            heading_sigma_rad: 1e-3,
            tilt_sigma_rad: 5e-4,
            pitch_sigma_rad: 0.0,
            beam_zero_sigma_rad: 0.0,
            robot_radius_m: 0.3,
            table_m: 0.75,
        }
    }
}

impl DesignParams {
    /// Refuses questions that have no answer.
    pub fn validated(self) -> Result<Self> {
        from_to("range", self.range_m, 0.01, 100.0)?;
        from_to("volume x", self.volume.x_m, 0.0, 100.0)?;
        from_to("volume y", self.volume.y_m, -100.0, 100.0)?;
        from_to("volume z", self.volume.z_m, -10.0, 100.0)?;
        number_within("resolution", self.resolution_m, 1e-3, 10.0)?;
        positive("albedo", self.albedo)?;
        number_within("albedo", self.albedo, 0.0, 1.0)?;
        number_within("ambient light", self.ambient_w_per_m2, 0.0, 1e6)?;
        if let Some(power_w) = self.source_power_w {
            positive("power of the laser", power_w)?;
            number_within("power of the laser", power_w, 0.0, 1e3)?;
        }
        if let Some(beam_rad) = self.beam_rad {
            if beam_rad.is_nan() || beam_rad <= 0.0 {
                let found = format!("{}°: at or above the horizon", beam_rad.to_degrees());
                return Err(Fault::new("beam", found, "an angle below the horizon: this beam never meets the floor"));
            }
            number_within("beam", beam_rad, 0.0, 1.5)?;
        }
        for (what, value, high) in [
            ("speed", self.speed_m_s, 100.0),
            ("turn rate", self.turn_rad_s, 100.0),
            ("timing", self.timing_sigma_s, 10.0),
            ("position sigma", self.position_sigma_m, 10.0),
            ("heading sigma", self.heading_sigma_rad, 1.0),
            ("tilt sigma", self.tilt_sigma_rad, 1.0),
            ("pitch sigma", self.pitch_sigma_rad, 1.0),
            ("beam zero sigma", self.beam_zero_sigma_rad, 1.0),
            ("robot radius", self.robot_radius_m, 10.0),
            ("table height", self.table_m, 10.0),
        ] {
            number_within(what, value, 0.0, high)?;
        }
        Ok(self)
    }
}

fn from_to(what: &str, [low, high]: [f64; 2], least: f64, most: f64) -> Result<()> {
    number_within(what, low, least, most)?;
    number_within(what, high, least, most)?;
    if low >= high {
        return Err(Fault::new(what, format!("{low} to {high}"), "a smaller number, then a greater one"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(text: &str) -> Result<DesignParams, String> {
        let params: DesignParams = toml::from_str(text).map_err(|e| e.to_string())?;
        params.validated().map_err(|fault| fault.to_string())
    }

    #[test]
    fn questions_without_an_answer_are_refused_by_name() {
        assert_eq!(asked("").unwrap(), DesignParams::default());
        for (text, what) in [
            ("range_m = [2, 1]", "range: found 2 to 1"),
            ("range_m = [nan, 1]", "range: found NaN"),
            ("resolution_m = 0", "resolution: found 0"),
            ("albedo = 0", "albedo: found 0"),
            ("beam_rad = -0.1", "at or above the horizon"),
            ("beam_rad = nan", "beam: found"),
            ("speed_m_s = inf", "speed: found inf"),
            ("source_power_w = -1", "power of the laser: found -1"),
            ("volume = { x_m = [1, 2], y_m = [0, 1], z_m = [1, 1] }", "volume z: found 1 to 1"),
            ("sped_m_s = 1", "unknown field `sped_m_s`"),
        ] {
            let fault = asked(text).unwrap_err();
            assert!(fault.contains(what), "{text}: {fault}");
        }
    }

    #[test]
    fn encoder_and_servo_come_from_the_sweep_where_it_is_known() {
        let pulse = std::f64::consts::TAU / 4000.0;
        let metro = Instrument::metro_i();
        assert!((metro.mirror_sigma_rad() - 0.1 * pulse).abs() < 1e-12 && metro.encoder_sigma_rad() == 0.0);
        let mut sweep = SweepParams { trigger: Trigger::Free, ..SweepParams::default() };
        sweep.mirror.stop_sigma_pulse = 0.3;
        let free = Instrument { sweep: Some(sweep.clone()), ..metro.clone() };
        assert!((free.mirror_sigma_rad() - 0.3 * pulse).abs() < 1e-12);
        assert!((free.encoder_sigma_rad() - 0.288_675 * pulse).abs() < 1e-8); // 1/√12
        sweep.trigger = Trigger::Settled;
        sweep.mirror.backlash_rad = 2e-3;
        assert!((Instrument { sweep: Some(sweep), ..metro }.encoder_sigma_rad() - 1e-3).abs() < 1e-12);
    }
}
