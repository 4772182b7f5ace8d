//! Rendered stripes for the tests: integrated over each pixel, with the noise of a real sensor.

use crate::image::Image;

/// A small generator of its own, so that these images stay what they are.
pub struct Noise(u64);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    /// Uniform in (0, 1): xorshift*.
    pub fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11;
        (bits as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// Normal with standard deviation 1.
    pub fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// The integral of the standard normal density up to x, by Simpson's rule: accurate to 1e-6.
fn cumulative(x: f64) -> f64 {
    let x = x.clamp(-8.0, 8.0);
    let (steps, density) = (60, |t: f64| (-0.5 * t * t).exp() / std::f64::consts::TAU.sqrt());
    let h = x / f64::from(steps);
    let inner: f64 = (1..steps).map(|i| density(f64::from(i) * h) * if i % 2 == 1 { 4.0 } else { 2.0 }).sum();
    0.5 + h / 3.0 * (density(0.0) + density(x) + inner)
}

/// How a stripe looks.
#[derive(Clone, Copy)]
pub struct Look {
    /// Standard deviation of its profile [px].
    pub width_px: f64,
    /// Level of the brightest pixel when the stripe is centred on it.
    pub peak: f64,
    /// Level around it.
    pub background: f64,
    /// Read noise [levels].
    pub read: f64,
    /// Shot noise: variance a level (white/well).
    pub shot: f64,
}

/// instrument.md 2: 7 bit, 100 ke⁻, 60 e⁻.
pub fn sensor(width_px: f64, peak: f64) -> Look {
    Look { width_px, peak, background: 0.0, read: 60.0 * 127.0 / 1e5, shot: 127.0 / 1e5 }
}

/// An image of 7-bit levels with a stripe at row `v(u)` in each column; none where that is `None`.
pub fn render(size: (usize, usize), look: Look, noise: &mut Noise, v: impl Fn(usize) -> Option<f64>) -> Image {
    let (width, height) = size;
    let mut levels = vec![0u8; width * height];
    let s = look.width_px;
    let centred = cumulative(0.5 / s) - cumulative(-0.5 / s);
    for u in 0..width {
        let at = v(u);
        for row in 0..height {
            let stripe = at.filter(|at| (at - row as f64).abs() < 8.0 * s + 1.0).map_or(0.0, |at| {
                let (lower, upper) = ((row as f64 - 0.5 - at) / s, (row as f64 + 0.5 - at) / s);
                look.peak * (cumulative(upper) - cumulative(lower)) / centred
            });
            let mean = look.background + stripe;
            let level = mean + (look.read * look.read + look.shot * mean).sqrt() * noise.normal();
            levels[row * width + u] = level.round().clamp(0.0, 127.0) as u8;
        }
    }
    Image::new(width, height, 127, levels).unwrap()
}
