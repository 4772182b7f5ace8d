//! Standard deviations of the bundle's rows, and how they are told from a fit.

use crate::calibration::solve::Solution;

/// Errors that the data must hold for their standard deviation to be found.
const HELD_MIN: f64 = 1.0;

/// Standard deviations that the data tell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sigmas {
    pub corner_px: f64,
    /// Stripe points are off by this many times what their own straight line says.
    pub stripe: f64,
    /// Stripes as a whole [px].
    pub whole_px: f64,
    pub arm_m: f64,
    pub arm_rad: f64,
}

impl Sigmas {
    pub fn near(&self, other: &Self) -> bool {
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 0.01;
        near(self.corner_px, other.corner_px)
            && near(self.stripe, other.stripe)
            && near(self.whole_px, other.whole_px)
            && near(self.arm_m, other.arm_m)
            && near(self.arm_rad, other.arm_rad)
    }
}

/// The standard deviation of errors that are parameters with mean 0, from their estimates.
///
/// An estimate is drawn to 0 the more, the less the data hold it: σ² = Σv²/Σ(1 − C/σ²) with its variance C (MacKay 1992), the
/// fixed point of expectation and maximisation, reached in fewer rounds.
#[derive(Clone, Copy, Default)]
pub(super) struct Spread {
    pub squares: f64,
    pub held: f64,
}

impl Spread {
    pub fn add(&mut self, fit: &Solution, i: usize, sigma: f64) {
        self.squares += fit.values[i].powi(2);
        self.held += (1.0 - fit.covariance[(i, i)] / (sigma * sigma)).max(0.0);
    }

    /// `None` where the data hold none of them.
    pub fn sigma(&self) -> Option<f64> {
        (self.held > HELD_MIN).then(|| (self.squares / self.held).sqrt())
    }
}
