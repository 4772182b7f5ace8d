//! Integer keys of blocks and cells, and a quick, fixed hash for them: no seed, so that two runs cannot differ.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// A map over packed keys. Its own order is never used for results.
pub(super) type KeyMap<V> = HashMap<u64, V, BuildHasherDefault<KeyHasher>>;

/// Half the range of one coordinate of a packed key.
pub(super) const HALF: i32 = 1 << 20;

/// Packs coordinates from −2²⁰ to 2²⁰ − 1, so that packed keys sort as the coordinates do: x, then y, then z.
pub(super) fn pack(key: [i32; 3]) -> u64 {
    let part = |c: i32| (i64::from(c) + i64::from(HALF)) as u64 & 0x1f_ffff;
    part(key[0]) << 42 | part(key[1]) << 21 | part(key[2])
}

/// Multiplies and folds.
#[derive(Default)]
pub(super) struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.write_u64(u64::from(*byte));
        }
    }
    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ (mixed >> 29);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn packed_keys_sort_as_coordinates(a in prop::array::uniform3(-HALF..HALF), b in prop::array::uniform3(-HALF..HALF)) {
            prop_assert_eq!(pack(a).cmp(&pack(b)), a.cmp(&b));
        }
    }
}
