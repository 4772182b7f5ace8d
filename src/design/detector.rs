//! What a stripe of so many electrons tells about its row: the Cramér–Rao bound of `instrument.md` 2.

use crate::scanner::ImageParams;

/// Rows to either side of the stripe that are added up.
const REACH: i32 = 8;
/// Positions within a pixel over which the bound is averaged.
const PHASES: i32 = 16;

/// A pixel column at work.
#[derive(Clone, Copy, Debug)]
pub(super) struct Detector {
    /// Electrons that fill a pixel.
    pub well: f64,
    /// Electrons of a pixel without the laser.
    pub background: f64,
    /// Levels an electron.
    pub gain: f64,
    /// Variance of a dark pixel: read noise² + (well/levels)²/12 [electrons²].
    dark_variance: f64,
}

impl Detector {
    pub fn new(image: &ImageParams, background: f64) -> Self {
        let gain = f64::from(image.white_level) / image.well_electrons;
        let dark_variance = image.read_noise_electrons.powi(2) + 1.0 / (12.0 * gain * gain);
        Self { well: image.well_electrons, background, gain, dark_variance }
    }

    /// RMS noise of a pixel that the stripe does not light [levels].
    pub fn noise_levels(&self) -> f64 {
        self.gain * (self.dark_variance + self.background).sqrt()
    }

    /// Highest level of a stripe over the background, with its middle on a pixel's [levels]; not clipped.
    pub fn peak_levels(&self, electrons: f64, stripe_px: f64) -> f64 {
        self.gain * electrons * (2.0 * normal(0.5 / stripe_px) - 1.0)
    }

    /// Whether the brightest pixel is full.
    pub fn is_full(&self, electrons: f64, stripe_px: f64) -> bool {
        self.peak_levels(electrons, stripe_px) >= (self.well - self.background) * self.gain
    }

    /// The least RMS error of the stripe's row, over all positions within a pixel [px]: [Σ(∂μ_i/∂v)²/(μ_i + σ²)]^−½ with
    /// pixels integrated, and full ones that tell nothing. Infinite where no pixel tells anything.
    pub fn row_bound_px(&self, electrons: f64, stripe_px: f64) -> f64 {
        let variance: f64 = (0..PHASES)
            .map(|k| 1.0 / self.information(electrons, stripe_px, (f64::from(k) + 0.5) / f64::from(PHASES) - 0.5))
            .sum();
        (variance / f64::from(PHASES)).sqrt()
    }

    fn information(&self, electrons: f64, stripe_px: f64, v: f64) -> f64 {
        let reach = REACH.max((4.0 * stripe_px).min(200.0) as i32);
        let edge = |row: f64| ((row - v) / stripe_px, (-((row - v) / stripe_px).powi(2) / 2.0).exp());
        let mut sum = 0.0;
        let mut below = edge(f64::from(-reach) - 0.5);
        for row in -reach..=reach {
            let above = edge(f64::from(row) + 0.5);
            let light = electrons * (normal(above.0) - normal(below.0)).max(0.0) + self.background;
            if light < self.well {
                let slope = electrons * (below.1 - above.1) / (stripe_px * std::f64::consts::TAU.sqrt());
                sum += slope * slope / (light + self.dark_variance);
            }
            below = above;
        }
        sum
    }
}

/// The cumulative normal distribution Φ(x), right to 1e-7: the rational form 26.2.17 of Abramowitz and Stegun.
pub(super) fn normal(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * x.abs());
    let series =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    let tail = (-x * x / 2.0).exp() / std::f64::consts::TAU.sqrt() * series;
    if x > 0.0 { 1.0 - tail } else { tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_normal_distribution_has_its_known_values() {
        for (x, p) in [(0.0, 0.5), (1.0, 0.841_344_746), (-2.0, 0.022_750_132), (3.3, 0.999_516_576)] {
            assert!((normal(x) - p).abs() < 1e-7, "{x}");
        }
    }

    #[test]
    fn the_bound_is_that_of_the_table() {
        // instrument.md 2: 7 bit, 100 ke⁻, 60 e⁻ read noise; stripe px, peak level: bound.
        let image = ImageParams::default();
        let detector = Detector::new(&image, 0.0);
        for (stripe, peak, bound) in
            [(0.35, 100.0, 0.003), (0.5, 100.0, 0.003), (0.8, 25.0, 0.013), (0.8, 100.0, 0.004), (1.2, 25.0, 0.016)]
        {
            let electrons = peak / detector.peak_levels(1.0, stripe);
            let found = detector.row_bound_px(electrons, stripe);
            assert!((found - bound).abs() < 0.0008, "stripe {stripe}, peak {peak}: {found} for {bound}");
        }
    }

    #[test]
    fn shot_noise_alone_gives_the_root_of_the_electrons() {
        // A wide stripe without any other noise: √(σ² + 1/12)/√N.
        let image =
            ImageParams { read_noise_electrons: 0.0, well_electrons: 1e12, white_level: 255, ..ImageParams::default() };
        let detector = Detector { dark_variance: 1e-9, ..Detector::new(&image, 0.0) };
        let found = detector.row_bound_px(1e6, 2.0);
        assert!((found / ((4.0f64 + 1.0 / 12.0).sqrt() / 1e3) - 1.0).abs() < 0.01, "{found}");
    }

    #[test]
    fn a_full_well_tells_less_and_darkness_nothing() {
        let detector = Detector::new(&ImageParams::default(), 0.0);
        assert!(detector.is_full(3e5, 0.5) && !detector.is_full(5e4, 0.5));
        assert!(detector.row_bound_px(3e6, 0.5) > detector.row_bound_px(1.2e5, 0.5));
        assert!(detector.row_bound_px(0.0, 0.5).is_infinite());
        assert!(Detector { background: 2e5, ..detector }.row_bound_px(1e5, 0.5).is_infinite());
    }
}
