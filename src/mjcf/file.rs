//! Writing numbers back into the text of a model file: comments, order and everything else stay.
//!
//! Attributes are written on the element itself, whatever default class it takes others from. Angles follow the
//! file's `compiler angle`. A body without an `inertial` gets one, unless all its mass is that of one geom.

use std::fmt::Write as _;
use std::ops::Range;

use roxmltree::{Document, Node};

use super::MjcfError;
use super::attribute::{Place, Target, body_geoms};
use super::edit::body_inertia;
use crate::mujoco::Model;

/// A replacement of a piece of the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Splice {
    pub(super) range: Range<usize>,
    pub(super) text: String,
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
            "stiffness" | "damping" | "hardness" | "dampratio"
                if target.attribute.kind == "pair" =>
            {
                "solref"
            }
            "tilt" => "gravity",
            "length" => "pos",
            "slide" => "friction",
            "forcelimit" => "forcerange",
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
        let node = find(root, target.attribute.kind, &target.element)?;
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
            "geometry" => write_geometry(xml, model, target.id, node, &mut splices)?,
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
        let shape = target.attribute.kind == "geom" && matches!(name, "pos" | "size");
        if shape || name == "geometry" {
            let (body, parent) = if shape {
                let parent = node.parent().filter(|p| p.has_tag_name("body"));
                (model.geom_bodyid()[target.id] as usize, parent)
            } else {
                (target.id, Some(node))
            };
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

/// The element of a kind (as in an address) and name.
pub(super) fn find<'a, 'i>(
    root: Node<'a, 'i>,
    kind: &'static str,
    element: &str,
) -> Result<Node<'a, 'i>, MjcfError> {
    let (section, tags): (&str, &[&str]) = match kind {
        "joint" => ("worldbody", &["joint", "freejoint"]),
        "body" => ("worldbody", &["body"]),
        "geom" => ("worldbody", &["geom"]),
        "site" => ("worldbody", &["site"]),
        "pair" => ("contact", &["pair"]),
        "custom" => ("custom", &["numeric"]),
        kind => (kind, &[]),
    };
    root.children()
        .filter(|n| n.has_tag_name(section))
        .flat_map(|n| n.descendants().skip(1))
        .filter(Node::is_element)
        .filter(|n| tags.is_empty() || tags.contains(&n.tag_name().name()))
        .find(|n| n.attribute("name") == Some(element))
        .ok_or_else(|| MjcfError::NotInFile {
            kind,
            element: element.to_owned(),
        })
}

/// The attribute's text: all its components as they are in `model`.
fn text_of(model: &Model, target: &Target, name: &str, root: Node<'_, '_>) -> String {
    if let ("pair", "solref") = (target.attribute.kind, name) {
        return numbers(&model.pair_solref()[2 * target.id..2 * target.id + 2]);
    }
    let (array, start, width) = match target.place {
        Place::Slots { first, .. } if target.attribute.kind == "custom" => {
            let width = model.numeric_size()[target.id] as usize;
            ("numeric_data", first - target.component, width)
        }
        Place::Slots { array, first, .. } => {
            let several = target.attribute.width > 1;
            let start = first - if several { target.component } else { 0 };
            (array, start, target.attribute.width)
        }
        Place::Sliding(pair) => ("pair_friction", 5 * pair, 5),
        Place::Length(body) => ("body_pos", 3 * body, 3),
        Place::ForceLimit(actuator) => ("actuator_forcerange", 2 * actuator, 2),
        _ => return String::new(),
    };
    let values = &model.numeric_field(array).unwrap_or_default()[start..start + width];
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

/// Places and sizes of a body's geoms, which the compiler keeps in the order of the file.
fn write_geometry(
    xml: &str,
    model: &Model,
    body: usize,
    node: Node<'_, '_>,
    splices: &mut Vec<Splice>,
) -> Result<(), MjcfError> {
    let geoms = node.children().filter(|n| n.has_tag_name("geom"));
    for (geom, id) in geoms.zip(body_geoms(model, body)) {
        if geom.attribute("fromto").is_some() {
            return Err(MjcfError::FromTo {
                body: node.attribute("name").unwrap_or_default().to_owned(),
            });
        }
        let (size, pos) = (
            &model.geom_size()[3 * id..3 * id + 3],
            &model.geom_pos()[3 * id..3 * id + 3],
        );
        let mut attributes = vec![("size", numbers(size))];
        if pos != [0.0; 3] {
            attributes.push(("pos", numbers(pos)));
        }
        set(xml, geom, &attributes, &[], splices);
    }
    Ok(())
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

pub(super) fn indent_before(xml: &str, at: usize) -> &str {
    let line = xml[..at].rfind('\n').map_or(0, |n| n + 1);
    let indent = &xml[line..at];
    if indent.trim().is_empty() { indent } else { "" }
}

/// Writes an attribute of `option`, making that element if there is none.
pub(super) fn write_option(root: Node<'_, '_>, name: &str, value: &str, splices: &mut Vec<Splice>) {
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
pub(super) fn set(
    xml: &str,
    node: Node<'_, '_>,
    attributes: &[(&str, String)],
    others: &[&str],
    splices: &mut Vec<Splice>,
) {
    let mut new = Vec::new();
    for (name, value) in attributes {
        match node.attribute_node(*name) {
            Some(old) => splices.push(Splice {
                range: old.range_value(),
                text: value.clone(),
            }),
            None => new.push(format!(" {name}=\"{value}\"")),
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
        splices.extend(new.into_iter().map(|text| Splice {
            range: at..at,
            text,
        }));
    }
}

pub(super) fn apply(xml: &str, mut splices: Vec<Splice>) -> String {
    splices.sort_by_key(|s| (s.range.start, s.range.end));
    let mut out = String::with_capacity(xml.len() + 200);
    let mut at = 0;
    for (i, splice) in splices.iter().enumerate() {
        // two targets may be written into one attribute: the size of a geom and that of its body
        if splices[..i].contains(splice) {
            continue;
        }
        out.push_str(&xml[at..splice.range.start.max(at)]);
        out.push_str(&splice.text);
        at = splice.range.end.max(at);
    }
    out.push_str(&xml[at..]);
    out
}

/// The shortest text that reads back to the same double.
pub(super) fn number(value: f64) -> String {
    let plain = format!("{value}");
    let scientific = format!("{value:e}");
    if scientific.len() < plain.len() {
        scientific
    } else {
        plain
    }
}

pub(super) fn numbers(values: &[f64]) -> String {
    values
        .iter()
        .map(|&v| number(v))
        .collect::<Vec<_>>()
        .join(" ")
}
