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

/// The integral of the standard normal density up to x: ½ + φ(x)·(x + x³/3 + x⁵/15 + …), to the last digits.
fn cumulative(x: f64) -> f64 {
    let x = x.clamp(-8.0, 8.0);
    let (mut term, mut sum, mut n) = (x, x, 1.0);
    while f64::abs(term) > 1e-17 * sum.abs() {
        n += 2.0;
        term *= x * x / n;
        sum += term;
    }
    0.5 + sum * (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt()
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

impl Look {
    /// The stripe's level in a pixel whose middle is this far from its own.
    pub fn stripe(&self, x: f64) -> f64 {
        let s = self.width_px;
        let part = |from: f64, to: f64| cumulative(to / s) - cumulative(from / s);
        self.peak * part(x - 0.5, x + 0.5) / part(-0.5, 0.5)
    }
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
    for u in 0..width {
        let at = v(u);
        for row in 0..height {
            let stripe = at.map(|at| row as f64 - at).filter(|x| x.abs() < 8.0 * s + 1.0);
            let stripe = stripe.map_or(0.0, |x| look.stripe(x));
            let mean = look.background + stripe;
            let level = mean + (look.read * look.read + look.shot * mean).sqrt() * noise.normal();
            levels[row * width + u] = level.round().clamp(0.0, 127.0) as u8;
        }
    }
    Image::new(width, height, 127, levels).unwrap()
}
