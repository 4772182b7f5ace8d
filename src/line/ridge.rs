//! What a ridge is, and its exact strength at one place.

use crate::image::Image;

/// Rows a group: the height of a background box.
pub(super) const GROUP: usize = 4;
/// Rows a band.
pub(super) const BAND: usize = 16;
/// Groups a band.
pub(super) const GROUPS: usize = BAND / GROUP;
/// Most rows searched; the rest of a higher image is not looked at.
const ROWS_MAX: usize = 1 << 16;

/// How an image is cut into groups of rows, and which groups are the background of which.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Grid {
    /// Columns.
    pub width: usize,
    /// Rows that are searched.
    pub height: usize,
    /// Groups of rows.
    pub groups: usize,
    /// Bands of groups.
    pub bands: usize,
    /// Background boxes lie this many groups above and below.
    pub gap: usize,
}

/// A ridge that was looked at exactly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Found {
    /// I(v−1) + 2·I(v) + I(v+1) less the brighter background box [4 × levels].
    pub strength: i16,
    /// Image row.
    pub row: u16,
    /// The boxes above and below: levels of eight pixels.
    pub boxes: u16,
}

impl Found {
    /// Mean level of the boxes above and below.
    pub fn background(self) -> f32 {
        f32::from(self.boxes) / (2 * GROUP) as f32
    }
}

impl Grid {
    pub fn new(image: &Image, gap: usize) -> Self {
        let height = image.height().min(ROWS_MAX);
        Self { width: image.width(), height, groups: height.div_ceil(GROUP), bands: height.div_ceil(BAND), gap }
    }

    /// The first rows of the background boxes of a group; at the edge, the outermost box.
    #[inline(always)]
    pub fn boxes(&self, group: usize) -> [usize; 2] {
        [group.saturating_sub(self.gap) * GROUP, (group + self.gap).min(self.groups - 1) * GROUP]
    }

    /// The strongest ridge of a group of rows; of equals, the upper one.
    pub fn exact(&self, image: &Image, u: usize, group: usize) -> Found {
        let first = group * GROUP;
        let (mut row, mut best) = (first, self.top(image, u, first));
        for v in first + 1..first + GROUP {
            let top = self.top(image, u, v);
            if top > best {
                (row, best) = (v, top);
            }
        }
        self.over_boxes(image, u, row.min(self.height - 1), best)
    }

    /// A ridge of this row and sum, with its background.
    fn over_boxes(&self, image: &Image, u: usize, row: usize, top: i16) -> Found {
        let [above, below] = self.boxes(row / GROUP);
        let (above, below) = (self.box_sum(image, u, above), self.box_sum(image, u, below));
        Found { strength: top - above.max(below), row: row as u16, boxes: (above + below) as u16 }
    }

    fn box_sum(&self, image: &Image, u: usize, v: usize) -> i16 {
        let at = |i: usize| self.level(image, u, v + i);
        at(0) + at(1) + at(2) + at(3)
    }

    /// I(v−1) + 2·I(v) + I(v+1).
    fn top(&self, image: &Image, u: usize, v: usize) -> i16 {
        self.level(image, u, v.saturating_sub(1)) + 2 * self.level(image, u, v) + self.level(image, u, v + 1)
    }

    /// Beyond the image, its edge goes on.
    #[inline(always)]
    fn level(&self, image: &Image, u: usize, v: usize) -> i16 {
        i16::from(image.levels()[v.min(self.height - 1) * self.width + u])
    }
}
