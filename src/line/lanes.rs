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

/// Asks the memory for a level that will be needed, or for nothing if there is none.
#[inline(always)]
pub(super) fn fetch(levels: &[u8], from: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint that reads nothing and cannot fail, whatever the address; SSE is part of x86_64.
        #[allow(unsafe_code)]
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(levels.as_ptr().wrapping_add(from).cast());
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (levels, from);
}

/// A bit for each lane: whether it has its highest one set.
#[inline(always)]
pub(super) fn bits(lanes: &Lanes<u8>) -> u32 {
    let mut bits = 0;
    #[cfg(target_arch = "x86_64")]
    for (half, lanes) in lanes.as_chunks::<16>().0.iter().enumerate() {
        use std::arch::x86_64::{_mm_loadu_si128, _mm_movemask_epi8};
        // SAFETY: reads the sixteen bytes of the array, wherever they lie; SSE2 is part of x86_64.
        #[allow(unsafe_code)]
        let sixteen = unsafe { _mm_movemask_epi8(_mm_loadu_si128(lanes.as_ptr().cast())) };
        bits |= (sixteen as u32) << (16 * half);
    }
    #[cfg(not(target_arch = "x86_64"))]
    for (i, lane) in lanes.iter().enumerate() {
        bits |= u32::from(lane >> 7) << i;
    }
    bits
}
