//! The receiver: echoes as overlapping pulses, and where their sum first passes the threshold.

use nalgebra::Complex;

use super::beam::Share;
use super::transducer::Transducer;

/// An echo as the receiver gets it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pulse {
    /// When it begins, after the start of the receiver's own ping [s].
    pub start_s: f64,
    /// Amplitude and phase at the receiver.
    pub amplitude: Complex<f64>,
}

/// Parts of an echo that are nearer in way than this come at once [m].
const AT_ONCE_M: f64 = 5e-4;

/// The pulses of an echo that begins `start_s` after the start of the receiver's ping, and how long its way is. Air and the
/// phase of the way come on top of its share.
pub(super) fn pulses(it: &Transducer, share: &Share, way_m: f64, start_s: f64) -> impl Iterator<Item = Pulse> {
    let carrier = Complex::from_polar(it.air_leaves(way_m), -it.wave_number * way_m);
    let apart_s = share.apart_m / it.sound_m_s;
    let parts =
        if share.apart_m < AT_ONCE_M { [Complex::default(), share.total(), Complex::default()] } else { share.parts };
    let steps = [-apart_s, 0.0, apart_s].into_iter().zip(parts).filter(|(_, part)| part.norm_sqr() > 0.0);
    steps.map(move |(step_s, part)| Pulse { start_s: start_s + step_s, amplitude: part * carrier })
}

/// Where the threshold was passed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Crossing {
    pub time_s: f64,
    /// Which pulse was the strongest then.
    pub pulse: usize,
}

/// All crossings, the first one first. `pulses` are in the order of their beginnings.
pub(super) fn crossings(it: &Transducer, pulses: &[Pulse]) -> Vec<Crossing> {
    let dead_s = 2.0 * it.params.separation_m / it.sound_m_s;
    let mut out = Vec::new();
    let mut time_s = it.params.blanking_s;
    // The receiver begins to hear in the middle of an echo; later it must fall silent first.
    let mut armed = true;
    while let Some(crossing) = next(it, pulses, time_s, armed) {
        out.push(crossing);
        time_s = crossing.time_s + dead_s.max(it.echo_s() / 100.0);
        armed = false;
    }
    out
}

/// The first time from `from_s` on at which the sum passes the threshold upwards; if `armed`, also if it is above it then.
fn next(it: &Transducer, pulses: &[Pulse], from_s: f64, armed: bool) -> Option<Crossing> {
    let step_s = it.params.rise_cycles.min(it.params.cycles) / it.params.frequency_hz / 6.0;
    let (long_s, last_s) = (it.echo_s(), it.last_s());
    let mut below = armed.then_some(from_s);
    let (mut first, mut t) = (0, from_s);
    while t <= last_s {
        while pulses.get(first).is_some_and(|p| p.start_s + long_s < t) {
            first += 1;
        }
        let coming = pulses.get(first)?;
        if coming.start_s > t {
            // Silence up to there.
            t = coming.start_s;
            below = Some(t);
            continue;
        }
        let open = pulses[first..].iter().take_while(|p| p.start_s <= t);
        let most: f64 = open.map(|p| p.amplitude.norm()).sum();
        if most >= it.threshold(t) && loud(it, pulses, first, t) {
            if let Some(quiet) = below {
                let time_s = refined(it, pulses, first, quiet, t);
                return Some(Crossing { time_s, pulse: strongest(it, pulses, first, t) });
            }
        } else {
            below = Some(t);
        }
        t += step_s;
    }
    None
}

fn sum(it: &Transducer, pulses: &[Pulse], first: usize, t: f64) -> f64 {
    let open = pulses[first..].iter().take_while(|p| p.start_s <= t);
    open.map(|p| p.amplitude * it.envelope(t - p.start_s)).sum::<Complex<f64>>().norm()
}

fn loud(it: &Transducer, pulses: &[Pulse], first: usize, t: f64) -> bool {
    sum(it, pulses, first, t) >= it.threshold(t)
}

/// Halves the stretch between a quiet and a loud moment down to a nanosecond.
fn refined(it: &Transducer, pulses: &[Pulse], first: usize, mut quiet: f64, mut high: f64) -> f64 {
    for _ in 0..16 {
        let middle = (quiet + high) / 2.0;
        if loud(it, pulses, first, middle) { high = middle } else { quiet = middle }
    }
    high
}

fn strongest(it: &Transducer, pulses: &[Pulse], first: usize, t: f64) -> usize {
    let level = |p: &Pulse| p.amplitude.norm() * it.envelope(t - p.start_s);
    let open = pulses.iter().enumerate().skip(first).take_while(|(_, p)| p.start_s <= t);
    open.max_by(|a, b| level(a.1).total_cmp(&level(b.1))).map_or(first, |(index, _)| index)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sonar::{Air, TransducerParams};

    fn it() -> Transducer {
        Transducer::new(TransducerParams::default(), &Air::default()).unwrap()
    }

    /// A wall's echo from r [m], `db` weaker than one square to the beam.
    fn wall(it: &Transducer, r: f64, db: f64) -> Pulse {
        let amplitude = Complex::new(it.air_leaves(2.0 * r) / r * 10f64.powf(db / 20.0), 0.0);
        Pulse { start_s: 2.0 * r / it.sound_m_s, amplitude }
    }

    fn ranges(it: &Transducer, pulses: &[Pulse]) -> Vec<f64> {
        crossings(it, pulses).iter().map(|c| c.time_s * it.sound_m_s / 2.0).collect()
    }

    #[test]
    fn a_wall_is_found_where_it_is_and_a_weak_one_late_or_never() {
        let it = it();
        for r in [0.5, 1.0, 3.0, 6.0, 10.0] {
            let found = ranges(&it, &[wall(&it, r, 0.0)]);
            assert!(found.len() == 1 && (0.0..3e-3).contains(&(found[0] - r)), "{r}: {found:?}");
        }
        // −37 dB is seen everywhere, some cycles late; −47 dB nowhere.
        for r in [0.5, 0.87, 1.3, 3.0, 6.0] {
            let found = ranges(&it, &[wall(&it, r, -37.0)]);
            assert!(found.len() == 1 && (0.0..0.04).contains(&(found[0] - r)), "{r}: {found:?}");
            assert!(ranges(&it, &[wall(&it, r, -47.0)]).is_empty());
        }
    }

    #[test]
    fn an_echo_under_way_when_the_receiver_wakes_is_read_as_the_blanking() {
        let it = it();
        let found = ranges(&it, &[wall(&it, 0.37, 0.0)]);
        assert!((found[0] - it.params.blanking_s * it.sound_m_s / 2.0).abs() < 1e-9);
        assert!(ranges(&it, &[wall(&it, 0.2, 0.0)]).is_empty());
    }

    #[test]
    fn echoes_three_inches_apart_are_two_and_nearer_ones_are_one() {
        let it = it();
        for (gap, count) in [(0.05, 1), (0.12, 2), (0.5, 2)] {
            let pulses = [wall(&it, 2.0, -15.0), wall(&it, 2.0 + gap, -15.0)];
            assert_eq!(ranges(&it, &pulses).len(), count, "{gap}");
        }
    }

    #[test]
    fn two_echoes_of_opposite_phase_cancel() {
        let it = it();
        let (a, mut b) = (wall(&it, 2.0, -30.0), wall(&it, 2.0, -30.0));
        assert_eq!(ranges(&it, &[a, b]).len(), 1);
        b.amplitude = -b.amplitude;
        assert!(ranges(&it, &[a, b]).is_empty());
    }

    #[test]
    fn the_strongest_pulse_is_named() {
        let it = it();
        let pulses = [wall(&it, 2.0, -44.0), wall(&it, 2.02, -10.0)];
        assert_eq!(crossings(&it, &pulses)[0].pulse, 1);
        assert!(crossings(&it, &[]).is_empty());
    }
}
