//! Recorded readings of a real ring against those that the ring's model gives in a like room.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use serde::Serialize;

use super::along::Round;
use crate::fault::{Result, number_within};
use crate::sonar::{JUMP_M, RangeStatistics};
use crate::sources::Scenario;
use crate::sources::range_table::RangeTable;

/// Rates that are this factor apart at most are called alike.
const FACTOR: f64 = 2.0;

/// What was recorded, and where the ring's model is to read the same.
pub struct Recorded {
    file: String,
    world_file: String,
    world: String,
    about: Vec<String>,
    row_s: f64,
    real: RangeStatistics,
    round: Round,
}

/// Both sets of readings.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Readings {
    /// The table that was read.
    pub file: String,
    /// The file of the simulation's world.
    pub world_file: String,
    /// Its name.
    pub world: String,
    /// What its file says of itself: the comment at its head, paragraph by paragraph.
    pub about: Vec<String>,
    /// Time that the simulated ring takes for a row [s].
    pub row_s: f64,
    /// What was recorded.
    pub real: RangeStatistics,
    /// What the model reads.
    pub simulated: RangeStatistics,
    /// Their rates beside each other.
    pub rates: Rates,
}

/// How often there is no reading, and how often it jumps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rates {
    /// Readings at the limit, of all.
    pub dropout: RatePair,
    /// Steps of more than 1 m from a row to the next, of all.
    pub jump: RatePair,
}

/// A rate of both; `None`: not measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RatePair {
    /// Of what was recorded.
    pub real: Option<f64>,
    /// Of what the model reads.
    pub simulated: Option<f64>,
    /// The model's over the recorded one; `None` also where nothing of the kind was recorded.
    pub ratio: Option<f64>,
    /// Whether they are within a factor of 2.
    pub within_factor_2: Option<bool>,
}

impl Recorded {
    /// Reads the table (`file`) and the scenario (`world`) whose ring is held against it. Ranges of `limit_m` and more, and
    /// no echo, count as drop-outs.
    ///
    /// # Errors
    /// A table or a scenario that is wrong; a limit that is none.
    pub fn load(file: &Path, world: &Path, limit_m: f64, model_path: &[std::path::PathBuf]) -> Result<Self> {
        number_within("--readings-limit", limit_m, 0.1, 100.0)?;
        let scenario = Scenario::load(world, model_path)?;
        let round = Round::new(&scenario).map_err(|fault| fault.in_file(world))?;
        let ring = scenario.sonar.unwrap_or_default();
        let mut real = RangeStatistics::new(limit_m);
        real.add_run(&RangeTable::load(file, ring.count)?.rows());
        Ok(Self {
            file: file.display().to_string(),
            world_file: world.display().to_string(),
            world: scenario.name,
            about: head_comment(&scenario.text),
            row_s: ring.ring_s(),
            real,
            round,
        })
    }

    /// The name of the simulation's world.
    pub fn world(&self) -> &str {
        &self.world
    }

    /// Carries the ring's model through its world; `None` if `stop` ended it. `progress` hears of thousandths.
    ///
    /// # Errors
    /// What the ring cannot do.
    pub fn compare(
        self,
        threads: usize,
        stop: &AtomicBool,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Option<Readings>> {
        let Some(runs) = self.round.read(threads, stop, progress)? else { return Ok(None) };
        let mut simulated = RangeStatistics::new(self.real.limit_m);
        for rows in &runs {
            simulated.add_run(rows);
        }
        let Self { file, world_file, world, about, row_s, real, .. } = self;
        let rates = Rates {
            dropout: RatePair::new(real.dropout_rate(), simulated.dropout_rate()),
            jump: RatePair::new(real.jump_rate(), simulated.jump_rate()),
        };
        Ok(Some(Readings { file, world_file, world, about, row_s, real, simulated, rates }))
    }
}

impl RatePair {
    fn new(real: Option<f64>, simulated: Option<f64>) -> Self {
        let ratio = real.zip(simulated).filter(|(real, _)| *real > 0.0).map(|(real, simulated)| simulated / real);
        let within_factor_2 = ratio.map(|ratio| (1.0 / FACTOR..=FACTOR).contains(&ratio));
        Self { real, simulated, ratio, within_factor_2 }
    }

    fn in_words(&self, what: &str) -> String {
        let percent = |rate: Option<f64>| rate.map_or("not measured".into(), |rate| format!("{:.1} %", 100.0 * rate));
        let verdict = match self.within_factor_2 {
            Some(true) => "within a factor of 2",
            Some(false) => "more than a factor of 2 apart",
            None => "no ratio to state",
        };
        format!("{what}: real ring {}, model {}: {verdict}.", percent(self.real), percent(self.simulated))
    }
}

impl Readings {
    /// The rates in words, a sentence each.
    pub fn sentences(&self) -> [String; 2] {
        [
            self.rates.dropout.in_words(&format!("Ranges at the limit of {} m", self.real.limit_m)),
            self.rates.jump.in_words(&format!("Steps of more than {JUMP_M} m")),
        ]
    }
}

/// The comment at the head of a file: paragraphs end at an empty line, and points (`- `) are paragraphs.
fn head_comment(text: &str) -> Vec<String> {
    let mut out: Vec<String> = Vec::new();
    let mut ended = true;
    for line in text.lines().map_while(|line| line.strip_prefix('#')).map(str::trim) {
        if line.is_empty() {
            ended = true;
            continue;
        }
        match out.last_mut().filter(|_| !ended && !line.starts_with("- ")) {
            Some(paragraph) => *paragraph += &format!(" {line}"),
            None => out.push(line.into()),
        }
        ended = false;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOT: &str = env!("CARGO_MANIFEST_DIR");

    #[test]
    fn a_robot_along_the_walls_of_a_room_reads_what_a_real_one_read() {
        let world = Path::new(ROOT).join("worlds/sonar_room.toml");
        let file = Path::new(ROOT).join("../shared/data/sonar_ring/sensor_readings_24.data");
        if !file.exists() {
            eprintln!("skipped: ../shared/data is absent");
            return;
        }
        let recorded = Recorded::load(&file, &world, 5.0, &[]).unwrap();
        let begun = std::time::Instant::now();
        let found = recorded.compare(2, &AtomicBool::new(false), &|_| {}).unwrap().unwrap();
        let (seconds, readings) = (begun.elapsed().as_secs_f64(), found.simulated.readings);
        eprintln!("{readings} readings simulated in {seconds:.1} s\n{}", found.sentences().join("\n"));
        let Rates { dropout, jump } = found.rates;
        assert_eq!((found.real.readings, found.real.steps), (5456 * 24, 5455 * 24));
        assert!((dropout.real.unwrap() - 0.1384).abs() < 1e-4 && (jump.real.unwrap() - 0.0598).abs() < 1e-4);
        assert_eq!((dropout.within_factor_2, jump.within_factor_2), (Some(true), Some(true)), "{:?}", found.rates);
        assert!(found.about.iter().any(|paragraph| paragraph.contains("not a prediction")), "{:?}", found.about);
    }

    #[test]
    fn rates_are_alike_within_a_factor_of_two() {
        let within = |real, simulated| RatePair::new(real, simulated).within_factor_2;
        assert_eq!([0.05, 0.1, 0.4, 0.41].map(|s| within(Some(0.2), Some(s))), [false, true, true, false].map(Some));
        assert_eq!(
            (within(Some(0.0), Some(0.1)), within(None, Some(0.1)), within(Some(0.1), None)),
            (None, None, None)
        );
        let words = RatePair::new(Some(0.2), Some(0.5)).in_words("Ranges");
        assert_eq!(words, "Ranges: real ring 20.0 %, model 50.0 %: more than a factor of 2 apart.");
    }

    #[test]
    fn a_file_says_of_itself_what_stands_at_its_head() {
        let text = "# A room\n# with walls.\n#\n# So:\n# - one,\n#   and on\n# - two\nname = 'x'\n# not this\n";
        assert_eq!(head_comment(text), ["A room with walls.", "So:", "- one, and on", "- two"]);
        assert!(head_comment("name = 'x'\n# y\n").is_empty());
    }

    #[test]
    fn what_cannot_be_held_against_each_other_is_refused() {
        let fault = |limit| Recorded::load(Path::new("a"), Path::new("b"), limit, &[]).err().unwrap().to_string();
        assert_eq!(fault(0.0), "--readings-limit: found 0, expected a number from 0.1 to 100");
        assert!(fault(f64::NAN).starts_with("--readings-limit: found NaN"));
        let world = Path::new(ROOT).join("worlds/corridor.toml");
        let fault = Recorded::load(Path::new("a"), &world, 5.0, &[]).err().unwrap().to_string();
        assert!(
            fault.contains("corridor.toml: sonar: found nothing") || fault.contains("corridor.toml: mission"),
            "{fault}"
        );
    }
}
