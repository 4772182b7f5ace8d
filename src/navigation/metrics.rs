//! Sums over a run.

use nalgebra::Vector3;

/// The length of a path.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Travel {
    last: Option<Vector3<f64>>,
    metres: f64,
}

impl Travel {
    /// Adds a position [m]; one that is not finite is passed over.
    pub fn add(&mut self, position: &Vector3<f64>) {
        if position.iter().all(|c| c.is_finite()) {
            self.metres += self.last.map_or(0.0, |last| (position - last).norm());
            self.last = Some(*position);
        }
    }

    /// The length so far [m].
    pub fn metres(&self) -> f64 {
        self.metres
    }
}

/// A root mean square, and the largest of what went in.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rms {
    squares: f64,
    count: u64,
    max: f64,
}

impl Rms {
    /// Adds an error.
    pub fn add(&mut self, error: f64) {
        self.squares += error * error;
        self.count += 1;
        self.max = self.max.max(error.abs());
    }

    /// Adds all that another one has seen.
    pub fn merge(&mut self, other: &Self) {
        self.squares += other.squares;
        self.count += other.count;
        self.max = self.max.max(other.max);
    }

    /// The root mean square; `None` before the first error.
    pub fn value(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.squares / self.count as f64).sqrt())
    }

    /// The largest magnitude; 0 before the first error.
    pub fn max(&self) -> f64 {
        self.max
    }

    /// How many errors went in.
    pub fn count(&self) -> u64 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_as_long_as_its_parts() {
        let mut travel = Travel::default();
        assert_eq!(travel.metres(), 0.0);
        for p in [[1.0, 1.0, 0.0], [4.0, 5.0, 0.0], [f64::NAN, 0.0, 0.0], [4.0, 5.0, 2.0]] {
            travel.add(&Vector3::from(p));
        }
        assert_eq!(travel.metres(), 7.0);
    }

    #[test]
    fn the_rms_of_parts_is_that_of_the_whole() {
        assert_eq!(Rms::default().value(), None);
        let (mut a, mut b) = (Rms::default(), Rms::default());
        a.add(3.0);
        b.add(-4.0);
        a.merge(&b);
        assert_eq!((a.value(), a.max(), a.count()), (Some(12.5f64.sqrt()), 4.0, 2));
    }
}
