//! Drawing the parameters of a model anew for each rollout: the ensembles of the paper.
//!
//! A rule names an element by a glob (`body/p*_base`), an attribute of it, and a distribution. Draws are made from the
//! nominal value, never from the last draw, so that a rollout depends on its own random stream only. When several rules
//! hit the same number they act one after the other: the second draws around what the first left.
//!
//! ```toml
//! [[randomise]]
//! element = "body/p*_base"        # kind/name, `*` and `?` match within the name
//! attribute = "pos"
//! components = [0, 1]             # x and y; all components when absent
//! distribution = { normal = 0.005 }
//! ```

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::mujoco::{Data, Model, ModelEdit, MujocoError, ObjectKind};
use crate::rng::{self, Stream};

/// What can be wrong with a rule.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RandomiseError {
    /// The engine refused the edited model.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The rule cannot be applied to this model.
    #[error("randomise rule `{element} {attribute}`: {reason}")]
    Rule {
        /// as configured
        element: String,
        /// as configured
        attribute: String,
        /// what is wrong
        reason: String,
    },
}

/// How a component is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Distribution {
    /// nominal + N(0, sigma²), sigma in the attribute's unit
    Normal(f64),
    /// nominal + U(-half width, half width)
    Uniform(f64),
    /// nominal × exp(N(0, sigma²)); keeps the sign
    LogNormal(f64),
    /// the value itself, the same in every rollout; not below 0 where that makes no sense
    Fixed(f64),
}

/// One rule; see the module.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// `kind/glob`
    pub element: String,
    /// attribute of that kind
    pub attribute: String,
    /// components to draw; empty: all
    #[serde(default)]
    pub components: Vec<usize>,
    /// distribution of each component, independent of the others
    pub distribution: Distribution,
}

impl Rule {
    /// A rule from its parts.
    pub fn new(
        element: &str,
        attribute: &str,
        components: &[usize],
        distribution: Distribution,
    ) -> Self {
        Self {
            element: element.to_owned(),
            attribute: attribute.to_owned(),
            components: components.to_vec(),
            distribution,
        }
    }
}

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
    attribute("site", "pos", ObjectKind::Site, "site_pos", false),
    attribute(
        "actuator",
        "gear",
        ObjectKind::Actuator,
        "actuator_gear",
        false,
    ),
];

/// One number of `mjModel` and its nominal value.
#[derive(Debug, Clone, Copy)]
struct Slot {
    array: &'static str,
    index: usize,
    nominal: f64,
}

/// Arrays no derived constant depends on. Nor does one on `body_pos` of a body fixed to the world: moving a whole
/// mechanism changes no inertia.
const SURFACE: [&str; 3] = ["geom_friction", "geom_solref", "geom_solimp"];

// `mjtGeom` of the engine's model format
const SPHERE: i32 = 2;
const CAPSULE: i32 = 3;
const ELLIPSOID: i32 = 4;
const CYLINDER: i32 = 5;
const BOX: i32 = 6;

#[derive(Debug, Clone)]
struct Target {
    slot: Slot,
    positive: bool,
    distribution: Distribution,
    /// numbers that keep their ratio to this one: a body's inertia follows its mass
    followers: Vec<Slot>,
}

impl Target {
    fn sample(&self, around: f64, rng: &mut Stream) -> f64 {
        let value = match self.distribution {
            Distribution::Normal(sigma) => around + sigma * rng::normal(rng),
            Distribution::Uniform(half_width) => {
                around + rng::uniform(rng, -half_width, half_width)
            }
            Distribution::LogNormal(sigma) => around * (sigma * rng::normal(rng)).exp(),
            Distribution::Fixed(value) => return value,
        };
        // a far draw of a wide distribution must not make a body of negative mass: keep a hundredth
        if self.positive {
            value.max(0.01 * around)
        } else {
            value
        }
    }
}

/// Rules bound to a model.
#[derive(Debug, Clone, Default)]
pub struct Randomiser {
    targets: Vec<Target>,
    /// whether the engine's derived constants (inverse weights, subtree masses) depend on a target
    inertial: bool,
    /// geoms whose size is drawn: their bounding radius, which the engine only computes when it compiles, follows
    resized: Vec<usize>,
}

impl Randomiser {
    /// Resolve `rules` against the elements of `model`.
    ///
    /// # Errors
    /// A rule that matches nothing, an unknown attribute, a component out of range, a spread that is not a number of
    /// at least 0.
    pub fn new(model: &Model, rules: &[Rule]) -> Result<Self, RandomiseError> {
        let mut targets = Vec::new();
        for rule in rules {
            resolve(model, rule, &mut targets).map_err(|reason| RandomiseError::Rule {
                element: rule.element.clone(),
                attribute: rule.attribute.clone(),
                reason,
            })?;
        }
        let inertial = targets.iter().any(|t| match t.slot.array {
            "body_pos" => model.body_parentid()[t.slot.index / 3] != 0,
            array => !SURFACE.contains(&array),
        });
        let mut resized: Vec<usize> = targets
            .iter()
            .filter(|t| t.slot.array == "geom_size")
            .map(|t| t.slot.index / 3)
            .collect();
        resized.dedup();
        Ok(Self {
            targets,
            inertial,
            resized,
        })
    }

    /// Draw every target from its nominal value into the model of `data`, which should be reset afterwards.
    ///
    /// # Errors
    /// When the engine refuses the drawn model.
    pub fn draw(&self, data: &mut Data, rng: &mut Stream) -> Result<(), RandomiseError> {
        if self.targets.is_empty() {
            return Ok(());
        }
        data.edit_model(|edit| {
            for target in &self.targets {
                for slot in std::iter::once(&target.slot).chain(&target.followers) {
                    slot.set(edit, slot.nominal);
                }
            }
            for target in &self.targets {
                let around = target.slot.get(edit);
                let value = target.sample(around, rng);
                target.slot.set(edit, value);
                for follower in &target.followers {
                    let of_follower = follower.get(edit);
                    follower.set(edit, of_follower * value / around);
                }
            }
            for &geom in &self.resized {
                let radius = bounding_radius(edit.model(), geom);
                if let (Some(radius), Some(bound)) = (radius, edit.geom_rbound().get_mut(geom)) {
                    *bound = radius;
                }
            }
            if self.inertial {
                edit.recompute_constants();
            }
        })?;
        Ok(())
    }
}

impl Slot {
    fn get(&self, edit: &ModelEdit<'_>) -> f64 {
        edit.model()
            .numeric_field(self.array)
            .map_or(self.nominal, |array| array[self.index])
    }

    fn set(&self, edit: &mut ModelEdit<'_>, value: f64) {
        if let Some(array) = edit.numeric_field_mut(self.array) {
            array[self.index] = value;
        }
    }
}

/// Radius of the smallest sphere about its centre that holds a geom; `None` for shapes not made of `size`.
fn bounding_radius(model: &Model, geom: usize) -> Option<f64> {
    let size = &model.geom_size()[3 * geom..3 * geom + 3];
    match model.geom_type()[geom] {
        SPHERE => Some(size[0]),
        CAPSULE => Some(size[0] + size[1]),
        ELLIPSOID => Some(size[0].max(size[1]).max(size[2])),
        CYLINDER => Some(size[0].hypot(size[1])),
        BOX => Some(size[0].hypot(size[1]).hypot(size[2])),
        _ => None,
    }
}

fn resolve(model: &Model, rule: &Rule, targets: &mut Vec<Target>) -> Result<(), String> {
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
            .is_some_and(|name| glob_matches(glob, name))
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

/// Whether `name` matches a glob of literal characters, `*` (any run) and `?` (any one character).
fn glob_matches(glob: &str, name: &str) -> bool {
    match glob.chars().next() {
        None => name.is_empty(),
        Some('*') => {
            let rest = &glob[1..];
            name.char_indices()
                .map(|(i, _)| i)
                .chain([name.len()])
                .any(|i| glob_matches(rest, &name[i..]))
        }
        Some(first) => {
            let mut characters = name.chars();
            characters
                .next()
                .is_some_and(|c| first == '?' || first == c)
                && glob_matches(&glob[first.len_utf8()..], characters.as_str())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::glob_matches;

    #[test]
    fn globs() {
        for (glob, name, expected) in [
            ("p*_base", "p0_base", true),
            ("p?_base", "p0_base", true),
            ("p?_base", "p10_base", false),
            ("*", "", true),
            ("object", "object", true),
            ("object", "objects", false),
            ("**_t*", "p0_tip", true),
            ("é*", "éa", true),
        ] {
            assert_eq!(glob_matches(glob, name), expected, "{glob} {name}");
        }
    }
}
