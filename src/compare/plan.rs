//! Maps and the world as pictures of the report.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use super::layers::Shown;
use crate::fault::{Fault, Result};
use crate::maps::PlanView;
use crate::report::{escaped, html};

/// Margin around what is drawn of the world [m].
const MARGIN_M: f64 = 0.5;
/// Size of a number's disc, and how far beside its obstacle it stands [m].
const DISC_M: f64 = 0.24;
const BESIDE_M: f64 = 0.42;

/// A part of the ground: lower and upper corner [m].
struct Frame {
    low: [f64; 2],
    high: [f64; 2],
}

impl Frame {
    fn of(view: &PlanView) -> Self {
        let size = [view.width, view.height];
        let high = std::array::from_fn(|axis| view.origin_m[axis] + size[axis] as f64 * view.resolution_m);
        Self { low: view.origin_m, high }
    }

    /// What of a map is known, with a margin.
    fn of_known(view: &PlanView) -> Self {
        let mut frame = Self { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };
        for (index, _) in view.cells.iter().enumerate().filter(|cell| *cell.1 >= 0) {
            let cell = [index % view.width.max(1), index / view.width.max(1)];
            for (axis, cell) in cell.into_iter().enumerate() {
                let at = view.origin_m[axis] + cell as f64 * view.resolution_m;
                frame.low[axis] = frame.low[axis].min(at - MARGIN_M);
                frame.high[axis] = frame.high[axis].max(at + view.resolution_m + MARGIN_M);
            }
        }
        if frame.low[0] < frame.high[0] { frame } else { Self::of(view) }
    }

    fn cells(&self, cell_m: f64) -> [usize; 2] {
        std::array::from_fn(|axis| ((self.high[axis] - self.low[axis]) / cell_m).round().clamp(1.0, 1e5) as usize)
    }

    /// A map within the frame as a PNG file, y up: black occupied, white free, grey unknown.
    fn png(&self, view: &PlanView) -> Result<Vec<u8>> {
        let [width, height] = self.cells(view.resolution_m);
        let shift: [i64; 2] =
            std::array::from_fn(|axis| ((self.low[axis] - view.origin_m[axis]) / view.resolution_m).round() as i64);
        let mut levels = Vec::with_capacity(width * height);
        for row in (0..height as i64).rev() {
            for column in 0..width as i64 {
                let (x, y) = (column + shift[0], row + shift[1]);
                let inside = (0..view.width as i64).contains(&x) && (0..view.height as i64).contains(&y);
                let cell = if inside { view.cells[y as usize * view.width + x as usize] } else { -1 };
                levels.push(match cell {
                    i8::MIN..0 => 190,
                    0..50 => 255,
                    _ => 0,
                });
            }
        }
        let mut png = Vec::new();
        PngEncoder::new(&mut png)
            .write_image(&levels, width as u32, height as u32, ExtendedColorType::L8)
            .map_err(|e| Fault::new("picture of a map", e, "a map that PNG can hold"))?;
        Ok(png)
    }
}

/// A map in the frame of another one, as a figure.
pub(super) fn map(view: &PlanView, frame: &PlanView, name: &str) -> Result<String> {
    let frame = Frame::of(frame);
    let [w, h] = std::array::from_fn(|axis| frame.high[axis] - frame.low[axis]);
    let png = frame.png(view)?;
    Ok(html::picture(&format!("{name} ({w:.1} x {h:.1} m)"), &png, frame.cells(view.resolution_m)))
}

/// The world from above, with the robot's way and every obstacle's class by its number in `order`.
pub(super) fn world(truth: &PlanView, shown: &Shown, order: &[String]) -> Result<String> {
    let frame = Frame::of_known(truth);
    let [w, h] = std::array::from_fn(|axis| frame.high[axis] - frame.low[axis]);
    // In metres, y down as SVG has it.
    let at = |p: [f64; 2]| [p[0] - frame.low[0], frame.high[1] - p[1]];
    let data = STANDARD.encode(frame.png(truth)?);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {w:.2} {h:.2}\" role=\"img\"><image width=\"{w:.2}\" height=\"{h:.2}\" \
         preserveAspectRatio=\"none\" style=\"image-rendering:pixelated\" href=\"data:image/png;base64,{data}\"/><polyline \
         fill=\"none\" stroke=\"#0072b2\" stroke-width=\"0.05\" stroke-dasharray=\"0.16 0.1\" points=\""
    );
    // Writing to a string cannot fail.
    for [x, y] in shown.way_m.iter().map(|p| at(*p)) {
        let _ = write!(svg, "{x:.2},{y:.2} ");
    }
    svg += "\"/>";
    svg += "<path d=\"M0.8 0.32h1\" stroke=\"#000\" stroke-width=\"0.06\"/><text x=\"0.1\" y=\"0.4\" \
            style=\"font-size:.28px;fill:#000\">1 m</text>";
    for place in &shown.places {
        let [x, y] = at(place.at_m);
        let numbers: Vec<String> = order
            .iter()
            .zip(1..)
            .filter(|(class, _)| place.classes.contains(class))
            .map(|(_, number): (_, u32)| number.to_string())
            .collect();
        // Towards the middle of the picture, so that the disc stays in it.
        let [cx, cy] = [
            if x < w / 2.0 { x + BESIDE_M } else { x - BESIDE_M },
            if y < h / 2.0 { y + BESIDE_M } else { y - BESIDE_M },
        ];
        let wide = DISC_M * (0.1 + 0.9 * numbers.len() as f64);
        let _ = write!(
            svg,
            "<g><title>{}</title><path d=\"M{x:.2} {y:.2}L{cx:.2} {cy:.2}\" stroke=\"#a33\" stroke-width=\"0.03\"/><ellipse \
             cx=\"{cx:.2}\" cy=\"{cy:.2}\" rx=\"{wide:.2}\" ry=\"{DISC_M}\" fill=\"#a33\"/><text x=\"{cx:.2}\" y=\"{:.2}\" \
             text-anchor=\"middle\" style=\"font-size:.3px;fill:#fff;font-weight:600\">{}</text></g>",
            escaped(&place.classes.join(", ")),
            cy + 0.1,
            numbers.join("·")
        );
    }
    svg += "</svg>";
    let met: Vec<String> = order.iter().zip(1..).map(|(class, number)| format!("{number} {class}")).collect();
    let caption = format!(
        "The world from above, and the way of one seed (dashed). Black: what reaches into the robot's height; white: floor; grey: out of \
         sight. {}.",
        met.join(" · ")
    );
    Ok(html::captioned(&svg, &caption))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::layers::{Picture, Place};

    fn view() -> PlanView {
        let mut cells = vec![-1; 40 * 30];
        for cell in &mut cells[410..430] {
            *cell = 0;
        }
        cells[415] = 100;
        PlanView { resolution_m: 0.1, origin_m: [-2.0, -1.0], width: 40, height: 30, cells }
    }

    #[test]
    fn a_map_keeps_its_size_and_its_colours() {
        let figure = map(&view(), &view(), "Laser").unwrap();
        assert!(figure.contains("Laser (4.0 x 3.0 m)") && figure.contains("width=\"40\" height=\"30\""));
        let png = Frame::of(&view()).png(&view()).unwrap();
        let picture = image::load_from_memory(&png).unwrap().to_luma8();
        // Row 10 from below is row 19 from above.
        assert_eq!([15, 16, 9].map(|x| picture.get_pixel(x, 19).0[0]), [0, 255, 190]);
    }

    #[test]
    fn the_world_is_cut_to_what_is_known_and_names_what_is_numbered() {
        let place = |class: &str, at_m| Place { classes: vec![class.into(), "fast".into()], at_m };
        let shown = Shown {
            maps: vec![Picture::of(&view())],
            way_m: vec![[0.0, 0.0], [0.5, 0.0]],
            places: vec![place("a <pole>", [-0.45, 0.05]), place("unknown", [0.0, 0.0])],
        };
        let figure = world(&view(), &shown, &["a <pole>", "fast"].map(String::from)).unwrap();
        assert!(figure.contains("viewBox=\"0 0 3.00 1.10\""), "{figure}");
        assert_eq!((figure.matches(">1·2</text>").count(), figure.matches("&lt;pole&gt;").count()), (1, 2));
        assert!(world(&PlanView { cells: vec![-1; 1200], ..view() }, &shown, &[]).unwrap().contains("0 0 4.00 3.00"));
    }
}
