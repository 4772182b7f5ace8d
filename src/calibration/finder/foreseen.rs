//! What an experiment tells of each parameter, whether it was made or is only thought of.

use nalgebra::DMatrix;

use super::model::Model;
use super::parameters::{GROWTH_MAX, HELD, WIDER};

/// What an experiment tells of the parameters, if it came out so.
pub(super) struct Foreseen {
    /// Standard deviation of each parameter, in its unit; 0 for what is known.
    pub sigmas: Vec<f64>,
    /// By how many times each grows when what is made up beforehand is taken [`WIDER`] times as wide.
    pub growth: Vec<f64>,
}

impl Foreseen {
    /// At these numbers; `None` if this finder cannot make the experiment.
    pub fn of(model: &Model, numbers: &[f64]) -> Option<Self> {
        let whitening = model.assumptions.camera.map(|camera| camera.whitening()).transpose().ok()?;
        let unknowns = model.unknowns(numbers);
        let free: Vec<usize> = (0..unknowns.len()).filter(|&i| !unknowns[i].fixed).collect();
        // Columns in units of what was believed before, so that they are of like size.
        let units: Vec<f64> = free.iter().map(|&i| model.sigma_before(i).max(1e-12)).collect();
        let steps: Vec<f64> = free.iter().map(|&i| 1e-5 * unknowns[i].scale).collect();
        let slopes = |rows: &dyn Fn(&[f64]) -> Option<Vec<f64>>| {
            let mut columns = Vec::with_capacity(free.len());
            for ((&i, step), unit) in free.iter().zip(&steps).zip(&units) {
                let mut moved = numbers.to_vec();
                moved[i] += step;
                let high = rows(&moved)?;
                moved[i] -= 2.0 * step;
                let low = rows(&moved)?;
                columns.push(high.iter().zip(&low).map(|(h, l)| (h - l) / (2.0 * step) * unit).collect::<Vec<f64>>());
            }
            Some(DMatrix::from_fn(columns.first()?.len(), free.len(), |r, c| columns[c][r]))
        };
        let data = slopes(&|p| model.data_rows(p))?;
        let sigmas = |wider: f64| {
            let prior = slopes(&|p| {
                let mut rows = Vec::new();
                model.prior_rows(p, numbers, whitening.as_deref(), wider, &mut rows);
                Some(rows)
            })?;
            let mut stacked = DMatrix::zeros(data.nrows() + prior.nrows(), free.len());
            stacked.rows_mut(0, data.nrows()).copy_from(&data);
            stacked.rows_mut(data.nrows(), prior.nrows()).copy_from(&prior);
            // (JᵀJ)⁻¹ = R⁻¹·R⁻ᵀ, without squaring what is badly conditioned.
            let inverse = stacked.qr().r().try_inverse()?;
            Some(inverse.row_iter().map(|row| row.norm()).collect::<Vec<f64>>())
        };
        let (now, wide) = (sigmas(1.0)?, sigmas(WIDER)?);
        let mut all = Self { sigmas: vec![0.0; unknowns.len()], growth: vec![1.0; unknowns.len()] };
        for (k, &i) in free.iter().enumerate() {
            all.sigmas[i] = now[k] * units[k];
            all.growth[i] = wide[k] / now[k];
        }
        Some(all)
    }
}

/// Whether the data hold parameter `i` by themselves.
pub(super) fn is_held(model: &Model, i: usize, sigma: f64, growth: f64) -> bool {
    sigma <= HELD * model.sigma_before(i) && growth <= GROWTH_MAX
}
