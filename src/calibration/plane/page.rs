//! Verdict and report of a laser plane's calibration.

use super::{FrameFit, HeldOut, PlaneFit, place, rms};
use crate::calibration::page::{Page, histogram, vectors};
use crate::calibration::report::{Residual, Verdict, Weak, weak};
use crate::fault::{Result, positive};
use crate::report::html::{figures, table};
use crate::report::{Plot, Series, Style};

/// What is asked of a plane's calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaneLimits {
    /// RMS distance of the stripes from the plane, as a part of the boards' distance from the camera.
    pub rms_part_max: f64,
    /// Standard deviation of the normal's direction [rad].
    pub normal_sigma_rad_max: f64,
    /// Boards that must carry a stripe.
    pub boards_min: usize,
}

impl Default for PlaneLimits {
    fn default() -> Self {
        Self { rms_part_max: 0.002, normal_sigma_rad_max: 2e-3, boards_min: 4 }
    }
}

impl PlaneLimits {
    /// Refuses limits that nothing can keep.
    pub fn validated(self) -> Result<Self> {
        positive("limit of the plane's residual", self.rms_part_max)?;
        positive("limit of the normal", self.normal_sigma_rad_max)?;
        Ok(self)
    }
}

impl PlaneFit {
    /// Distance of the boards with a stripe from the camera, on average [m].
    pub fn distance_m(&self) -> f64 {
        let with = || self.frames.iter().filter(|f| !f.points.is_empty());
        with().map(|f| f.camera_from_board.translation.vector.norm()).sum::<f64>() / with().count().max(1) as f64
    }

    /// Standard deviation of the normal's direction, the worst way [rad].
    pub fn normal_sigma_rad(&self) -> f64 {
        let turn = self.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        turn.symmetric_eigenvalues().max().max(0.0).sqrt()
    }

    /// Whether it keeps the limits.
    pub fn verdict(&self, limits: &PlaneLimits) -> Verdict {
        let mut reasons = Vec::new();
        let (off, most) = (self.residual().rms, limits.rms_part_max * self.distance_m() * 1e3);
        if off.is_nan() || off > most {
            reasons.push(format!(
                "the stripes are off the plane by {} mm RMS, more than {}",
                figures(off, 3),
                figures(most, 3)
            ));
        }
        let (turn, most) = (self.normal_sigma_rad().to_degrees(), limits.normal_sigma_rad_max.to_degrees());
        if turn.is_nan() || turn > most {
            reasons.push(format!("the normal is known to {}° only, not to {}°", figures(turn, 2), figures(most, 2)));
        }
        let boards = self.counts()[0];
        if boards < limits.boards_min {
            reasons.push(format!("a stripe on {boards} boards, fewer than {}", limits.boards_min));
        }
        Verdict::of(reasons)
    }

    /// What the stripes hardly tell apart.
    pub fn weak(&self) -> Vec<Weak> {
        weak(&self.solution, &(0..place::FRAMES).collect::<Vec<_>>())
    }

    /// The report as HTML.
    pub fn page(&self, limits: &PlaneLimits, held: &[HeldOut]) -> String {
        let [stripes, boards] = self.counts();
        let mut about = format!(
            "Stripes on {stripes} boards, {boards} boards seen by their corners. In the image the stripes are off by {} px RMS; the \
             plane by SVD alone was turned by {}°.",
            figures(self.stripe_residual().rms, 3),
            figures(self.svd_off_rad.to_degrees(), 2)
        );
        if let Some([shift, turn]) = self.arm_sigma {
            let (shift, turn) = (figures(shift * 1e3, 2), figures(turn.to_degrees(), 2));
            about += &format!(" The arm's poses are off by {shift} mm and {turn}° (σ, each axis).");
        }
        if !held.is_empty() {
            let [all, seen, arm] = residuals_of(held);
            about += &format!(
                " Held out: the triangulated stripes of {} images lie {} mm RMS off their boards ({} mm where the board is seen, \
                 {} mm where it is known through the arm).",
                held.len(),
                figures(all.rms, 3),
                figures(seen.rms, 3),
                figures(arm.rms, 3)
            );
        }
        let mm = figures(limits.rms_part_max * self.distance_m() * 1e3, 3);
        let degrees = figures(limits.normal_sigma_rad_max.to_degrees(), 2);
        let each: Vec<f64> = self.frames.iter().flat_map(|f| f.from_plane_m.iter().map(|d| d * 1e3)).collect();
        Page {
            title: "Calibration of a laser plane".into(),
            about,
            verdict: &self.verdict(limits),
            limits: format!(
                "stripes off the plane by at most {mm} mm RMS, the normal known to {degrees}° (σ), at least {} boards",
                limits.boards_min
            ),
            report: &self.report(),
            weak: &self.weak(),
            plots: vec![self.stripes(), histogram("Stripe points off the plane", "mm", &each), self.by_distance()],
            images: self.images() + &held_table(held),
        }
        .html()
    }

    /// Each stripe in the image, with what is left of it across.
    fn stripes(&self) -> Plot {
        let mut all = Vec::new();
        for frame in &self.frames {
            let (Some(first), Some(last)) = (frame.points.first(), frame.points.last()) else { continue };
            let along = nalgebra::Vector2::new(last[0] - first[0], last[1] - first[1]);
            let Some(along) = along.try_normalize(1e-9) else { continue };
            let every = frame.points.len().div_ceil(40).max(1);
            for (point, off) in frame.points.iter().zip(&frame.stripe_px).step_by(every) {
                all.push((*point, [-along.y * off.abs() * off.signum(), along.x * off]));
            }
        }
        vectors("Stripes", [self.camera.width, self.camera.height], &all)
    }

    fn by_distance(&self) -> Plot {
        let with = |seen: bool| {
            let frames = self.frames.iter().filter(|f| !f.points.is_empty() && (f.corners > 0) == seen);
            frames.map(|f| (f.camera_from_board.translation.vector.norm() * 1e3, f.plane_rms_m() * 1e3)).collect()
        };
        let mut plot = Plot::new("Stripes off the plane", "distance of the board", "mm", "RMS", "mm")
            .with(Series::new("boards seen", Style::Dots, with(true)))
            .from_zero();
        if self.hand_eye.is_some() {
            plot = plot.with(Series::new("through the arm", Style::Dots, with(false)));
        }
        plot
    }

    fn images(&self) -> String {
        let row = |f: &FrameFit| {
            let dash = |shown: bool, text: String| if shown { text } else { "–".into() };
            let (seen, lit) = (f.corners > 0, !f.points.is_empty());
            [
                f.name.clone(),
                dash(seen, f.corners.to_string()),
                dash(seen, figures(f.corners_px, 3)),
                dash(lit, f.points.len().to_string()),
                dash(lit, f.outside.to_string()),
                dash(lit, figures(rms(f.stripe_px.iter().copied()), 3)),
                dash(lit, figures(f.plane_rms_m() * 1e3, 3)),
                dash(f.arm_off[0] > 0.0, figures(f.arm_off[0] * 1e3, 2)),
                dash(f.arm_off[1] > 0.0, figures(f.arm_off[1].to_degrees(), 2)),
                f.look.clone(),
            ]
        };
        let head = [
            "image",
            "corners",
            "rms [px]",
            "points",
            "outside",
            "stripe [px]",
            "plane [mm]",
            "arm off [mm]",
            "arm off [°]",
            "look",
        ];
        "<h2>Image by image</h2><p>outside: points that were not on the board and not used. stripe: RMS distance in the image from \
         where plane and board cross. plane: RMS distance of the points from the plane. arm off: the most likely error of the \
         arm's pose. look: channel, pixels taken together, direction.</p>"
            .to_string()
            + &table(head, self.frames.iter().map(row))
    }
}

/// Distances of held-out points from their boards [mm]: of all, of those on boards that were seen, of those through the arm.
pub fn residuals_of(held: &[HeldOut]) -> [Residual; 3] {
    let of = |counts: &dyn Fn(&HeldOut) -> bool| {
        let some = held.iter().filter(|h| counts(h));
        Residual::of(some.flat_map(|h| h.from_board_m.iter().map(|d| d.abs() * 1e3)), "mm")
    };
    [of(&|_| true), of(&|h| h.seen), of(&|h| !h.seen)]
}

fn held_table(held: &[HeldOut]) -> String {
    if held.is_empty() {
        return String::new();
    }
    let row = |h: &HeldOut| {
        let board = if h.seen { "seen" } else { "through the arm" };
        let off = figures(rms(h.from_board_m.iter().copied()) * 1e3, 3);
        [h.name.clone(), board.into(), h.from_board_m.len().to_string(), off]
    };
    "<h2>Held out</h2><p>Calibrated without these; their stripes, triangulated, should lie on their boards.</p>"
        .to_string()
        + &table(["image", "board", "points", "off the board, RMS [mm]"], held.iter().map(row))
}
