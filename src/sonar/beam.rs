//! The beam of a round piston in a baffle, far away and near by.
//!
//! Far away its directivity is B(θ) = 2·J₁(ka·sin θ)/(ka·sin θ), with side lobes. But two pistons of 19 mm that see each
//! other over 1 m (a wall at 0.5 m, and its mirror image) see each other under angles that differ by ±2° from place to
//! place: that fills the nulls and moves the level by 8 dB a degree beside them. So the mean over all pairs of points, one
//! on the sending and one on the receiving piston, is worked out to the second order of the path in both, which is right
//! to 0.2 dB from 0.3 m on, nulls included (tests in `reference`).

use nalgebra::Complex;

use super::special::bessel;

/// Terms of the coupling between both pistons: powers of x and of y.
const ORDERS: [(usize, usize); 9] = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (0, 2), (1, 2), (2, 2), (0, 4)];
/// From this distance on the first order of nearness is enough: 0.3 dB off beside a null, less elsewhere [m]. (Nearness goes
/// with k·a²/r: so for a piston of k·a² = 0.33 m; for others in proportion.)
const FAR_M: f64 = 3.0;
const FAR_KAA_M: f64 = 0.333;
/// Steps of the table of B over sin θ.
const STEPS: usize = 2048;

/// How the path from a point (x₁, y₁) of the sending piston by the target to a point (x₂, y₂) of the receiving one grows
/// with both, across the line of sight: Σ own·(x₁² + x₂²) − 2·cross·x₁·x₂ [1/m].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Bend {
    pub own: f64,
    pub cross: f64,
}

impl Bend {
    /// A mirror at distance `r` [m], curved away from the transducer with this radius [m]: a wall has ∞, an edge 0.
    pub fn mirror(r: f64, radius: f64) -> Self {
        let flat = if radius.is_finite() { radius / (radius + r) } else { 1.0 };
        let cross = flat / (4.0 * r);
        Self { own: 1.0 / (2.0 * r) - cross, cross }
    }

    /// What sends sound back to where it came from: a right-angled corner at distance `r` [m].
    pub fn corner(r: f64) -> Self {
        Self { own: 1.0 / (4.0 * r), cross: -1.0 / (4.0 * r) }
    }

    /// The mean of two, one counted `share`, where the axes of target and beam do not agree.
    pub fn mixed(self, share: f64, other: Self) -> Self {
        let mix = |a: f64, b: f64| a * share + b * (1.0 - share);
        Self { own: mix(self.own, other.own), cross: mix(self.cross, other.cross) }
    }
}

/// A piston of radius a at wave number k.
#[derive(Clone, Debug)]
pub(super) struct Piston {
    /// k·a.
    ka: f64,
    /// k·a² [m].
    kaa_m: f64,
    /// B, B′ and B″ over u = ka·sin θ, at equal steps of sin θ from 0 to 1.
    table: Vec<[f64; 3]>,
    /// The largest |B| from each step on.
    most: Vec<f64>,
    /// Chords x and weights of the Gauss–Chebyshev rule of the second kind, for x > 0.
    chords: Vec<(f64, f64)>,
}

impl Piston {
    pub fn new(wave_number: f64, radius_m: f64) -> Self {
        let ka = wave_number * radius_m;
        let table = (0..=STEPS + 1).map(|i| directivity(ka * i as f64 / STEPS as f64)).collect::<Vec<_>>();
        let mut most: Vec<f64> = table.iter().map(|[b, ..]| b.abs()).collect();
        for i in (0..=STEPS).rev() {
            most[i] = most[i].max(most[i + 1]);
        }
        // The rule is exact for polynomials of a degree below twice its points: enough for exp(−j·ka·x) at once.
        let half = (ka / 2.0) as usize + 8;
        let angle = std::f64::consts::PI / (2 * half + 1) as f64;
        let chords = (1..=half)
            .map(|i| (i as f64 * angle).sin_cos())
            .map(|(sin, cos)| (cos, 2.0 * sin * sin / (2 * half + 1) as f64))
            .collect();
        Self { ka, kaa_m: wave_number * radius_m * radius_m, table, most, chords }
    }

    /// B(θ) far away, from sin θ and cos θ; nothing goes behind the baffle.
    pub fn far(&self, sin: f64, cos: f64) -> f64 {
        if cos <= 0.0 {
            return 0.0;
        }
        self.derivatives(sin)[0]
    }

    /// B, B′ and B″ at this sin θ.
    fn derivatives(&self, sin: f64) -> [f64; 3] {
        let place = sin.abs().min(1.0) * STEPS as f64;
        let cell = place as usize;
        let part = place - cell as f64;
        match (self.table.get(cell), self.table.get(cell + 1)) {
            (Some(a), Some(b)) => std::array::from_fn(|i| a[i] + (b[i] - a[i]) * part),
            _ => [0.0; 3],
        }
    }

    /// The most that |B| reaches from this sin θ on outwards: a bound without nulls.
    pub fn most(&self, sin: f64) -> f64 {
        self.most.get((sin.abs() * STEPS as f64) as usize).copied().unwrap_or(0.0)
    }

    /// How much more than the bound's square nearness may leave at this distance [m].
    pub fn near(&self, r: f64) -> f64 {
        1.0 + 2.5 * self.kaa_m / r
    }

    /// What is left of a target's echo, averaged over all pairs of points of one piston that sends and receives. The
    /// target is seen under θ from the axis; `across` is how it bends the path within the plane of θ, `along` how at right
    /// angles to it. Far away the whole is B².
    pub fn both_ways(&self, sin: f64, cos: f64, across: Bend, along: Bend) -> Share {
        if cos <= 0.0 {
            return Share::default();
        }
        let u = self.ka * sin;
        let tilt = cos * cos; // the piston is foreshortened within the plane of θ
        let (own_x, own_y) = (self.kaa_m * across.own * tilt, self.kaa_m * along.own);
        let (cross_x, cross_y) = (2.0 * self.kaa_m * across.cross * tilt, 2.0 * self.kaa_m * along.cross);
        let lean_m = sin * self.kaa_m / self.ka;
        // As far from a target as `FAR_M`, own is at most 1/2r.
        if across.own.max(along.own) * self.kaa_m < 0.5 * FAR_KAA_M / FAR_M {
            return self.afar(sin, u, [own_x, own_y], cross_x).with_lean(lean_m);
        }
        let moments = self.moments(u, own_x, own_y);
        let moment = |p: usize, q: usize| ORDERS.iter().position(|o| *o == (p, q)).map_or(ZERO, |i| moments[i]);
        // exp(j·cross·x₁x₂) = Σ (j·cross)ⁿ/n!·x₁ⁿ·x₂ⁿ: each term is the square of a moment of one piston.
        let power = |base: f64, n: usize| (Complex::i() * base).powu(n as u32) / FACTORIAL[n];
        let (mut whole, mut first, mut second) = (ZERO, ZERO, ZERO);
        for (p, q) in ORDERS {
            let term = power(cross_x, p) * power(cross_y, q);
            let (m, n, o) = (moment(p, q), moment(p + 1, q), moment(p + 2, q));
            whole += term * m * m;
            // ⟨x₁ + x₂⟩ and ⟨(x₁ + x₂)²⟩.
            first += term * m * n * 2.0;
            second += term * (m * o + n * n) * 2.0;
        }
        Share::new(whole, first, second).with_lean(lean_m)
    }

    /// The same to the first order of nearness: with ⟨x²·e⟩ = −B″, ⟨y²·e⟩ = −B′/u and ⟨x·e⟩ = jB′ over one piston.
    fn afar(&self, sin: f64, u: f64, own: [f64; 2], cross_x: f64) -> Share {
        let [b, b1, b2] = self.derivatives(sin);
        // Near u = 0, B = 1 − u²/8.
        let b1_u = if u < 1e-3 { -0.25 } else { b1 / u };
        let near = 2.0 * (own[0] * b2 + own[1] * b1_u) * b - cross_x * b1 * b1;
        Share::new(
            Complex::new(b * b, near),
            Complex::new(0.0, 2.0 * b * b1),
            Complex::new(-2.0 * (b2 * b + b1 * b1), 0.0),
        )
    }

    /// ⟨xᵖ·y^q·exp(−j(u·x + own_x·x² + own_y·y²))⟩ over the unit disc for all `ORDERS`.
    fn moments(&self, u: f64, own_x: f64, own_y: f64) -> [Complex<f64>; 9] {
        let mut sums = [Complex::default(); 9];
        for &(x, weight) in &self.chords {
            let square = x * x;
            let bend = small_turn(own_x * square) * (2.0 * weight);
            let (sin, cos) = (u * x).sin_cos();
            // Even powers of x keep the cosine of ±x, odd ones −j times the sine.
            let (even, odd) = (bend * cos, bend * Complex::new(0.0, -sin));
            let h = 1.0 - square; // half a chord, squared
            let chord = [chord_mean(0.0, h, own_y), chord_mean(2.0, h, own_y) * h, chord_mean(4.0, h, own_y) * h * h];
            let powers = [1.0, x, square, x * square, square * square];
            for (sum, (p, q)) in sums.iter_mut().zip(ORDERS) {
                *sum += if p % 2 == 0 { even } else { odd } * chord[q / 2] * powers[p];
            }
        }
        sums
    }
}

const ZERO: Complex<f64> = Complex::new(0.0, 0.0);

/// The share of an echo that a leaning piston lets pass. The near side of the piston hears it first, the far side last, so
/// its beginning is not that of a copy of the ping: it comes in three parts, `apart_m` of way before, on and after the
/// middle, which have the same mean, mean time and spread of times. In a null they cancel, but not in the first cycles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Share {
    pub parts: [Complex<f64>; 3],
    pub apart_m: f64,
}

/// The parts are so far apart, in units of a·sin θ, that their fourth moment is right too for an even sum over both discs:
/// √(⟨s⁴⟩/⟨s²⟩) of s = x₁ + x₂, with ⟨x²⟩ = 1/4 and ⟨x⁴⟩ = 1/8.
const APART: f64 = 1.118;

impl Share {
    /// From ⟨1⟩, ⟨s⟩ and ⟨s²⟩ of s = x₁ + x₂.
    fn new(whole: Complex<f64>, first: Complex<f64>, second: Complex<f64>) -> Self {
        let (odd, even) = (first / (2.0 * APART), second / (2.0 * APART * APART));
        Self { parts: [even - odd, whole - even * 2.0, even + odd], apart_m: 0.0 }
    }

    /// For a piston whose edge leans so far out of its middle [m].
    fn with_lean(self, lean_m: f64) -> Self {
        Self { apart_m: APART * lean_m, ..self }
    }

    /// All of it at once.
    pub fn whole(whole: f64) -> Self {
        Self { parts: [ZERO, Complex::new(whole, 0.0), ZERO], apart_m: 0.0 }
    }

    /// The share of a long ping.
    pub fn total(&self) -> Complex<f64> {
        self.parts.iter().sum()
    }
}

impl std::ops::Add for Share {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { parts: std::array::from_fn(|i| self.parts[i] + other.parts[i]), ..self }
    }
}

impl std::ops::Mul<Complex<f64>> for Share {
    type Output = Self;
    fn mul(self, factor: Complex<f64>) -> Self {
        Self { parts: self.parts.map(|part| part * factor), ..self }
    }
}

impl std::ops::Mul<f64> for Share {
    type Output = Self;
    fn mul(self, factor: f64) -> Self {
        self * Complex::new(factor, 0.0)
    }
}

const FACTORIAL: [f64; 5] = [1.0, 1.0, 2.0, 6.0, 24.0];

/// exp(−jw) for |w| below 1 (7e-6 off at most).
fn small_turn(w: f64) -> Complex<f64> {
    let s = w * w;
    Complex::new(1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - s / 30.0)), -w * (1.0 - s / 6.0 * (1.0 - s / 20.0)))
}

/// The mean of y^q·exp(−j·own·y²) over |y| ≤ √h, over h^(q/2), for small `own`.
fn chord_mean(q: f64, h: f64, own: f64) -> Complex<f64> {
    let w = own * h;
    let real = 1.0 / (q + 1.0) - w * w / (2.0 * (q + 5.0));
    let imaginary = -w / (q + 3.0) + w * w * w / (6.0 * (q + 7.0));
    Complex::new(real, imaginary)
}

/// B = 2·J₁(x)/x, B′ = −2·J₂(x)/x and B″ = −2·J₁(x)/x + 6·J₂(x)/x².
fn directivity(x: f64) -> [f64; 3] {
    if x.abs() < 1e-3 {
        return [1.0 - x * x / 8.0, -x / 4.0, -0.25];
    }
    let (j1, j2) = (bessel(1, x), bessel(2, x));
    [2.0 * j1 / x, -2.0 * j2 / x, -2.0 * j1 / x + 6.0 * j2 / (x * x)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The Polaroid's, at 20 °C.
    fn piston() -> Piston {
        Piston::new(std::f64::consts::TAU * 49.4e3 / 343.29, 0.0192)
    }

    #[test]
    fn the_beam_has_the_width_null_and_side_lobe_of_a_round_piston() {
        // −3 dB at 5.3°, null at 12.7°, first side lobe −17.6 dB (instrument.md 6).
        let piston = piston();
        let far_db = |deg: f64| {
            let (sin, cos) = deg.to_radians().sin_cos();
            20.0 * piston.far(sin, cos).abs().log10()
        };
        assert!((far_db(5.33) + 3.0).abs() < 0.05, "{}", far_db(5.33));
        assert!(far_db(12.74) < -60.0);
        let lobe = (140..220).map(|d| far_db(f64::from(d) / 10.0)).fold(f64::MIN, f64::max);
        assert!((lobe + 17.57).abs() < 0.02, "{lobe}");
        assert_eq!(piston.far(0.3, -0.95), 0.0);
        assert_eq!(piston.far(0.0, 1.0), 1.0);
    }

    #[test]
    fn nothing_is_louder_than_its_bound() {
        let piston = piston();
        for i in 0..900 {
            let (sin, cos) = (f64::from(i) / 10.0).to_radians().sin_cos();
            for r in [0.2, 0.5, 2.0] {
                let wall = Bend::mirror(r, f64::INFINITY);
                for bend in [wall, Bend::corner(r), Bend::mirror(r, 0.0)] {
                    let found = piston.both_ways(sin, cos, bend, wall).total().norm();
                    let bound = piston.most(sin).powi(2) * piston.near(r);
                    assert!(found <= bound * 1.001, "{i} {r}: {found} {bound}");
                }
            }
        }
    }

    #[test]
    fn far_away_both_ways_is_the_square_of_the_beam() {
        let piston = piston();
        for deg in [0.0, 3.0, 8.0, 17.0, 30.0_f64] {
            let (sin, cos) = deg.to_radians().sin_cos();
            for bend in [Bend::mirror(1e4, f64::INFINITY), Bend::corner(1e4), Bend::mirror(1e4, 0.0)] {
                let found = piston.both_ways(sin, cos, bend, bend).total();
                let square = piston.far(sin, cos).powi(2);
                assert!((found - Complex::new(square, 0.0)).norm() < 2e-6 + 1e-4 * square, "{deg}: {found} {square}");
            }
        }
    }

    #[test]
    fn a_bend_is_that_of_its_limits() {
        assert_eq!(Bend::mirror(2.0, f64::INFINITY), Bend { own: 0.125, cross: 0.125 });
        assert_eq!(Bend::mirror(2.0, 0.0), Bend { own: 0.25, cross: 0.0 });
        let half = Bend::mirror(2.0, 0.0).mixed(0.5, Bend::mirror(2.0, f64::INFINITY));
        assert_eq!(half, Bend { own: 0.1875, cross: 0.0625 });
    }
}
