//! What the readers of COLLADA and SDF share: XML with bounded memory, elements by name, numbers, and lines for errors.

use std::borrow::Cow;
use std::fmt::Display;

use roxmltree::{Document, Node, ParsingOptions};

use crate::fault::{Fault, Result};

/// XML nodes in one file: bounds the memory that a file of small tags can take.
const XML_NODES_MAX: u32 = 10_000_000;

/// Parses a text.
///
/// # Errors
/// Text that is not well-formed XML, with its line. Document type definitions are refused.
pub(super) fn parse(text: &str) -> Result<Document<'_>> {
    let options = ParsingOptions { nodes_limit: XML_NODES_MAX, ..Default::default() };
    Document::parse_with_options(text, options)
        .map_err(|error| Fault::new("XML", &error, "well-formed XML").at_line(error.pos().row as usize))
}

/// The line of a node, from 1.
pub(super) fn line_of(node: Node) -> usize {
    node.document().text_pos_at(node.range().start).row as usize
}

/// A fault with the line of a node.
pub(super) fn fault(node: Node, what: impl Display, found: impl Display, expected: impl Display) -> Fault {
    Fault::new(what, found, expected).at_line(line_of(node))
}

/// An element's name without its namespace.
pub(super) fn tag<'a>(node: Node<'a, '_>) -> &'a str {
    node.tag_name().name()
}

/// The elements within a node.
pub(super) fn elements<'a, 'i>(node: Node<'a, 'i>) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(Node::is_element)
}

/// The elements of this name within a node.
pub(super) fn children<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> impl Iterator<Item = Node<'a, 'i>> {
    elements(node).filter(move |child| tag(*child) == name)
}

/// The first element of this name within a node.
pub(super) fn child<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> Option<Node<'a, 'i>> {
    children(node, name).next()
}

/// The first element of this name within a node, which has to be there.
pub(super) fn required<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> Result<Node<'a, 'i>> {
    child(node, name).ok_or_else(|| fault(node, tag(node), format!("no <{name}>"), format!("<{name}>")))
}

/// All text of an element, also where comments or CDATA cut it into pieces.
pub(super) fn text_of<'a>(node: Node<'a, '_>) -> Cow<'a, str> {
    let mut pieces = node.children().filter_map(|piece| piece.text().filter(|_| piece.is_text()));
    match (pieces.next(), pieces.next()) {
        (None, _) => Cow::Borrowed(""),
        (Some(only), None) => Cow::Borrowed(only),
        (Some(first), Some(second)) => {
            Cow::Owned([first, second].into_iter().chain(pieces).collect::<Vec<_>>().join(" "))
        }
    }
}

/// The text of an element without the space around it.
pub(super) fn trimmed(node: Node) -> String {
    text_of(node).trim().to_string()
}

/// The numbers that are an element's text; each finite.
pub(super) fn floats(node: Node) -> Result<Vec<f64>> {
    let number = |word: &str| {
        let parsed = word.parse::<f64>().ok().filter(|x| x.is_finite());
        parsed.ok_or_else(|| fault(node, tag(node), format!("`{word}`"), "finite numbers"))
    };
    text_of(node).split_ascii_whitespace().map(number).collect()
}

/// Exactly `N` numbers.
pub(super) fn exactly<const N: usize>(node: Node) -> Result<[f64; N]> {
    let expected = if N == 1 { "1 number".to_string() } else { format!("{N} numbers") };
    floats(node)?.try_into().map_err(|v: Vec<f64>| fault(node, tag(node), format!("{} numbers", v.len()), &expected))
}
