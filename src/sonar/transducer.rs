//! The transducer and its electronics: a Polaroid 600 on a 6500 ranging module.
//!
//! Levels are in decibels over what a smooth endless wall, square to the beam, would send back from 1 m if air swallowed
//! nothing; so a wall at r gives −20·log₁₀ r − 2α·r.

use serde::{Deserialize, Serialize};

use super::air::Air;
use super::beam::Piston;
use crate::fault::{Fault, Result, number_within};

/// When the receiver's gain goes up a step, after the start of the ping [s]: the module's digital gain control (TL851
/// with TL852), step 0 to 10. [A] for the times, which are quoted from memory of its data sheet.
const GAIN_STEPS_S: [f64; 10] =
    [5.12e-3, 7.87e-3, 10.61e-3, 13.35e-3, 16.09e-3, 18.84e-3, 21.58e-3, 27.07e-3, 32.55e-3, 38.04e-3];
/// The last step has no end; it is set for one more of the length of its predecessor.
const LAST_STEP_S: f64 = 43.53e-3;

/// Time constants after the end of a ping in which its tail still counts.
const TAIL: f64 = 8.0;
/// Steps of the table of the envelope.
const ENVELOPE_STEPS: usize = 2048;

/// What a transducer and its electronics are made of (`instrument.md` 6).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TransducerParams {
    /// Frequency [Hz].
    pub frequency_hz: f64,
    /// Radius of the piston [m].
    pub radius_m: f64,
    /// Length of a ping [cycles].
    pub cycles: f64,
    /// Time constant of the two poles that sender and receiver are, Q/π at Q = 5 [cycles] [A].
    pub rise_cycles: f64,
    /// How long the receiver is deaf after the start of a ping [s]: 2.38 ms, which is 0.41 m; 0.87 ms for 0.15 m.
    pub blanking_s: f64,
    /// The weakest echo that is detected wherever the gain is lowest for its range, over that of a smooth wall at that
    /// range square to the beam [dB] [A].
    pub threshold_db: f64,
    /// What is farther is not listened for [m].
    pub range_m_max: f64,
    /// Echoes are told apart from this distance on [m].
    pub separation_m: f64,
    /// Standard deviation of a range, at least [m] [A].
    pub range_sigma_m: f64,
    /// Standard deviation of a range, as a share of it [A].
    pub range_sigma_share: f64,
    /// Share of what a rough surface does not mirror that comes back at all, c_s, 0 to 1 [A].
    pub diffuse_share: f64,
    /// Length over which a rough surface's heights have to do with one another [m]: a wavelength [A].
    pub correlation_m: f64,
}

impl Default for TransducerParams {
    fn default() -> Self {
        Self {
            frequency_hz: 49.4e3,
            radius_m: 0.0192,
            cycles: 16.0,
            rise_cycles: 1.6,
            blanking_s: 2.38e-3,
            threshold_db: -38.0,
            range_m_max: 10.7,
            separation_m: 0.0762,
            range_sigma_m: 0.003,
            range_sigma_share: 0.003,
            diffuse_share: 1.0,
            correlation_m: 0.007,
        }
    }
}

impl TransducerParams {
    /// Refuses a transducer that cannot be; faults are named `transducer.…`.
    pub fn validated(self) -> Result<Self> {
        for (what, value, low, high) in [
            ("frequency_hz", self.frequency_hz, 20e3, 200e3),
            ("radius_m", self.radius_m, 0.002, 0.1),
            ("cycles", self.cycles, 1.0, 200.0),
            ("rise_cycles", self.rise_cycles, 0.01, 20.0),
            ("blanking_s", self.blanking_s, 0.0, 0.05),
            ("threshold_db", self.threshold_db, -80.0, -6.0),
            ("range_m_max", self.range_m_max, 0.1, 20.0),
            ("separation_m", self.separation_m, 0.0, 1.0),
            ("range_sigma_m", self.range_sigma_m, 0.0, 0.1),
            ("range_sigma_share", self.range_sigma_share, 0.0, 0.1),
            ("diffuse_share", self.diffuse_share, 0.0, 1.0),
            ("correlation_m", self.correlation_m, 1e-4, 1.0),
        ] {
            number_within(&format!("transducer.{what}"), value, low, high)?;
        }
        let deaf_m = self.blanking_s * 343.0 / 2.0;
        if deaf_m >= self.range_m_max {
            let found = format!("{} s, which is {deaf_m:.2} m", self.blanking_s);
            let expected = format!("less than what {} m take", self.range_m_max);
            return Err(Fault::new("transducer.blanking_s", found, expected));
        }
        Ok(self)
    }
}

/// A transducer in air.
#[derive(Clone, Debug)]
pub(super) struct Transducer {
    pub params: TransducerParams,
    /// k [1/m].
    pub wave_number: f64,
    pub sound_m_s: f64,
    pub absorption_db_m: f64,
    pub piston: Piston,
    /// Amplitude that is detected in each step of the gain, and when the step ends [s].
    steps: Vec<(f64, f64)>,
    /// Length of a ping, and time constant of its rise [s].
    ping_s: f64,
    rise_s: f64,
    /// The envelope at equal steps over `echo_s`.
    envelope: Vec<f64>,
}

impl Transducer {
    pub fn new(params: TransducerParams, air: &Air) -> Result<Self> {
        let (params, air) = (params.validated()?, air.validated()?);
        let sound_m_s = air.sound_m_s();
        let wave_number = std::f64::consts::TAU * params.frequency_hz / sound_m_s;
        if wave_number * params.radius_m > 100.0 {
            let found = format!("{} m at {} Hz", params.radius_m, params.frequency_hz);
            return Err(Fault::new("transducer.radius_m", found, "at most 16 wavelengths"));
        }
        // The steps were set in the laboratory, for its air: −38 dB hold where a step ends, where a wall is weakest.
        let laboratory = Air::default();
        let lost = laboratory.absorption_db_m(params.frequency_hz);
        let detected = |end_s: f64| {
            let r = end_s * laboratory.sound_m_s() / 2.0;
            10f64.powf((params.threshold_db - 2.0 * lost * r) / 20.0) / r
        };
        let ends = GAIN_STEPS_S.iter().map(|end| (detected(*end), *end));
        let steps = ends.chain([(detected(LAST_STEP_S), f64::INFINITY)]).collect();
        let (ping_s, rise_s) = (params.cycles / params.frequency_hz, params.rise_cycles / params.frequency_hz);
        let step_s = (ping_s + TAIL * rise_s) / ENVELOPE_STEPS as f64;
        let rise = |t: f64| if t > 0.0 { 1.0 - (1.0 + t) * (-t).exp() } else { 0.0 };
        let at = |t: f64| rise(t / rise_s) - rise((t - ping_s) / rise_s);
        let envelope = (0..=ENVELOPE_STEPS).map(|i| at(i as f64 * step_s)).collect();
        Ok(Self {
            params,
            wave_number,
            sound_m_s,
            absorption_db_m: air.absorption_db_m(params.frequency_hz),
            piston: Piston::new(wave_number, params.radius_m),
            steps,
            ping_s,
            rise_s,
            envelope,
        })
    }

    /// The amplitude that is detected at this time after the start of a ping; ∞ while the receiver is deaf.
    pub fn threshold(&self, time_s: f64) -> f64 {
        if time_s < self.params.blanking_s || time_s > self.last_s() {
            return f64::INFINITY;
        }
        self.steps.iter().find(|(_, end)| time_s < *end).map_or(f64::INFINITY, |(level, _)| *level)
    }

    /// How far the normal of a smooth wall may be off the axis for the main lobe to see it [rad].
    pub fn main_lobe_rad(&self) -> f64 {
        let seen = 10f64.powf(self.params.threshold_db / 40.0);
        let degrees = (0..900).map(|tenth| f64::from(tenth) * 0.1);
        let mut angles = degrees.map(f64::to_radians).take_while(|a| self.piston.far(a.sin(), a.cos()) >= seen);
        angles.by_ref().last().unwrap_or(0.0)
    }

    /// When the receiver stops to listen [s].
    pub fn last_s(&self) -> f64 {
        2.0 * self.params.range_m_max / self.sound_m_s
    }

    /// How long an echo lasts, with the tail that still counts [s].
    pub fn echo_s(&self) -> f64 {
        self.ping_s + TAIL * self.rise_s
    }

    /// The envelope of an echo at this time after its beginning, 0 to 1: a box through two equal poles.
    pub fn envelope(&self, time_s: f64) -> f64 {
        let place = time_s / self.echo_s() * ENVELOPE_STEPS as f64;
        let cell = place as usize; // nothing before the beginning: there the cell is 0 too
        match (self.envelope.get(cell), self.envelope.get(cell + 1)) {
            (Some(a), Some(b)) if place > 0.0 => a + (b - a) * (place - cell as f64),
            _ => 0.0,
        }
    }

    /// The share of an amplitude that air leaves over this way [m].
    pub fn air_leaves(&self, way_m: f64) -> f64 {
        10f64.powf(-self.absorption_db_m * way_m / 20.0)
    }

    /// The share of an amplitude that a surface of this RMS height [m] mirrors at this cosine of incidence.
    pub fn mirrored(&self, roughness_m: f64, cos: f64) -> f64 {
        let phase = self.wave_number * roughness_m * cos;
        (-2.0 * phase * phase).exp()
    }

    /// The power n of the cosine with which such a surface spreads what it scatters. Gentle roughness keeps it near the
    /// mirrored ray, within what its slopes σ·√2/ℓ or the extent ℓ of its bumps allow; a coarse one spreads it as Lambert has
    /// it, n = 1 (after Beckmann and Spizzichino 1963, ch. 5, whose lobes exp(−tan²ψ/2m²) and exp(−(kℓ·sinψ)²) these are).
    pub fn spread(&self, roughness_m: f64) -> f64 {
        let slopes = 0.5 * (self.params.correlation_m / roughness_m).powi(2);
        let bumps = 2.0 * (self.wave_number * self.params.correlation_m).powi(2);
        1.0 + slopes.min(bumps)
    }

    /// The share of the power that such a surface scatters instead.
    pub fn scattered(&self, roughness_m: f64) -> f64 {
        self.params.diffuse_share * (1.0 - self.mirrored(roughness_m, 1.0).powi(2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn polaroid() -> Transducer {
        Transducer::new(TransducerParams::default(), &Air::default()).unwrap()
    }

    #[test]
    fn blanking_and_reach_are_those_of_the_data_sheet() {
        let it = polaroid();
        // 2.38 ms are 0.41 m; the option 0.15 m; and 10.7 m at most.
        assert!((it.params.blanking_s * it.sound_m_s / 2.0 - 0.41).abs() < 0.002);
        assert!(it.threshold(2.37e-3).is_infinite() && it.threshold(2.39e-3).is_finite());
        assert!((it.last_s() - 62.34e-3).abs() < 0.01e-3 && it.threshold(0.0624).is_infinite());
        let near = TransducerParams { blanking_s: 0.87e-3, ..TransducerParams::default() };
        let near = Transducer::new(near, &Air::default()).unwrap();
        assert!((near.params.blanking_s * near.sound_m_s / 2.0 - 0.15).abs() < 0.001);
        // −38 dB both ways: 11.2° (instrument.md 6).
        assert!((it.main_lobe_rad().to_degrees() - 11.2).abs() < 0.1, "{}", it.main_lobe_rad().to_degrees());
    }

    #[test]
    fn the_threshold_is_a_staircase_under_the_echo_of_a_wall() {
        let it = polaroid();
        let mut margins = Vec::new();
        for i in 0..612 {
            let r = 0.41 + f64::from(i) * 0.01;
            let wall = it.air_leaves(2.0 * r) / r;
            margins.push(20.0 * (it.threshold(2.0 * r / it.sound_m_s) / wall).log10());
        }
        let (low, high) = margins.iter().fold((f64::MAX, f64::MIN), |(l, h), m| (l.min(*m), h.max(*m)));
        // Never less sensitive than −38 dB; a step of 0.47 m from 0.41 m on is 8 dB.
        assert!((high + 38.0).abs() < 0.2 && (-46.5..-45.5).contains(&low), "{low} {high}");
        // A wall is seen to the end of the range.
        let far = it.air_leaves(21.3) / 10.65;
        assert!(far > it.threshold(0.062));
    }

    #[test]
    fn a_ping_rises_within_a_few_cycles_and_is_a_pulse_of_three_inches() {
        let it = polaroid();
        assert!(it.envelope(-1e-6) == 0.0 && it.envelope(0.0) == 0.0);
        let top = (0..1000).map(|i| it.envelope(f64::from(i) * 1e-6)).fold(0.0, f64::max);
        assert!((0.99..=1.0).contains(&top), "{top}");
        assert!(it.envelope(it.ping_s * 0.99) > 0.99);
        // What is 38 dB over the threshold is found within a millimetre, what just reaches it some 20 mm late.
        let crossed = |level: f64| (0..).map(|i| f64::from(i) * 1e-7).find(|t| it.envelope(*t) >= level).unwrap();
        let late_mm = |level: f64| crossed(level) * it.sound_m_s / 2.0 * 1e3;
        assert!(late_mm(0.0126) < 1.0, "{}", late_mm(0.0126));
        assert!((15.0..30.0).contains(&late_mm(0.9)), "{}", late_mm(0.9));
        assert!(it.envelope(it.echo_s()) < 0.004);
    }

    #[test]
    fn a_rough_surface_mirrors_less() {
        let it = polaroid();
        assert_eq!((it.mirrored(0.0, 1.0), it.scattered(0.0)), (1.0, 0.0));
        // kσ = 0.452 for cardboard of 0.5 mm: −3.55 dB.
        assert!((20.0 * it.mirrored(5e-4, 1.0).log10() + 3.55).abs() < 0.02);
        assert!(it.mirrored(4e-3, 1.0) < 1e-6 && it.scattered(4e-3) > 0.999);
        assert!(it.mirrored(5e-4, 0.5) > it.mirrored(5e-4, 1.0));
        // A painted wall keeps what it scatters within some 10°, a carpet spreads it.
        assert!(it.spread(2e-4) > 75.0 && it.spread(4e-3) < 2.6 && it.spread(0.1) < 1.01);
    }

    #[test]
    fn a_transducer_that_cannot_be_is_refused_by_name() {
        let fault = |text: &str| toml::from_str::<TransducerParams>(text).unwrap().validated().unwrap_err().to_string();
        assert!(fault("frequency_hz = 0").starts_with("transducer.frequency_hz: found 0"));
        assert!(fault("radius_m = nan").starts_with("transducer.radius_m"));
        assert!(fault("blanking_s = -1").starts_with("transducer.blanking_s"));
        assert!(fault("blanking_s = 0.01\nrange_m_max = 1").contains("less than what 1 m take"));
        assert!(toml::from_str::<TransducerParams>("colour = 1").is_err());
        let wide = TransducerParams { radius_m: 0.1, frequency_hz: 100e3, ..TransducerParams::default() };
        assert!(Transducer::new(wide, &Air::default()).unwrap_err().to_string().contains("16 wavelengths"));
    }
}
