//! From the words of a rule to numbers of a model.

use super::{Distribution, Rule, Slot, Target};
use crate::mjcf::attribute::bounding_radius;
use crate::mjcf::glob;
use crate::mujoco::{Model, ObjectKind};

/// Where an attribute of an element lives in `mjModel`.
struct Attribute {
    kind: &'static str,
    name: &'static str,
    object: ObjectKind,
    array: &'static str,
    positive: bool, // a physical quantity that must not become negative
}

const fn attribute(
    kind: &'static str,
    name: &'static str,
    object: ObjectKind,
    array: &'static str,
    positive: bool,
) -> Attribute {
    Attribute {
        kind,
        name,
        object,
        array,
        positive,
    }
}

/// Every attribute that can be randomised. Joint attributes of `dof_*` arrays apply to all dofs of the joint.
const ATTRIBUTES: &[Attribute] = &[
    attribute("body", "pos", ObjectKind::Body, "body_pos", false),
    attribute("body", "mass", ObjectKind::Body, "body_mass", true),
    attribute("body", "ipos", ObjectKind::Body, "body_ipos", false),
    attribute("body", "inertia", ObjectKind::Body, "body_inertia", true),
    attribute("joint", "pos", ObjectKind::Joint, "jnt_pos", false),
    attribute(
        "joint",
        "stiffness",
        ObjectKind::Joint,
        "jnt_stiffness",
        true,
    ),
    attribute("joint", "damping", ObjectKind::Joint, "dof_damping", true),
    attribute(
        "joint",
        "frictionloss",
        ObjectKind::Joint,
        "dof_frictionloss",
        true,
    ),
    attribute("joint", "armature", ObjectKind::Joint, "dof_armature", true),
    attribute("geom", "friction", ObjectKind::Geom, "geom_friction", true),
    attribute("geom", "size", ObjectKind::Geom, "geom_size", true),
    attribute("geom", "solref", ObjectKind::Geom, "geom_solref", false),
    attribute("geom", "solimp", ObjectKind::Geom, "geom_solimp", true),
    attribute("pair", "friction", ObjectKind::Pair, "pair_friction", true),
    attribute("pair", "solref", ObjectKind::Pair, "pair_solref", false),
    attribute("pair", "solimp", ObjectKind::Pair, "pair_solimp", true),
    attribute("site", "pos", ObjectKind::Site, "site_pos", false),
    attribute(
        "actuator",
        "gear",
        ObjectKind::Actuator,
        "actuator_gear",
        false,
    ),
];

/// Add what `rule` draws in `model` to `targets`; the error is the reason why it cannot.
pub(super) fn resolve(model: &Model, rule: &Rule, targets: &mut Vec<Target>) -> Result<(), String> {
    let (Distribution::Normal(spread)
    | Distribution::Uniform(spread)
    | Distribution::LogNormal(spread)
    | Distribution::Fixed(spread)) = rule.distribution;
    let fixed = matches!(rule.distribution, Distribution::Fixed(_));
    if !spread.is_finite() || (spread < 0.0 && !fixed) {
        return Err(format!(
            "distribution has {spread}, expected a finite number of at least 0"
        ));
    }
    let (kind, glob) = rule
        .element
        .split_once('/')
        .ok_or("element is not of the form `kind/name`")?;
    let attribute = ATTRIBUTES
        .iter()
        .find(|a| a.kind == kind && a.name == rule.attribute)
        .ok_or_else(|| {
            let known: Vec<_> = ATTRIBUTES
                .iter()
                .map(|a| format!("{} {}", a.kind, a.name))
                .collect();
            format!("unknown attribute, known are: {}", known.join(", "))
        })?;
    let (_, (_, width)) = model
        .numeric_field_shaped(attribute.array)
        .ok_or_else(|| format!("the model has no array `{}`", attribute.array))?;
    let is_mass = attribute.array == "body_mass";
    if fixed && attribute.positive && (spread < 0.0 || (is_mass && spread == 0.0)) {
        let bound = if is_mass { "above 0" } else { "of at least 0" };
        return Err(format!("fixed at {spread}, expected a number {bound}"));
    }
    let mut components = rule.components.clone();
    components.sort_unstable();
    if components.windows(2).any(|pair| pair[0] == pair[1]) {
        return Err("a component is listed twice".to_owned());
    }
    let slot = |array: &'static str, index: usize| -> Slot {
        let nominal = model.numeric_field(array).map_or(0.0, |a| a[index]);
        Slot {
            array,
            index,
            nominal,
        }
    };
    let n_before = targets.len();
    for id in 0..model.count(attribute.object) {
        if !model
            .name(attribute.object, id)
            .is_some_and(|name| glob::matches(glob, name))
        {
            continue;
        }
        if let Some(reason) = without_effect(model, attribute, id) {
            return Err(reason);
        }
        for row in array_rows(model, attribute, id) {
            let all: Vec<usize> = (0..width).collect();
            for &component in if rule.components.is_empty() {
                &all
            } else {
                &rule.components
            } {
                if component >= width {
                    return Err(format!(
                        "component {component} does not exist, the attribute has {width}"
                    ));
                }
                let followers = if is_mass {
                    (0..3).map(|i| slot("body_inertia", 3 * id + i)).collect()
                } else {
                    Vec::new()
                };
                let slot = slot(attribute.array, row * width + component);
                if !followers.is_empty() && slot.nominal <= 0.0 {
                    let name = model.name(attribute.object, id).unwrap_or_default();
                    return Err(format!("body `{name}` has no mass to draw around"));
                }
                targets.push(Target {
                    slot,
                    positive: attribute.positive,
                    distribution: rule.distribution,
                    followers,
                });
            }
        }
    }
    if targets.len() == n_before {
        return Err(format!("no {kind} is named `{glob}`"));
    }
    Ok(())
}

/// Why drawing the attribute of element `id` would do nothing or break the model.
fn without_effect(model: &Model, attribute: &Attribute, id: usize) -> Option<String> {
    let name = model.name(attribute.object, id).unwrap_or_default();
    match attribute.array {
        // the engine takes the place of a free body from qpos alone
        "body_pos" if model.body_dofnum()[id] == 6 && model.body_jntnum()[id] == 1 => Some(
            format!("body `{name}` is free, its position is part of the state"),
        ),
        "body_pos" if id == 0 => Some("the world cannot be moved".to_owned()),
        "geom_size" if bounding_radius(model, id).is_none() => Some(format!(
            "the shape of geom `{name}` is not made of its size"
        )),
        _ => None,
    }
}

/// Rows of the attribute's array that belong to element `id`.
fn array_rows(model: &Model, attribute: &Attribute, id: usize) -> std::ops::Range<usize> {
    if !attribute.array.starts_with("dof_") {
        return id..id + 1;
    }
    let first = model.jnt_dofadr()[id] as usize;
    let next = model
        .jnt_dofadr()
        .get(id + 1)
        .map_or(model.nv(), |&adr| adr as usize);
    first..next
}
