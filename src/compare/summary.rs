//! All seeds together: every figure with its interval, and which differences are more than chance.

use std::collections::BTreeMap;

use serde::Serialize;

use super::ledger::{BIN_M, Encounter, LASER, SENSORS, ULTRASONIC};
use super::statistics::{Rate, Value, holm, mean, median, rate, rms, sign_flip};
use super::trial::{Sensors, Trial, bytes_per_s, power_w};
use crate::fault::{Fault, Result};
use crate::sources::{CompareParams, Scenario};

/// A difference counts where its corrected probability is below this.
pub const ALPHA: f64 = 0.05;
/// The three maps, in this order.
pub const MAPS: [&str; 3] = ["laser", "ultrasonic", "fused"];

/// Everything that a comparison found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// The scenario's name.
    pub name: String,
    /// Version of the program.
    pub version: &'static str,
    /// What was run: SHA-256.
    pub fingerprint: String,
    /// The seeds.
    pub seeds: Vec<u64>,
    /// Which sensors were at work.
    pub sensors: Sensors,
    /// On what terms.
    pub terms: CompareParams,
    /// Simulated time of one seed [s].
    pub sim_s: Option<Value>,
    /// Way of the robot in one seed [m].
    pub travel_m: Option<Value>,
    /// Times the robot touched something, all seeds.
    pub collisions: u64,
    /// What each sensor made of each class.
    pub classes: BTreeMap<String, BTreeMap<&'static str, ClassResult>>,
    /// Share of a class's opportunities in which either sensor saw it: what a robot with both would notice.
    pub either: BTreeMap<String, Option<Rate>>,
    /// Classes in the order of the world file.
    pub order: Vec<String>,
    /// Reports that no surface explains.
    pub false_obstacles: BTreeMap<&'static str, FalseObstacles>,
    /// Maps against truth.
    pub map: BTreeMap<&'static str, MapResult>,
    /// What each sensor needs.
    pub needs: BTreeMap<&'static str, Needs>,
    /// Laser against ultrasonic, seed by seed.
    pub differences: Vec<Difference>,
}

/// What one sensor made of one class; `None`, null in JSON: not measured, since there was nothing to measure.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ClassResult {
    /// Opportunities: an encounter with an obstacle, while it was in one bin of distance within the nominal range.
    pub opportunities: u64,
    /// Opportunities in which it was seen at least once.
    pub detected: u64,
    /// Their ratio.
    pub rate: Option<f64>,
    /// Its 95 % interval.
    pub ci95: Option<[f64; 2]>,
    /// Encounters in which it was seen at all.
    pub encounters: Option<Rate>,
    /// Reports in its direction that no surface explains.
    pub false_share: Option<Rate>,
    /// RMS error of range over its sightings [m].
    pub range_rmse_m: Option<Value>,
    /// RMS error of bearing over its sightings [rad].
    pub bearing_rmse_rad: Option<Value>,
    /// Distance at the first sighting, median over encounters; one without a sighting counts as 0 [m]. `None`: most have none.
    pub first_detection_m: Option<Value>,
    /// Time from coming into play to the first sighting, median over encounters [s]. `None`: most have none.
    pub first_detection_s: Option<Value>,
    /// The rate by distance.
    pub by_distance: Vec<DistanceRate>,
}

/// The rate in one bin of distance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DistanceRate {
    /// The bin [m].
    pub from_m: f64,
    /// Its far end [m].
    pub to_m: f64,
    /// How often.
    #[serde(flatten)]
    pub rate: Rate,
}

/// Reports that no surface explains, over all runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FalseObstacles {
    /// Share of reports.
    pub of_reports: Option<Rate>,
    /// Share of seconds with a report in which one was false.
    pub of_seconds: Option<Rate>,
}

/// A map against the truth; means over seeds. What the keys mean, [`super::MapScore`] says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs, reason = "the fields are those of MapScore")]
pub struct MapResult {
    pub iou: Option<Value>,
    pub precision: Option<Value>,
    pub recall: Option<Value>,
    pub free_space_error: Option<Value>,
    pub free_blocked: Option<Value>,
    pub free_found: Option<Value>,
}

/// What a sensor needs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Needs {
    /// Power [W].
    pub power_w: Option<Value>,
    /// What it sends [kB/s].
    pub kb_per_s: Option<Value>,
    /// What is left of that when the line has been found in the images [kB/s].
    pub line_kb_per_s: Option<Value>,
    /// Exposures or pings a second.
    pub per_s: Option<Value>,
}

/// Laser less ultrasonic, paired over seeds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// A class, or what else was compared.
    pub what: String,
    /// Which measure.
    pub measure: &'static str,
    /// Whether more of it is better.
    pub more_is_better: bool,
    /// Mean over seeds that measured it for both.
    pub laser: Option<f64>,
    /// The same of the ring.
    pub ultrasonic: Option<f64>,
    /// Laser less ultrasonic, mean over seeds.
    pub difference: Option<Value>,
    /// Probability that it is chance: signs flipped over seeds.
    pub p: Option<f64>,
    /// The same corrected for the number of comparisons (Holm).
    pub p_holm: Option<f64>,
    /// `laser`, `ultrasonic`, or `None`: not significant, or not measured.
    pub winner: Option<&'static str>,
}

/// Sums up trials of one scenario.
///
/// # Errors
/// No trials.
pub fn sum_up(scenario: &Scenario, fingerprint: &str, sensors: Sensors, trials: &[Trial]) -> Result<Comparison> {
    if trials.is_empty() {
        return Err(Fault::new("trials", "none", "at least one seed"));
    }
    let order = class_order(scenario, trials);
    let mut classes = BTreeMap::new();
    for name in &order {
        let by_sensor = (0..2).filter(|sensor| sensors.has(*sensor));
        let found = by_sensor.map(|sensor| (SENSORS[sensor], class_result(scenario, trials, name, sensor)));
        classes.insert(name.clone(), found.collect::<BTreeMap<_, _>>());
    }
    let either = order.iter().map(|name| (name.clone(), either(scenario, trials, name))).collect();
    let reports = |sensor: usize, pick: fn(&super::Reports) -> (u64, u64)| {
        rate(&trials.iter().map(|trial| pick(&trial.reports[sensor])).collect::<Vec<_>>())
    };
    let false_obstacles = (0..2).filter(|sensor| sensors.has(*sensor)).map(|sensor| {
        let of_reports = reports(sensor, |r| (r.false_reports, r.reports));
        let of_seconds = reports(sensor, |r| (r.false_seconds, r.seconds));
        (SENSORS[sensor], FalseObstacles { of_reports, of_seconds })
    });
    let used = [sensors.laser, sensors.ultrasonic, sensors == Sensors::BOTH];
    let map = (0..3).filter(|which| used[*which]).map(|which| (MAPS[which], map_result(trials, which)));
    let needs =
        (0..2).filter(|sensor| sensors.has(*sensor)).map(|sensor| (SENSORS[sensor], needs(scenario, trials, sensor)));
    let over = |pick: fn(&Trial) -> f64| mean(&trials.iter().map(pick).collect::<Vec<_>>());
    Ok(Comparison {
        name: scenario.name.clone(),
        version: env!("CARGO_PKG_VERSION"),
        fingerprint: fingerprint.into(),
        seeds: trials.iter().map(|trial| trial.seed).collect(),
        sensors,
        terms: scenario.compare.clone(),
        sim_s: over(|trial| trial.sim_s),
        travel_m: over(|trial| trial.travel_m),
        collisions: trials.iter().map(|trial| trial.collisions).sum(),
        false_obstacles: false_obstacles.collect(),
        map: map.collect(),
        needs: needs.collect(),
        differences: if sensors == Sensors::BOTH { differences(scenario, trials, &order) } else { Vec::new() },
        classes,
        either,
        order,
    })
}

/// The classes of the world file in its order, then others that were met.
fn class_order(scenario: &Scenario, trials: &[Trial]) -> Vec<String> {
    let mut order: Vec<String> = Vec::new();
    let targets = &scenario.compare.target;
    let named = targets.iter().flat_map(|target| std::iter::once(&target.class).chain(&target.fast_class));
    for name in named.chain(trials.iter().flat_map(|trial| trial.classes.keys())) {
        if !order.contains(name) {
            order.push(name.clone());
        }
    }
    order
}

fn encounters<'a>(trial: &'a Trial, class: &str) -> &'a [Encounter] {
    trial.classes.get(class).map_or(&[], Vec::as_slice)
}

/// Opportunities of an encounter: its bins, and whether the sensor saw it there.
fn opportunities(encounter: &Encounter, sensor: usize, bin_s_min: f64) -> impl Iterator<Item = (u32, bool)> {
    let seen = &encounter.by[sensor].seen;
    encounter.bins.iter().filter(move |bin| *bin.1 >= bin_s_min).map(move |(bin, _)| (*bin, seen.contains_key(bin)))
}

/// The same where both sensors are expected to see.
fn nominal<'a>(encounter: &'a Encounter, sensor: usize, terms: &CompareParams) -> impl Iterator<Item = bool> + 'a {
    let nominal_m = terms.nominal_m + 1e-9;
    let within = move |bin: u32| f64::from(bin + 1) * BIN_M <= nominal_m;
    opportunities(encounter, sensor, terms.bin_s_min).filter(move |o| within(o.0)).map(|o| o.1)
}

/// How often either sensor saw a class.
fn either(scenario: &Scenario, trials: &[Trial], class: &str) -> Option<Rate> {
    let seen = |trial: &Trial| {
        let met = encounters(trial, class).iter();
        counted(met.flat_map(|e| {
            let both = nominal(e, LASER, &scenario.compare).zip(nominal(e, ULTRASONIC, &scenario.compare));
            both.map(|(laser, ultrasonic)| laser || ultrasonic)
        }))
    };
    rate(&trials.iter().map(seen).collect::<Vec<_>>())
}

fn counted(opportunities: impl Iterator<Item = bool>) -> (u64, u64) {
    opportunities.fold((0, 0), |(hits, of), hit| (hits + u64::from(hit), of + 1))
}

fn class_result(scenario: &Scenario, trials: &[Trial], class: &str, sensor: usize) -> ClassResult {
    let bin_s_min = scenario.compare.bin_s_min;
    let all = |trial: &Trial| -> Vec<(u32, bool)> {
        encounters(trial, class).iter().flat_map(|e| opportunities(e, sensor, bin_s_min)).collect()
    };
    let rated = |pick: &dyn Fn(&Trial) -> (u64, u64)| rate(&trials.iter().map(pick).collect::<Vec<_>>());
    let overall =
        rated(&|trial| counted(encounters(trial, class).iter().flat_map(|e| nominal(e, sensor, &scenario.compare))));
    let bins = trials.iter().flat_map(|trial| all(trial).into_iter().map(|o| o.0)).max().map_or(0, |bin| bin + 1);
    let by_distance = (0..bins).filter_map(|bin| {
        let here = |trial: &Trial| counted(all(trial).into_iter().filter(|o| o.0 == bin).map(|o| o.1));
        let [from_m, to_m] = [bin, bin + 1].map(|edge| f64::from(edge) * BIN_M);
        Some(DistanceRate { from_m, to_m, rate: rated(&here)? })
    });
    let sums = |pick: fn(&super::Account) -> f64| {
        let one = |trial: &Trial| {
            let accounts = encounters(trial, class).iter().map(|e| &e.by[sensor]);
            accounts.fold((0.0, 0), |(sum, count), account| (sum + pick(account), count + account.errors))
        };
        rms(&trials.iter().map(one).collect::<Vec<_>>())
    };
    let firsts = |pick: &dyn Fn(&Encounter) -> f64| {
        let one = |trial: &Trial| encounters(trial, class).iter().map(pick).collect::<Vec<f64>>();
        median(&trials.iter().map(one).collect::<Vec<_>>())
    };
    // Never is nearer than anything: the same median as that of the times.
    let first_m = firsts(&|e| e.by[sensor].first_m.map_or(f64::INFINITY, |m| -m)).filter(|v| v.value.is_finite());
    let first_s = firsts(&|e| e.by[sensor].first_s.unwrap_or(f64::INFINITY)).filter(|v| v.value.is_finite());
    ClassResult {
        opportunities: overall.map_or(0, |rate| rate.of),
        detected: overall.map_or(0, |rate| rate.hits),
        rate: overall.map(|rate| rate.rate),
        ci95: overall.and_then(|rate| rate.ci95),
        encounters: rated(&|trial| counted(encounters(trial, class).iter().map(|e| e.by[sensor].first_m.is_some()))),
        false_share: rated(&|trial| {
            let accounts = encounters(trial, class).iter().map(|e| &e.by[sensor]);
            accounts.fold((0, 0), |(bad, all), a| (bad + a.false_reports, all + a.reports))
        }),
        range_rmse_m: sums(|account| account.range_m2),
        bearing_rmse_rad: sums(|account| account.bearing_rad2),
        first_detection_m: first_m.map(finite_end).map(negated),
        first_detection_s: first_s.map(finite_end),
        by_distance: by_distance.collect(),
    }
}

fn negated(value: Value) -> Value {
    Value { value: -value.value, ci95: value.ci95.map(|[low, high]| [-high, -low]) }
}

/// An interval whose upper end is "never" has no end.
fn finite_end(value: Value) -> Value {
    Value { ci95: value.ci95.filter(|ci| ci[1].is_finite()), ..value }
}

fn map_result(trials: &[Trial], which: usize) -> MapResult {
    let over = |pick: fn(&super::MapScore) -> Option<f64>| {
        mean(&trials.iter().filter_map(|trial| pick(trial.maps[which].as_ref()?)).collect::<Vec<_>>())
    };
    MapResult {
        iou: over(|score| score.iou),
        precision: over(|score| score.precision),
        recall: over(|score| score.recall),
        free_space_error: over(|score| score.free_space_error),
        free_blocked: over(|score| score.free_blocked),
        free_found: over(|score| score.free_found),
    }
}

fn needs(scenario: &Scenario, trials: &[Trial], sensor: usize) -> Needs {
    let over = |pick: &dyn Fn(&Trial) -> f64| mean(&trials.iter().map(pick).collect::<Vec<_>>());
    let per_s = |count: f64, trial: &Trial| count / trial.sim_s.max(1e-9);
    Needs {
        power_w: over(&|trial| power_w(trial, scenario, sensor)),
        kb_per_s: over(&|trial| bytes_per_s(trial, sensor) / 1e3),
        line_kb_per_s: (sensor == 0).then(|| over(&|trial| per_s(trial.bytes[1] as f64, trial) / 1e3)).flatten(),
        per_s: over(&|trial| per_s(if sensor == 0 { trial.captures } else { trial.pings } as f64, trial)),
    }
}

/// Laser less ultrasonic in every class, and in what is asked of all classes together.
fn differences(scenario: &Scenario, trials: &[Trial], order: &[String]) -> Vec<Difference> {
    let mut out: Vec<Difference> = order
        .iter()
        .map(|class| {
            let share = |trial: &Trial, sensor: usize| {
                let met = encounters(trial, class).iter();
                let (hits, of) = counted(met.flat_map(|e| nominal(e, sensor, &scenario.compare)));
                (of > 0).then(|| hits as f64 / of as f64)
            };
            paired(class, "detection rate", true, trials, &share)
        })
        .collect();
    let errors = |pick: fn(&super::Account) -> f64| {
        move |trial: &Trial, sensor: usize| {
            // Of encounters in which both saw it, each as much as any other: who sees what is hard to see must not lose by it.
            let met = trial.classes.values().flatten().filter(|e| e.by.iter().all(|account| account.errors > 0));
            let squares: Vec<f64> = met.map(|e| pick(&e.by[sensor]) / e.by[sensor].errors as f64).collect();
            (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
        }
    };
    out.push(paired("encounters that both saw", "RMS range error [m]", false, trials, &errors(|a| a.range_m2)));
    out.push(paired("encounters that both saw", "RMS bearing error [rad]", false, trials, &errors(|a| a.bearing_rad2)));
    let false_share = |trial: &Trial, sensor: usize| {
        let all = &trial.reports[sensor];
        (all.reports > 0).then(|| all.false_reports as f64 / all.reports as f64)
    };
    out.push(paired("all reports", "share of false obstacles", false, trials, &false_share));
    let map = |pick: fn(&super::MapScore) -> Option<f64>| {
        move |trial: &Trial, sensor: usize| trial.maps[sensor].as_ref().and_then(pick)
    };
    out.push(paired("map", "IoU", true, trials, &map(|score| score.iou)));
    out.push(paired("map", "free cells that are not", false, trials, &map(|score| score.free_space_error)));
    let corrected = holm(&out.iter().map(|difference| difference.p).collect::<Vec<_>>());
    for (difference, p_holm) in out.iter_mut().zip(corrected) {
        difference.p_holm = p_holm;
        let ahead = difference.difference.map_or(0.0, |d| if difference.more_is_better { d.value } else { -d.value });
        difference.winner = p_holm.filter(|p| *p < ALPHA && ahead != 0.0).map(|_| SENSORS[usize::from(ahead < 0.0)]);
    }
    out
}

fn paired(
    what: &str,
    measure: &'static str,
    more_is_better: bool,
    trials: &[Trial],
    value: &dyn Fn(&Trial, usize) -> Option<f64>,
) -> Difference {
    let both: Vec<[f64; 2]> =
        trials.iter().filter_map(|trial| Some([value(trial, LASER)?, value(trial, ULTRASONIC)?])).collect();
    let pairs: Vec<f64> = both.iter().map(|[laser, ultrasonic]| laser - ultrasonic).collect();
    let (difference, p) = (mean(&pairs), sign_flip(&pairs).filter(|_| pairs.len() > 1));
    let over = |sensor: usize| {
        (!both.is_empty()).then(|| both.iter().map(|pair| pair[sensor]).sum::<f64>() / both.len() as f64)
    };
    let (laser, ultrasonic) = (over(LASER), over(ULTRASONIC));
    Difference {
        what: what.into(),
        measure,
        more_is_better,
        laser,
        ultrasonic,
        difference,
        p,
        p_holm: None,
        winner: None,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::compare::{Account, Reports};

    /// A seed in which a class was met once in two bins, each sensor seeing it in so many of them.
    pub fn trial(seed: u64, seen: [usize; 2]) -> Trial {
        let account = |count: usize| Account {
            seen: (0..count as u32).map(|bin| (bin + 2, 3)).collect(),
            first_m: (count > 0).then_some(1.2),
            first_s: (count > 0).then_some(2.0),
            range_m2: 4e-4 * count as f64,
            bearing_rad2: 0.01 * count as f64,
            errors: count as u64,
            reports: 4,
            false_reports: 1,
        };
        let encounter = Encounter {
            target: "a".into(),
            from_s: 0.0,
            seconds: 4.0,
            bins: [(2, 2.0), (3, 1.9), (4, 0.1)].into(),
            by: seen.map(account),
        };
        let reports = Reports { reports: 10, false_reports: 1, seconds: 5, false_seconds: 1 };
        Trial {
            seed,
            sim_s: 10.0,
            travel_m: 3.0,
            collisions: 0,
            captures: 60,
            pings: 150,
            bytes: [1000, 100, 1950],
            refused: [0; 2],
            targets: 1,
            classes: [("box".to_string(), vec![encounter])].into(),
            reports: [reports.clone(), reports],
            maps: Default::default(),
            shown: None,
        }
    }

    pub fn scenario() -> Scenario {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("empty.toml");
        std::fs::write(&path, "name = 'empty'\n[world]\nground = true\n").unwrap();
        Scenario::load(&path, &[]).unwrap()
    }

    #[test]
    fn rates_are_over_bins_that_lasted_and_winners_are_more_than_chance() {
        let trials: Vec<Trial> = (0..12).map(|seed| trial(seed, [2, 1])).collect();
        let found = sum_up(&scenario(), "f", Sensors::BOTH, &trials).unwrap();
        let laser = &found.classes["box"]["laser"];
        let sound = &found.classes["box"]["ultrasonic"];
        assert_eq!((laser.opportunities, laser.detected, sound.detected), (24, 24, 12));
        assert_eq!((laser.rate, sound.rate), (Some(1.0), Some(0.5)));
        assert_eq!(found.either["box"].unwrap().hits, 24);
        assert_eq!(sound.by_distance.len(), 2);
        assert_eq!((sound.by_distance[0].rate.rate, sound.by_distance[1].rate.rate), (1.0, 0.0));
        assert!((laser.range_rmse_m.unwrap().value - 0.02).abs() < 1e-12);
        assert!((laser.bearing_rmse_rad.unwrap().value - 0.1).abs() < 1e-12);
        assert_eq!(laser.first_detection_m.unwrap().value, 1.2);
        assert_eq!(found.differences[0].winner, Some("laser"));
        // Nothing differs in the errors: no winner; the maps were not measured.
        assert!(found.differences[1..].iter().all(|d| d.winner.is_none()));
        assert_eq!(found.differences.iter().find(|d| d.measure == "IoU").unwrap().p, None);
        assert!((found.needs["ultrasonic"].kb_per_s.unwrap().value - 0.195).abs() < 1e-12);
    }

    #[test]
    fn what_never_could_happen_is_not_measured() {
        let mut empty = trial(0, [0, 0]);
        empty.classes.clear();
        empty.reports = Default::default();
        let found = sum_up(&scenario(), "f", Sensors::BOTH, &[empty]).unwrap();
        assert!(found.classes.is_empty() && found.differences.iter().all(|d| d.p.is_none()));
        assert_eq!(found.false_obstacles["laser"].of_reports, None);
        let json = serde_json::to_value(&found).unwrap();
        assert!(json["false_obstacles"]["laser"]["of_reports"].is_null());
        assert!(sum_up(&scenario(), "f", Sensors::BOTH, &[]).is_err());
    }

    #[test]
    fn a_class_that_was_mostly_missed_has_no_first_detection() {
        let mut trials: Vec<Trial> = (0..5).map(|seed| trial(seed, [0, 2])).collect();
        trials[0] = trial(0, [1, 2]);
        let found = sum_up(&scenario(), "f", Sensors::BOTH, &trials).unwrap();
        let laser = &found.classes["box"]["laser"];
        assert_eq!((laser.first_detection_m, laser.first_detection_s), (None, None));
        assert_eq!(laser.encounters.unwrap().hits, 1);
        // Five seeds cannot show a difference: 2 of 32 is the least probability there is.
        assert!(found.differences[0].p.unwrap() >= 2.0 / 32.0 && found.differences[0].winner.is_none());
    }
}
