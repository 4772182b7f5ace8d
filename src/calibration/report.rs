//! What a calibration says of itself: the same for camera, finder and plane.

use serde::Serialize;
use serde::ser::{SerializeMap, Serializer};

use super::solve::Solution;

/// A parameter with its error bar.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Its name, with the unit as suffix where it is not SI.
    #[serde(skip)]
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Its standard deviation; 0 for one that was held.
    pub sigma: f64,
    /// The unit of both.
    pub unit: &'static str,
}

impl Estimate {
    /// `name` = `value` ± `sigma` `unit`.
    pub fn new(name: impl Into<String>, value: f64, sigma: f64, unit: &'static str) -> Self {
        Self { name: name.into(), value, sigma, unit }
    }
}

/// What is left between measurement and model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Residual {
    /// √(mean of squared distances).
    pub rms: f64,
    /// Mean distance.
    pub mean: f64,
    /// Largest distance.
    pub max: f64,
    /// The unit of all three.
    pub unit: &'static str,
}

impl Residual {
    /// Over distances that are 0 or more; all 0 for none.
    pub fn of(distances: impl IntoIterator<Item = f64>, unit: &'static str) -> Self {
        let (mut count, mut sum, mut squares, mut max) = (0.0, 0.0, 0.0, 0.0f64);
        for d in distances {
            (count, sum, squares, max) = (count + 1.0, sum + d, squares + d * d, max.max(d));
        }
        let count = f64::max(count, 1.0);
        Self { rms: (squares / count).sqrt(), mean: sum / count, max, unit }
    }
}

/// A measurement that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Rejected {
    /// Which one.
    pub what: String,
    /// Why.
    pub why: String,
}

/// The outcome of a calibration, as `calibrate --json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// What was determined, in a fixed order.
    #[serde(serialize_with = "by_name")]
    pub parameters: Vec<Estimate>,
    /// What is left.
    pub residual: Residual,
    /// How many measurements went into it.
    pub used: usize,
    /// Those that did not.
    pub rejected: Vec<Rejected>,
}

/// Whether a calibration may be used, and if not, why not.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// Whether all limits are kept.
    pub accepted: bool,
    /// The limits that are not, in words.
    pub reasons: Vec<String>,
}

impl Verdict {
    /// Accepted, if there is no reason against it.
    pub fn of(reasons: Vec<String>) -> Self {
        Self { accepted: reasons.is_empty(), reasons }
    }
}

/// Two parameters that the data hardly tell apart.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Weak {
    /// What changes together, each by one standard deviation or its share of it.
    #[serde(serialize_with = "as_map")]
    pub changes: Vec<(String, f64)>,
    /// How closely, −1 to 1.
    pub correlation: f64,
}

/// The pairs among the parameters at `places` with a correlation beyond ± 0.95, the closest first.
pub(super) fn weak(fit: &Solution, places: &[usize]) -> Vec<Weak> {
    const CLOSE: f64 = 0.95;
    let mut found = Vec::new();
    for (k, &i) in places.iter().enumerate() {
        for &j in &places[..k] {
            let correlation = fit.correlation(i, j);
            if correlation.abs() > CLOSE {
                let name = |i: usize| fit.parameters[i].name.clone();
                let changes = vec![(name(j), fit.sigma(j)), (name(i), correlation * fit.sigma(i))];
                found.push(Weak { changes, correlation });
            }
        }
    }
    found.sort_by(|a, b| b.correlation.abs().total_cmp(&a.correlation.abs()));
    found
}

fn as_map<S: Serializer>(changes: &[(String, f64)], serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(changes.len()))?;
    for (name, by) in changes {
        map.serialize_entry(name, by)?;
    }
    map.end()
}

fn by_name<S: Serializer>(parameters: &[Estimate], serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(parameters.len()))?;
    for estimate in parameters {
        map.serialize_entry(&estimate.name, estimate)?;
    }
    map.end()
}

/// The robust standard deviation of values around 0 (from the median of their sizes); 0 for none.
pub(super) fn robust_sigma(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = values.into_iter().map(f64::abs).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.get(sizes.len() / 2).map_or(0.0, |median| 1.4826 * median)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_json_has_the_agreed_keys() {
        let report = Report {
            parameters: vec![Estimate::new("f_mm", 11.5, 0.25, "mm")],
            residual: Residual::of([3.0, 5.0], "px"),
            used: 2,
            rejected: vec![Rejected { what: "line 7".into(), why: "9 px off".into() }],
        };
        let json = serde_json::to_value(&report).unwrap();
        let expected = serde_json::json!({
            "parameters": { "f_mm": { "value": 11.5, "sigma": 0.25, "unit": "mm" } },
            "residual": { "rms": 17f64.sqrt(), "mean": 4.0, "max": 5.0, "unit": "px" },
            "used": 2,
            "rejected": [{ "what": "line 7", "why": "9 px off" }],
        });
        assert_eq!(json, expected);
    }
}
