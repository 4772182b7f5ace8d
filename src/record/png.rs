//! Grey images as PNG: without loss, fast rather than small.

use std::io::Cursor;

use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::{ColorType, ExtendedColorType, ImageDecoder, ImageEncoder, Limits};

use crate::fault::{Fault, Result};
use crate::image::Image;

/// The image as a PNG file of 8-bit grey; its white level is not in it.
pub fn encode(image: &Image) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Up);
    // Sides above 32 bits cannot be: an image has at most 64 Mpixel.
    let (width, height) = (image.width() as u32, image.height() as u32);
    encoder
        .write_image(image.levels(), width, height, ExtendedColorType::L8)
        .map_err(|error| Fault::new("image", error, "an image that PNG can hold"))?;
    Ok(bytes)
}

/// The image in a PNG file, with the white level it had.
///
/// Errors: no PNG, not 8-bit grey, another size than `width` × `height`, or damaged.
pub fn decode(bytes: &[u8], width: usize, height: usize, white: u8) -> Result<Image> {
    let refused = |error: image::ImageError| Fault::new("image", error, "a PNG file of 8-bit grey");
    let mut limits = Limits::default();
    limits.max_alloc = Some((Image::PIXELS_MAX as u64) * 2);
    let decoder = PngDecoder::with_limits(Cursor::new(bytes), limits).map_err(refused)?;
    let size = decoder.dimensions();
    if (size.0 as usize, size.1 as usize) != (width, height) {
        return Err(Fault::new("image size", format!("{} x {}", size.0, size.1), format!("{width} x {height}")));
    }
    if decoder.color_type() != ColorType::L8 {
        return Err(Fault::new("image", format!("{:?}", decoder.color_type()), "8-bit grey"));
    }
    let pixels = width.checked_mul(height).filter(|pixels| *pixels <= Image::PIXELS_MAX);
    let pixels = pixels.ok_or_else(|| Fault::new("image size", format!("{width} x {height}"), "at most 64 Mpixel"))?;
    let mut levels = vec![0; pixels];
    decoder.read_image(&mut levels).map_err(refused)?;
    Image::new(width, height, white, levels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn nothing_is_lost(width in 1usize..40, height in 1usize..40, seed in any::<u64>()) {
            let levels = (0..width * height).map(|i| (seed.rotate_left(i as u32 % 64) ^ i as u64) as u8).collect();
            let image = Image::new(width, height, 127, levels).unwrap();
            prop_assert_eq!(decode(&encode(&image).unwrap(), width, height, 127).unwrap(), image);
        }

        #[test]
        fn damage_is_an_error_or_another_image(at in 0usize..200, bit in 0u8..8) {
            let image = Image::new(16, 8, 255, (0..128).collect()).unwrap();
            let mut bytes = encode(&image).unwrap();
            let at = at % bytes.len();
            bytes[at] ^= 1 << bit;
            if let Ok(read) = decode(&bytes, 16, 8, 255) {
                prop_assert_eq!(read.levels().len(), 128);
            }
            prop_assert!(decode(&bytes[..at], 16, 8, 255).is_err());
        }
    }

    #[test]
    fn another_size_or_colour_is_refused() {
        let image = Image::new(4, 3, 127, vec![9; 12]).unwrap();
        let bytes = encode(&image).unwrap();
        assert!(decode(&bytes, 3, 4, 127).is_err());
        let mut colour = Vec::new();
        PngEncoder::new(&mut colour).write_image(&[0; 36], 4, 3, ExtendedColorType::Rgb8).unwrap();
        assert!(decode(&colour, 4, 3, 127).unwrap_err().to_string().contains("Rgb8"));
        assert!(decode(b"", 4, 3, 127).is_err());
    }
}
