//! Least squares for calibrations: Levenberg–Marquardt with covariance, and what the data cannot tell apart.
//!
//! ```text
//! let parameters = [Parameter::new("f", 800.0, 800.0), Parameter::new("tilt", 0.4, 1.0), Parameter::new("gain", 1.0, 1.0).fixed()];
//! let residuals = |p: &[f64]| -> Option<Vec<f64>> { … };        // all parameters in, also the fixed ones
//! let fit = minimise(&parameters, &residuals, &Options::default())?;
//! fit.values[0], fit.sigma(0), fit.residual_rms;
//! let fit = fit.full_rank()?;                                   // a Fault that names what the data cannot tell apart
//! for weak in &fit.directions { weak.sigma, weak.changes }      // weakest first
//! ```
//!
//! - `residuals` gives the same number of rows every time, or `None` where the model ends (a point behind the camera): such a
//!   step is not taken. A residual that is no number is a `Fault`.
//! - A residual is best divided by its standard deviation ([`Noise::Known`]`(1.0)`); a prior is one more row,
//!   (p − expected)/σ.
//! - `scale` of a parameter: the size of a change over which the residuals are no longer straight (an angle: 1 rad, a focal
//!   length: itself). It sets the step of the numeric derivatives and the units of the weak directions, not the result.

use nalgebra::{DMatrix, DVector, SVD};

use crate::fault::{Fault, Result};

/// One unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// Its name, for faults and tables.
    pub name: String,
    /// First guess.
    pub start: f64,
    /// The size of a change over which the residuals are no longer straight, in the parameter's unit; greater than 0.
    pub scale: f64,
    /// Whether it stays at `start`.
    pub fixed: bool,
}

impl Parameter {
    /// A free parameter.
    pub fn new(name: impl Into<String>, start: f64, scale: f64) -> Self {
        Self { name: name.into(), start, scale, fixed: false }
    }

    /// The same, held at its first guess: it keeps its place among the parameters, has σ 0, and costs no data.
    pub fn fixed(self) -> Self {
        Self { fixed: true, ..self }
    }
}

/// How large the noise of one residual is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Noise {
    /// s² = Σr²/(rows − unknowns).
    FromResiduals,
    /// Its standard deviation is known, in the residuals' unit: 1.0 where each row was divided by its own.
    Known(f64),
}

/// When to stop, and what noise to believe in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Steps that may be taken before giving up.
    pub steps_max: usize,
    /// Settled when a step promises and brings a smaller relative fall of Σr² than this.
    pub fall_min: f64,
    /// For the covariance.
    pub noise: Noise,
    /// A direction whose singular value is smaller than this, relative to the largest with columns of equal length, is not
    /// determined at all.
    pub rank_tolerance: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self { steps_max: 200, fall_min: 1e-13, noise: Noise::FromResiduals, rank_tolerance: 1e-8 }
    }
}

/// The residuals at given parameters, or `None` where the model ends.
pub type Residuals<'a> = &'a dyn Fn(&[f64]) -> Option<Vec<f64>>;

/// The derivatives at given parameters: a row a residual, a column a parameter (fixed ones too).
pub type Jacobian<'a> = &'a dyn Fn(&[f64]) -> Option<DMatrix<f64>>;

/// A combination of parameters, and how well the data hold it.
#[derive(Clone, Debug, PartialEq)]
pub struct Direction {
    /// Standard deviation along it, in units of the parameters' scales; infinite if the data do not hold it at all.
    pub sigma: f64,
    /// The parts of the parameters' scales in the combination, of length 1 over all parameters (0 for fixed ones).
    pub parts: Vec<f64>,
    /// What each parameter changes by at one standard deviation along it (each in its own unit); for an infinite σ, at one scale.
    pub changes: Vec<f64>,
}

impl Direction {
    /// The names of the parameters in it, those with less than a fifth of the largest part left out.
    pub fn names(&self, parameters: &[Parameter]) -> Vec<String> {
        let largest = self.parts.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
        let counts = |part: &f64| part.abs() > 0.2 * largest;
        self.parts.iter().zip(parameters).filter(|(part, _)| counts(part)).map(|(_, p)| p.name.clone()).collect()
    }
}

/// A minimum.
#[derive(Clone, Debug)]
pub struct Solution {
    /// The parameters as given.
    pub parameters: Vec<Parameter>,
    /// Their values at the minimum, in the same order.
    pub values: Vec<f64>,
    /// s²·(JᵀJ)⁻¹; rows and columns of fixed parameters are 0. Where the data do not hold a parameter its variance is infinite.
    pub covariance: DMatrix<f64>,
    /// The residuals at the minimum.
    pub residuals: Vec<f64>,
    /// √(Σr²/rows).
    pub residual_rms: f64,
    /// The standard deviation of one residual that the covariance is based on.
    pub noise: f64,
    /// Largest over smallest singular value of the derivatives, columns brought to equal length; infinite if one is 0.
    pub condition: f64,
    /// How many combinations of parameters the data hold.
    pub rank: usize,
    /// Combinations of parameters, the weakest first.
    pub directions: Vec<Direction>,
    /// Steps taken.
    pub steps: usize,
}

impl Solution {
    /// Standard deviation of parameter `i`, in its unit; NaN for no such parameter.
    pub fn sigma(&self, i: usize) -> f64 {
        self.covariance.get((i, i)).map_or(f64::NAN, |v| v.max(0.0).sqrt())
    }

    /// The place of a parameter.
    pub fn index(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|p| p.name == name)
    }

    /// Correlation of two parameters, −1 to 1; 0 where one is fixed or not held by the data.
    pub fn correlation(&self, i: usize, j: usize) -> f64 {
        let product = self.sigma(i) * self.sigma(j);
        let both = product.is_finite() && product > 0.0;
        if both { self.covariance[(i, j)] / product } else { 0.0 }
    }

    /// How many parameters were free.
    pub fn free(&self) -> usize {
        self.parameters.iter().filter(|p| !p.fixed).count()
    }

    /// Refuses a minimum that is a valley: the fault names the parameters that the data cannot tell apart.
    pub fn full_rank(self) -> Result<Self> {
        if self.rank == self.free() {
            return Ok(self);
        }
        let weak: Vec<String> = self.directions[..self.free() - self.rank]
            .iter()
            .map(|direction| direction.names(&self.parameters).join(", "))
            .collect();
        let found = format!("data that do not hold apart: {}", weak.join("; "));
        Err(Fault::new("calibration", found, "data in which each parameter shows on its own"))
    }
}

/// The parameters of the least sum of squared residuals near the first guess, with numeric derivatives.
///
/// Errors: no parameters, a first guess or a scale that is no number, fewer residuals than unknowns (with
/// [`Noise::FromResiduals`] one more is needed), a first guess outside the model, residuals that are no numbers, no
/// minimum within `steps_max`.
pub fn minimise(parameters: &[Parameter], residuals: Residuals, options: &Options) -> Result<Solution> {
    let numeric = |p: &[f64]| numeric_jacobian(parameters, residuals, p);
    descend(parameters, residuals, &numeric, options)
}

/// The same with derivatives of the caller's own.
pub fn minimise_with(
    parameters: &[Parameter],
    residuals: Residuals,
    jacobian: Jacobian,
    options: &Options,
) -> Result<Solution> {
    descend(parameters, residuals, jacobian, options)
}

/// What the search holds at one place.
struct Place {
    values: Vec<f64>,
    residuals: DVector<f64>,
    cost: f64,
}

fn descend(parameters: &[Parameter], residuals: Residuals, jacobian: Jacobian, options: &Options) -> Result<Solution> {
    let free: Vec<usize> = (0..parameters.len()).filter(|&i| !parameters[i].fixed).collect();
    let start = checked_start(parameters, &free, residuals, options)?;
    let mut place = start;
    let (mut damping, mut grow) = (1e-3, 2.0);
    for steps in 0..options.steps_max {
        let whole = jacobian(&place.values).ok_or_else(|| outside("derivatives"))?;
        let slopes = free_columns(&whole, &free, place.residuals.len())?;
        let lengths = column_lengths(&slopes);
        let qr = scaled_columns(slopes.clone(), &lengths).qr();
        let mut turned = place.residuals.clone();
        qr.q_tr_mul(&mut turned);
        let (r, rhs) = (qr.r(), turned.rows(0, free.len()).into_owned());
        // What is left to gain if the residuals were straight: |Qᵀr|² of Σr².
        let promised = rhs.norm_squared();
        let floor = place.cost * options.fall_min + rounding(parameters, &free, &lengths).powi(2);
        let mut settled = promised <= floor;
        while !settled {
            let step = damped_step(&r, &rhs, damping)
                .ok_or_else(|| Fault::new("least squares", "derivatives that are no numbers", "finite derivatives"))?;
            let tried = moved(&place, &free, &step, &lengths, residuals)?;
            let gain = tried.as_ref().map_or(f64::NEG_INFINITY, |t| place.cost - t.cost);
            let model = rhs.norm_squared() - (&r * &step + &rhs).norm_squared();
            if let (Some(tried), true) = (tried, gain > 0.0) {
                let agreement = gain / model.max(f64::MIN_POSITIVE);
                // Nielsen's rule: the better the straight model predicted the gain, the less damping.
                damping = (damping * (1.0 - (2.0 * agreement - 1.0).powi(3)).max(1.0 / 3.0)).max(1e-15);
                grow = 2.0;
                settled = gain <= floor && model <= floor * 10.0;
                place = tried;
                break;
            }
            // Nothing better within rounding: this is the bottom, if little was promised.
            settled = model <= place.cost * 1e-10;
            damping *= grow;
            grow *= 2.0;
            if !settled && damping > 1e20 {
                return Err(outside("way down"));
            }
        }
        if settled {
            return concluded(parameters, &free, place, jacobian, options, steps + 1);
        }
    }
    let found = format!("a sum that still falls after {} steps", options.steps_max);
    Err(Fault::new("least squares", found, "a minimum near the first guess"))
}

/// What rounding of the parameters makes of the residuals: exact data leave no less.
fn rounding(parameters: &[Parameter], free: &[usize], lengths: &[f64]) -> f64 {
    let reach = free.iter().zip(lengths).map(|(&i, length)| parameters[i].scale * length);
    1e-14 * reach.fold(f64::MIN_POSITIVE, f64::max)
}

fn outside(what: &str) -> Fault {
    Fault::new("least squares", format!("no {what} from the first guess"), "a first guess well inside the model")
}

fn checked_start(parameters: &[Parameter], free: &[usize], residuals: Residuals, options: &Options) -> Result<Place> {
    if free.is_empty() {
        return Err(Fault::new("least squares", "no free parameter", "at least one"));
    }
    for p in parameters {
        if !(p.start.is_finite() && p.scale.is_finite() && p.scale > 0.0) {
            let found = format!("first guess {}, scale {}", p.start, p.scale);
            return Err(Fault::new(&p.name, found, "finite numbers, the scale greater than 0"));
        }
    }
    let values: Vec<f64> = parameters.iter().map(|p| p.start).collect();
    let rows = evaluated(residuals, &values, None)?.ok_or_else(|| outside("residuals"))?;
    let needed = free.len() + usize::from(options.noise == Noise::FromResiduals);
    if rows.len() < needed {
        let expected = format!("at least {needed} for {} unknowns", free.len());
        return Err(Fault::new("measurements", rows.len(), expected));
    }
    Ok(Place { values, cost: rows.norm_squared(), residuals: rows })
}

/// The residuals at `values`; `None` outside the model, a fault for what is no number.
fn evaluated(residuals: Residuals, values: &[f64], rows: Option<usize>) -> Result<Option<DVector<f64>>> {
    let Some(row) = residuals(values) else { return Ok(None) };
    if rows.is_some_and(|rows| rows != row.len()) {
        return Err(Fault::new("residuals", row.len(), format!("{} as before", rows.unwrap_or(0))));
    }
    if let Some(i) = row.iter().position(|r| !r.is_finite()) {
        return Err(Fault::new(format!("residual {i}"), row[i], "a finite number"));
    }
    Ok(Some(DVector::from_vec(row)))
}

fn moved(
    place: &Place,
    free: &[usize],
    step: &DVector<f64>,
    lengths: &[f64],
    residuals: Residuals,
) -> Result<Option<Place>> {
    let mut values = place.values.clone();
    for (k, &i) in free.iter().enumerate() {
        values[i] += step[k] / lengths[k];
    }
    if values.iter().any(|v| !v.is_finite()) {
        return Ok(None);
    }
    let rows = evaluated(residuals, &values, Some(place.residuals.len()))?;
    Ok(rows.map(|rows| Place { values, cost: rows.norm_squared(), residuals: rows }))
}

fn free_columns(whole: &DMatrix<f64>, free: &[usize], rows: usize) -> Result<DMatrix<f64>> {
    if whole.nrows() != rows || free.iter().any(|&i| i >= whole.ncols()) {
        let found = format!("{} x {}", whole.nrows(), whole.ncols());
        return Err(Fault::new("derivatives", found, format!("{rows} rows, a column a parameter")));
    }
    if whole.iter().any(|v| !v.is_finite()) {
        return Err(Fault::new("derivatives", "one that is no number", "finite numbers"));
    }
    Ok(whole.select_columns(free))
}

/// Lengths of the columns; 1 for a column of zeros.
fn column_lengths(slopes: &DMatrix<f64>) -> Vec<f64> {
    slopes.column_iter().map(|c| c.norm()).map(|n| if n > 0.0 { n } else { 1.0 }).collect()
}

fn scaled_columns(mut slopes: DMatrix<f64>, lengths: &[f64]) -> DMatrix<f64> {
    for (mut column, length) in slopes.column_iter_mut().zip(lengths) {
        column /= *length;
    }
    slopes
}

/// min |R·x + rhs|² + damping·|x|² by QR of the two stacked: no squaring of the condition as in normal equations.
fn damped_step(r: &DMatrix<f64>, rhs: &DVector<f64>, damping: f64) -> Option<DVector<f64>> {
    let n = r.ncols();
    let mut stacked = DMatrix::zeros(2 * n, n);
    stacked.view_mut((0, 0), (n, n)).copy_from(r);
    stacked.view_mut((n, 0), (n, n)).fill_diagonal(damping.sqrt());
    let mut right = DVector::zeros(2 * n);
    right.rows_mut(0, n).copy_from(&(-rhs));
    let qr = stacked.qr();
    qr.q_tr_mul(&mut right);
    let step = qr.r().solve_upper_triangular(&right.rows(0, n).into_owned())?;
    step.iter().all(|v| v.is_finite()).then_some(step)
}

/// Central differences; one-sided where the model ends on the other side.
fn numeric_jacobian(parameters: &[Parameter], residuals: Residuals, at: &[f64]) -> Option<DMatrix<f64>> {
    let here = residuals(at)?;
    let mut slopes = DMatrix::zeros(here.len(), parameters.len());
    let mut values = at.to_vec();
    for (j, parameter) in parameters.iter().enumerate().filter(|(_, p)| !p.fixed) {
        let step = 6e-6 * parameter.scale; // ∛ε: balances rounding against curvature
        values[j] = at[j] + step;
        let (high, ahead) = (residuals(&values), values[j] - at[j]);
        values[j] = at[j] - step;
        let (low, behind) = (residuals(&values), at[j] - values[j]);
        values[j] = at[j];
        let (high, low, width) = match (high, low) {
            (Some(high), Some(low)) => (high, low, ahead + behind),
            (Some(high), None) => (high, here.clone(), ahead),
            (None, Some(low)) => (here.clone(), low, behind),
            (None, None) => return None,
        };
        if high.len() != here.len() || low.len() != here.len() || width <= 0.0 {
            return None;
        }
        for (i, (h, l)) in high.iter().zip(&low).enumerate() {
            slopes[(i, j)] = (h - l) / width;
        }
    }
    Some(slopes)
}

/// Covariance and weak directions at the bottom.
fn concluded(
    parameters: &[Parameter],
    free: &[usize],
    place: Place,
    jacobian: Jacobian,
    options: &Options,
    steps: usize,
) -> Result<Solution> {
    let (rows, unknowns) = (place.residuals.len(), free.len());
    let noise = match options.noise {
        Noise::Known(sigma) => crate::fault::positive("noise", sigma)?,
        Noise::FromResiduals => (place.cost / (rows - unknowns) as f64).sqrt(),
    };
    let whole = jacobian(&place.values).ok_or_else(|| outside("derivatives"))?;
    let slopes = free_columns(&whole, free, rows)?;
    let (rank, condition) = rank_of(&slopes, options.rank_tolerance)?;
    let scales: Vec<f64> = free.iter().map(|&i| parameters[i].scale).collect();
    let in_scales: Vec<f64> = scales.iter().map(|s| 1.0 / s).collect();
    let svd = svd_of(scaled_columns(slopes, &in_scales).qr().r())?;
    let v_t = svd.v_t.unwrap_or_else(|| DMatrix::identity(unknowns, unknowns));
    let mut order: Vec<usize> = (0..unknowns).collect();
    order.sort_by(|&a, &b| svd.singular_values[a].total_cmp(&svd.singular_values[b]).then(a.cmp(&b)));
    let mut covariance = DMatrix::zeros(parameters.len(), parameters.len());
    let mut directions = Vec::with_capacity(unknowns);
    let mut lost = vec![false; parameters.len()];
    for (weakness, &k) in order.iter().enumerate() {
        let held = weakness >= unknowns - rank;
        let sigma = if held { noise / svd.singular_values[k] } else { f64::INFINITY };
        let mut parts = vec![0.0; parameters.len()];
        for (c, &i) in free.iter().enumerate() {
            parts[i] = v_t[(k, c)];
        }
        let reach = if held { sigma } else { 1.0 };
        let changes: Vec<f64> = parts.iter().zip(parameters).map(|(part, p)| part * p.scale * reach).collect();
        if held {
            let change = DVector::from_column_slice(&changes);
            covariance += &change * change.transpose();
        } else {
            parts.iter().zip(&mut lost).for_each(|(part, lost)| *lost |= part.abs() > 1e-6);
        }
        directions.push(Direction { sigma, parts, changes });
    }
    for i in (0..lost.len()).filter(|&i| lost[i]) {
        covariance[(i, i)] = f64::INFINITY;
    }
    Ok(Solution {
        parameters: parameters.to_vec(),
        values: place.values,
        covariance,
        residual_rms: (place.cost / rows as f64).sqrt(),
        residuals: place.residuals.as_slice().to_vec(),
        noise,
        condition,
        rank,
        directions,
        steps,
    })
}

/// Rank and condition with columns of equal length, so that units do not matter.
fn rank_of(slopes: &DMatrix<f64>, tolerance: f64) -> Result<(usize, f64)> {
    let lengths = column_lengths(slopes);
    let values = svd_of(scaled_columns(slopes.clone(), &lengths).qr().r())?.singular_values;
    let (largest, smallest) = (values.max(), values.min());
    let rank = values.iter().filter(|v| **v > tolerance * largest).count();
    Ok((rank, if smallest > 0.0 { largest / smallest } else { f64::INFINITY }))
}

fn svd_of(r: DMatrix<f64>) -> Result<SVD<f64, nalgebra::Dyn, nalgebra::Dyn>> {
    let refused = || Fault::new("least squares", "derivatives without singular values", "finite derivatives");
    SVD::try_new(r, false, true, f64::EPSILON, 10_000).ok_or_else(refused)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha12Rng;

    fn parameters(starts: &[f64]) -> Vec<Parameter> {
        starts.iter().enumerate().map(|(i, s)| Parameter::new(format!("p{i}"), *s, s.abs().max(1.0))).collect()
    }

    #[test]
    fn rosenbrock_from_the_usual_start() {
        let residuals = |p: &[f64]| Some(vec![10.0 * (p[1] - p[0] * p[0]), 1.0 - p[0], 0.0]);
        let fit = minimise(&parameters(&[-1.2, 1.0]), &residuals, &Options::default()).unwrap();
        assert!((fit.values[0] - 1.0).abs() < 1e-9 && (fit.values[1] - 1.0).abs() < 1e-9, "{fit:?}");
        assert!(fit.steps < 60, "{}", fit.steps);
    }

    #[test]
    fn misra1a_has_the_certified_values_and_deviations() {
        // NIST StRD, Misra1a: y = b1·(1 − exp(−b2·x)), start 1.
        let y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78];
        let x = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0];
        let residuals =
            |p: &[f64]| Some(x.iter().zip(&y).map(|(x, y)| p[0] * (1.0 - (-p[1] * x).exp()) - y).collect::<Vec<_>>());
        let start = [Parameter::new("b1", 500.0, 500.0), Parameter::new("b2", 1e-4, 1e-4)];
        let fit = minimise(&start, &residuals, &Options::default()).unwrap();
        assert!((fit.values[0] / 2.3894212918e2 - 1.0).abs() < 1e-7, "{:?}", fit.values);
        assert!((fit.values[1] / 5.5015643181e-4 - 1.0).abs() < 1e-7);
        assert!((fit.sigma(0) / 2.7070075241 - 1.0).abs() < 1e-4, "{}", fit.sigma(0));
        assert!((fit.sigma(1) / 7.2668688436e-6 - 1.0).abs() < 1e-4);
        assert!((fit.noise / 1.0187876330e-1 - 1.0).abs() < 1e-7);
        // b1 and b2 are nearly one: the weakest direction says so.
        assert!(fit.correlation(0, 1) < -0.99);
    }

    #[test]
    fn a_given_jacobian_gives_the_same_as_a_numeric_one() {
        let residuals = |p: &[f64]| Some((0..9).map(|i| (p[0] * i as f64).sin() + p[1] - 0.1 * i as f64).collect());
        let slopes = |p: &[f64]| {
            Some(DMatrix::from_fn(9, 2, |i, j| if j == 0 { i as f64 * (p[0] * i as f64).cos() } else { 1.0 }))
        };
        let start = parameters(&[0.1, 0.0]);
        let numeric = minimise(&start, &residuals, &Options::default()).unwrap();
        let given = minimise_with(&start, &residuals, &slopes, &Options::default()).unwrap();
        assert!((numeric.values[0] - given.values[0]).abs() < 1e-7);
        assert!((numeric.sigma(1) / given.sigma(1) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn the_truth_lies_where_the_deviations_say() {
        let mut rng = ChaCha12Rng::seed_from_u64(7);
        let (mut inside, mut inside_known) = (0, 0);
        for _ in 0..400 {
            // Twelve uniform numbers make a normal one.
            let noise: Vec<f64> =
                (0..40).map(|_| (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>() * 0.05).collect();
            let residuals = |p: &[f64]| {
                let row = |i: usize| p[0] * (-p[1] * i as f64 / 20.0).exp() - 2.0 * (-0.7 * i as f64 / 20.0).exp();
                Some((0..40).map(|i| row(i) - noise[i]).collect())
            };
            let fit = minimise(&parameters(&[1.0, 1.0]), &residuals, &Options::default()).unwrap();
            inside += usize::from((fit.values[1] - 0.7).abs() < 1.96 * fit.sigma(1));
            let known = Options { noise: Noise::Known(0.05), ..Options::default() };
            let fit = minimise(&parameters(&[1.0, 1.0]), &residuals, &known).unwrap();
            inside_known += usize::from((fit.values[1] - 0.7).abs() < 1.96 * fit.sigma(1));
        }
        assert!((368..=392).contains(&inside) && (368..=392).contains(&inside_known), "{inside}, {inside_known}");
    }

    #[test]
    fn parameters_that_only_show_together_are_named() {
        let residuals = |p: &[f64]| Some((0..9).map(|i| (p[0] + p[1]) * i as f64 + p[2] - 3.0 * i as f64).collect());
        let mut start = parameters(&[1.0, 1.0, 0.0]);
        let fit = minimise(&start, &residuals, &Options::default()).unwrap();
        assert_eq!(fit.rank, 2);
        assert!(fit.sigma(0).is_infinite() && fit.sigma(1).is_infinite() && fit.sigma(2).is_finite());
        assert_eq!(fit.directions[0].names(&start), ["p0", "p1"]);
        let fault = fit.full_rank().unwrap_err();
        assert!(fault.to_string().contains("hold apart: p0, p1"), "{fault}");
        start[1] = start[1].clone().fixed();
        let fit = minimise(&start, &residuals, &Options::default()).unwrap().full_rank().unwrap();
        assert!((fit.values[0] - 2.0).abs() < 1e-9 && fit.values[1] == 1.0 && fit.sigma(1) == 0.0);
    }

    #[test]
    fn a_parameter_that_shows_nowhere_is_named() {
        let residuals = |p: &[f64]| Some((0..9).map(|i| p[0] * i as f64 - 1.0).collect());
        let fault =
            minimise(&parameters(&[1.0, 1.0]), &residuals, &Options::default()).unwrap().full_rank().unwrap_err();
        assert!(fault.to_string().contains("p1"), "{fault}");
    }

    #[test]
    fn the_edge_of_the_model_is_not_crossed() {
        // √p is defined for p ≥ 0 only; a full step from 9 would land below.
        let residuals = |p: &[f64]| (p[0] >= 0.0).then(|| vec![p[0].sqrt() - 0.01, p[0].sqrt() - 0.01]);
        let fit = minimise(&[Parameter::new("p", 9.0, 9.0)], &residuals, &Options::default()).unwrap();
        assert!((fit.values[0] - 1e-4).abs() < 1e-9, "{:?}", fit.values);
    }

    #[test]
    fn what_is_no_problem_is_refused() {
        let fine = |p: &[f64]| Some(vec![p[0]; 3]);
        let options = Options::default();
        assert!(minimise(&[], &fine, &options).is_err());
        assert!(minimise(&parameters(&[f64::NAN]), &fine, &options).is_err());
        assert!(minimise(&[Parameter::new("p", 1.0, 0.0)], &fine, &options).is_err());
        let fault = minimise(&parameters(&[1.0]), &|_| Some(vec![1.0, f64::NAN]), &options).unwrap_err();
        assert_eq!(fault.to_string(), "residual 1: found NaN, expected a finite number");
        assert!(minimise(&parameters(&[1.0]), &|_| None, &options).is_err());
        let fault = minimise(&parameters(&[1.0, 2.0]), &|p: &[f64]| Some(vec![p[0] + p[1]]), &options).unwrap_err();
        assert!(fault.to_string().contains("at least 3 for 2 unknowns"), "{fault}");
        let fault = minimise(&parameters(&[1.0]), &|p: &[f64]| Some(vec![(-p[0]).exp(); 3]), &options).unwrap_err();
        assert!(fault.to_string().contains("least squares"), "{fault}");
    }
}
