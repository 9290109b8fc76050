//! Changes of a model file that are more than a number: elements, flags, custom numbers. Comments, order and everything
//! else stay.

use std::fmt::Write as _;

use roxmltree::{Document, Node};

use super::MjcfError;
use super::file::{Splice, apply, find, indent_before, numbers, set, write_option};

/// One change.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// an attribute of a named element
    Attribute {
        /// kind of element, as in an address
        kind: &'static str,
        /// its name
        element: String,
        /// attribute
        attribute: &'static str,
        /// its text
        value: String,
    },
    /// an attribute of `option`
    Option {
        /// attribute
        attribute: &'static str,
        /// its text
        value: String,
    },
    /// a custom `numeric`: its numbers if there is one of this name, else a new one
    Numeric {
        /// its name
        name: String,
        /// its numbers
        data: Vec<f64>,
    },
    /// an element at the end of a section, which is made if there is none
    Element {
        /// `tendon`, `custom`, …
        section: &'static str,
        /// the element
        xml: String,
    },
    /// an element at the end of a body
    Child {
        /// name of the body
        body: String,
        /// the element
        xml: String,
    },
    /// a `motor` written as the `general` actuator that it is
    General {
        /// its name
        actuator: String,
    },
    /// more constraint rows, where their number is limited
    Room {
        /// how many more
        rows: usize,
    },
}

/// The text `xml` of a model with changes made one after the other.
///
/// # Errors
/// Text that is not XML, an element that is not in it.
pub fn change(xml: &str, changes: &[Change]) -> Result<String, MjcfError> {
    let mut text = xml.to_owned();
    for change in changes {
        text = one(&text, change)?;
    }
    Ok(text)
}

fn one(xml: &str, change: &Change) -> Result<String, MjcfError> {
    let document = Document::parse(xml).map_err(|e| MjcfError::Xml {
        reason: e.to_string(),
    })?;
    let root = document.root_element();
    let mut splices = Vec::new();
    match change {
        Change::Attribute {
            kind,
            element,
            attribute,
            value,
        } => {
            let node = find(root, kind, element)?;
            set(xml, node, &[(attribute, value.clone())], &[], &mut splices);
        }
        Change::Option { attribute, value } => write_option(root, attribute, value, &mut splices),
        Change::Numeric { name, data } => {
            let data = numbers(data);
            if let Ok(node) = find(root, "custom", name) {
                set(xml, node, &[("data", data)], &["size"], &mut splices);
            } else {
                let element = format!("<numeric name=\"{name}\" data=\"{data}\"/>");
                in_section(xml, root, "custom", &element, &mut splices);
            }
        }
        Change::Element {
            section,
            xml: element,
        } => in_section(xml, root, section, element, &mut splices),
        Change::Child { body, xml: element } => {
            let node = find(root, "body", body)?;
            append(xml, node, element, &mut splices);
        }
        Change::General { actuator } => {
            generalise(xml, find(root, "actuator", actuator)?, &mut splices)?;
        }
        Change::Room { rows } => enlarge(root, *rows, &mut splices),
    }
    Ok(apply(xml, splices))
}

fn in_section(
    xml: &str,
    root: Node<'_, '_>,
    section: &str,
    element: &str,
    splices: &mut Vec<Splice>,
) {
    let existing = root.children().rfind(|n| n.has_tag_name(section));
    if let Some(node) = existing {
        append(xml, node, element, splices);
    } else {
        let text = format!("<{section}>\n    {element}\n  </{section}>");
        append(xml, root, &text, splices);
    }
}

/// Puts an element behind the last one inside `node`, with the same indentation.
fn append(xml: &str, node: Node<'_, '_>, element: &str, splices: &mut Vec<Splice>) {
    let own = indent_before(xml, node.range().start);
    if let Some(last) = node.children().rfind(Node::is_element) {
        let at = last.range().end;
        let indent = indent_before(xml, last.range().start);
        splices.push(Splice {
            range: at..at,
            text: format!("\n{indent}{element}"),
        });
        return;
    }
    let (range, tag) = (node.range(), node.tag_name().name());
    let inside = &xml[range.clone()];
    if inside.ends_with("/>") {
        let at = range.end - "/>".len();
        splices.push(Splice {
            range: at..range.end,
            text: format!(">\n{own}  {element}\n{own}</{tag}>"),
        });
    } else {
        let at = range.start + inside.rfind("</").unwrap_or(inside.len());
        // an element without others may stand on one line or hold comments on lines of their own
        let blank = xml[..at].len() - xml[..at].trim_end_matches([' ', '\t']).len();
        let start = if xml[..at - blank].ends_with('\n') {
            at - blank
        } else {
            at
        };
        let begin = if start < at || start == at && xml[..at].ends_with('\n') {
            ""
        } else {
            "\n"
        };
        splices.push(Splice {
            range: start..at,
            text: format!("{begin}{own}  {element}\n{own}"),
        });
    }
}

fn generalise(xml: &str, node: Node<'_, '_>, splices: &mut Vec<Splice>) -> Result<(), MjcfError> {
    let tag = node.tag_name().name();
    match tag {
        "general" => return Ok(()),
        "motor" => {}
        _ => {
            return Err(MjcfError::Shorthand {
                element: node.attribute("name").unwrap_or_default().to_owned(),
                tag: tag.to_owned(),
                attribute: "biasprm".to_owned(),
            });
        }
    }
    let start = node.range().start + 1;
    splices.push(Splice {
        range: start..start + tag.len(),
        text: "general".to_owned(),
    });
    let text = &xml[node.range()];
    if let Some(at) = text.rfind("</motor") {
        let at = node.range().start + at + "</".len();
        splices.push(Splice {
            range: at..at + tag.len(),
            text: "general".to_owned(),
        });
    }
    // what a motor is, whatever its default class says of others
    let mut fixed = String::new();
    for (name, value) in [("gaintype", "fixed"), ("gainprm", "1")] {
        let _ = write!(fixed, " {name}=\"{value}\"");
    }
    let end = node.attributes().map(|a| a.range().end).max();
    let at = end.unwrap_or(start + tag.len());
    splices.push(Splice {
        range: at..at,
        text: fixed,
    });
    Ok(())
}

/// Raises the limits of `size`, the stack in proportion to the rows.
fn enlarge(root: Node<'_, '_>, rows: usize, splices: &mut Vec<Splice>) {
    let sizes: Vec<_> = root.children().filter(|n| n.has_tag_name("size")).collect();
    let limit = |name: &str| {
        let attribute = sizes.iter().rev().find_map(|n| n.attribute_node(name))?;
        let value: usize = attribute.value().trim().parse().ok()?;
        Some((attribute.range_value(), value))
    };
    let Some((range, before)) = limit("njmax").filter(|(_, n)| *n > 0) else {
        return;
    };
    let after = before + rows;
    splices.push(Splice {
        range,
        text: after.to_string(),
    });
    if let Some((range, stack)) = limit("nstack") {
        let text = (stack * after).div_ceil(before).to_string();
        splices.push(Splice { range, text });
    }
}
