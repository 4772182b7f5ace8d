//! The two functions that waves need: the Bessel function J₁ and the Fresnel integral's tail.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use nalgebra::Complex;

/// Jₙ(x), from Bessel's integral Jₙ(x) = 1/π·∫₀^π cos(nτ − x·sin τ) dτ. Its integrand is periodic and smooth, so the
/// midpoint rule is right to the last digits as soon as it has more points than |x| + n by some twenty.
pub(super) fn bessel(order: u8, x: f64) -> f64 {
    let n = f64::from(order);
    let steps = (x.abs() + n) as usize + 24;
    let step = PI / steps as f64;
    let sum: f64 = (0..steps).map(|i| (i as f64 + 0.5) * step).map(|t| (n * t - x * t.sin()).cos()).sum();
    sum / steps as f64
}

/// ∫_v^∞ exp(−jτ²) dτ: what a wave passes beyond a straight edge, but for a factor. Right to 1e-7.
pub(super) fn fresnel_tail(v: f64) -> Complex<f64> {
    if v < 0.0 {
        // The whole line gives √π·exp(−jπ/4).
        return Complex::from_polar(PI.sqrt(), -FRAC_PI_4) - fresnel_tail(-v);
    }
    let x = v * v;
    if x > 16.0 {
        return Complex::from_polar(1.0 / (2.0 * v), -x - FRAC_PI_2) * asymptotic(x);
    }
    // ∫₀^v = Σ (−j)ⁿ·v^(2n+1)/(n!·(2n+1)).
    let (mut term, mut sum) = (Complex::new(v, 0.0), Complex::new(v, 0.0));
    for n in 1..80 {
        term *= Complex::new(0.0, -x / f64::from(n));
        sum += term / f64::from(2 * n + 1);
        if term.norm_sqr() < 1e-24 {
            break;
        }
    }
    Complex::from_polar(PI.sqrt() / 2.0, -FRAC_PI_4) - sum
}

/// The transition function of the uniform theory of diffraction, F(x) = 2j·√x·exp(jx)·∫_√x^∞ exp(−jτ²) dτ for x ≥ 0
/// (Kouyoumjian and Pathak 1974, eq. 26): 0 on a shadow boundary, 1 far from it.
pub(super) fn transition(x: f64) -> Complex<f64> {
    if x > 16.0 {
        return asymptotic(x);
    }
    Complex::new(0.0, 2.0 * x.sqrt()) * Complex::from_polar(1.0, x) * fresnel_tail(x.sqrt())
}

/// Σ (2n−1)!!·(j/2x)ⁿ: F(x) where x is large.
fn asymptotic(x: f64) -> Complex<f64> {
    let step = Complex::new(0.0, 0.5 / x);
    let mut term = Complex::new(1.0, 0.0);
    let mut sum = term;
    for n in 0..8 {
        term *= step * f64::from(2 * n + 1);
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bessel_functions_have_the_values_of_the_tables() {
        // Abramowitz and Stegun, table 9.1, and the zeros of table 9.5.
        let table = [
            (0.0, 0.0),
            (0.5, 0.242_268_457_7),
            (1.0, 0.440_050_585_7),
            (2.0, 0.576_724_807_8),
            (5.0, -0.327_579_137_6),
            (10.0, 0.043_472_746_2),
            (17.5, -0.163_419_969_4),
            (3.831_705_970_2, 0.0),
            (7.015_586_669_8, 0.0),
            (10.173_468_135_1, 0.0),
        ];
        for (x, value) in table {
            assert!((bessel(1, x) - value).abs() < 2e-10, "J1({x}) = {}", bessel(1, x));
            assert!((bessel(1, -x) + value).abs() < 2e-10);
        }
        for (order, x, value) in [(0, 2.0, 0.223_890_779_1), (0, 10.0, -0.245_935_764_5), (2, 5.0, 0.046_565_116_3)] {
            assert!((bessel(order, x) - value).abs() < 2e-10);
        }
    }

    #[test]
    fn the_fresnel_tail_has_the_values_of_the_tables() {
        // C(x) and S(x) of Abramowitz and Stegun, table 7.7: ∫₀^v exp(−jτ²)dτ = √(π/2)·(C − jS) at x = v·√(2/π).
        let table = [(0.5, 0.492_344_2, 0.064_732_4), (1.0, 0.779_893_4, 0.438_259_1), (2.0, 0.488_253_4, 0.343_415_7)];
        for (x, c, s) in table {
            let scale = FRAC_PI_2.sqrt();
            let whole = Complex::from_polar(PI.sqrt() / 2.0, -FRAC_PI_4);
            let head = Complex::new(c, -s) * scale;
            let v = x * scale;
            assert!((fresnel_tail(v) - (whole - head)).norm() < 1e-6);
            assert!((fresnel_tail(-v) - (whole + head)).norm() < 1e-6);
        }
    }

    #[test]
    fn series_and_asymptote_meet_and_the_transition_goes_from_zero_to_one() {
        let (below, above) = (fresnel_tail(3.999_999), fresnel_tail(4.000_001));
        assert!((below - above).norm() < 4e-6, "{below} {above}");
        assert!((transition(15.999_999) - transition(16.000_001)).norm() < 2e-6);
        assert!(transition(0.0).norm() == 0.0);
        // Near a boundary F ≈ (√(πx) − 2x·e^{jπ/4})·e^{j(π/4 + x)} (Kouyoumjian and Pathak, eq. 27a, its two first terms).
        let x = 1e-4_f64;
        let near = (Complex::new((PI * x).sqrt(), 0.0) - Complex::from_polar(2.0 * x, FRAC_PI_4))
            * Complex::from_polar(1.0, FRAC_PI_4 + x);
        assert!((transition(x) - near).norm() < 2e-6);
        assert!((transition(1e6) - Complex::new(1.0, 0.0)).norm() < 1e-6);
    }
}
