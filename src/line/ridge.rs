//! One pass over the rows: the strongest ridge in each column of each band of 16 rows.

use crate::image::Image;

/// Rows a group: the height of a background box.
const GROUP: usize = 4;
/// Rows a band.
const BAND: usize = 16;
/// Most bands searched: with an image higher than 65 536 rows, the rest is not looked at.
const BANDS_MAX: usize = 4096;

/// The ridges of one image.
#[derive(Clone, Debug)]
pub(super) struct Ridge {
    /// Columns.
    pub width: usize,
    /// Bands.
    pub bands: usize,
    height: usize,
    /// Background boxes lie this many groups above and below.
    gap: usize,
    /// Sums of the four rows of a group, a column: groups × width.
    boxes: Vec<i16>,
    /// Bands × width: ridge × 16 + (15 − row in band). One integer maximum keeps both; of equals, the upper row wins.
    best: Vec<i16>,
}

impl Ridge {
    /// With background boxes `gap` groups of four rows away.
    pub fn new(gap: usize) -> Self {
        Self { width: 0, bands: 0, height: 0, gap, boxes: Vec::new(), best: Vec::new() }
    }

    /// The strongest ridges of a band: 16 × strength [4 × levels], plus what `row` reads.
    pub fn band(&self, band: usize) -> &[i16] {
        &self.best[band * self.width..(band + 1) * self.width]
    }

    /// The image row of the best row of a band.
    pub fn row(&self, band: usize, u: usize) -> usize {
        let in_band = 15 - (self.best[band * self.width + u] & 15) as usize;
        (band * BAND + in_band).min(self.height - 1)
    }

    /// Mean level of the boxes above and below the best row of a band.
    pub fn background(&self, band: usize, u: usize) -> f32 {
        let group = self.row(band, u) / GROUP;
        let (above, below) = self.sides(group);
        let at = |g: usize| f32::from(self.boxes[g * self.width + u]);
        (at(above) + at(below)) / (2 * GROUP) as f32
    }

    /// The groups of the background above and below a group; at the edge, the outermost one.
    fn sides(&self, group: usize) -> (usize, usize) {
        let last = self.boxes.len() / self.width - 1;
        (group.saturating_sub(self.gap), (group + self.gap).min(last))
    }

    /// Looks at every pixel of the image.
    pub fn scan(&mut self, image: &Image) {
        self.width = image.width();
        self.height = image.height().min(BANDS_MAX * BAND);
        let groups = self.height.div_ceil(GROUP);
        self.bands = self.height.div_ceil(BAND);
        self.boxes.resize(groups * self.width, 0);
        self.best.clear();
        self.best.resize(self.bands * self.width, 0);
        let row = |v: usize| image.row(v.min(self.height - 1));
        let mut summed = 0;
        for group in 0..groups {
            // Boxes are summed just ahead of their first use, while their rows are near.
            while summed <= (group + self.gap).min(groups - 1) {
                let v = summed * GROUP;
                let sums = &mut self.boxes[summed * self.width..(summed + 1) * self.width];
                sum_rows([row(v), row(v + 1), row(v + 2), row(v + 3)], sums);
                summed += 1;
            }
            let v = group * GROUP;
            let rows = [row(v.saturating_sub(1)), row(v), row(v + 1), row(v + 2), row(v + 3), row(v + 4)];
            let (above, below) = self.sides(group);
            let side = |g: usize| &self.boxes[g * self.width..(g + 1) * self.width];
            let band = v / BAND;
            let best = &mut self.best[band * self.width..(band + 1) * self.width];
            scan_group(rows, side(above), side(below), (15 - v % BAND) as i16, best);
        }
    }
}

/// sums = the four rows added up.
fn sum_rows(rows: [&[u8]; 4], sums: &mut [i16]) {
    let n = sums.len();
    let [a, b, c, d] = rows.map(|row| &row[..n]);
    for u in 0..n {
        sums[u] = i16::from(a[u]) + i16::from(b[u]) + i16::from(c[u]) + i16::from(d[u]);
    }
}

/// The ridges of rows 1–4 of `rows`, kept in `best` where they are larger. No branches: compilers make vectors of it.
fn scan_group(rows: [&[u8]; 6], above: &[i16], below: &[i16], tag: i16, best: &mut [i16]) {
    let n = best.len();
    let [a, b, c, d, e, f] = rows.map(|row| &row[..n]);
    let (above, below) = (&above[..n], &below[..n]);
    for u in 0..n {
        let level = |row: &[u8]| i16::from(row[u]);
        let (a, b, c, d, e, f) = (level(a), level(b), level(c), level(d), level(e), level(f));
        let background = above[u].max(below[u]);
        let (ab, bc, cd, de, ef) = (a + b - background, b + c, c + d - background, d + e, e + f - background);
        let first = (((ab + bc) << 4) | tag).max(((bc + cd) << 4) | (tag - 1));
        let second = (((cd + de) << 4) | (tag - 2)).max(((de + ef) << 4) | (tag - 3));
        best[u] = best[u].max(first.max(second));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scanned(width: usize, height: usize, level: impl Fn(usize, usize) -> u8) -> Ridge {
        let levels = (0..height).flat_map(|v| (0..width).map(move |u| (u, v))).map(|(u, v)| level(u, v)).collect();
        let mut ridge = Ridge::new(2);
        ridge.scan(&Image::new(width, height, 255, levels).unwrap());
        ridge
    }

    /// The same by its definition, one pixel at a time.
    fn slow(level: impl Fn(usize, usize) -> u8, u: usize, v: usize, height: usize) -> i32 {
        let at = |v: isize| i32::from(level(u, v.clamp(0, height as isize - 1) as usize));
        let (row, groups) = (v as isize, height.div_ceil(4) as isize);
        let group = |g: isize| (0..4).map(|i| at(g.clamp(0, groups - 1) * 4 + i)).sum::<i32>();
        at(row - 1) + 2 * at(row) + at(row + 1) - group(row / 4 - 2).max(group(row / 4 + 2))
    }

    #[test]
    fn every_band_holds_its_strongest_ridge() {
        for (width, height) in [(37, 100), (8, 16), (3, 7), (1, 1), (19, 482)] {
            let level = |u: usize, v: usize| ((u * 7919 + v * 104_729 + u * v * 31) % 251) as u8;
            let ridge = scanned(width, height, level);
            for u in 0..width {
                for band in 0..ridge.bands {
                    let rows = band * 16..(band * 16 + 16).min(height);
                    let strongest = rows.clone().map(|v| slow(level, u, v, height)).max().unwrap().max(0);
                    let found = i32::from(ridge.band(band)[u] >> 4);
                    let at_the_end = rows.end == height;
                    assert!(found == strongest || (at_the_end && found > strongest), "{u} {band}");
                    if found > 0 && !at_the_end {
                        assert_eq!(slow(level, u, ridge.row(band, u), height), found);
                    }
                }
            }
        }
    }

    #[test]
    fn a_bright_wall_has_no_ridge_and_a_line_beside_it_has() {
        let ridge = scanned(4, 160, |_, v| {
            if v < 60 {
                250
            } else if v == 100 {
                80
            } else {
                10
            }
        });
        for band in 0..ridge.bands {
            let expected = if band == 100 / 16 { 140 } else { 0 };
            assert_eq!(ridge.band(band)[2] >> 4, expected, "{band}");
        }
        assert_eq!(ridge.row(6, 2), 100);
        assert_eq!(ridge.background(6, 2), 10.0);
    }
}
