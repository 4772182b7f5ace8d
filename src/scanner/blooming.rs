//! Blooming: what a full pixel cannot hold runs into its neighbours up and down the column, which is the range axis.

/// Spills what is over `room` electrons: `share` of it, half up and half down, each on to the next pixel with room; the
/// rest is drained. What runs off the column's ends is lost.
pub(super) fn spill(column: &mut [f32], room: f32, share: f32) {
    let over: Vec<f32> = column.iter().map(|held| (held - room).max(0.0) * share / 2.0).collect();
    column.iter_mut().for_each(|held| *held = held.min(room));
    let mut run = |rows: &mut dyn Iterator<Item = usize>| {
        let mut carried = 0.0f32;
        for row in rows {
            let taken = carried.min(room - column[row]);
            column[row] += taken;
            carried += over[row] - taken;
        }
    };
    run(&mut (0..over.len()));
    run(&mut (0..over.len()).rev());
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn one_bright_pixel_becomes_a_run_of_full_ones() {
        // 700 in a well of 100: 600 over, 300 each way: three full rows on both sides.
        let mut column = vec![0.0; 21];
        column[10] = 700.0;
        spill(&mut column, 100.0, 1.0);
        let full: Vec<usize> = (0..21).filter(|row| column[*row] == 100.0).collect();
        assert_eq!(full, [7, 8, 9, 10, 11, 12, 13]);
        assert_eq!(column.iter().sum::<f32>(), 700.0);
        // Half drained: 150 each way. All drained: only the pixel itself is full.
        for (share, each_way) in [(0.5, 150.0), (0.0, 0.0)] {
            let mut column = vec![0.0; 21];
            column[10] = 700.0;
            spill(&mut column, 100.0, share);
            assert_eq!(column[..10].iter().sum::<f32>(), each_way);
            assert_eq!(column[11..].iter().sum::<f32>(), each_way);
        }
    }

    proptest! {
        #[test]
        fn charge_is_kept_and_no_pixel_overflows(levels in prop::collection::vec(0.0f32..400.0, 1..40)) {
            let padded = |n: usize| std::iter::repeat_n(0.0, n);
            let mut column: Vec<f32> = padded(200).chain(levels.iter().copied()).chain(padded(200)).collect();
            let before: f32 = column.iter().sum();
            spill(&mut column, 100.0, 1.0);
            prop_assert!(column.iter().all(|held| (0.0..=100.0).contains(held)));
            prop_assert!((column.iter().sum::<f32>() / before.max(1.0) - before / before.max(1.0)).abs() < 1e-3);
        }
    }
}
