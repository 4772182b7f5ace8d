//! Air: how fast sound is in it and how much of it is swallowed.

use serde::{Deserialize, Serialize};

use crate::fault::{Result, number_within};

/// The air between a transducer and its targets.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Air {
    /// Temperature [K], 233.15 to 333.15.
    pub temperature_k: f64,
    /// Relative humidity [%], 0 to 100.
    pub humidity_percent: f64,
    /// Pressure [kPa], 50 to 110.
    pub pressure_kpa: f64,
}

/// 20 °C and 50 % at sea level.
impl Default for Air {
    fn default() -> Self {
        Self { temperature_k: 293.15, humidity_percent: 50.0, pressure_kpa: 101.325 }
    }
}

impl Air {
    /// Refuses air that no robot drives in; faults are named `air.…`.
    pub fn validated(self) -> Result<Self> {
        number_within("air.temperature_k", self.temperature_k, 233.15, 333.15)?;
        number_within("air.humidity_percent", self.humidity_percent, 0.0, 100.0)?;
        number_within("air.pressure_kpa", self.pressure_kpa, 50.0, 110.0)?;
        Ok(self)
    }

    /// Speed of sound, 20.05·√T [m/s] (`instrument.md` 6).
    pub fn sound_m_s(&self) -> f64 {
        20.05 * self.temperature_k.sqrt()
    }

    /// What sound of this frequency loses on its way [dB/m]: ISO 9613-1:1993, eq. 3 to 5 and B.2, B.3.
    pub fn absorption_db_m(&self, frequency_hz: f64) -> f64 {
        let (t, p) = (self.temperature_k / 293.15, self.pressure_kpa / 101.325);
        let saturated = 10f64.powf(4.6151 - 6.8346 * (273.16 / self.temperature_k).powf(1.261));
        let water = self.humidity_percent * saturated / p; // molar concentration [%]
        let oxygen_hz = p * (24.0 + 4.04e4 * water * (0.02 + water) / (0.391 + water));
        let nitrogen_hz = p / t.sqrt() * (9.0 + 280.0 * water * (-4.170 * (t.powf(-1.0 / 3.0) - 1.0)).exp());
        let f2 = frequency_hz * frequency_hz;
        let relaxed = |strength: f64, kelvin: f64, hz: f64| {
            strength * (-kelvin / self.temperature_k).exp() / (hz + f2 / hz) * t.powf(-2.5)
        };
        let classical = 1.84e-11 / p * t.sqrt();
        8.686 * f2 * (classical + relaxed(0.01275, 2239.1, oxygen_hz) + relaxed(0.1068, 3352.0, nitrogen_hz))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(celsius: f64, humidity_percent: f64) -> Air {
        Air { temperature_k: 273.15 + celsius, humidity_percent, ..Air::default() }
    }

    #[test]
    fn absorption_is_that_of_the_standard() {
        // ISO 9613-1, table 1 [dB/km], at the exact middle frequencies of the octaves, 1000·2ⁿ ≈ 1000·10^(0.3 n).
        let table = [(10.0, 70.0, 0, 3.66), (10.0, 70.0, 3, 117.0), (20.0, 70.0, 2, 22.9), (20.0, 70.0, 3, 76.6)];
        for (celsius, humidity, octave, db_km) in table {
            let found = at(celsius, humidity).absorption_db_m(1000.0 * 10f64.powf(0.3 * f64::from(octave))) * 1e3;
            assert!((found / db_km - 1.0).abs() < 0.005, "{celsius} °C, octave {octave}: {found} for {db_km}");
        }
        // The figure that the rest of the model leans on (instrument.md 6).
        assert!((Air::default().absorption_db_m(49.4e3) - 1.64).abs() < 0.005);
        assert!(at(0.0, 50.0).absorption_db_m(49.4e3) < 0.6);
        assert!(at(20.0, 0.0).absorption_db_m(49.4e3).is_finite());
    }

    #[test]
    fn sound_is_faster_in_warm_air() {
        assert!((Air::default().sound_m_s() - 343.3).abs() < 0.05);
        assert!((at(0.0, 50.0).sound_m_s() - 331.4).abs() < 0.05);
    }

    #[test]
    fn air_that_is_none_is_refused() {
        let fault = Air { temperature_k: -20.0, ..Air::default() }.validated().unwrap_err();
        assert!(fault.to_string().starts_with("air.temperature_k: found -20, expected a number from 233.15 to 333.15"));
        for bad in [f64::NAN, -1.0, 101.0] {
            assert!(Air { humidity_percent: bad, ..Air::default() }.validated().is_err());
        }
        assert!(Air { pressure_kpa: 0.0, ..Air::default() }.validated().is_err());
    }
}
