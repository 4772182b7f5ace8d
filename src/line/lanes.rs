//! Many columns at once: safe loops without branches, compiled twice, and the choice between the two at run time.
//!
//! Both do the same arithmetic in the same order (no fused operations), so results are the same bits on every machine.

/// Columns at once: a vector of bytes where vectors are widest.
pub(super) const LANES: usize = 32;

/// One value for each of `LANES` columns.
pub(super) type Lanes<T> = [T; LANES];

/// Lanes that begin where a vector should: half of the others would lie across two cache lines.
#[derive(Clone, Copy, Debug)]
#[repr(align(32))]
pub(super) struct Aligned<T>(pub Lanes<T>);

impl<T: Copy + Default> Default for Aligned<T> {
    fn default() -> Self {
        Self([T::default(); LANES])
    }
}

/// Work that gains from wide vectors. `run` should be `#[inline(always)]`, with all it calls, to be compiled with them.
pub(super) trait Work {
    /// Does it.
    fn run(self);
}

/// Whether `run` may use AVX2.
pub(super) fn has_avx2() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx2");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

/// Runs work compiled for AVX2, or for any machine of its kind.
#[inline]
pub(super) fn run(work: impl Work, is_wide: bool) {
    #[cfg(target_arch = "x86_64")]
    if is_wide && has_avx2() {
        #[target_feature(enable = "avx2")]
        fn wide(work: impl Work) {
            work.run();
        }
        // SAFETY: the processor has AVX2, as was asked just now. The work is safe code, compiled for wider vectors.
        #[allow(unsafe_code)]
        unsafe {
            wide(work);
        }
        return;
    }
    let _ = is_wide;
    work.run();
}

/// The levels from a place in the image on; zeros beyond the last one.
#[inline(always)]
pub(super) fn lanes_at(levels: &[u8], from: usize) -> Lanes<u8> {
    let levels = &levels[from..];
    match levels.first_chunk::<LANES>() {
        Some(lanes) => *lanes,
        None => {
            let mut lanes = [0; LANES];
            lanes[..levels.len()].copy_from_slice(levels);
            lanes
        }
    }
}

/// The columns of a chunk in a row; zeros beyond the last column.
#[inline(always)]
pub(super) fn chunk_of(row: &[u8], chunk: usize) -> Lanes<u8> {
    let row = &row[chunk * LANES..];
    match row.first_chunk::<LANES>() {
        Some(lanes) => *lanes,
        None => {
            let mut lanes = [0; LANES];
            lanes[..row.len()].copy_from_slice(row);
            lanes
        }
    }
}
