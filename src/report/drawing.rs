//! Drawings to scale as SVG: a metre is as long to the right as it is up.

use std::fmt::Write;

use super::plot::{Axis, COLOURS, Scale, Style, draw, escaped, line, text};

/// How a shape is drawn; the number is its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ink {
    /// Filled, so that what lies under it shows through.
    Fill(usize),
    /// Filled and not seen through.
    Solid(usize),
    /// A line.
    Line(usize),
    /// A thin line, for many of them.
    Thin(usize),
    /// A dashed line.
    Dashed(usize),
}

/// A shape with its name.
#[derive(Clone, Debug, PartialEq)]
struct Item {
    /// For the legend; the same name stands there once.
    name: String,
    ink: Ink,
    points: Vec<(f64, f64)>,
}

/// A drawing to scale.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Drawing {
    title: String,
    x: Axis,
    y: Axis,
    x_range: [f64; 2],
    y_range: [f64; 2],
    items: Vec<Item>,
    labels: Vec<(f64, f64, String)>,
}

/// Width of the drawing, as of a plot, and the room for ticks: left, right, under, and a line of the legend.
const WIDTH: f64 = 440.0;
const ROOM: (f64, f64, f64, f64) = (48.0, 12.0, 44.0, 16.0);

impl Drawing {
    /// An empty drawing of this part of the plane; title, and what the axes are.
    pub fn new(title: &str, x: (&str, [f64; 2]), y: (&str, [f64; 2])) -> Self {
        let axis = |label: &str| Axis { label: label.into(), unit: "m".into() };
        Self {
            title: title.into(),
            x: axis(x.0),
            y: axis(y.0),
            x_range: x.1,
            y_range: y.1,
            items: Vec::new(),
            labels: Vec::new(),
        }
    }

    /// With one more shape over the others; an empty name keeps it out of the legend.
    pub fn with(mut self, name: &str, ink: Ink, points: Vec<(f64, f64)>) -> Self {
        self.items.push(Item { name: name.into(), ink, points });
        self
    }

    /// With a word at a place.
    pub fn label(mut self, at: (f64, f64), text: &str) -> Self {
        self.labels.push((at.0, at.1, text.into()));
        self
    }

    /// The drawing as an SVG element. Its title must differ from that of every other drawing on the page.
    pub fn svg(&self) -> String {
        let span = |range: [f64; 2]| (range[1] - range[0]).max(1e-6);
        let scale = (WIDTH - ROOM.0 - ROOM.1) / span(self.x_range);
        let inner = span(self.y_range) * scale;
        let rows = self.legend().len().div_ceil(2) as f64;
        let top = 26.0 + ROOM.3 * rows + 4.0;
        let (bottom, height) = (top + inner, top + inner + ROOM.2);
        let at_x = |x: f64| ROOM.0 + (x - self.x_range[0]) * scale;
        let at_y = |y: f64| bottom - (y - self.y_range[0]) * scale;
        let id: String = self.title.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        // Writing to a string cannot fail.
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDTH} {height:.0}\" role=\"img\" aria-label=\"{}\" xmlns=\"http://www.w3.org/2000/svg\">\
             <clipPath id=\"{id}\"><rect x=\"{}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{inner:.1}\"/></clipPath>",
            escaped(&self.title),
            ROOM.0,
            WIDTH - ROOM.0 - ROOM.1,
        );
        text(&mut svg, WIDTH / 2.0, 16.0, "middle", "title", &self.title);
        self.ticks(&mut svg, &at_x, &at_y, (top, bottom));
        let _ = write!(svg, "<g clip-path=\"url(#{id})\">");
        for item in &self.items {
            let points = item.points.iter().filter(|p| p.0.is_finite() && p.1.is_finite());
            ink(&mut svg, item.ink, &points.map(|p| (at_x(p.0), at_y(p.1))).collect::<Vec<_>>());
        }
        svg.push_str("</g>");
        for (x, y, word) in &self.labels {
            text(&mut svg, at_x(*x), at_y(*y), "start", "note", word);
        }
        for (i, (name, look)) in self.legend().into_iter().enumerate() {
            let (x, y) = (ROOM.0 + (i % 2) as f64 * 190.0, 36.0 + ROOM.3 * (i / 2) as f64);
            match look {
                Ink::Fill(_) | Ink::Solid(_) => {
                    ink(&mut svg, look, &[(x, y - 9.0), (x + 18.0, y - 9.0), (x + 18.0, y), (x, y)]);
                }
                _ => ink(&mut svg, look, &[(x, y - 4.0), (x + 18.0, y - 4.0)]),
            }
            text(&mut svg, x + 24.0, y, "start", "legend", name);
        }
        svg + "</svg>"
    }

    fn ticks(&self, svg: &mut String, at_x: &dyn Fn(f64) -> f64, at_y: &dyn Fn(f64) -> f64, (top, bottom): (f64, f64)) {
        let within = |value: f64, range: [f64; 2]| value >= range[0] - 1e-9 && value <= range[1] + 1e-9;
        // The longer side decides how far apart the lines are, so that they are squares.
        let longer = if self.x_range[1] - self.x_range[0] > self.y_range[1] - self.y_range[0] {
            self.x_range
        } else {
            self.y_range
        };
        // Twice as many as a plot has: here they measure.
        let half = longer[0] + (longer[1] - longer[0]) / 2.0;
        let step = Scale::over([longer[0], half].into_iter(), false);
        let every = step.ticks().get(1).zip(step.ticks().first()).map_or(1.0, |(b, a)| b - a);
        let grid = |range: [f64; 2]| {
            let first = (range[0] / every).ceil() as i64;
            let last = (range[1] / every).floor().min(first as f64 + 60.0) as i64;
            (first..=last).map(|k| k as f64 * every).filter(|v| within(*v, range)).collect::<Vec<_>>()
        };
        for x in grid(self.x_range) {
            line(svg, "grid", (at_x(x), top), (at_x(x), bottom));
            text(svg, at_x(x), bottom + 16.0, "middle", "tick", &step.label(x));
        }
        for y in grid(self.y_range) {
            line(svg, "grid", (at_x(self.x_range[0]), at_y(y)), (at_x(self.x_range[1]), at_y(y)));
            text(svg, at_x(self.x_range[0]) - 6.0, at_y(y) + 4.0, "end", "tick", &step.label(y));
        }
        let middle = (at_x(self.x_range[0]) + at_x(self.x_range[1])) / 2.0;
        text(svg, middle, bottom + 36.0, "middle", "label", &format!("{} [{}]", self.x.label, self.x.unit));
        let _ = write!(
            svg,
            "<text class=\"label\" text-anchor=\"middle\" transform=\"translate(13 {:.1}) rotate(-90)\">{}</text>",
            (top + bottom) / 2.0,
            escaped(&format!("{} [{}]", self.y.label, self.y.unit))
        );
    }

    fn legend(&self) -> Vec<(&str, Ink)> {
        let mut named: Vec<(&str, Ink)> = Vec::new();
        for item in &self.items {
            if !item.name.is_empty() && !named.iter().any(|(name, _)| *name == item.name) {
                named.push((&item.name, item.ink));
            }
        }
        named
    }
}

fn ink(svg: &mut String, ink: Ink, points: &[(f64, f64)]) {
    let colour = |i: usize| COLOURS[i % COLOURS.len()];
    let path = || {
        let place = |(i, (x, y)): (usize, &(f64, f64))| format!("{}{x:.1} {y:.1}", if i == 0 { 'M' } else { 'L' });
        points.iter().enumerate().map(place).collect::<String>()
    };
    let _ = match ink {
        Ink::Fill(i) => write!(svg, "<path fill=\"{}\" fill-opacity=\"0.3\" d=\"{}Z\"/>", colour(i), path()),
        Ink::Solid(i) => write!(svg, "<path fill=\"{}\" d=\"{}Z\"/>", colour(i), path()),
        Ink::Thin(i) => write!(svg, "<path fill=\"none\" stroke=\"{}\" d=\"{}\"/>", colour(i), path()),
        Ink::Line(i) => {
            draw(svg, Style::Line, colour(i), points);
            Ok(())
        }
        Ink::Dashed(i) => {
            draw(svg, Style::Dashed, colour(i), points);
            Ok(())
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_metre_is_as_long_either_way_and_the_legend_names_each_thing_once() {
        let drawing = Drawing::new("a <side> view", ("X", [0.0, 4.0]), ("Z", [0.0, 1.0]))
            .with("box", Ink::Fill(0), vec![(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, f64::NAN)])
            .with("box", Ink::Fill(0), vec![(2.0, 0.0), (3.0, 0.0), (3.0, 1.0)])
            .with("", Ink::Thin(1), vec![(0.0, 0.0), (9.0, 9.0)])
            .with("ray", Ink::Dashed(1), vec![(0.0, 1.0), (4.0, 0.0)])
            .label((1.0, 0.5), "a & b");
        let svg = drawing.svg();
        assert_eq!(svg.matches(">box</text>").count(), 1);
        assert!(svg.contains("a &amp; b") && svg.contains("a &lt;side&gt; view") && !svg.contains("NaN"));
        // One metre is (440 − 60)/4 = 95 units: the ray falls 95 over 380.
        let inner = svg.split("height=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(inner, "95.0");
        assert_eq!(svg.matches("<g").count(), svg.matches("</g>").count());
        assert!(Drawing::default().svg().ends_with("</svg>"));
    }
}
