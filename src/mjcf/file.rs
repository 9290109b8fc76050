//! Writing numbers back into the text of a model file: comments, order and everything else stay.
//!
//! Attributes are written on the element itself, whatever default class it takes others from. Angles follow the
//! file's `compiler angle`. A body without an `inertial` gets one, unless all its mass is that of one geom.

use std::fmt::Write as _;
use std::ops::Range;

use roxmltree::{Document, Node};

use super::MjcfError;
use super::attribute::{Place, Target};
use super::edit::body_inertia;
use crate::mujoco::Model;

/// A replacement of a piece of the text.
struct Splice {
    range: Range<usize>,
    text: String,
}

/// The text `xml` of a model with the values that `targets` have in `model`, and a comment at its top.
///
/// # Errors
/// Text that is not XML, an element that is not in it.
pub fn rewrite(
    xml: &str,
    model: &Model,
    targets: &[&Target],
    header: &str,
) -> Result<String, MjcfError> {
    let document = Document::parse(xml).map_err(|e| MjcfError::Xml {
        reason: e.to_string(),
    })?;
    let root = document.root_element();
    let mut done: Vec<(&str, usize, &str)> = Vec::new();
    let mut splices = Vec::new();
    if !header.is_empty() {
        let text = format!("<!-- {} -->\n", header.replace("--", "- -"));
        splices.push(Splice {
            range: root.range().start..root.range().start,
            text,
        });
    }
    for target in targets {
        let name = match target.attribute.name {
            // all that describes the mass of a body, and all that describes one contact, is written at once
            "mass" | "ipos" | "inertia" => "inertia",
            "stiffness" | "damping" if target.attribute.kind == "pair" => "solref",
            "tilt" => "gravity",
            name => name,
        };
        let key = (target.attribute.kind, target.id, name);
        if done.contains(&key) {
            continue;
        }
        done.push(key);
        if target.attribute.kind == "option" {
            let gravity = numbers(&model.option().gravity);
            write_option(root, "gravity", &gravity, &mut splices);
            continue;
        }
        let node = find(root, target).ok_or_else(|| MjcfError::NotInFile {
            kind: target.attribute.kind,
            element: target.element.clone(),
        })?;
        let tag = node.tag_name().name();
        if matches!(name, "gainprm" | "biasprm") && tag != "general" {
            let (element, tag) = (target.element.clone(), tag.to_owned());
            return Err(MjcfError::Shorthand {
                element,
                tag,
                attribute: name.to_owned(),
            });
        }
        match name {
            "inertia" => {
                let only_mass = target.attribute.name == "mass";
                write_inertia(xml, model, target.id, only_mass, node, &mut splices);
            }
            "rotation" => {
                let q = &model.body_quat()[4 * target.id..4 * target.id + 4];
                let others = ["euler", "axisangle", "xyaxes", "zaxis"];
                set(xml, node, &[("quat", numbers(q))], &others, &mut splices);
            }
            _ => {
                let value = text_of(model, target, name, root);
                set(xml, node, &[(name, value)], &[], &mut splices);
            }
        }
        // a shape that the compiler would take the inertia from
        if target.attribute.kind == "geom" && matches!(name, "pos" | "size") {
            let body = model.geom_bodyid()[target.id] as usize;
            let parent = node.parent().filter(|p| p.has_tag_name("body"));
            if let Some(parent) =
                parent.filter(|p| !has_inertial(p) && !done.contains(&("body", body, "inertia")))
            {
                done.push(("body", body, "inertia"));
                write_inertia(xml, model, body, false, parent, &mut splices);
            }
        }
    }
    Ok(apply(xml, splices))
}

/// The element of a target.
fn find<'a, 'i>(root: Node<'a, 'i>, target: &Target) -> Option<Node<'a, 'i>> {
    let (section, tags): (&str, &[&str]) = match target.attribute.kind {
        "joint" => ("worldbody", &["joint", "freejoint"]),
        "body" => ("worldbody", &["body"]),
        "geom" => ("worldbody", &["geom"]),
        "site" => ("worldbody", &["site"]),
        "pair" => ("contact", &["pair"]),
        kind => (kind, &[]),
    };
    root.children()
        .filter(|n| n.has_tag_name(section))
        .flat_map(|n| n.descendants().skip(1))
        .filter(Node::is_element)
        .filter(|n| tags.is_empty() || tags.contains(&n.tag_name().name()))
        .find(|n| n.attribute("name") == Some(target.element.as_str()))
}

/// The attribute's text: all its components as they are in `model`.
fn text_of(model: &Model, target: &Target, name: &str, root: Node<'_, '_>) -> String {
    if let ("pair", "solref") = (target.attribute.kind, name) {
        return numbers(&model.pair_solref()[2 * target.id..2 * target.id + 2]);
    }
    let Place::Slots { array, first, .. } = target.place else {
        return String::new();
    };
    let values = model.numeric_field(array).unwrap_or_default();
    let start = first
        - if target.attribute.width > 1 {
            target.component
        } else {
            0
        };
    let values = &values[start..start + target.attribute.width];
    // hinge angles are in degrees in the file unless it says otherwise
    let hinge = target.attribute.kind == "joint" && model.jnt_type()[target.id] == 3;
    if name == "springref" && hinge && in_degrees(root) {
        return numbers(&[values[0].to_degrees()]);
    }
    numbers(values)
}

fn in_degrees(root: Node<'_, '_>) -> bool {
    root.children()
        .filter(|n| n.has_tag_name("compiler"))
        .filter_map(|n| n.attribute("angle"))
        .next_back()
        != Some("radian")
}

fn has_inertial(body: &Node<'_, '_>) -> bool {
    body.children().any(|n| n.has_tag_name("inertial"))
}

/// Mass, centre and inertia of body `id` as an `inertial`, or as the mass of its only geom.
fn write_inertia(
    xml: &str,
    model: &Model,
    id: usize,
    only_mass: bool,
    body: Node<'_, '_>,
    splices: &mut Vec<Splice>,
) {
    let inertia = body_inertia(model, id);
    if inertia.mass <= 0.0 {
        return;
    }
    // principal axes, because the compiler diagonalises a full inertia to seven digits only
    let written = [
        ("pos", numbers(&inertia.ipos)),
        ("mass", number(inertia.mass)),
        ("quat", numbers(&inertia.iquat)),
        ("diaginertia", numbers(&inertia.inertia)),
    ];
    let inertial = body.children().find(|n| n.has_tag_name("inertial"));
    let geoms: Vec<_> = body.children().filter(|n| n.has_tag_name("geom")).collect();
    match inertial {
        Some(node) => {
            let others = ["fullinertia", "euler", "axisangle", "xyaxes", "zaxis"];
            set(xml, node, &written, &others, splices);
        }
        None if only_mass && geoms.len() == 1 => {
            set(
                xml,
                geoms[0],
                &[("mass", number(inertia.mass))],
                &["density"],
                splices,
            );
        }
        None => {
            let mut text = String::from("<inertial");
            for (name, value) in written {
                let _ = write!(text, " {name}=\"{value}\"");
            }
            text.push_str("/>");
            let first = body.children().find(Node::is_element);
            let at = first.map_or(body.range().end, |n| n.range().start);
            let indent = first.map_or("", |n| indent_before(xml, n.range().start));
            splices.push(Splice {
                range: at..at,
                text: format!("{text}\n{indent}"),
            });
        }
    }
}

fn indent_before(xml: &str, at: usize) -> &str {
    let line = xml[..at].rfind('\n').map_or(0, |n| n + 1);
    let indent = &xml[line..at];
    if indent.trim().is_empty() { indent } else { "" }
}

/// Writes an attribute of `option`, making that element if there is none.
fn write_option(root: Node<'_, '_>, name: &str, value: &str, splices: &mut Vec<Splice>) {
    let options: Vec<_> = root
        .children()
        .filter(|n| n.has_tag_name("option"))
        .collect();
    if let Some(attribute) = options.iter().rev().find_map(|n| n.attribute_node(name)) {
        splices.push(Splice {
            range: attribute.range_value(),
            text: value.to_owned(),
        });
    } else if let Some(option) = options.last() {
        let at = option.range().start + "<option".len();
        splices.push(Splice {
            range: at..at,
            text: format!(" {name}=\"{value}\""),
        });
    } else if let Some(first) = root.children().find(Node::is_element) {
        let at = first.range().start;
        let text = format!("<option {name}=\"{value}\"/>\n  ");
        splices.push(Splice {
            range: at..at,
            text,
        });
    }
}

/// Sets attributes of an element and removes `others`.
fn set(
    xml: &str,
    node: Node<'_, '_>,
    attributes: &[(&str, String)],
    others: &[&str],
    splices: &mut Vec<Splice>,
) {
    let mut new = String::new();
    for (name, value) in attributes {
        match node.attribute_node(*name) {
            Some(old) => splices.push(Splice {
                range: old.range_value(),
                text: value.clone(),
            }),
            None => {
                let _ = write!(new, " {name}=\"{value}\"");
            }
        }
    }
    for other in others {
        if let Some(old) = node.attribute_node(*other) {
            let start = xml[..old.range().start].trim_end().len();
            splices.push(Splice {
                range: start..old.range().end,
                text: String::new(),
            });
        }
    }
    if !new.is_empty() {
        // after the last attribute, or after the tag's name
        let tag = node.range().start + 1 + node.tag_name().name().len();
        let at = node
            .attributes()
            .map(|a| a.range().end)
            .max()
            .unwrap_or(tag);
        splices.push(Splice {
            range: at..at,
            text: new,
        });
    }
}

fn apply(xml: &str, mut splices: Vec<Splice>) -> String {
    splices.sort_by_key(|s| (s.range.start, s.range.end));
    let mut out = String::with_capacity(xml.len() + 200);
    let mut at = 0;
    for splice in splices {
        out.push_str(&xml[at..splice.range.start.max(at)]);
        out.push_str(&splice.text);
        at = splice.range.end.max(at);
    }
    out.push_str(&xml[at..]);
    out
}

/// The shortest text that reads back to the same double.
fn number(value: f64) -> String {
    let plain = format!("{value}");
    let scientific = format!("{value:e}");
    if scientific.len() < plain.len() {
        scientific
    } else {
        plain
    }
}

fn numbers(values: &[f64]) -> String {
    values
        .iter()
        .map(|&v| number(v))
        .collect::<Vec<_>>()
        .join(" ")
}
