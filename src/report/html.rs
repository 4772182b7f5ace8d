//! A report as one HTML page that needs nothing but itself: no script, no font, no network.

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::plot::{Plot, escaped};

const STYLE: &str = "\
:root{--ink:#1b1b1b;--paper:#fff;--soft:#5c5c5c;--line:#d9d9d9;--good:#00694a;--bad:#b02a00;--shade:#f5f5f3}\
@media(prefers-color-scheme:dark){:root{--ink:#e9e9e9;--paper:#161616;--soft:#a5a5a5;--line:#3a3a3a;--good:#4fd0a5;--bad:#ff8a63;--shade:#1f1f1f}}\
*{box-sizing:border-box}\
body{margin:0 auto;padding:1rem;max-width:82rem;font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper)}\
h1{font-size:1.5rem;line-height:1.2}h2{font-size:1.15rem;margin:2.2rem 0 .5rem}h3{font-size:1rem;margin:1.6rem 0 .3rem}\
summary{cursor:pointer}small{color:var(--soft)}ul.verdict{max-width:52rem;padding-left:1.2rem}ul.verdict li{margin:.35rem 0}b.note{font-weight:600}\
p{max-width:46rem}.good{color:var(--good)}.bad{color:var(--bad);font-weight:600}\
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.82rem;font-variant-numeric:tabular-nums}\
th,td{padding:.22rem .6rem;border-bottom:1px solid var(--line);text-align:right;white-space:nowrap}\
th{color:var(--soft);font-weight:600}.t,.a,.n{text-align:left}td.a{white-space:normal;min-width:min(15rem,30vw)}\
td.n{white-space:normal;min-width:15rem;color:var(--soft)}\
ol{margin:.4rem 0 0;padding-left:1.4rem;font-size:.82rem;color:var(--soft)}sup{line-height:0;color:var(--soft)}\
@media(max-width:30rem){th,td{padding:.2rem .3rem}}\
tbody tr:nth-child(even){background:var(--shade)}\
.drawn{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,24rem),1fr));gap:1rem;margin:.8rem 0}\
.even{grid-template-columns:repeat(auto-fill,minmax(min(100%,24rem),1fr))}\
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(8.8rem,1fr));gap:.6rem;margin:1rem 0}\
.tiles div{background:var(--shade);border-left:3px solid var(--good);padding:.45rem .7rem}\
.tiles dt{font-size:.8rem;color:var(--soft)}.tiles dd{margin:0;font-size:1rem;white-space:nowrap;font-weight:600}\
figure{margin:0;max-width:40rem}figcaption{font-size:.86rem;color:var(--soft)}img,svg{display:block;width:100%;height:auto}\
img{background:#000}\
svg text{fill:var(--ink);font-family:system-ui,sans-serif;font-size:12.5px}svg .title{font-size:13.5px;font-weight:600}\
svg .tick{fill:var(--soft)}svg .grid{stroke:var(--line);stroke-width:.7}svg .axis{stroke:var(--ink);stroke-width:1}svg .note{font-size:11px}\
@media print{body{max-width:none}}";

/// A whole page. `title` is text, `body` is HTML.
pub fn page(title: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{title}</title>\
         <style>{STYLE}</style></head><body>{body}</body></html>"
    )
}

/// A picture inside the page, from a PNG file of this size [px].
pub fn picture(caption: &str, png: &[u8], [width, height]: [usize; 2]) -> String {
    let (caption, data) = (escaped(caption), STANDARD.encode(png));
    format!(
        "<figure><img alt=\"{caption}\" width=\"{width}\" height=\"{height}\" \
         src=\"data:image/png;base64,{data}\"><figcaption>{caption}</figcaption></figure>"
    )
}

/// Figures beside each other, as many in a row as there is room for.
pub fn gallery(figures: impl IntoIterator<Item = String>) -> String {
    format!("<div class=\"drawn\">{}</div>", figures.into_iter().collect::<String>())
}

/// The same, all of one size however many stand in the last row.
pub fn even_gallery(figures: impl IntoIterator<Item = String>) -> String {
    format!("<div class=\"drawn even\">{}</div>", figures.into_iter().collect::<String>())
}

/// Numbers that say most, large, each with what it is. Text.
pub fn tiles(tiles: impl IntoIterator<Item = (String, String)>) -> String {
    let tile =
        |(name, value): (String, String)| format!("<div><dt>{}</dt><dd>{}</dd></div>", escaped(&name), escaped(&value));
    format!("<dl class=\"tiles\">{}</dl>", tiles.into_iter().map(tile).collect::<String>())
}

/// A plot as a figure.
pub fn drawing(plot: &Plot) -> String {
    format!("<figure>{}</figure>", plot.svg())
}

/// An SVG element as a figure with a caption.
pub fn captioned(svg: &str, caption: &str) -> String {
    format!("<figure>{svg}<figcaption>{}</figcaption></figure>", escaped(caption))
}

/// A table that scrolls where it is too wide. The first column is text, the others are numbers; cells are text.
pub fn table<const N: usize>(head: [&str; N], rows: impl IntoIterator<Item = [String; N]>) -> String {
    let class = |column: usize| if column == 0 { " class=\"t\"" } else { "" };
    let mut html = String::from("<div class=\"wide\"><table><thead><tr>");
    for (column, text) in head.iter().enumerate() {
        // Writing to a string cannot fail.
        let _ = write!(html, "<th{}>{}</th>", class(column), escaped(text));
    }
    html += "</tr></thead><tbody>";
    for row in rows {
        html += "<tr>";
        for (column, text) in row.iter().enumerate() {
            let _ = write!(html, "<td{}>{}</td>", class(column), escaped(text));
        }
        html += "</tr>";
    }
    html + "</tbody></table></div>"
}

/// A number to as many places as are of use: six figures, and thousandths of larger ones.
pub fn number(value: f64) -> String {
    figures(value, if value.abs() >= 1000.0 { 7 } else { 6 })
}

/// A number to so many figures.
pub fn figures(value: f64, figures: i32) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    if value == 0.0 {
        return "0".into();
    }
    let magnitude = value.abs().log10().floor();
    if !(-4.0..7.0).contains(&magnitude) {
        return format!("{value:.2e}").replace('-', "−");
    }
    let decimals = (figures - 1 - magnitude as i32).clamp(0, 8) as usize;
    let text = format!("{value:.decimals$}").replace('-', "−");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_string() } else { text }
}

/// A number and its standard deviation, both to two figures of the latter.
pub fn with_sigma(value: f64, sigma: f64) -> [String; 2] {
    if !(sigma.is_finite() && sigma > 0.0) {
        return [number(value), "–".into()];
    }
    let places = (1.0 - sigma.log10().floor()).clamp(0.0, 9.0) as usize;
    [value, sigma].map(|number| format!("{number:.places$}").replace('-', "−"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_holds_its_parts_and_text_is_no_markup() {
        let body = table(["what", "how much"], [["a <b> & c".to_string(), "1".to_string()]])
            + &gallery([picture("\"x\"", b"foob", [1, 2])]);
        let html = page("<title>", &body);
        assert!(html.starts_with("<!doctype html>") && html.ends_with("</html>"));
        assert!(html.contains("base64,Zm9vYg==\"") && html.contains("<title>&lt;title&gt;</title>"));
        assert!(html.contains("<td class=\"t\">a &lt;b&gt; &amp; c</td><td>1</td>") && !html.contains("<b>"));
    }

    #[test]
    fn an_error_bar_says_how_many_figures_count() {
        assert_eq!(with_sigma(-0.155431, 0.0022), ["−0.1554", "0.0022"]);
        assert_eq!(with_sigma(1e-16, 0.0012), ["0.0000", "0.0012"]);
        assert_eq!(with_sigma(253.573, 19.7), ["254", "20"]);
        assert_eq!(with_sigma(0.5, 0.0), ["0.5", "–"]);
        assert_eq!(with_sigma(0.5, f64::INFINITY), ["0.5", "–"]);
    }

    #[test]
    fn numbers_are_as_long_as_they_need_to_be() {
        for (value, text) in [
            (817.2443, "817.244"),
            (-2.355286, "−2.35529"),
            (0.0, "0"),
            (2197.8779, "2197.878"),
            (0.00335, "0.00335"),
            (81.0, "81"),
            (f64::NAN, "–"),
            (-1e-9, "−1.00e−9"),
        ] {
            assert_eq!(number(value), text);
        }
    }
}
