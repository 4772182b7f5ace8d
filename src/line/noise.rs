//! The noise of an image, from its own ridges: the line fills few of its bands, so their median ridge is noise.

/// Largest ridge: four times the largest level.
const RIDGE_MAX: usize = 4 * 255;

/// Median of the strongest ridge in a band, over the standard deviation of a pixel, for white noise (see the test).
const RIDGE_OF_NOISE: f32 = 3.42;

/// The noise of a pixel of an image with this median ridge [levels, standard deviation].
pub(super) fn of_pixel(median: f32) -> f32 {
    median / RIDGE_OF_NOISE
}

/// How many ridges have which strength.
#[derive(Clone, Debug)]
pub(super) struct Counts(Vec<u32>);

impl Default for Counts {
    fn default() -> Self {
        Self(vec![0; RIDGE_MAX + 1])
    }
}

impl Counts {
    pub fn clear(&mut self) {
        self.0.fill(0);
    }

    pub fn add(&mut self, strength: i16) {
        self.0[strength.clamp(0, RIDGE_MAX as i16) as usize] += 1;
    }

    /// The median, interpolated within whole numbers; 0 of none.
    pub fn median(&self) -> f32 {
        let half = self.0.iter().sum::<u32>() as f32 / 2.0;
        let mut below = 0.0;
        for (number, count) in self.0.iter().enumerate().filter(|(_, count)| **count > 0) {
            let count = *count as f32;
            if below + count >= half {
                return (number as f32 - 0.5 + (half - below) / count).max(0.0);
            }
            below += count;
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::{Look, Noise, render, sensor};
    use super::*;
    use crate::image::Image;
    use crate::line::ridge::Grid;
    use crate::line::scan::Scan;

    fn seen(image: &Image, is_exact: bool) -> f64 {
        let (mut scan, grid) = (Scan::default(), Grid::new(image, 2));
        let rounded = scan.scan(image, grid, true);
        f64::from(of_pixel(if is_exact { scan.scan_again(image, grid, true) } else { rounded }))
    }

    #[test]
    fn the_noise_of_a_pixel_is_seen_to_15_percent_whatever_the_line() {
        for size in [(512, 480), (640, 480), (1280, 100), (40, 2000), (10, 3000)] {
            for read in [1.0, 3.0, 10.0] {
                for peak in [0.0, 90.0] {
                    let look = Look { background: 60.0, read, ..sensor(0.8, peak) };
                    let image = render(size, look, &mut Noise::new(12), |_| Some(50.0));
                    let truth = (read * read + 1.0 / 12.0 + look.shot * 60.0).sqrt();
                    for is_exact in [true, false] {
                        let ratio = seen(&image, is_exact) / truth;
                        assert!((ratio - 1.0).abs() < 0.15, "{size:?} {read} {peak}: {ratio} {is_exact}");
                    }
                }
            }
        }
    }
}
