//! Plots as SVG: axes with units, a legend, readable from a telephone to a screen.

use std::fmt::Write;

/// An axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// What is along it.
    pub label: String,
    /// In what unit; empty for a bare number.
    pub unit: String,
}

impl Axis {
    fn title(&self) -> String {
        if self.unit.is_empty() { self.label.clone() } else { format!("{} [{}]", self.label, self.unit) }
    }
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Style {
    /// Joined.
    Line,
    /// Round marks.
    Dots,
    /// Marks of the smallest size, for many points.
    Points,
    /// Joined by dashes: a limit, not a measurement.
    Dashed,
    /// Filled: the points run once around it.
    Area,
    /// Points taken in pairs, each pair joined.
    Segments,
}

/// Points with a name.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// For the legend; empty: not in it.
    pub name: String,
    /// How.
    pub style: Style,
    /// x and y in the axes' units; those that are not finite are left out.
    pub points: Vec<(f64, f64)>,
    /// Number of its colour; without it, its place among the series.
    pub colour: Option<usize>,
}

impl Series {
    /// Points with a name.
    pub fn new(name: impl Into<String>, style: Style, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), style, points, colour: None }
    }

    /// In a colour of its own, so that the same thing looks the same in several plots.
    pub fn coloured(mut self, colour: usize) -> Self {
        self.colour = Some(colour);
        self
    }

    fn ink(&self, place: usize) -> &'static str {
        COLOURS[self.colour.unwrap_or(place) % COLOURS.len()]
    }
}

/// A plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Over it.
    pub title: String,
    /// To the right.
    pub x: Axis,
    /// Up.
    pub y: Axis,
    /// What is drawn.
    pub series: Vec<Series>,
    /// Whether y grows downwards, as image rows do.
    pub y_down: bool,
    /// Whether y begins at 0.
    pub y_from_zero: bool,
    /// Whether y grows by factors: what is not above 0 is left out.
    pub y_log: bool,
}

/// Size of the drawing: small, so that its letters stay readable where it is shrunk to a telephone's width.
const SIZE: (f64, f64) = (440.0, 320.0);
/// Room for tick labels and titles: left, right, top, bottom.
const ROOM: (f64, f64, f64, f64) = (58.0, 24.0, 30.0, 46.0);
/// Colours that also the colour-blind tell apart (Okabe and Ito).
pub(super) const COLOURS: [&str; 8] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#777777", "#e69f00", "#8c6bb1"];

impl Plot {
    /// An empty plot: title, x axis and unit, y axis and unit.
    pub fn new(title: &str, x: &str, x_unit: &str, y: &str, y_unit: &str) -> Self {
        let axis = |label: &str, unit: &str| Axis { label: label.into(), unit: unit.into() };
        Self { title: title.into(), x: axis(x, x_unit), y: axis(y, y_unit), ..Self::default() }
    }

    /// With one more series.
    pub fn with(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    /// With y from 0.
    pub fn from_zero(mut self) -> Self {
        self.y_from_zero = true;
        self
    }

    /// With y downwards.
    pub fn downwards(mut self) -> Self {
        self.y_down = true;
        self
    }

    /// With y by factors.
    pub fn log_y(mut self) -> Self {
        self.y_log = true;
        self
    }

    /// The plot as an SVG element. A plot without a finite point shows its axes from 0 to 1.
    pub fn svg(&self) -> String {
        let x = Scale::over(self.points().map(|p| p.0), false);
        let heights = self.points().map(|p| p.1);
        let y = if self.y_log { Scale::factors(heights) } else { Scale::over(heights, self.y_from_zero) };
        let (left, right, top, bottom) = (ROOM.0, SIZE.0 - ROOM.1, self.top(), SIZE.1 - ROOM.3);
        let at_x = |value: f64| left + x.part(value) * (right - left);
        let at_y = |value: f64| {
            let part = if self.y_down { 1.0 - y.part(value) } else { y.part(value) };
            bottom - part * (bottom - top)
        };
        let mut svg = format!(
            "<svg viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\" xmlns=\"http://www.w3.org/2000/svg\">",
            SIZE.0,
            SIZE.1,
            escaped(&self.title)
        );
        text(&mut svg, SIZE.0 / 2.0, 16.0, "middle", "title", &self.title);
        for tick in x.ticks() {
            line(&mut svg, "grid", (at_x(tick), top), (at_x(tick), bottom));
            text(&mut svg, at_x(tick), bottom + 16.0, "middle", "tick", &x.label(tick));
        }
        for tick in y.ticks() {
            line(&mut svg, "grid", (left, at_y(tick)), (right, at_y(tick)));
            text(&mut svg, left - 6.0, at_y(tick) + 4.0, "end", "tick", &y.label(tick));
        }
        line(&mut svg, "axis", (left, bottom), (right, bottom));
        line(&mut svg, "axis", (left, top), (left, bottom));
        text(&mut svg, (left + right) / 2.0, SIZE.1 - 8.0, "middle", "label", &self.x.title());
        let middle = (top + bottom) / 2.0;
        // Writing to a string cannot fail.
        let _ = write!(
            svg,
            "<text class=\"label\" text-anchor=\"middle\" transform=\"translate(14 {middle:.1}) rotate(-90)\">{}</text>",
            escaped(&self.y.title())
        );
        for (i, series) in self.series.iter().enumerate() {
            let placed = series.points.iter().filter(|p| self.is_drawn(p)).map(|p| (at_x(p.0), at_y(p.1)));
            draw(&mut svg, series.style, series.ink(i), &placed.collect::<Vec<_>>());
        }
        self.legend(&mut svg);
        svg.push_str("</svg>");
        svg
    }

    fn points(&self) -> impl Iterator<Item = &(f64, f64)> {
        self.series.iter().flat_map(|series| &series.points).filter(|p| self.is_drawn(p))
    }

    fn is_drawn(&self, point: &(f64, f64)) -> bool {
        point.0.is_finite() && point.1.is_finite() && (!self.y_log || point.1 > 0.0)
    }

    /// Legends stand over the plot.
    fn top(&self) -> f64 {
        ROOM.2 + 16.0 * self.legend_lines() as f64
    }

    fn legend_lines(&self) -> usize {
        if self.series.len() < 2 { 0 } else { self.named().count().div_ceil(self.legend_columns()) }
    }

    /// Series that stand in the legend, with their places: those that have a name.
    fn named(&self) -> impl Iterator<Item = (usize, &Series)> {
        self.series.iter().enumerate().filter(|(_, series)| !series.name.is_empty())
    }

    /// Two names a line where they are short.
    fn legend_columns(&self) -> usize {
        if self.series.iter().any(|series| series.name.chars().count() > 22) { 1 } else { 2 }
    }

    fn legend(&self, svg: &mut String) {
        if self.legend_lines() == 0 {
            return;
        }
        for (i, (place, series)) in self.named().enumerate() {
            let (column, row) = (i % self.legend_columns(), i / self.legend_columns());
            let (x, y) = (ROOM.0 + column as f64 * 185.0, ROOM.2 + 6.0 + 16.0 * row as f64);
            let colour = series.ink(place);
            let (left, right) = (x, x + 18.0);
            match series.style {
                Style::Line | Style::Dashed => draw(svg, series.style, colour, &[(left, y - 4.0), (right, y - 4.0)]),
                Style::Area => {
                    let box_of = [(left, y - 9.0), (right, y - 9.0), (right, y), (left, y)];
                    draw(svg, Style::Area, colour, &box_of);
                }
                Style::Segments => draw(svg, Style::Line, colour, &[(left, y - 4.0), (right, y - 4.0)]),
                Style::Dots | Style::Points => draw(svg, Style::Dots, colour, &[(x + 9.0, y - 4.0)]),
            }
            text(svg, x + 24.0, y, "start", "legend", &series.name);
        }
    }
}

pub(super) fn draw(svg: &mut String, style: Style, colour: &str, points: &[(f64, f64)]) {
    let path = |svg: &mut String, each: &dyn Fn(usize, &(f64, f64)) -> String| {
        points.iter().enumerate().for_each(|(i, p)| svg.push_str(&each(i, p)));
    };
    match style {
        Style::Line | Style::Dashed => {
            let dashes = if style == Style::Dashed { " stroke-dasharray=\"6 4\"" } else { "" };
            let _ = write!(svg, "<path fill=\"none\" stroke-width=\"2\"{dashes} stroke=\"{colour}\" d=\"");
            path(svg, &|i, (x, y)| format!("{}{x:.1} {y:.1}", if i == 0 { 'M' } else { 'L' }));
            svg.push_str("\"/>");
        }
        Style::Area => {
            let _ = write!(svg, "<path fill=\"{colour}\" fill-opacity=\"0.8\" d=\"");
            path(svg, &|i, (x, y)| format!("{}{x:.1} {y:.1}", if i == 0 { 'M' } else { 'L' }));
            svg.push_str("Z\"/>");
        }
        Style::Segments => {
            let _ = write!(svg, "<path fill=\"none\" stroke-width=\"1.2\" stroke=\"{colour}\" d=\"");
            path(svg, &|i, (x, y)| format!("{}{x:.1} {y:.1}", if i % 2 == 0 { 'M' } else { 'L' }));
            svg.push_str("\"/>");
        }
        Style::Dots => {
            path(svg, &|_, (x, y)| format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"{colour}\"/>"))
        }
        // One path of squares: thousands of points stay light.
        Style::Points => {
            let _ = write!(svg, "<path fill=\"{colour}\" d=\"");
            path(svg, &|_, (x, y)| format!("M{:.1} {:.1}h1.6v1.6h-1.6z", x - 0.8, y - 0.8));
            svg.push_str("\"/>");
        }
    }
}

pub(super) fn line(svg: &mut String, class: &str, from: (f64, f64), to: (f64, f64)) {
    let _ = write!(
        svg,
        "<line class=\"{class}\" x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\"/>",
        from.0, from.1, to.0, to.1
    );
}

pub(super) fn text(svg: &mut String, x: f64, y: f64, anchor: &str, class: &str, what: &str) {
    let _ = write!(
        svg,
        "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>",
        escaped(what)
    );
}

/// Text for HTML and SVG.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// From a smallest to a largest value, in round steps or by factors.
pub(super) struct Scale {
    low: f64,
    high: f64,
    step: f64,
    /// Then `low` and `high` are whole powers of ten.
    log: bool,
}

impl Scale {
    pub(super) fn over(values: impl Iterator<Item = f64>, from_zero: bool) -> Self {
        let (mut low, mut high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        if from_zero {
            low = low.min(0.0);
        }
        if high - low <= 1e-12 * high.abs().max(low.abs()) {
            let about = low.abs().max(1.0) * 0.5;
            (low, high) = (low - about, high + about);
        }
        let rough = (high - low) / 5.0;
        let power = 10f64.powf(rough.log10().floor());
        let step =
            [1.0, 2.0, 2.5, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough * 0.999).unwrap_or(rough);
        Self { low: (low / step + 1e-9).floor() * step, high: (high / step - 1e-9).ceil() * step, step, log: false }
    }

    /// Over whole powers of ten; the values are all above 0.
    fn factors(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values.fold((f64::INFINITY, 0f64), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low > high { (1.0, 10.0) } else { (low, high) };
        let low = (low.log10() + 1e-9).floor();
        let high = (high.log10() - 1e-9).ceil().max(low + 1.0);
        Self { low: 10f64.powf(low), high: 10f64.powf(high), step: 1.0, log: true }
    }

    fn part(&self, value: f64) -> f64 {
        if self.log {
            return (value / self.low).log10() / (self.high / self.low).log10();
        }
        (value - self.low) / (self.high - self.low)
    }

    pub(super) fn ticks(&self) -> Vec<f64> {
        if self.log {
            let decades = (self.high / self.low).log10().round().clamp(1.0, 40.0) as i32;
            let within: &[f64] = if decades <= 2 { &[1.0, 2.0, 5.0] } else { &[1.0] };
            let all = (0..decades).flat_map(|k| within.iter().map(move |m| m * 10f64.powi(k)));
            return all.map(|m| self.low * m).chain([self.high]).collect();
        }
        let count = ((self.high - self.low) / self.step).round().clamp(1.0, 20.0) as i32;
        (0..=count).map(|i| self.low + f64::from(i) * self.step).collect()
    }

    pub(super) fn label(&self, value: f64) -> String {
        if self.log {
            let decimals = (-value.log10() - 1e-9).ceil().clamp(0.0, 9.0) as usize;
            return if value >= 1e5 { format!("{value:.0e}") } else { format!("{value:.decimals$}") };
        }
        let whole = |d: &usize| {
            let steps = self.step * 10f64.powi(*d as i32);
            (steps - steps.round()).abs() < 1e-6 * steps
        };
        let decimals = (0..9).find(whole).unwrap_or(9);
        let text = format!("{value:.decimals$}");
        if text.trim_start_matches('-').bytes().all(|b| b == b'0' || b == b'.') { text.replace('-', "") } else { text }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_round_and_hold_all_values() {
        for (low, high) in
            [(0.0, 312.0), (1500.0, 2500.0), (-0.3, 0.2), (8.2, 23.9), (-1e-7, 3e-7), (5.0, 5.0), (0.0, 0.0)]
        {
            let scale = Scale::over([low, high].into_iter(), false);
            assert!(scale.low <= low && scale.high >= high, "{low} {high}: {} {}", scale.low, scale.high);
            assert!((3..=12).contains(&scale.ticks().len()));
        }
        let scale = Scale::over([0.0, 1.0].into_iter(), false);
        assert_eq!(
            scale.ticks().into_iter().map(|t| scale.label(t)).collect::<Vec<_>>(),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        let scale = Scale::over([0.0, 12.0].into_iter(), false);
        assert_eq!(scale.label(2.5), "2.5");
    }

    #[test]
    fn factors_are_drawn_evenly_and_what_is_not_above_zero_is_left_out() {
        let scale = Scale::factors([0.03, 4.0].into_iter());
        assert!((scale.low - 0.01).abs() < 1e-12 && (scale.high - 10.0).abs() < 1e-9);
        assert!((scale.part(1.0) - scale.part(0.1) - 1.0 / 3.0).abs() < 1e-9);
        let labels: Vec<_> = scale.ticks().into_iter().map(|t| scale.label(t)).collect();
        assert_eq!(labels, ["0.01", "0.1", "1", "10"]);
        let labels: Vec<_> = Scale::factors([3.0].into_iter()).ticks().into_iter().map(|t| scale.label(t)).collect();
        assert_eq!(labels, ["1", "2", "5", "10"]);
        let plot = Plot::new("t", "x", "", "y", "")
            .with(Series::new("l", Style::Line, vec![(0.0, 1.0), (1.0, 0.0), (2.0, 10.0)]))
            .with(Series::new("a", Style::Area, vec![(0.0, 1.0), (2.0, 1.0), (2.0, 5.0)]))
            .log_y();
        let svg = plot.svg();
        assert!(!svg.contains("inf") && !svg.contains("NaN") && svg.contains("Z\"/>"));
        assert!(Plot::default().log_y().svg().contains("</svg>"));
    }

    #[test]
    fn a_plot_is_whole_and_safe() {
        let plot = Plot::new("a < b & \"c\"", "x", "mm", "y", "")
            .with(Series::new("line", Style::Line, vec![(0.0, 1.0), (2.0, f64::NAN), (1.0, 3.0)]))
            .with(Series::new("dots", Style::Points, vec![(0.5, 2.0)]));
        let svg = plot.svg();
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>"));
        assert!(svg.contains("a &lt; b &amp; &quot;c&quot;") && svg.contains("x [mm]") && !svg.contains("NaN"));
        let tree = svg.matches("<text").count();
        assert_eq!(tree, svg.matches("</text>").count());
        assert!(Plot::default().svg().contains("</svg>"));
    }
}
