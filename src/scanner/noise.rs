//! The image sensor: from electrons to grey levels (EMVA 1288, linear model), and the light collected in one exposure.
//!
//! μ_y = K·μ, σ_y² = K²·(μ + σ_d²) + 1/12, clipped at 0 and at the well. Shot noise is a normal deviate of variance μ,
//! which is near enough to Poisson from some 20 electrons on; dark signal and ambient light keep every pixel above that.
//! Every deviate comes from 16 bits hashed from (seed, frame, pixel): no state, so no thread can change what another draws.

use super::blooming::spill;
use crate::fault::Result;
use crate::image::Image;

/// Side of the blocks of pixels that share a background [px].
const BLOCK: usize = 8;
/// The background changes from zone to zone by this many levels, or by more where there would be too many zones.
const ZONE_LEVELS: f64 = 0.1;
/// Most zones of background.
const ZONES_MAX: f64 = 64.0;

/// What a detector is made of; all numbers already checked.
#[derive(Clone, Copy, Debug)]
pub(super) struct Detector {
    /// Electrons that fill a pixel.
    pub well_electrons: f64,
    /// RMS read noise [electrons].
    pub read_noise_electrons: f64,
    /// What a pixel in the middle of the image collects without the laser: dark signal and ambient light [electrons].
    pub background_electrons: f64,
    /// Share of a full pixel's overflow that goes up and down its column.
    pub blooming: f64,
    /// Level of a full pixel.
    pub white_level: u8,
}

/// A detector with the levels of its background drawn up in advance.
#[derive(Clone, Debug)]
pub(super) struct Sensor {
    detector: Detector,
    zones: Vec<Zone>,
    /// The zone of each block of pixels, row by row; empty where there is one zone only.
    zone_of: Vec<u8>,
}

/// Pixels with the same background.
#[derive(Clone, Debug)]
struct Zone {
    /// Without laser light [electrons].
    electrons: f64,
    /// The level without laser light for each value of a pixel's 16 random bits.
    levels: Box<[u8; 1 << 16]>,
}

impl Detector {
    /// The level of a pixel that collected `mean` electrons on average. A full well has no noise.
    fn level(&self, mean: f64, bits: u16) -> u8 {
        let white = f64::from(self.white_level);
        if mean >= self.well_electrons * (1.0 - 1e-6) {
            return self.white_level;
        }
        let deviation = (mean + self.read_noise_electrons * self.read_noise_electrons).sqrt();
        let level = (mean + deviate(bits) * deviation) * white / self.well_electrons;
        (level + 0.5).clamp(0.0, white + 0.5) as u8 // truncation: rounds half up
    }

    fn zone(&self, electrons: f64) -> Zone {
        let levels = Box::new(std::array::from_fn(|bits| self.level(electrons, bits as u16)));
        Zone { electrons, levels }
    }
}

impl Sensor {
    /// A sensor with the same background everywhere.
    pub fn new(detector: Detector) -> Self {
        Self { detector, zones: vec![detector.zone(detector.background_electrons)], zone_of: Vec::new() }
    }

    /// A sensor of `width` × `height` pixels whose background at column u, row v has `lost(u, v)` electrons less than in
    /// the middle.
    pub fn shaded(detector: Detector, width: usize, height: usize, lost: impl Fn(f64, f64) -> f64) -> Self {
        let middle = |block: usize| (block * BLOCK) as f64 + (BLOCK as f64 - 1.0) / 2.0;
        let (across, down) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let lost: Vec<f64> = (0..across * down).map(|i| lost(middle(i % across), middle(i / across))).collect();
        let most = lost.iter().copied().fold(0.0, f64::max);
        let level = detector.well_electrons / f64::from(detector.white_level);
        let step = (ZONE_LEVELS * level).max(most / (ZONES_MAX - 1.0));
        if most < step / 2.0 {
            return Self::new(detector);
        }
        let zone_of: Vec<u8> = lost.iter().map(|lost| (lost / step).round().max(0.0) as u8).collect();
        let last = zone_of.iter().copied().max().unwrap_or_default();
        let zone = |zone: u8| detector.zone(detector.background_electrons - f64::from(zone) * step);
        Self { detector, zones: (0..=last).map(zone).collect(), zone_of }
    }

    /// Reads out one exposure.
    pub fn read(&self, mut light: Light, seed: u64, frame: u64) -> Result<Image> {
        if self.detector.blooming > 0.0 {
            let room = self.detector.well_electrons - self.detector.background_electrons;
            light.bloom(room, self.detector.blooming);
        }
        let (width, height) = (light.columns.len(), light.height);
        let draws = Draws::new(seed, frame);
        let mut levels = vec![0; width * height];
        for (group, pixels) in levels.chunks_mut(4).enumerate() {
            let mut bits = draws.bits(group as u64);
            let zone = self.zone(4 * group, width);
            for pixel in pixels {
                *pixel = zone.levels[usize::from(bits as u16)];
                bits >>= 16;
            }
        }
        for (u, column) in light.columns.iter().enumerate() {
            for v in column.first..column.end {
                let pixel = v * width + u;
                let bits = (draws.bits(pixel as u64 / 4) >> (16 * (pixel % 4))) as u16;
                let electrons = f64::from(light.electrons[u * height + v]) + self.zone(pixel / 4 * 4, width).electrons;
                levels[pixel] = self.detector.level(electrons, bits);
            }
        }
        Image::new(width, height, self.detector.white_level, levels)
    }

    /// The zone that a pixel and the three after it are in.
    fn zone(&self, pixel: usize, width: usize) -> &Zone {
        if self.zone_of.is_empty() {
            return &self.zones[0];
        }
        let block = pixel / width / BLOCK * width.div_ceil(BLOCK) + pixel % width / BLOCK;
        &self.zones[usize::from(self.zone_of[block])]
    }
}

/// The laser light that each pixel collects on average.
pub(super) struct Light {
    height: usize,
    /// Column by column [electrons].
    electrons: Vec<f32>,
    columns: Vec<Lit>,
}

/// The rows of a column that hold light: first..end.
#[derive(Clone, Copy, Default)]
struct Lit {
    first: usize,
    end: usize,
}

impl Light {
    pub fn new(width: usize, height: usize) -> Self {
        Self { height, electrons: vec![0.0; width * height], columns: vec![Lit::default(); width] }
    }

    /// Adds a stripe's crossing of a column: a normal profile about row `v`, integrated over each pixel.
    pub fn add(&mut self, bell: &Bell, column: usize, v: f64, sigma_px: f64, electrons: f64) {
        let Some(lit) = self.columns.get_mut(column) else { return };
        let tail = Bell::REACH * sigma_px + 0.5;
        let row = |v: f64| v.round().clamp(0.0, self.height as f64) as usize;
        let (first, end) = (row(v - tail), row(v + tail + 1.0));
        if first >= end || !electrons.is_finite() {
            return;
        }
        let held = lit.first < lit.end;
        *lit = if held { Lit { first: lit.first.min(first), end: lit.end.max(end) } } else { Lit { first, end } };
        let rows = &mut self.electrons[column * self.height..][first..end];
        let mut below = bell.at((first as f64 - 0.5 - v) / sigma_px);
        for (i, pixel) in rows.iter_mut().enumerate() {
            let above = bell.at(((first + i) as f64 + 0.5 - v) / sigma_px);
            *pixel += (electrons * (above - below)) as f32;
            below = above;
        }
    }
}

impl Light {
    /// Adds the same light to every pixel of a square block with this first column and row.
    pub fn add_block(&mut self, [column, row]: [usize; 2], side: usize, electrons: f64) {
        let (width, height) = (self.columns.len(), self.height);
        let (first, end) = (row.min(height), (row + side).min(height));
        for u in column..(column + side).min(width) {
            let lit = &mut self.columns[u];
            let held = lit.first < lit.end;
            *lit = if held { Lit { first: lit.first.min(first), end: lit.end.max(end) } } else { Lit { first, end } };
            self.electrons[u * height..][first..end].iter_mut().for_each(|pixel| *pixel += electrons as f32);
        }
    }

    /// Spills what is over `room` [electrons] along each column.
    fn bloom(&mut self, room: f64, share: f64) {
        for (column, lit) in self.columns.iter_mut().enumerate() {
            let rows = &mut self.electrons[column * self.height..][..self.height];
            let is_over = rows[lit.first..lit.end].iter().any(|held| f64::from(*held) > room);
            if is_over && room > 0.0 {
                spill(rows, room as f32, share as f32);
                let has_light = |row: &usize| rows[*row] > 0.0;
                let first = (0..self.height).find(has_light).unwrap_or(0);
                *lit = Lit { first, end: (0..self.height).rev().find(has_light).map_or(0, |last| last + 1) };
            }
        }
    }
}

/// The cumulative normal distribution, from a table: right to 3e-6.
#[derive(Clone, Debug)]
pub(super) struct Bell {
    table: Vec<f64>,
}

impl Bell {
    /// Standard deviations to either side that are not zero or one.
    const REACH: f64 = 5.0;
    const PER_SIGMA: f64 = 128.0;

    pub fn new() -> Self {
        let step = 1.0 / Self::PER_SIGMA;
        let density = |x: f64| (-x * x / 2.0).exp() / std::f64::consts::TAU.sqrt();
        let mut sum = 0.0;
        let mut table = vec![0.0];
        for i in 0..(2.0 * Self::REACH * Self::PER_SIGMA) as i32 {
            let x = f64::from(i) * step - Self::REACH;
            sum += (density(x) + 4.0 * density(x + step / 2.0) + density(x + step)) * step / 6.0; // Simpson
            table.push(sum);
        }
        table.iter_mut().for_each(|value| *value /= sum);
        Self { table }
    }

    /// Φ(x).
    pub fn at(&self, x: f64) -> f64 {
        let place = (x + Self::REACH) * Self::PER_SIGMA;
        let cell = place.max(0.0) as usize;
        match (self.table.get(cell), self.table.get(cell + 1)) {
            _ if place <= 0.0 => 0.0,
            (Some(a), Some(b)) => a + (b - a) * (place - cell as f64),
            _ => 1.0,
        }
    }
}

/// Random bits as a function of seed, frame and place.
#[derive(Clone, Copy)]
struct Draws {
    key: u64,
}

impl Draws {
    fn new(seed: u64, frame: u64) -> Self {
        Self { key: scatter(scatter(seed) ^ frame) }
    }

    fn bits(self, place: u64) -> u64 {
        scatter(self.key ^ place)
    }
}

/// The finaliser of splitmix64 after its step: a bijection in which every input bit moves every output bit.
pub(super) fn scatter(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// The standard normal deviate that `bits` stand for: the quantile of (bits + ½)/65536, so ±4.3 at most. Rational
/// approximations of Wichura's AS 241, seven digits.
pub(super) fn deviate(bits: u16) -> f64 {
    let q = (f64::from(bits) + 0.5) / 65_536.0 - 0.5;
    if q.abs() <= 0.425 {
        let r = 0.180_625 - q * q;
        let over = ((59.109_374_720 * r + 159.291_132_02) * r + 50.434_271_938) * r + 3.387_132_717_9;
        let under = ((67.187_563_600 * r + 78.757_757_664) * r + 17.895_169_469) * r + 1.0;
        return q * over / under;
    }
    let r = (-(0.5 - q.abs()).ln()).sqrt() - 1.6; // at most 5 − 1.6: the outer tail of AS 241 is never reached
    let over = ((0.170_238_211_03 * r + 1.306_728_481_6) * r + 2.756_815_390_0) * r + 1.423_437_277_7;
    let under = (0.120_211_329_75 * r + 0.737_001_642_50) * r + 1.0;
    (over / under).copysign(q)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small well: its noise is a level and more, so that rounding adds its 1/12 and shifts no mean.
    fn detector(background_electrons: f64) -> Detector {
        Detector {
            well_electrons: 10e3,
            read_noise_electrons: 60.0,
            background_electrons,
            white_level: 127,
            blooming: 0.0,
        }
    }

    fn moments(levels: impl Iterator<Item = u8> + Clone) -> (f64, f64) {
        let count = levels.clone().count() as f64;
        let mean = levels.clone().map(f64::from).sum::<f64>() / count;
        (mean, levels.map(|l| (f64::from(l) - mean).powi(2)).sum::<f64>() / count)
    }

    #[test]
    fn mean_and_variance_are_those_of_emva_1288() {
        // Levels 10 to 100, background and stripe: σ_y² = K²(μ + σ_d²) + 1/12. 512·480 pixels: the mean is good to
        // 1.3/√245760 = 0.003 levels, the variance to √(2/245760) = 0.3 %; the bounds are four times that.
        let gain = 127.0 / 10e3;
        for electrons in [800.0, 2.03e3, 4.41e3, 7.97e3] {
            let variance = gain * gain * (electrons + 3600.0) + 1.0 / 12.0;
            let dark = Sensor::new(detector(electrons)).read(Light::new(512, 480), 7, 3).unwrap();
            let mut light = Light::new(512, 480);
            light.electrons.fill((electrons - 500.0) as f32);
            light.columns.fill(Lit { first: 0, end: 480 });
            let lit = Sensor::new(detector(500.0)).read(light, 8, 3).unwrap();
            for image in [dark, lit] {
                let (mean, spread) = moments(image.levels().iter().copied());
                assert!((mean - gain * electrons).abs() < 0.012, "{mean} for {}", gain * electrons);
                assert!((spread / variance - 1.0).abs() < 0.012, "{spread} for {variance}");
            }
        }
    }

    #[test]
    fn neighbours_in_space_and_time_are_independent() {
        let sensor = Sensor::new(detector(2e3));
        let images: Vec<_> =
            [(1, 0), (1, 1), (2, 0)].map(|(s, f)| sensor.read(Light::new(512, 480), s, f).unwrap()).into();
        let level = |i: usize, p: usize| f64::from(images[i].levels()[p]);
        let (mean, variance) = moments(images[0].levels().iter().copied());
        let correlation = |i: usize, shift: usize| {
            let n = 512 * 480 - shift;
            (0..n).map(|p| (level(0, p) - mean) * (level(i, p + shift) - mean)).sum::<f64>() / n as f64 / variance
        };
        for (image, shift) in [(0, 1), (0, 2), (0, 4), (0, 512), (1, 0), (2, 0), (1, 1)] {
            assert!(correlation(image, shift).abs() < 0.01, "{image} {shift}: {}", correlation(image, shift));
        }
        assert_eq!(images[1], sensor.read(Light::new(512, 480), 1, 1).unwrap());
    }

    #[test]
    fn a_full_well_is_white_and_stays_white() {
        let mut light = Light::new(4, 4);
        light.electrons.fill(1e9);
        light.columns.fill(Lit { first: 0, end: 4 });
        assert!(Sensor::new(detector(0.0)).read(light, 0, 0).unwrap().levels().iter().all(|l| *l == 127));
    }

    #[test]
    fn overflow_runs_along_the_column() {
        // Five wells' worth of light in one pixel: four run over, two each way.
        let lit = |blooming: f64| {
            let mut light = Light::new(4, 40);
            light.electrons[40 + 20] = 48_000.0;
            light.columns[1] = Lit { first: 20, end: 21 };
            let image = Sensor::new(Detector { blooming, ..detector(400.0) }).read(light, 0, 0).unwrap();
            (0..40).filter(|v| image.row(*v)[1] == 127).collect::<Vec<_>>()
        };
        assert_eq!(lit(0.0), [20]);
        assert_eq!(lit(1.0), [18, 19, 20, 21, 22]);
        assert_eq!(lit(0.5), [19, 20, 21]);
    }

    #[test]
    fn a_shaded_background_has_its_levels_everywhere() {
        let (width, height) = (512, 480);
        let lost = |u: f64, v: f64| 1500.0 * (((u - 256.0) / 256.0).powi(2) + ((v - 240.0) / 240.0).powi(2)) / 2.0;
        let image = Sensor::shaded(detector(2e3), width, height, lost).read(Light::new(width, height), 1, 1).unwrap();
        for (u0, v0) in [(240, 232), (0, 0), (496, 464), (480, 240), (96, 400)] {
            let area = (v0..v0 + 16).flat_map(|v| image.row(v)[u0..u0 + 16].iter().copied());
            let expected = (2e3 - lost(u0 as f64 + 7.5, v0 as f64 + 7.5)) * 127.0 / 10e3;
            let (mean, _) = moments(area);
            assert!((mean - expected).abs() < 0.35, "{mean} for {expected} at {u0}, {v0}"); // 256 pixels of 1.1 levels
        }
    }

    #[test]
    fn a_stripe_is_integrated_over_pixels_and_loses_nothing() {
        // Φ(½/σ) − Φ(−½/σ) = erf(½/(σ√2)): 0.682689 at σ = 0.5, 0.904419 at σ = 0.3 (tables of erf).
        let bell = Bell::new();
        for (sigma, middle) in [(0.5, 0.682_689), (0.3, 0.904_419)] {
            let mut light = Light::new(1, 40);
            light.add(&bell, 0, 20.0, sigma, 1000.0);
            assert!((f64::from(light.electrons[20]) / 1000.0 - middle).abs() < 1e-5);
            let total: f32 = light.electrons.iter().sum();
            let centre: f32 = light.electrons.iter().enumerate().map(|(v, e)| v as f32 * e).sum::<f32>() / total;
            assert!((total - 1000.0).abs() < 0.01 && (centre - 20.0).abs() < 1e-4);
        }
        let mut light = Light::new(1, 40);
        light.add(&bell, 0, -0.5, 0.5, 1000.0); // half of it above the image
        light.add(&bell, 0, -50.0, 0.5, 1000.0);
        light.add(&bell, 0, f64::NAN, 0.5, 1000.0);
        light.add(&bell, 9, 3.0, 0.5, 1000.0);
        assert!((light.electrons.iter().sum::<f32>() - 500.0).abs() < 0.01);
    }

    #[test]
    fn the_normal_distribution_and_its_inverse_have_their_known_values() {
        let bell = Bell::new();
        for (x, p) in [(0.0, 0.5), (1.0, 0.841_344_746), (-2.0, 0.022_750_132), (3.3, 0.999_516_576)] {
            assert!((bell.at(x) - p).abs() < 3e-6);
        }
        assert_eq!((bell.at(-9.0), bell.at(9.0)), (0.0, 1.0));
        for bits in (0..=u16::MAX).step_by(61) {
            let p = (f64::from(bits) + 0.5) / 65_536.0;
            assert!((bell.at(deviate(bits)) - p).abs() < 4e-6, "{bits}");
        }
        assert!((deviate(65_535) - 4.3258).abs() < 1e-3 && deviate(0) == -deviate(65_535));
    }
}
