//! Intervals and tests over seeds. What happens within one seed hangs together, so a seed counts as one draw of a cluster.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// Draws of a bootstrap.
const DRAWS: usize = 2000;
/// Fewest seeds that are drawn from.
const BOOTSTRAP_MIN: usize = 5;
/// Draws of the test by flipped signs, where there are too many to try them all.
const FLIPS: usize = 20_000;
/// Up to so many seeds all flips are tried.
const SEEDS_TRIED_ALL: usize = 14;
/// Every interval's draws start here: the same numbers give the same interval.
const SEED: u64 = 0x636f_6d70;

/// A rate with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// How often it happened.
    pub hits: u64,
    /// How often it could have.
    pub of: u64,
    /// Their ratio.
    pub rate: f64,
    /// 95 % interval; `None` with a single seed.
    pub ci95: Option<[f64; 2]>,
}

/// A quantity with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Value {
    /// The value over all seeds.
    pub value: f64,
    /// 95 % interval; `None` with a single seed.
    pub ci95: Option<[f64; 2]>,
}

/// A rate from (hits, of) of each seed; `None` where it never could have happened.
///
/// Wilson's interval for as many independent tries as the spread between seeds says there were (the ratio estimator's
/// variance over clusters against the binomial one), never more than there were; where all or none were hits, that spread
/// says nothing and each seed counts as one try. Student's quantile for the number of seeds.
pub fn rate(seeds: &[(u64, u64)]) -> Option<Rate> {
    let seeds: Vec<(f64, f64)> = seeds.iter().filter(|s| s.1 > 0).map(|s| (s.0 as f64, s.1 as f64)).collect();
    let (hits, of) = seeds.iter().fold((0.0, 0.0), |sum, s| (sum.0 + s.0, sum.1 + s.1));
    if of == 0.0 {
        return None;
    }
    // Seeds that had more tries weigh more: so many equal ones would say as much (Kish).
    let (p, clusters) = (hits / of, seeds.len() as f64);
    let equal = of * of / seeds.iter().map(|s| s.1 * s.1).sum::<f64>();
    let tries = if p == 0.0 || p == 1.0 {
        equal
    } else {
        let spread: f64 = seeds.iter().map(|s| (s.0 - p * s.1).powi(2)).sum();
        let variance = spread * clusters / (clusters - 1.0).max(1.0) / (of * of);
        (p * (1.0 - p) / variance).clamp(equal.min(of), of)
    };
    let ci95 = (seeds.len() > 1).then(|| {
        let t = student(seeds.len() - 1);
        let t2 = t * t / tries;
        let middle = (p + t2 / 2.0) / (1.0 + t2);
        let half = t / (1.0 + t2) * (p * (1.0 - p) / tries + t2 / (4.0 * tries)).sqrt();
        // Rounding leaves no end beside 0 or 1.
        [
            if hits == 0.0 { 0.0 } else { (middle - half).max(0.0) },
            if hits == of { 1.0 } else { (middle + half).min(1.0) },
        ]
    });
    Some(Rate { hits: hits as u64, of: of as u64, rate: p, ci95 })
}

/// A statistic of what all seeds gave, with the percentiles of its bootstrap over seeds. `None` where there is nothing to
/// make it of.
pub fn bootstrap<T>(seeds: &[T], statistic: impl Fn(&[&T]) -> Option<f64>) -> Option<Value> {
    let all: Vec<&T> = seeds.iter().collect();
    let value = statistic(&all)?;
    // The percentiles of fewer are little else than the least and the greatest.
    if seeds.len() < BOOTSTRAP_MIN {
        return Some(Value { value, ci95: None });
    }
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut draws: Vec<f64> = (0..DRAWS)
        .filter_map(|_| {
            let drawn: Vec<&T> = seeds.iter().map(|_| &seeds[rng.random_range(0..seeds.len())]).collect();
            statistic(&drawn)
        })
        .collect();
    draws.sort_by(f64::total_cmp);
    let at = |share: f64| draws.get(((draws.len() as f64 - 1.0).max(0.0) * share).round() as usize).copied();
    Some(Value { value, ci95: at(0.025).zip(at(0.975)).map(|(low, high)| [low, high]) })
}

/// Root mean square of seeds that each gave (sum of squares, count).
pub fn rms(seeds: &[(f64, u64)]) -> Option<Value> {
    let seeds: Vec<(f64, u64)> = seeds.iter().filter(|s| s.1 > 0).copied().collect();
    bootstrap(&seeds, |drawn| {
        let (sum, count) = drawn.iter().fold((0.0, 0), |all, s| (all.0 + s.0, all.1 + s.1));
        (count > 0).then(|| (sum / count as f64).sqrt())
    })
}

/// Mean over seeds.
pub fn mean(seeds: &[f64]) -> Option<Value> {
    bootstrap(seeds, |drawn| (!drawn.is_empty()).then(|| drawn.iter().copied().sum::<f64>() / drawn.len() as f64))
}

/// Median of all numbers of all seeds; the lower one of two middles.
pub fn median(seeds: &[Vec<f64>]) -> Option<Value> {
    let seeds: Vec<&Vec<f64>> = seeds.iter().filter(|numbers| !numbers.is_empty()).collect();
    bootstrap(&seeds, |drawn| {
        let mut numbers: Vec<f64> = drawn.iter().flat_map(|numbers| numbers.iter().copied()).collect();
        numbers.sort_by(f64::total_cmp);
        numbers.get(numbers.len().saturating_sub(1) / 2).copied()
    })
}

/// Probability that differences as far from 0 on average would come about if their signs were chance: two-sided, exact up to
/// 14 seeds, by 20 000 draws beyond. `None` without differences.
pub fn sign_flip(differences: &[f64]) -> Option<f64> {
    let n = differences.len();
    if n == 0 {
        return None;
    }
    let found = differences.iter().sum::<f64>().abs() - 1e-12;
    let sum = |flips: &dyn Fn(usize) -> bool| {
        differences.iter().enumerate().map(|(i, d)| if flips(i) { -d } else { *d }).sum::<f64>().abs()
    };
    if n <= SEEDS_TRIED_ALL {
        let count = (0..1u32 << n).filter(|bits| sum(&|i| bits >> i & 1 == 1) >= found).count();
        return Some(count as f64 / f64::from(1u32 << n));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut count = 1;
    for _ in 0..FLIPS {
        let flips: Vec<bool> = (0..n).map(|_| rng.random()).collect();
        count += usize::from(sum(&|i| flips[i]) >= found);
    }
    Some(count as f64 / (FLIPS + 1) as f64)
}

/// Holm's correction for that many tests were made: what to hold against 0.05, in the order given.
pub fn holm(p: &[Option<f64>]) -> Vec<Option<f64>> {
    let mut order: Vec<(usize, f64)> = p.iter().enumerate().filter_map(|(i, p)| Some((i, (*p)?))).collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    let mut out = vec![None; p.len()];
    let mut least = 0.0_f64;
    for (rank, (i, p)) in order.iter().enumerate() {
        least = least.max((p * (order.len() - rank) as f64).min(1.0));
        out[*i] = Some(least);
    }
    out
}

/// The 97.5 % quantile of Student's distribution: Cornish and Fisher's expansion, right to 1 % from 3 degrees of freedom on.
fn student(freedom: usize) -> f64 {
    match freedom {
        0 | 1 => 12.706,
        2 => 4.303,
        _ => {
            let (z, n) = (1.959_964_f64, freedom as f64);
            z + (z.powi(3) + z) / (4.0 * n)
                + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * n * n)
                + (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / (384.0 * n.powi(3))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_tries_there_is_no_rate() {
        assert_eq!((rate(&[]), rate(&[(0, 0), (0, 0)])), (None, None));
        assert_eq!((rms(&[]), median(&[vec![]]), sign_flip(&[]), mean(&[])), (None, None, None, None));
        assert_eq!(rate(&[(1, 2)]).unwrap().ci95, None);
    }

    #[test]
    fn students_quantiles_are_those_of_the_tables() {
        for (freedom, expected) in [(1, 12.706), (3, 3.182), (5, 2.571), (9, 2.262), (19, 2.093), (120, 1.980)] {
            assert!((student(freedom) / expected - 1.0).abs() < 0.01, "{freedom}: {}", student(freedom));
        }
    }

    #[test]
    fn all_hits_of_twenty_seeds_leave_the_room_that_twenty_tries_leave() {
        // Wilson for 20 of 20 at t = 2.093: 1/(1 + t²/20).
        let found = rate(&[(4, 4); 20]).unwrap();
        let ci = found.ci95.unwrap();
        assert!((ci[0] - 1.0 / (1.0 + 2.093_f64.powi(2) / 20.0)).abs() < 1e-3 && ci[1] == 1.0, "{ci:?}");
    }

    /// How often the interval of `seeds` clusters holds the truth, where each cluster has a rate of its own.
    fn coverage(seeds: usize, tries: u64, p: f64, spread: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let runs = 1500;
        let mut held = 0;
        for _ in 0..runs {
            let clusters: Vec<(u64, u64)> = (0..seeds)
                .map(|_| {
                    let own = p + if rng.random::<bool>() { spread } else { -spread };
                    ((0..tries).filter(|_| rng.random::<f64>() < own).count() as u64, tries)
                })
                .collect();
            let ci = rate(&clusters).unwrap().ci95.unwrap();
            held += usize::from((ci[0]..=ci[1]).contains(&p));
        }
        held as f64 / runs as f64
    }

    #[test]
    fn intervals_hold_the_truth_as_often_as_they_say() {
        // Independent tries, clusters that differ, clusters that are all or nothing; few seeds and many.
        for (seeds, tries, p, spread) in [
            (20, 5, 0.5, 0.0),
            (20, 5, 0.8, 0.15),
            (20, 4, 0.5, 0.5),
            (6, 5, 0.5, 0.2),
            (20, 3, 0.95, 0.05),
            (10, 8, 0.2, 0.2),
        ] {
            let held = coverage(seeds, tries, p, spread);
            assert!((0.925..=0.998).contains(&held), "{seeds} x {tries} at {p} ± {spread}: {held}");
        }
    }

    #[test]
    fn a_bootstrap_of_the_median_holds_the_truth() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let held = (0..150)
            .filter(|_| {
                let seeds: Vec<Vec<f64>> = (0..20).map(|_| (0..3).map(|_| rng.random::<f64>()).collect()).collect();
                let ci = median(&seeds).unwrap().ci95.unwrap();
                (ci[0]..=ci[1]).contains(&0.5)
            })
            .count();
        assert!((133..=149).contains(&held), "{held}");
    }

    #[test]
    fn flipped_signs_tell_a_difference_from_chance() {
        assert_eq!(sign_flip(&[0.5; 5]), Some(2.0 / 32.0));
        assert_eq!(sign_flip(&[0.0; 5]), Some(1.0));
        assert!(sign_flip(&[0.5; 20]).unwrap() < 1e-4);
        let even: Vec<f64> = (0..20).map(|i| if i % 2 == 0 { 0.3 } else { -0.3 }).collect();
        assert!(sign_flip(&even).unwrap() > 0.9);
    }

    #[test]
    fn holm_corrects_the_smallest_most() {
        let found = holm(&[Some(0.01), None, Some(0.04), Some(0.03)]);
        assert_eq!(found, [Some(0.03), None, Some(0.06), Some(0.06)]);
        assert_eq!(holm(&[Some(0.6), Some(0.7)]), [Some(1.0), Some(1.0)]);
    }
}
