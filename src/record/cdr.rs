//! CDR as ROS 2 has it: four bytes of encapsulation, then every number aligned to its own size, counted after those four.

use re_cdr::{BigEndian, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::fault::{Fault, Result};

/// The encapsulation that `encode` writes: plain CDR, little-endian, no options.
const LITTLE: [u8; 4] = [0, 1, 0, 0];

/// The payload of a message: encapsulation and body, little-endian.
///
/// Errors: a type that CDR has no form for.
pub fn encode<T: Serialize>(message: &T) -> Result<Vec<u8>> {
    let mut bytes = LITTLE.to_vec();
    let mut serializer = re_cdr::CdrSerializer::<LittleEndian>::new(&mut bytes);
    message.serialize(&mut serializer).map_err(|error| Fault::new("message", error, "a type that CDR can hold"))?;
    Ok(bytes)
}

/// The message in a payload, of either byte order.
///
/// Errors: an encapsulation other than plain CDR, a body that ends early, holds what the type cannot, or goes on for more
/// than the padding to the next 8 bytes.
pub fn decode<T: DeserializeOwned>(payload: &[u8]) -> Result<T> {
    let refused = |found: String| Fault::new("message", found, "plain CDR");
    let (header, body) = payload.split_first_chunk::<4>().ok_or_else(|| refused(format!("{} bytes", payload.len())))?;
    let read = match header {
        [0, 0, _, _] => re_cdr::from_bytes::<T, BigEndian>(body),
        [0, 1, _, _] => re_cdr::from_bytes::<T, LittleEndian>(body),
        other => return Err(refused(format!("encapsulation {other:02x?}"))),
    };
    let (message, used) = read.map_err(|error| Fault::new("message", error, "the fields of its type"))?;
    let rest = body.len().saturating_sub(used);
    if rest >= 8 {
        return Err(Fault::new("message", format!("{rest} bytes after its last field"), "the fields of its type"));
    }
    Ok(message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde::Deserialize;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Mixed {
        a: u8,
        b: f64,
        c: String,
        d: Vec<u16>,
        e: i64,
    }

    /// Worked out by hand: offsets count from after the encapsulation.
    const MIXED: [u8; 44] = [
        0x00, 0x01, 0x00, 0x00, // encapsulation
        0x07, 0, 0, 0, 0, 0, 0, 0, // a, then 7 bytes to offset 8
        0, 0, 0, 0, 0, 0, 0xF8, 0x3F, // b = 1.5
        0x03, 0, 0, 0, b'h', b'i', 0, 0, // c: length with its end mark; one byte to offset 24
        0x02, 0, 0, 0, 0x01, 0x00, 0xFF, 0xFF, // d: length, 1, 65535; offset 32
        0xFE, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, // e = −2
    ];

    fn mixed() -> Mixed {
        Mixed { a: 7, b: 1.5, c: "hi".into(), d: vec![1, 65535], e: -2 }
    }

    #[test]
    fn bytes_are_aligned_by_the_rules_of_cdr() {
        assert_eq!(encode(&mixed()).unwrap(), MIXED);
        assert_eq!(decode::<Mixed>(&MIXED).unwrap(), mixed());
    }

    #[test]
    fn what_is_cut_or_foreign_is_refused() {
        for end in 0..MIXED.len() {
            assert!(decode::<Mixed>(&MIXED[..end]).is_err(), "{end}");
        }
        let mut foreign = MIXED;
        foreign[1] = 3; // parameter list CDR
        assert!(decode::<Mixed>(&foreign).unwrap_err().to_string().contains("encapsulation"));
        let longer = [&MIXED[..], &[0; 8]].concat();
        assert!(decode::<Mixed>(&longer).is_err());
        assert!(decode::<Mixed>(&longer[..longer.len() - 5]).is_ok(), "padding is no error");
    }

    #[test]
    fn big_endian_is_read_too() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct Two {
            a: u16,
            b: u32,
        }
        assert_eq!(decode::<Two>(&[0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 0, 9]).unwrap(), Two { a: 258, b: 9 });
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = decode::<Mixed>(&bytes);
            let _ = decode::<crate::record::messages::CaptureMessage>(&bytes);
            let _ = decode::<crate::record::messages::CompressedImage>(&bytes);
        }
    }
}
