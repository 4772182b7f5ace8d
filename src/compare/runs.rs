//! Many seeds on many threads, each finished one in a file of its own: what was stopped goes on where it was.
//!
//! Whatever the threads and however often it was stopped, the results are read back from the same files in the order of
//! their seeds, so they have the same bits.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::trial::{Sensors, Trial, run};
use crate::fault::{Fault, Result};
use crate::sources::Scenario;

/// Longest file of a seed that is read.
const FILE_BYTES_MAX: u64 = 256 << 20;
/// Most seeds of a comparison.
pub const SEEDS_MAX: u64 = 10_000;

/// A seed's file: what it belongs to, what it holds, and its check.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    fingerprint: String,
    digest: String,
    trial: String,
}

/// What to run.
#[derive(Clone, Copy, Debug)]
pub struct Plan<'a> {
    /// The scenario.
    pub scenario: &'a Scenario,
    /// What the scenario is: [`fingerprint`].
    pub fingerprint: &'a str,
    /// Number of seeds, counted up from the scenario's own.
    pub seeds: u64,
    /// Which sensors.
    pub sensors: Sensors,
    /// Threads at work.
    pub threads: usize,
    /// Where the seeds' files are.
    pub dir: &'a Path,
}

/// What became of a plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// All trials in the order of their seeds; empty if it was stopped.
    pub trials: Vec<Trial>,
    /// Seeds whose files were there already.
    pub kept: u64,
    /// Files that were damaged or of another scenario or version: done again.
    pub redone: Vec<String>,
    /// Seeds that are done.
    pub done: u64,
}

/// What a comparison depends on, as SHA-256: the scenario's text, its files as they were read, the sensors, and the program
/// itself: results of two builds are never mixed.
pub fn fingerprint(scenario: &Scenario, sensors: Sensors) -> String {
    let mut hasher = Sha256::new();
    // Debug prints every number in full: meshes, rigs and worlds beside the scenario count as its own text does.
    let parts = format!("{} {scenario:?} {sensors:?}", env!("CARGO_PKG_VERSION"));
    hasher.update(parts.as_bytes());
    // Where the program cannot be read, its version has to do.
    if let Some(program) = std::env::current_exe().ok().and_then(|path| std::fs::read(path).ok()) {
        hasher.update(&program);
    }
    hex(hasher)
}

fn hex(hasher: Sha256) -> String {
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn digest(text: &str) -> String {
    let mut hasher = Sha256::new();
    hasher.update(text.as_bytes());
    hex(hasher)
}

fn file_of(dir: &Path, seed: u64) -> PathBuf {
    dir.join(format!("seed_{seed}.json"))
}

/// The trial in a file; why not, if it cannot be used.
fn stored(path: &Path, plan: &Plan, seed: u64) -> Result<Trial> {
    let bad = |found: String, expected: &str| Fault::new("result of a seed", found, expected).in_file(path);
    let size = std::fs::metadata(path).map_err(|e| Fault::io(path, &e))?.len();
    if size > FILE_BYTES_MAX {
        return Err(bad(format!("{size} bytes"), "fewer"));
    }
    let text = std::fs::read_to_string(path).map_err(|e| Fault::io(path, &e))?;
    let file: Stored = serde_json::from_str(&text).map_err(|e| bad(e.to_string(), "what this program wrote"))?;
    if file.fingerprint != plan.fingerprint {
        return Err(bad("another scenario, sensors or version".into(), "this one's"));
    }
    if digest(&file.trial) != file.digest {
        return Err(bad("damage".into(), "what was written"));
    }
    let trial: Trial = serde_json::from_str(&file.trial).map_err(|e| bad(e.to_string(), "what this program wrote"))?;
    if trial.seed == seed { Ok(trial) } else { Err(bad(format!("seed {}", trial.seed), "its own seed")) }
}

/// Writes a file whole or not at all.
///
/// # Errors
/// What the disk refuses.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let beside = path.with_extension("part");
    let write = || -> std::io::Result<()> {
        let mut file = std::fs::File::create(&beside)?;
        std::io::Write::write_all(&mut file, bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    };
    write().map_err(|e| Fault::io(path, &e))
}

fn store(plan: &Plan, trial: &Trial) -> Result<()> {
    let named = |e: serde_json::Error| Fault::new("result of a seed", e, "numbers that JSON can hold");
    let text = serde_json::to_string(trial).map_err(named)?;
    let file = Stored { fingerprint: plan.fingerprint.into(), digest: digest(&text), trial: text };
    let text = serde_json::to_string(&file).map_err(named)?;
    write_whole(&file_of(plan.dir, trial.seed), text.as_bytes())
}

/// Runs all seeds that are not done yet. `progress` hears how many thousandths of the whole are done; `stop` ends it, with
/// the seeds under way lost and all finished ones kept.
///
/// # Errors
/// No seeds or too many; the first fault of any seed; a directory that cannot be written.
pub fn run_all(plan: &Plan, stop: &AtomicBool, progress: &(dyn Fn(u64) + Sync)) -> Result<Outcome> {
    if !(1..=SEEDS_MAX).contains(&plan.seeds) {
        return Err(Fault::new("--seeds", plan.seeds, format!("1 to {SEEDS_MAX}")));
    }
    std::fs::create_dir_all(plan.dir).map_err(|e| Fault::io(plan.dir, &e))?;
    let first = plan.scenario.seed;
    let seeds: Vec<u64> = (0..plan.seeds).map(|k| first.wrapping_add(k)).collect();
    let mut outcome = Outcome::default();
    let mut todo = Vec::new();
    for &seed in &seeds {
        let path = file_of(plan.dir, seed);
        match path.exists().then(|| stored(&path, plan, seed)) {
            Some(Ok(_)) => outcome.kept += 1,
            Some(Err(fault)) => {
                outcome.redone.push(fault.to_string());
                todo.push(seed);
            }
            None => todo.push(seed),
        }
    }
    let part: Vec<AtomicU64> = todo.iter().map(|_| AtomicU64::new(0)).collect();
    let (next, failed) = (AtomicUsize::new(0), Mutex::new(None::<(u64, Fault)>));
    let halted = AtomicBool::new(false);
    let ends = || stop.load(Ordering::SeqCst) || halted.load(Ordering::SeqCst);
    let work = || {
        loop {
            let index = next.fetch_add(1, Ordering::SeqCst);
            let Some(&seed) = todo.get(index).filter(|_| !ends()) else { return };
            let go_on = |thousandths: u64| {
                part[index].store(thousandths, Ordering::Relaxed);
                let done = part.iter().map(|p| p.load(Ordering::Relaxed)).sum::<u64>();
                progress((outcome.kept * 1000 + done) / plan.seeds);
                !ends()
            };
            let result = run(plan.scenario, seed, plan.sensors, seed == first, &go_on);
            let result = result.and_then(|trial| trial.map_or(Ok(()), |trial| store(plan, &trial)));
            part[index].store(1000, Ordering::Relaxed);
            if let Err(fault) = result {
                halted.store(true, Ordering::SeqCst);
                if let Ok(mut failed) = failed.lock() {
                    failed.get_or_insert((seed, fault));
                }
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..plan.threads.clamp(1, todo.len().max(1)) {
            scope.spawn(work);
        }
    });
    if let Some((seed, fault)) = failed.into_inner().unwrap_or(None) {
        return Err(Fault { what: format!("seed {seed}: {}", fault.what), ..fault });
    }
    let trials: Result<Vec<Trial>> = seeds.iter().map(|seed| stored(&file_of(plan.dir, *seed), plan, *seed)).collect();
    match trials {
        Ok(trials) => outcome.trials = trials,
        Err(fault) if !stop.load(Ordering::SeqCst) => return Err(fault),
        Err(_) => {}
    }
    outcome.done = seeds.iter().filter(|seed| stored(&file_of(plan.dir, **seed), plan, **seed).is_ok()).count() as u64;
    Ok(outcome)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario(dir: &Path, duration_s: f64) -> Scenario {
        let path = dir.join("small.toml");
        let text = format!(
            "name = 'small'\nseed = 3\nduration_s = {duration_s}\n[world]\nground = true\n[[world.cylinder]]\nname = 'bin'\n\
             position = [2.0, 0.0]\nradius = 0.15\nheight = 0.5\n[robot]\nstart = {{ x_m = 0, y_m = 0, yaw_deg = 0 }}\n[sonar]\n\
             [[mission]]\ngo_to = [1.0, 0.0]\nspeed_m_s = 0.3\n"
        );
        std::fs::write(&path, text).unwrap();
        Scenario::load(&path, &[]).unwrap()
    }

    fn plan<'a>(scenario: &'a Scenario, fingerprint: &'a str, dir: &'a Path, threads: usize) -> Plan<'a> {
        Plan { scenario, fingerprint, seeds: 3, sensors: Sensors::BOTH, threads, dir }
    }

    fn all(plan: &Plan) -> Outcome {
        run_all(plan, &AtomicBool::new(false), &|_| {}).unwrap()
    }

    fn files(dir: &Path) -> Vec<String> {
        (3..6).map(|seed| std::fs::read_to_string(file_of(dir, seed)).unwrap()).collect()
    }

    #[test]
    fn what_was_stopped_goes_on_and_ends_with_the_same_bits() {
        let home = tempfile::tempdir().unwrap();
        let scenario = scenario(home.path(), 1.0);
        let print = fingerprint(&scenario, Sensors::BOTH);
        let [once, twice] = ["once", "twice"].map(|name| home.path().join(name));
        let undisturbed = all(&plan(&scenario, &print, &once, 2));
        assert_eq!((undisturbed.trials.len(), undisturbed.kept, undisturbed.done), (3, 0, 3));
        assert!(undisturbed.trials.iter().all(|trial| trial.captures > 0 && trial.pings > 10));
        assert_ne!(undisturbed.trials[0].classes, undisturbed.trials[1].classes);

        // Stopped in the middle of the second seed.
        let stop = AtomicBool::new(false);
        let halfway = |thousandths: u64| stop.store(thousandths > 400, Ordering::SeqCst);
        let stopped = run_all(&plan(&scenario, &print, &twice, 1), &stop, &halfway).unwrap();
        assert!(stopped.trials.is_empty() && stopped.done < 3, "{stopped:?}");
        let resumed = all(&plan(&scenario, &print, &twice, 1));
        assert_eq!((resumed.kept, &resumed.trials), (stopped.done, &undisturbed.trials));
        assert_eq!(files(&once), files(&twice));

        // A cut file, one that was changed, one of another scenario: told, and done again.
        let whole = files(&twice);
        std::fs::write(file_of(&twice, 3), &whole[0][..whole[0].len() / 2]).unwrap();
        std::fs::write(file_of(&twice, 4), whole[1].replacen("captures", "Captures", 1)).unwrap();
        std::fs::write(file_of(&twice, 5), whole[2].replacen(&print[..8], "00000000", 1)).unwrap();
        let mended = all(&plan(&scenario, &print, &twice, 2));
        assert_eq!((mended.redone.len(), mended.kept), (3, 0));
        assert_eq!((files(&twice), mended.trials), (whole, undisturbed.trials));
    }

    #[test]
    fn another_scenario_version_or_sensor_has_another_fingerprint() {
        let home = tempfile::tempdir().unwrap();
        let (one, two) = (scenario(home.path(), 1.0), scenario(home.path(), 2.0));
        let laser = Sensors { laser: true, ultrasonic: false };
        let prints = [(&one, Sensors::BOTH), (&two, Sensors::BOTH), (&one, laser)].map(|(s, w)| fingerprint(s, w));
        assert!(prints[0] != prints[1] && prints[0] != prints[2]);
        assert_eq!(prints[0], fingerprint(&one, Sensors::BOTH));
    }

    #[test]
    fn no_seeds_and_no_sensors_are_refused() {
        let home = tempfile::tempdir().unwrap();
        let scenario = scenario(home.path(), 1.0);
        let none = Plan { seeds: 0, ..plan(&scenario, "", home.path(), 1) };
        let fault = run_all(&none, &AtomicBool::new(false), &|_| {}).unwrap_err().to_string();
        assert_eq!(fault, "--seeds: found 0, expected 1 to 10000");
        let blind =
            Plan { sensors: Sensors { laser: false, ultrasonic: false }, ..plan(&scenario, "", home.path(), 1) };
        let fault = run_all(&blind, &AtomicBool::new(false), &|_| {}).unwrap_err().to_string();
        assert!(fault.starts_with("seed 3: sensors: found none"), "{fault}");
    }
}
