//! The layers of the plane as one picture, side by side, marked against the truth where there is one.

use image::{ImageFormat, Rgb, RgbImage};

use crate::fault::{Fault, Result};
use crate::maps::{Layers, PlanView};

/// A panel is drawn at least this wide, if its cells are not too many [px].
const PANEL_PX: usize = 400;
/// A picture has at most this many pixels.
const PIXELS_MAX: usize = 64 << 20;
/// Around and between panels [px].
const GAP_PX: usize = 12;
/// Pixels of a dot of a letter, and the height of the line of letters [px].
const DOT_PX: usize = 2;
const LINE_PX: usize = 9 * DOT_PX;

const PAPER: Rgb<u8> = Rgb([255, 255, 255]);
const INK: Rgb<u8> = Rgb([30, 34, 42]);
const UNKNOWN: Rgb<u8> = Rgb([196, 200, 206]);
const FREE: Rgb<u8> = Rgb([250, 250, 246]);
const FALSE: Rgb<u8> = Rgb([220, 50, 40]);
const MISSED: Rgb<u8> = Rgb([255, 170, 60]);

/// The layers as a PNG file: black occupied, white free, grey unknown. With the truth (100 a surface, 0 free, 50 a surface
/// where the robot cannot come, −1 nothing there and out of reach) it stands first, and in the others red is occupied with no surface within
/// one cell, orange free where the robot cannot roll.
///
/// # Errors
/// A truth of another size than the layers; too many cells for a picture.
pub fn png(layers: &Layers, truth: Option<&PlanView>) -> Result<Vec<u8>> {
    let (width, height) = (layers.fused.width, layers.fused.height);
    if let Some(truth) = truth.filter(|truth| (truth.width, truth.height) != (width, height)) {
        let found = format!("{} x {}", truth.width, truth.height);
        return Err(Fault::new("cells of the truth", found, format!("{width} x {height}, as the layers have")));
    }
    let named = [("laser", &layers.laser), ("ultrasonic", &layers.ultrasonic), ("fused", &layers.fused)];
    let panels: Vec<(&str, &PlanView)> = truth.map(|truth| ("truth", truth)).into_iter().chain(named).collect();
    let scale = (PANEL_PX / width.max(1)).clamp(1, 12);
    let (panel_px, high_px) = (width * scale, height * scale);
    let size = [panels.len() * (panel_px + GAP_PX) + GAP_PX, high_px + LINE_PX + 2 * GAP_PX];
    if width == 0 || height == 0 || size[0].saturating_mul(size[1]) > PIXELS_MAX {
        return Err(Fault::new("picture of the layers", format!("{width} x {height} cells"), "1 to 64 Mpixel"));
    }
    let mut picture = RgbImage::from_pixel(size[0] as u32, size[1] as u32, PAPER);
    for (number, (name, view)) in panels.into_iter().enumerate() {
        let left = GAP_PX + number * (panel_px + GAP_PX);
        write(&mut picture, name, [left, GAP_PX]);
        for y in 0..high_px {
            for x in 0..panel_px {
                // The first row of the picture has the highest y.
                let at = (height - 1 - y / scale) * width + x / scale;
                let colour = colour(view, truth.filter(|truth| *truth != view), at);
                picture.put_pixel((left + x) as u32, (GAP_PX + LINE_PX + y) as u32, colour);
            }
        }
    }
    let mut bytes = std::io::Cursor::new(Vec::new());
    let done = picture.write_to(&mut bytes, ImageFormat::Png);
    done.map_err(|error| Fault::new("picture of the layers", error, "an image that PNG can hold"))?;
    Ok(bytes.into_inner())
}

fn colour(view: &PlanView, truth: Option<&PlanView>, at: usize) -> Rgb<u8> {
    let said = view.cells.get(at).copied().unwrap_or(-1);
    let truly = truth.and_then(|truth| truth.cells.get(at).copied());
    match (said, truly) {
        (100, Some(-1 | 0)) if !truth.is_some_and(|truth| beside_surface(truth, at)) => FALSE,
        (100, _) => INK,
        (0, Some(100 | 50 | -1)) => MISSED,
        (0, _) => FREE,
        _ => UNKNOWN,
    }
}

/// Whether a neighbour of a cell is occupied, also diagonally.
fn beside_surface(view: &PlanView, at: usize) -> bool {
    let (x, y) = (at % view.width, at / view.width);
    let mut rows = y.saturating_sub(1)..(y + 2).min(view.height);
    rows.any(|row| (x.saturating_sub(1)..(x + 2).min(view.width)).any(|c| view.cells[row * view.width + c] >= 50))
}

/// Small letters of 5 x 7 dots, a row a number, the leftmost dot its highest bit: those of the names above.
const LETTERS: &[(char, [u8; 7])] = &[
    ('a', [0, 0, 0b01110, 0b00001, 0b01111, 0b10001, 0b01111]),
    ('c', [0, 0, 0b01110, 0b10000, 0b10000, 0b10001, 0b01110]),
    ('d', [0b00001, 0b00001, 0b01101, 0b10011, 0b10001, 0b10001, 0b01111]),
    ('e', [0, 0, 0b01110, 0b10001, 0b11111, 0b10000, 0b01110]),
    ('f', [0b00110, 0b01001, 0b01000, 0b11100, 0b01000, 0b01000, 0b01000]),
    ('h', [0b10000, 0b10000, 0b10110, 0b11001, 0b10001, 0b10001, 0b10001]),
    ('i', [0b00100, 0, 0b01100, 0b00100, 0b00100, 0b00100, 0b01110]),
    ('l', [0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110]),
    ('n', [0, 0, 0b10110, 0b11001, 0b10001, 0b10001, 0b10001]),
    ('o', [0, 0, 0b01110, 0b10001, 0b10001, 0b10001, 0b01110]),
    ('r', [0, 0, 0b10110, 0b11001, 0b10000, 0b10000, 0b10000]),
    ('s', [0, 0, 0b01110, 0b10000, 0b01110, 0b00001, 0b11110]),
    ('t', [0b01000, 0b01000, 0b11100, 0b01000, 0b01000, 0b01001, 0b00110]),
    ('u', [0, 0, 0b10001, 0b10001, 0b10001, 0b10011, 0b01101]),
];

fn write(picture: &mut RgbImage, text: &str, [left, top]: [usize; 2]) {
    for (number, letter) in text.chars().enumerate() {
        let Some((_, rows)) = LETTERS.iter().find(|(known, _)| *known == letter) else { continue };
        let dots = rows.iter().enumerate().flat_map(|(row, bits)| (0..5).map(move |column| (row, column, *bits)));
        for (row, column, _) in dots.filter(|(_, column, bits)| bits >> (4 - column) & 1 == 1) {
            let at = [left + (number * 6 + column) * DOT_PX, top + row * DOT_PX];
            for (x, y) in (0..DOT_PX).flat_map(|x| (0..DOT_PX).map(move |y| (x, y))) {
                let place = [at[0] + x, at[1] + y].map(|c| c as u32);
                if place[0] < picture.width() && place[1] < picture.height() {
                    picture.put_pixel(place[0], place[1], INK);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(cells: [i8; 6]) -> PlanView {
        PlanView { resolution_m: 0.05, origin_m: [0.0; 2], width: 3, height: 2, cells: cells.to_vec() }
    }

    fn layers() -> Layers {
        let [laser, ultrasonic] = [view([0, 100, -1, 0, 0, -1]), view([100, 0, -1, -1, -1, 100])];
        Layers { laser: laser.clone(), ultrasonic, fused: laser }
    }

    #[test]
    fn right_and_wrong_have_their_colours_with_the_highest_row_on_top() {
        let truth = view([0, 0, 100, 0, 0, 0]);
        let seen = image::load_from_memory(&png(&layers(), Some(&truth)).unwrap()).unwrap().to_rgb8();
        let scale = 12;
        let middle = |panel: usize, x: usize, row: usize| {
            let left = GAP_PX + panel * (3 * scale + GAP_PX) + x * scale + scale / 2;
            *seen.get_pixel(left as u32, (GAP_PX + LINE_PX + (1 - row) * scale + scale / 2) as u32)
        };
        assert_eq!([middle(0, 2, 0), middle(0, 0, 0)], [INK, FREE]);
        // The laser's occupied cell has a surface beside it; the ultrasonic's at the left has none.
        assert_eq!([middle(1, 1, 0), middle(1, 2, 0), middle(1, 0, 1)], [INK, UNKNOWN, FREE]);
        assert_eq!([middle(2, 0, 0), middle(2, 2, 1)], [FALSE, INK]);
        let missed = Layers { fused: view([0, 0, 0, 0, 0, 0]), ..layers() };
        let seen = image::load_from_memory(&png(&missed, Some(&truth)).unwrap()).unwrap().to_rgb8();
        assert!(seen.pixels().any(|pixel| *pixel == MISSED));
        assert!(png(&layers(), None).unwrap().len() > 100);
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        let wide = PlanView { width: 6, height: 1, ..view([0; 6]) };
        assert!(png(&layers(), Some(&wide)).unwrap_err().to_string().contains("6 x 1"));
        let empty = PlanView { width: 0, height: 0, cells: vec![], ..view([0; 6]) };
        let none = Layers { laser: empty.clone(), ultrasonic: empty.clone(), fused: empty };
        assert!(png(&none, None).is_err());
    }

    #[test]
    fn every_letter_of_the_names_is_there() {
        let known = |letter: char| LETTERS.iter().any(|(l, _)| *l == letter);
        assert!("truthlaserultrasonicfused".chars().all(known));
    }
}
