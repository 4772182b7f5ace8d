//! Verdict and report of a camera's calibration.

use super::camera::{BlockFit, place};
use super::page::{Page, histogram, vectors};
use super::report::{Verdict, Weak, weak};
use super::views::{BoardFit, PosedView};
use crate::fault::{Result, positive};
use crate::report::html::{figures, table};
use crate::report::{Plot, Series, Style};

/// What is asked of a camera's calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraLimits {
    /// RMS distance of the marks in the image, the target as its drawing says [px].
    pub rms_px_max: f64,
    /// Relative standard deviation of the focal length.
    pub f_sigma_max: f64,
}

impl Default for CameraLimits {
    fn default() -> Self {
        Self { rms_px_max: 0.5, f_sigma_max: 0.01 }
    }
}

impl CameraLimits {
    /// Refuses limits that nothing can keep.
    pub fn validated(self) -> Result<Self> {
        positive("limit of the reprojection", self.rms_px_max)?;
        positive("limit of the focal length", self.f_sigma_max)?;
        Ok(self)
    }

    fn verdict(&self, rms_px: f64, f_sigma: f64) -> Verdict {
        let mut reasons = Vec::new();
        if rms_px.is_nan() || rms_px > self.rms_px_max {
            reasons.push(format!("the marks are off by {} px RMS, more than {}", figures(rms_px, 3), self.rms_px_max));
        }
        if f_sigma.is_nan() || f_sigma > self.f_sigma_max {
            let (found, most) = (figures(f_sigma * 100.0, 2), figures(self.f_sigma_max * 100.0, 2));
            reasons.push(format!("the focal length is known to {found} % only, not to {most} %"));
        }
        Verdict::of(reasons)
    }

    fn words(&self) -> String {
        let f = figures(self.f_sigma_max * 100.0, 2);
        format!("marks off by at most {} px RMS, focal length known to {f} % (σ)", self.rms_px_max)
    }
}

impl BlockFit {
    /// Whether it keeps the limits.
    pub fn verdict(&self, limits: &CameraLimits) -> Verdict {
        limits.verdict(self.residual().rms, self.solution.sigma(place::F) / self.f_mm)
    }

    /// What the marks hardly tell apart.
    pub fn weak(&self) -> Vec<Weak> {
        weak(&self.solution, &(place::ORIGIN..=place::CENTRE + 1).collect::<Vec<_>>())
    }

    /// The report as HTML. `marks` are the pixels of the marks used, in the order of `residuals_px`.
    pub fn page(&self, limits: &CameraLimits, marks: &[[f64; 2]]) -> String {
        let shape = if self.flat { "flat" } else { "with depth" };
        let about = format!(
            "One view of a target, {shape}, {} marks, tilted {:.1}° against the line of sight. Model: Tsai, one factor k.",
            self.used.len(),
            self.tilt_rad.to_degrees()
        );
        let all: Vec<_> = marks.iter().copied().zip(self.residuals_px.iter().copied()).collect();
        let each: Vec<f64> = self.residuals_px.iter().flatten().copied().collect();
        Page {
            title: "Calibration of a camera".into(),
            about,
            verdict: &self.verdict(limits),
            limits: limits.words(),
            report: &self.report(),
            weak: &self.weak(),
            plots: vec![
                vectors("Marks", [self.camera.width, self.camera.height], &all),
                histogram("Marks, columns and rows", "px", &each),
            ],
            images: String::new(),
        }
        .html()
    }
}

impl PosedView {
    /// Tilt of the board against the line of sight [rad].
    pub fn tilt_rad(&self) -> f64 {
        let normal = self.camera_from_target.rotate(&nalgebra::Vector3::z());
        normal.x.hypot(normal.y).atan2(normal.z.abs())
    }

    /// RMS distance of the marks, the board as its drawing says [px].
    pub fn drawn_rms_px(&self) -> f64 {
        let square: f64 = self.drawn_residuals_px.iter().map(|[u, v]| u * u + v * v).sum();
        (square / self.drawn_residuals_px.len().max(1) as f64).sqrt()
    }
}

impl BoardFit {
    /// Whether it keeps the limits.
    pub fn verdict(&self, limits: &CameraLimits) -> Verdict {
        let f_sigma = (0..2).map(|i| self.solution.sigma(i) / self.solution.values[i]).fold(0.0, f64::max);
        limits.verdict(self.drawn_residual().rms, f_sigma)
    }

    /// What the boards hardly tell apart.
    pub fn weak(&self) -> Vec<Weak> {
        weak(&self.solution, &(0..9).collect::<Vec<_>>())
    }

    /// The report as HTML.
    pub fn page(&self, limits: &CameraLimits) -> String {
        let about = format!(
            "{} views of a flat board. Model: pinhole with Brown–Conrady distortion. The board itself is estimated to be off its \
             drawing by {} mm RMS: with it the marks are off by {} px RMS, against the drawing by {} px.",
            self.views.len(),
            figures(self.board_rms_m() * 1e3, 2),
            figures(self.residual().rms, 3),
            figures(self.drawn_residual().rms, 3)
        );
        let pixels = |v: &PosedView| v.marks.iter().map(|m| [m.u_px, m.v_px]).collect::<Vec<_>>();
        let all: Vec<_> = self.views.iter().flat_map(|v| pixels(v).into_iter().zip(v.residuals_px.clone())).collect();
        let drawn: Vec<_> =
            self.views.iter().flat_map(|v| pixels(v).into_iter().zip(v.drawn_residuals_px.clone())).collect();
        let each: Vec<f64> = self.views.iter().flat_map(|v| v.residuals_px.iter().flatten().copied()).collect();
        let size = [self.camera.width, self.camera.height];
        let places = |v: &PosedView| (v.tilt_rad().to_degrees(), v.drawn_rms_px());
        let tilts = Plot::new("Views", "tilt of the board", "°", "marks off, RMS", "px")
            .with(Series::new("", Style::Dots, self.views.iter().map(places).collect()))
            .from_zero();
        let rows = self.views.iter().map(|v| {
            [
                v.name.clone(),
                v.marks.len().to_string(),
                figures(v.residual().rms, 3),
                figures(v.drawn_rms_px(), 3),
                figures(v.residual().max, 3),
                figures(v.tilt_rad().to_degrees(), 3),
                figures(v.camera_from_target.xyz().norm(), 4),
            ]
        });
        let head = ["image", "marks", "rms [px]", "rms, drawn [px]", "largest [px]", "tilt [°]", "distance [m]"];
        let images =
            "<h2>Image by image</h2><p>rms: the marks against the board as it is estimated to be; drawn: against its \
                      drawing.</p>"
                .to_string()
                + &table(head, rows);
        Page {
            title: "Calibration of a camera".into(),
            about,
            verdict: &self.verdict(limits),
            limits: limits.words(),
            report: &self.report(),
            weak: &self.weak(),
            plots: vec![
                vectors("Marks", size, &all),
                vectors("Marks against the drawing", size, &drawn),
                histogram("Marks, columns and rows", "px", &each),
                tilts,
            ],
            images,
        }
        .html()
    }
}
