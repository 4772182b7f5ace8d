//! Which voxels a line of sight passes, and the marks that all lines of one capture leave.

use super::grid::BLOCK;
use super::key::{KeyMap, pack};

/// Visits every voxel from the one that holds `from` to the one that holds `to`, both included, each next to the one
/// before by a face; coordinates in voxels. After Amanatides and Woo (1987), but the number of steps along each axis
/// is counted in integers, so that rounding cannot miss the end.
pub(super) fn traverse(from: [f64; 3], to: [f64; 3], mut visit: impl FnMut([i32; 3])) {
    let key = from.map(|c| c.floor() as i32);
    let end = to.map(|c| c.floor() as i32);
    // Along each axis: the way to the next face, between faces, and which way it goes.
    let mut next = [f64::INFINITY; 3];
    let mut delta = [f64::INFINITY; 3];
    let mut step = [0; 3];
    let mut total = 0;
    for axis in 0..3 {
        let left = end[axis].abs_diff(key[axis]);
        if left > 0 {
            total += left;
            let run = to[axis] - from[axis];
            delta[axis] = 1.0 / run.abs();
            step[axis] = if run > 0.0 { 1 } else { -1 };
            let within = from[axis] - f64::from(key[axis]);
            next[axis] = if run > 0.0 { 1.0 - within } else { within } * delta[axis];
        }
    }
    visit(key);
    let after = |axis: usize, key: i32, next: f64| if key == end[axis] { f64::INFINITY } else { next + delta[axis] };
    let [mut x, mut y, mut z] = key;
    let [mut next_x, mut next_y, mut next_z] = next;
    for _ in 0..total {
        if next_x <= next_y && next_x <= next_z {
            x += step[0];
            next_x = after(0, x, next_x);
        } else if next_y <= next_z {
            y += step[1];
            next_y = after(1, y, next_y);
        } else {
            z += step[2];
            next_z = after(2, z, next_z);
        }
        visit([x, y, z]);
    }
}

/// The marks of one capture in one block: a bit a voxel, `[x]` with bit `y·8 + z`.
pub(super) struct MarkedBlock {
    pub packed: u64,
    pub key: [i32; 3],
    pub free: [u64; BLOCK],
    pub hit: [u64; BLOCK],
}

/// What one capture saw: each voxel at most once, whatever the number of rays through it.
#[derive(Default)]
pub(super) struct Marks {
    index: KeyMap<usize>,
    blocks: Vec<MarkedBlock>,
    /// The block of the last mark: neighbours are mostly in the same one.
    last: Option<(u64, usize)>,
}

impl Marks {
    pub fn clear(&mut self) {
        self.index.clear();
        self.blocks.clear();
        self.last = None;
    }

    pub fn free(&mut self, voxel: [i32; 3]) {
        let (x, bit) = place(voxel);
        self.block(voxel).free[x] |= bit;
    }

    pub fn hit(&mut self, voxel: [i32; 3]) {
        let (x, bit) = place(voxel);
        self.block(voxel).hit[x] |= bit;
    }

    /// The marked blocks in the order of their keys, which is not the order of the rays.
    pub fn sorted(&mut self) -> &[MarkedBlock] {
        self.index.clear();
        self.last = None;
        self.blocks.sort_unstable_by_key(|block| block.packed);
        &self.blocks
    }

    fn block(&mut self, voxel: [i32; 3]) -> &mut MarkedBlock {
        let key = voxel.map(|c| c >> BLOCK.trailing_zeros());
        let packed = pack(key);
        let at = match self.last {
            Some((last, at)) if last == packed => at,
            _ => *self.index.entry(packed).or_insert_with(|| {
                self.blocks.push(MarkedBlock { packed, key, free: [0; BLOCK], hit: [0; BLOCK] });
                self.blocks.len() - 1
            }),
        };
        self.last = Some((packed, at));
        &mut self.blocks[at]
    }
}

/// The word and the bit of a voxel in its block.
fn place(voxel: [i32; 3]) -> (usize, u64) {
    let [x, y, z] = voxel.map(|c| c as usize & (BLOCK - 1));
    (x, 1 << (y * BLOCK + z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn visited(from: [f64; 3], to: [f64; 3]) -> Vec<[i32; 3]> {
        let mut seen = Vec::new();
        traverse(from, to, |key| seen.push(key));
        seen
    }

    /// Whether the segment comes within 1e-9 of the voxel (slab test).
    fn meets(from: [f64; 3], to: [f64; 3], key: [i32; 3]) -> bool {
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for axis in 0..3 {
            let (low, high) = (f64::from(key[axis]) - 1e-9, f64::from(key[axis]) + 1.0 + 1e-9);
            let run = to[axis] - from[axis];
            if run == 0.0 {
                if from[axis] < low || from[axis] > high {
                    return false;
                }
                continue;
            }
            let (a, b) = ((low - from[axis]) / run, (high - from[axis]) / run);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        enter <= leave
    }

    fn coordinate() -> impl Strategy<Value = f64> {
        prop_oneof![-30.0..30.0f64, (-30i32..30).prop_map(f64::from), (-60i32..60).prop_map(|c| f64::from(c) / 2.0)]
    }

    proptest! {
        #[test]
        fn a_ray_visits_what_dense_samples_find_and_nothing_else(
            from in prop::array::uniform3(coordinate()), to in prop::array::uniform3(coordinate()),
        ) {
            let seen = visited(from, to);
            prop_assert_eq!(seen[0], from.map(|c| c.floor() as i32));
            prop_assert_eq!(*seen.last().unwrap(), to.map(|c| c.floor() as i32));
            for pair in seen.windows(2) {
                let steps: u32 = (0..3).map(|axis| pair[0][axis].abs_diff(pair[1][axis])).sum();
                prop_assert_eq!(steps, 1, "not connected by a face");
            }
            let set: BTreeSet<_> = seen.iter().copied().collect();
            prop_assert_eq!(set.len(), seen.len(), "visited twice");
            for key in &seen {
                prop_assert!(meets(from, to, *key), "{key:?} is off the ray");
            }
            for i in 0..=5000 {
                let t = f64::from(i) / 5000.0;
                let at: [f64; 3] = std::array::from_fn(|axis| from[axis] + (to[axis] - from[axis]) * t);
                // A sample on a face belongs to either side.
                if at.iter().all(|c| (c - c.round()).abs() > 1e-9) {
                    prop_assert!(set.contains(&at.map(|c| c.floor() as i32)), "missed {at:?}");
                }
            }
        }
    }

    #[test]
    fn a_ray_of_no_length_visits_its_own_voxel() {
        assert_eq!(visited([0.5, -0.5, 2.0], [0.5, -0.5, 2.0]), vec![[0, -1, 2]]);
    }

    #[test]
    fn marks_are_one_a_voxel() {
        let mut marks = Marks::default();
        for voxel in [[0, 0, 0], [-1, 0, 0], [0, 0, 0], [7, 7, 7], [8, 7, 7]] {
            marks.free(voxel);
        }
        marks.hit([-1, 0, 0]);
        let keys: Vec<_> = marks.sorted().iter().map(|block| block.key).collect();
        assert_eq!(keys, [[-1, 0, 0], [0, 0, 0], [1, 0, 0]]);
        let free: u32 = marks.sorted().iter().flat_map(|block| block.free).map(u64::count_ones).sum();
        assert_eq!(free, 4);
        assert_eq!(marks.sorted()[0].hit[7], 1);
    }
}
