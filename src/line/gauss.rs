//! The Gaussian nearest to five pixels, for one column or for many at once: the default estimator.

/// Rows above and below the middle.
pub(super) const REACH: usize = 2;
/// Rows looked at.
pub(super) const SIZE: usize = 2 * REACH + 1;
/// Farther from the middle row than this, the window is moved [px].
pub(super) const OFFSET_MAX: f32 = 0.6;
/// Least and most variance of a stripe that makes sense of five pixels [px²].
const WIDTH2: [f32; 2] = [0.15, 4.0];
/// Real stripes are Gaussian to this part of their peak.
pub(super) const SHAPE: f32 = 0.02;
/// A χ² over this, of two degrees of freedom, is no noise: four in a million.
const MISFIT: f32 = 25.0;
/// A peak this many times brighter than what is seen at all is not dim, however narrow.
const DIM: f32 = 8.0;
/// What is darker than this counts as this much of the peak, as there is no logarithm of nothing.
const FLOOR: f32 = 1e-3;

/// Noise of an image's pixels (EMVA 1288).
#[derive(Clone, Copy, Debug)]
pub(super) struct Sensor {
    /// What the image shows where there is no stripe [levels²].
    pub seen: f32,
    /// Read noise and quantisation, which are always there [levels²].
    pub floor: f32,
    /// Shot noise: variance a level [levels].
    pub shot: f32,
}

impl Sensor {
    /// Variance of a pixel with so much light that is not the stripe's [levels²]: what is seen, or what must be there if
    /// that is more.
    #[inline(always)]
    pub fn dark(self, ambient: f32) -> f32 {
        (self.floor + self.shot * ambient).max(self.seen)
    }
}

/// Noise of a pixel: `dark` [levels²] without the stripe's light, and `shot` times the level of that.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    pub dark: f32,
    pub shot: f32,
}

/// The natural logarithm of a normal number greater than 0, right to 1e-7. No branches and no library: compilers make
/// vectors of it, and it is the same on every machine.
#[inline(always)]
fn ln(x: f32) -> f32 {
    // x = m·2ⁿ with m in [√½, √2), by moving the exponent's border from 1 to √½.
    const HALF_ROOT: u32 = 0x3F35_04F3;
    let shifted = x.to_bits().wrapping_sub(HALF_ROOT);
    let n = (shifted as i32 >> 23) as f32;
    let m = f32::from_bits((shifted & 0x007F_FFFF) + HALF_ROOT);
    // ln m = 2·artanh z, z = (m − 1)/(m + 1), |z| < 0.172.
    let z = (m - 1.0) / (m + 1.0);
    let zz = z * z;
    n * std::f32::consts::LN_2 + 2.0 * z * (1.0 + zz * (1.0 / 3.0 + zz * (0.2 + zz * (1.0 / 7.0))))
}

/// The parabola nearest to the logarithms of five levels over the background, weighted by the levels squared (Guo 2011):
/// the offset of its top from the middle [px] and the variance of that [px²]. No number if there is no top.
///
/// Where the levels do not fit a stripe (a mixed peak at an edge, two stripes in one), half its width is added to σ.
///
/// A pixel is the integral of the light over it, not its value at the middle. For a stripe of fitted variance W the
/// parabola is therefore off by k(W)·δ·(1 − 4δ²), which is taken away: 1/k = (1.198 + 1.930·W + 5.000·W²)⁴ is fitted to
/// integrated Gaussians without noise, and right to 6 % for σ of 0.35 to 0.8 px. At 0.5 px it is 0.005 px; above 0.8, 0.
#[inline(always)]
pub(super) fn gauss5(level: [f32; SIZE], noise: Noise) -> (f32, f32) {
    let peak = level[REACH];
    let scale = 1.0 / peak;
    // Moments of the weights and of the weighted logarithms, relative to the peak: Σw·xⁿ and Σw·xⁿ·ln I.
    let over = |level: f32| (level * scale).max(FLOOR);
    let ratio = [over(level[0]), over(level[1]), 1.0, over(level[3]), over(level[4])];
    let (a, b) = (ratio[0] * ratio[0], ratio[1] * ratio[1]);
    let (d, e) = (ratio[3] * ratio[3], ratio[4] * ratio[4]);
    let (la, lb, ld, le) = (ln(ratio[0]), ln(ratio[1]), ln(ratio[3]), ln(ratio[4]));
    let (s0, s1) = (a + b + 1.0 + d + e, 2.0 * (e - a) + d - b);
    let (s2, s3, s4) = (4.0 * (a + e) + b + d, 8.0 * (e - a) + d - b, 16.0 * (a + e) + b + d);
    let (wa, wb, wd, we) = (a * la, b * lb, d * ld, e * le);
    let (t0, t1, t2) = (wa + wb + wd + we, 2.0 * (we - wa) + wd - wb, 4.0 * (wa + we) + wb + wd);
    // Cofactors of the normal equations' matrix [s0 s1 s2; s1 s2 s3; s2 s3 s4].
    let (c00, c01, c02) = (s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2);
    let (c11, c12, c22) = (s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1);
    let height = c00 * t0 + c01 * t1 + c02 * t2; // times the determinant, as are the next two
    let slope = c01 * t0 + c11 * t1 + c12 * t2;
    let bend = c02 * t0 + c12 * t1 + c22 * t2;
    let determinant = s0 * c00 + s1 * c01 + s2 * c02;
    let per_bend = if bend < 0.0 { -0.5 / bend } else { f32::NAN };
    let offset = slope * per_bend;
    let width2 = (determinant * per_bend).clamp(WIDTH2[0], WIDTH2[1]);
    // dδ/d(ln I) is a parabola in x too: times the weight, and d(ln I)/dI = 1/I.
    let (p0, p1, p2) = (c01 + 2.0 * offset * c02, c11 + 2.0 * offset * c12, c12 + 2.0 * offset * c22);
    let (per_determinant, logs) = (1.0 / determinant, [la, lb, 0.0, ld, le]);
    let (mut variance, mut misfit) = (0.0, 0.0);
    for i in 0..SIZE {
        let x = i as f32 - REACH as f32;
        let part = ratio[i] * (p0 + x * (p1 + x * p2)) * per_bend * scale;
        let of_pixel = noise.dark + noise.shot * level[i].max(0.0);
        variance += part * part * of_pixel;
        let residual = ratio[i] * (logs[i] - (height + x * (slope + x * bend)) * per_determinant) * peak;
        misfit += residual * residual / (of_pixel + (SHAPE * peak) * (SHAPE * peak));
    }
    let variance = if misfit > MISFIT { variance + 0.25 * width2 } else { variance };
    let q = 1.198 + width2 * (1.930 + 5.0 * width2);
    let (qq, inside) = (q * q, (1.0 - 4.0 * offset * offset).max(0.0));
    (offset - offset * inside / (qq * qq), variance)
}

/// Σi·J/ΣJ over the five rows with its variance. What is darker than the background counts as none, which keeps dim
/// stripes in place; the error is then up to a third smaller than σ says. No number if there is no light.
#[inline(always)]
pub(super) fn centroid5(level: [f32; SIZE], noise: Noise) -> (f32, f32) {
    let [a, b, c, d, e] = level;
    let (a, b, c, d, e) = (a.max(0.0), b.max(0.0), c.max(0.0), d.max(0.0), e.max(0.0));
    let per_light = 1.0 / (a + b + c + d + e);
    let offset = (2.0 * (e - a) + d - b) * per_light;
    let mut variance = 0.0;
    for i in 0..SIZE {
        let arm = (i as f32 - REACH as f32 - offset) * per_light;
        variance += arm * arm * (noise.dark + noise.shot * level[i].max(0.0));
    }
    (offset, variance)
}

/// Whether the stripe is too dark for logarithms: its peak is not far over `seen`, and a neighbour not at all.
#[inline(always)]
pub(super) fn is_dim(level: [f32; SIZE], seen: f32) -> bool {
    (level[REACH] <= DIM * seen) & (level[REACH - 1].min(level[REACH + 1]) <= seen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_logarithm_is_right() {
        for i in 1..100_000 {
            let x = i as f32 * 1e-3;
            assert!((f64::from(ln(x)) - f64::from(x).ln()).abs() < 3e-7 * f64::from(x).ln().abs().max(1.0), "{x}");
        }
    }
}
