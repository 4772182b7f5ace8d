//! The laser's stripe on a flat board: points to sub-pixel, in whichever channel, direction and fineness it shows best.
//!
//! On a flat board the stripe is a straight line to a camera without distortion. That is the measure of how well it was found:
//! each image is looked at in each channel, along columns and along rows, as it is and with 2 × 2 and 4 × 4 pixels taken
//! together (a stripe wider than some pixels is mostly speckle at full size), and the look is kept whose line is the tightest.

use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::report::robust_sigma;
use crate::fault::{Fault, Result, number_within};
use crate::image::Image;
use crate::line::{Extractor, LineParams};
use crate::optics::Camera;

/// How a stripe is found on a board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StripeParams {
    /// Points dimmer than this part of the bright ones (their 90th percentile) are left out: at its ends a stripe drowns in its
    /// own halo, which is not centred on it.
    pub level_min: f64,
    /// Points this many robust standard deviations off the straight line are left out.
    pub outlier_sigmas: f64,
    /// Fewer points than this are no stripe.
    pub points_min: usize,
    /// How the line is extracted.
    pub line: LineParams,
}

impl Default for StripeParams {
    fn default() -> Self {
        Self { level_min: 0.5, outlier_sigmas: 3.0, points_min: 16, line: LineParams::default() }
    }
}

impl StripeParams {
    /// Refuses numbers that make no sense.
    pub fn validated(self) -> Result<Self> {
        number_within("stripe.level_min", self.level_min, 0.0, 1.0)?;
        number_within("stripe.outlier_sigmas", self.outlier_sigmas, 2.0, 1e3)?;
        if !(8..=10_000).contains(&self.points_min) {
            return Err(Fault::new("stripe.points_min", self.points_min, "8 to 10000"));
        }
        self.line.validated()?;
        Ok(self)
    }
}

/// A stripe on a board.
#[derive(Clone, Debug, PartialEq)]
pub struct Stripe {
    /// Its points (column, row) [px] of the full image.
    pub points: Vec<[f64; 2]>,
    /// RMS distance of the points from their straight line [px].
    pub sigma_px: f64,
    /// How many neighbours err alike: the points hold as much as `points.len() / alike` independent ones would.
    pub alike: f64,
    /// Points found that were not on the board.
    pub outside: usize,
    /// Points found on the board but off the line, or too dim.
    pub off: usize,
    /// The look it was found in.
    pub look: String,
}

/// How many pixels are taken together, each way.
const FINENESS: [usize; 3] = [1, 2, 4];
/// A look whose line has less than this part of the longest one's points is not taken.
const LENGTH_MIN: f64 = 0.5;
/// A point farther than this from the line of the most is none of it [px].
const NEAR_PX: f64 = 3.0;

/// Finds the stripe on the board that `on_board` knows: whether a line of sight (x, y, 1) meets it. `images` are the channels
/// of one image, with names.
///
/// Errors: a black or saturated image, no stripe, a stripe that lies outside the board.
pub fn find(
    images: &[(&str, &Image)],
    camera: &Camera,
    on_board: &dyn Fn(&Vector3<f64>) -> bool,
    params: &StripeParams,
) -> Result<Stripe> {
    let params = params.validated()?;
    let mut extractor = Extractor::new(params.line)?;
    let (mut looks, mut outside_most, mut found_most): (Vec<Straight>, usize, usize) = (Vec::new(), 0, 0);
    for (name, image) in images {
        if (image.width(), image.height()) != (camera.width, camera.height) {
            let found = format!("{} x {}", image.width(), image.height());
            return Err(Fault::new("image size", found, format!("{} x {}, the camera's", camera.width, camera.height)));
        }
        for fineness in FINENESS {
            for along_rows in [false, true] {
                let Some(small) = reduced(image, fineness, along_rows) else { continue };
                let line = extractor.extract(&small);
                let mut look = Look { points: Vec::new(), outside: 0, step: fineness as f64, along_rows };
                let middle = (fineness as f64 - 1.0) / 2.0;
                for (i, peak) in line.columns.iter().enumerate().filter_map(|(i, peak)| peak.map(|p| (i, p))) {
                    let across = f64::from(peak.v) * fineness as f64 + middle;
                    let along = (i * fineness) as f64 + middle;
                    let [u, v] = if along_rows { [across, along] } else { [along, across] };
                    match camera.ray(u, v) {
                        Some(ray) if on_board(&ray) => {
                            look.points.push(Seen { at: [u, v], ray: ray.xy(), level: peak.level })
                        }
                        _ => look.outside += 1,
                    }
                }
                outside_most = outside_most.max(look.outside);
                found_most = found_most.max(look.points.len());
                let how = format!("{name}, {} px, {}", fineness, if along_rows { "by rows" } else { "by columns" });
                looks.extend(look.straight(camera, &params, how));
            }
        }
    }
    // A short piece of a line, or of the board's edge, may be tight too: it must be about as long as the longest.
    let longest = looks.iter().map(|l| l.length_px).fold(0.0, f64::max);
    let long = looks.into_iter().filter(|l| l.length_px >= LENGTH_MIN * longest);
    let best = long.min_by(|a, b| a.score.total_cmp(&b.score));
    best.map(|l| l.stripe).ok_or_else(|| refused(images, found_most, outside_most, &params))
}

/// Why there is no stripe.
fn refused(images: &[(&str, &Image)], found: usize, outside: usize, params: &StripeParams) -> Fault {
    let share = |counts: &dyn Fn(u8, u8) -> bool| {
        let of = |image: &Image| {
            let count = image.levels().iter().filter(|level| counts(**level, image.white())).count();
            count as f64 / image.levels().len() as f64
        };
        images.iter().map(|(_, image)| of(image)).fold(0.0, f64::max)
    };
    let full = share(&|level, white| level >= white);
    if full > 0.5 {
        return Fault::new("stripe", format!("an image {:.0} % saturated", full * 100.0), "a shorter exposure");
    }
    if share(&|level, white| level > white / 16) < 1e-4 {
        return Fault::new("stripe", "a black image", "the laser on, and a longer exposure");
    }
    if outside >= params.points_min && found < params.points_min {
        let found = format!("outside the board ({outside} points, {found} on it)");
        return Fault::new(
            "stripe",
            found,
            "a stripe across the board, or a wider margin if its flat sheet reaches further",
        );
    }
    let expected = format!("one straight line of at least {} points on the board", params.points_min);
    Fault::new("stripe", "none", expected)
}

/// The image with `n` × `n` pixels taken together; its rows become columns if `turned`. `None` if nothing is left.
fn reduced(image: &Image, n: usize, turned: bool) -> Option<Image> {
    let (across, down) = (image.width() / n, image.height() / n);
    let mut sums = vec![0u32; across * down];
    for v in 0..down * n {
        let row = &image.row(v)[..across * n];
        let sums = &mut sums[(v / n) * across..(v / n + 1) * across];
        for (sum, pixels) in sums.iter_mut().zip(row.chunks_exact(n)) {
            *sum += pixels.iter().map(|p| u32::from(*p)).sum::<u32>();
        }
    }
    let count = (n * n) as u32;
    let level = |sum: u32| ((sum + count / 2) / count) as u8;
    let levels = if turned {
        (0..across).flat_map(|u| (0..down).map(move |v| (u, v))).map(|(u, v)| level(sums[v * across + u])).collect()
    } else {
        sums.into_iter().map(level).collect()
    };
    let (width, height) = if turned { (down, across) } else { (across, down) };
    Image::new(width, height, image.white(), levels).ok()
}

/// A point of the line, on the board.
#[derive(Clone, Copy)]
struct Seen {
    at: [f64; 2],
    /// Its line of sight (x, y), z = 1.
    ray: Vector2<f64>,
    level: f32,
}

/// What one look at the image shows.
struct Look {
    points: Vec<Seen>,
    outside: usize,
    /// Pixels from one point to the next.
    step: f64,
    along_rows: bool,
}

impl Look {
    /// The points on one straight line.
    fn straight(self, camera: &Camera, params: &StripeParams, look: String) -> Option<Straight> {
        if self.points.len() < params.points_min {
            return None;
        }
        let focal = (camera.fx + camera.fy) / 2.0;
        let rays: Vec<Vector2<f64>> = self.points.iter().map(|p| p.ray * focal).collect();
        let mut line = best_line(&rays)?;
        let mut limit = NEAR_PX;
        for _ in 0..10 {
            let near: Vec<Vector2<f64>> = rays.iter().filter(|r| line.off(r).abs() < limit).copied().collect();
            line = Line::through_all(&near)?;
            let sigma = robust_sigma(near.iter().map(|r| line.off(r)));
            limit = (params.outlier_sigmas * sigma).clamp(0.1, NEAR_PX);
        }
        // A stripe cut at a slant shifts towards its bright end: it is cut along columns or rows, whichever is more across it.
        let across = if self.along_rows { line.normal.x } else { line.normal.y };
        if across.abs() < 0.65 {
            return None;
        }
        let on_line = |p: &&Seen| line.off(&(p.ray * focal)).abs() < limit;
        let mut levels: Vec<f32> = self.points.iter().filter(on_line).map(|p| p.level).collect();
        levels.sort_by(f32::total_cmp);
        let least = levels.get(levels.len() * 9 / 10)? * params.level_min as f32;
        let kept: Vec<Seen> = self.points.iter().filter(on_line).filter(|p| p.level >= least).copied().collect();
        if kept.len() < params.points_min {
            return None;
        }
        let off: Vec<f64> = kept.iter().map(|p| line.off(&(p.ray * focal))).collect();
        let sigma_px = (off.iter().map(|e| e * e).sum::<f64>() / off.len() as f64).sqrt().max(0.02);
        let length_px = kept.len() as f64 * self.step;
        let stripe = Stripe {
            sigma_px,
            alike: alike(&off),
            outside: self.outside,
            off: self.points.len() - kept.len(),
            points: kept.iter().map(|p| p.at).collect(),
            look,
        };
        Some(Straight { length_px, score: sigma_px / length_px.sqrt(), stripe })
    }
}

/// The points of one look that are on a straight line.
struct Straight {
    /// Columns or rows with a point.
    length_px: f64,
    /// What is left open of the line's place: smaller is better.
    score: f64,
    stripe: Stripe,
}

/// A straight line n·p = d.
#[derive(Clone, Copy)]
struct Line {
    normal: Vector2<f64>,
    offset: f64,
}

impl Line {
    fn off(&self, p: &Vector2<f64>) -> f64 {
        self.normal.dot(p) - self.offset
    }

    fn through(a: &Vector2<f64>, b: &Vector2<f64>) -> Option<Self> {
        let normal = Vector2::new(a.y - b.y, b.x - a.x).try_normalize(1e-6)?;
        Some(Self { normal, offset: normal.dot(a) })
    }

    /// The line of least squared distances.
    fn through_all(points: &[Vector2<f64>]) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in points {
            let d = p - mean;
            (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
        }
        // The direction of largest spread is at half the angle of the doubled one.
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let normal = Vector2::new(-angle.sin(), angle.cos());
        normal.iter().all(|x| x.is_finite()).then_some(Self { normal, offset: normal.dot(&mean) })
    }
}

/// The line with the most points near it, among lines through two of them: evenly spread pairs, the same every time.
fn best_line(points: &[Vector2<f64>]) -> Option<Line> {
    const TRIES: usize = 400;
    let at = |x: f64| points.get((x.fract() * points.len() as f64) as usize);
    let mut best: Option<(f64, Line)> = None;
    for k in 1..=TRIES {
        // Parts of the plastic number's powers fill the unit square evenly.
        let (Some(a), Some(b)) = (at(k as f64 * 0.754_877_666), at(k as f64 * 0.569_840_291)) else { continue };
        let Some(line) = Line::through(a, b) else { continue };
        let cost: f64 = points.iter().map(|p| line.off(p).powi(2).min(NEAR_PX * NEAR_PX)).sum();
        if best.as_ref().is_none_or(|(known, _)| cost < *known) {
            best = Some((cost, line));
        }
    }
    best.map(|(_, line)| line)
}

/// How many neighbours err alike: 1 + 2·Σ of the correlations up to the first that is not positive.
fn alike(off: &[f64]) -> f64 {
    let power: f64 = off.iter().map(|e| e * e).sum();
    let correlation = |lag: usize| off.iter().zip(&off[lag..]).map(|(a, b)| a * b).sum::<f64>() / power.max(1e-300);
    let sum: f64 = (1..off.len() / 4).map(correlation).take_while(|c| *c > 0.0).sum();
    1.0 + 2.0 * sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera { distortion: crate::optics::Distortion::Pinhole, width: 320, height: 240, ..Camera::metro_i() }
    }

    /// A stripe of this width along v(u) = 60 + slope·u, or along the rows.
    fn image(slope: f64, width_px: f64, upright: bool) -> Image {
        let level = |u: usize, v: usize| {
            let (along, across) = if upright { (v, u) } else { (u, v) };
            let d = (across as f64 - 60.0 - slope * along as f64) / width_px;
            let speckle = 1.0 + 0.3 * ((u * 7919 + v * 104_729) as f64).sin();
            (10.0 + 150.0 * speckle * (-0.5 * d * d).exp()) as u8
        };
        let levels = (0..240).flat_map(|v| (0..320).map(move |u| (u, v))).map(|(u, v)| level(u, v)).collect();
        Image::new(320, 240, 255, levels).unwrap()
    }

    fn found(image: &Image, on_board: &dyn Fn(&Vector3<f64>) -> bool) -> Result<Stripe> {
        find(&[("red", image)], &camera(), on_board, &StripeParams::default())
    }

    #[test]
    fn a_stripe_is_found_along_columns_and_along_rows_and_wide_ones_too() {
        for (upright, width, look) in [(false, 0.8, "by columns"), (true, 0.8, "by rows"), (false, 4.0, "by columns")] {
            let stripe = found(&image(0.2, width, upright), &|_| true).unwrap();
            assert!(stripe.look.contains(look), "{}", stripe.look);
            assert!(stripe.points.len() > 50 && stripe.outside == 0, "{} {}", stripe.look, stripe.points.len());
            for [u, v] in &stripe.points {
                let (along, across) = if upright { (v, u) } else { (u, v) };
                assert!((across - 60.0 - 0.2 * along).abs() < 0.6, "{u} {v}");
            }
            let mean = stripe.points.iter().map(|[u, v]| if upright { u - 0.2 * v } else { v - 0.2 * u }).sum::<f64>()
                / stripe.points.len() as f64;
            assert!((mean - 60.0).abs() < 0.05, "{mean}");
        }
    }

    #[test]
    fn only_what_is_on_the_board_counts() {
        let image = image(0.0, 0.8, false);
        let half = found(&image, &|ray| ray.x > 0.0).unwrap();
        assert!(half.points.iter().all(|[u, _]| *u > camera().cx) && half.outside > 100, "{}", half.outside);
        let fault = found(&image, &|_| false).unwrap_err().to_string();
        assert!(fault.contains("outside the board"), "{fault}");
    }

    #[test]
    fn images_that_show_none_are_refused_with_the_reason() {
        let fault = |level: u8| {
            let image = Image::new(320, 240, 255, vec![level; 320 * 240]).unwrap();
            found(&image, &|_| true).unwrap_err().to_string()
        };
        assert!(fault(0).contains("black"));
        assert!(fault(255).contains("saturated"));
        assert!(fault(90).contains("found none"));
        let small = Image::new(32, 24, 255, vec![0; 32 * 24]).unwrap();
        assert!(found(&small, &|_| true).unwrap_err().to_string().contains("320 x 240"));
    }

    #[test]
    fn neighbours_that_err_alike_count_less() {
        let noise = |i: usize| ((i * i * 31 + 17 * i) as f64 * 0.77).sin();
        let white: Vec<f64> = (0..400).map(noise).collect();
        let smooth: Vec<f64> = (0..400).map(|i| (0..8).map(|k| noise(i + k)).sum()).collect();
        assert!(alike(&white) < 2.0 && alike(&smooth) > 4.0, "{} {}", alike(&white), alike(&smooth));
    }
}
