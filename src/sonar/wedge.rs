//! Diffraction by a hard wedge: the uniform geometrical theory (Kouyoumjian and Pathak, Proc. IEEE 62, 1974, eq. 25–28),
//! which is Keller's coefficient but for the surroundings of shadow boundaries, where it joins the mirrored field smoothly.

use std::f64::consts::{FRAC_PI_4, PI, TAU};

use nalgebra::Complex;

use super::special::transition;

/// Where a source and a receiver stand about an edge.
#[derive(Clone, Copy, Debug)]
pub(super) struct About {
    /// Free angle about the edge over π: 3/2 for a right-angled box, 2 for a thin plate.
    pub n: f64,
    /// Bearings of source and receiver about the edge, from the first face through the free space [rad], 0 to n·π.
    pub phi: [f64; 2],
    /// Angle between the incident ray and the edge [rad]: its sine.
    pub sin_beta: f64,
    /// Distances of source and receiver from the point of diffraction [m].
    pub way_m: [f64; 2],
}

/// The diffraction coefficient D [√m] of a hard wedge at wave number `k` [1/m].
pub(super) fn coefficient(k: f64, about: &About) -> Complex<f64> {
    let [source, receiver] = about.way_m;
    // L of a spherical wave.
    let length = source * receiver / (source + receiver) * about.sin_beta * about.sin_beta;
    let [from, to] = about.phi;
    let (less, more) = (to - from, to + from);
    let sum: Complex<f64> = [(1.0, less), (-1.0, less), (1.0, more), (-1.0, more)]
        .iter()
        .map(|&(sign, beta)| part(about.n, sign, beta, k * length))
        .sum();
    let scale = Complex::from_polar(1.0 / (2.0 * about.n * (TAU * k).sqrt() * about.sin_beta), -FRAC_PI_4);
    -scale * sum
}

/// cot((π ± β)/2n)·F(kL·a±(β)).
fn part(n: f64, sign: f64, beta: f64, kl: f64) -> Complex<f64> {
    let order = ((beta + sign * PI) / (TAU * n)).round();
    let half = (TAU * n * order - beta) / 2.0;
    let argument = 2.0 * half.cos().powi(2);
    let angle = (PI + sign * beta) / (2.0 * n);
    // ε is how far β is from its shadow boundary: there cot has its pole and F its root (eq. 33).
    let epsilon = beta - (TAU * n * order - sign * PI);
    if epsilon.abs() < 1e-6 {
        let root = (TAU * kl).sqrt() * if epsilon < 0.0 { -1.0 } else { 1.0 };
        return Complex::from_polar(n * root * sign, FRAC_PI_4);
    }
    transition(kl * argument) * (angle.cos() / angle.sin())
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: f64 = 904.0;

    fn back(n: f64, phi: f64, way: f64) -> Complex<f64> {
        coefficient(K, &About { n, phi: [phi, phi], sin_beta: 1.0, way_m: [way, way] })
    }

    #[test]
    fn a_right_angled_edge_is_as_far_below_a_wall_as_keller_has_it() {
        // Head on, 3π/4 from either face: D = (2/√3 − 2√3)/(3·√(2πk)); over a wall at 1 m √2·D: −36.8 dB.
        let level = 20.0 * (2f64.sqrt() * back(1.5, 0.75 * PI, 1.0).norm()).log10();
        let keller = (2.0 * 3f64.sqrt() - 2.0 / 3f64.sqrt()) / (3.0 * (TAU * K).sqrt());
        assert!((level - 20.0 * (2f64.sqrt() * keller).log10()).abs() < 0.02, "{level}");
        assert!((-37.0..-36.6).contains(&level));
        // instrument.md 6: 32 to 37 dB under a wall at 1 m, over most of the quarter that sees both faces.
        for deg in 105..=165 {
            let phi = f64::from(deg).to_radians();
            let level = 20.0 * (2f64.sqrt() * back(1.5, phi, 1.0).norm()).log10();
            assert!((-37.5..-24.0).contains(&level), "{deg}: {level}");
        }
    }

    #[test]
    fn wall_and_edge_together_are_smooth_across_the_shadow_boundary() {
        // A quarter of space filled; source and receiver at distance d over the first face, the foot at x from the edge
        // (x < 0: beside the face). Echo = mirror, if the foot is on the face, + edge.
        let (d, step) = (1.0, 1e-4);
        let echo = |x: f64| {
            let way = (d * d + x * x).sqrt();
            let phi = d.atan2(x);
            let edge = back(1.5, phi, way) / (way * (2.0 * way).sqrt()) * Complex::from_polar(1.0, -2.0 * K * way);
            let wall = Complex::from_polar(1.0 / (2.0 * d), -2.0 * K * d);
            if x > 0.0 { wall + edge } else { edge }
        };
        assert!((echo(step) - echo(-step)).norm() < 0.01 * 0.5, "{} {}", echo(step), echo(-step));
        // On the boundary half the wall is left; deep over the face all of it.
        assert!((echo(step).norm() / 0.5 - 0.5).abs() < 0.02, "{}", echo(step).norm());
        assert!((echo(0.6).norm() / 0.5 - 1.0).abs() < 0.06);
        // A straight edge lets at most 1.17 of the wave through (Cornu's spiral).
        let most = (1..600).map(|i| echo(f64::from(i) * 1e-3).norm() / 0.5).fold(0.0, f64::max);
        assert!((1.1..1.25).contains(&most), "{most}");
    }

    #[test]
    fn an_edge_between_two_halves_of_one_plane_is_none() {
        assert!(back(1.0 + 1e-9, 1.0, 1.0).norm() < 1e-6);
        // And both sides of the wedge are alike.
        assert!((back(1.5, 1.8, 2.0) - back(1.5, 1.5 * PI - 1.8, 2.0)).norm() < 1e-12);
    }
}
