//! Which attributes of which elements are numbers of a compiled model, and where.
//!
//! An address is `kind/glob attribute[component]`: `joint/p*_upper damping`, `pair/object_table friction[0]`,
//! `option/gravity tilt[1]`. Most attributes are entries of one array of `mjModel`; the rest are computed
//! ([`Place`]): the mass takes the inertia along, the inertia keeps to what a body can have, contact stiffness is in
//! N/m whatever the masses are. Numbers of custom elements are addressed as `custom/name data[i]`.

use super::{MjcfError, glob};
use crate::mujoco::{Model, ObjectKind};

/// An attribute that can be a parameter.
#[derive(Debug, PartialEq)]
pub struct Attribute {
    /// kind of element, as in an address
    pub kind: &'static str,
    /// as in MJCF, or one of the computed ones
    pub name: &'static str,
    /// array of `mjModel`; empty for computed attributes
    pub array: &'static str,
    /// numbers an element; 0: as many as the element has
    pub width: usize,
    /// whether it must not become negative
    pub positive: bool,
    /// unit
    pub unit: &'static str,
    /// size of a change that matters, for numbers whose nominal value is 0
    pub typical: f64,
}

macro_rules! attributes {
    ($($kind:literal $name:literal $array:literal $width:literal $sign:ident $unit:literal $typical:literal;)+) => {
        /// Every attribute that can be a parameter.
        pub const ATTRIBUTES: &[Attribute] = &[$(Attribute {
            kind: $kind, name: $name, array: $array, width: $width,
            positive: attributes!($sign), unit: $unit, typical: $typical,
        }),+];
    };
    (positive) => { true };
    (signed) => { false };
}

attributes! {
    "joint" "damping" "dof_damping" 1 positive "N m s/rad or N s/m" 1e-2;
    "joint" "frictionloss" "dof_frictionloss" 1 positive "N m or N" 1e-2;
    "joint" "armature" "dof_armature" 1 positive "kg m^2 or kg" 1e-4;
    "joint" "stiffness" "jnt_stiffness" 1 positive "N m/rad or N/m" 1e-2;
    "joint" "springref" "qpos_spring" 1 signed "rad or m" 1e-2;
    "joint" "pos" "jnt_pos" 3 signed "m" 1e-3;
    "joint" "solreflimit" "jnt_solref" 2 signed "s, 1" 1e-3;
    "joint" "solimplimit" "jnt_solimp" 5 positive "1" 1e-3;
    "joint" "solreffriction" "dof_solref" 2 signed "s, 1" 1e-3;
    "joint" "solimpfriction" "dof_solimp" 5 positive "1" 1e-3;
    "body" "mass" "" 1 positive "kg" 1e-2;
    "body" "ipos" "body_ipos" 3 signed "m" 1e-3;
    "body" "inertia" "" 10 signed "1" 1e-1;
    "body" "pos" "body_pos" 3 signed "m" 1e-3;
    "body" "rotation" "" 3 signed "rad" 1e-2;
    "body" "length" "" 1 positive "m" 1e-3;
    "body" "geometry" "" 1 positive "1" 1e-2;
    "geom" "friction" "geom_friction" 3 positive "1" 1e-1;
    "geom" "size" "geom_size" 3 positive "m" 1e-3;
    "geom" "pos" "geom_pos" 3 signed "m" 1e-3;
    "geom" "solref" "geom_solref" 2 signed "s, 1" 1e-3;
    "geom" "solimp" "geom_solimp" 5 positive "1" 1e-3;
    "pair" "friction" "pair_friction" 5 positive "1" 1e-1;
    "pair" "slide" "" 1 positive "1" 1e-1;
    "pair" "solref" "pair_solref" 2 signed "s, 1" 1e-3;
    "pair" "solimp" "pair_solimp" 5 positive "1" 1e-3;
    "pair" "stiffness" "" 1 positive "N/m" 1e3;
    "pair" "damping" "" 1 positive "N s/m" 1e1;
    "pair" "hardness" "" 1 positive "N/m" 1e3;
    "pair" "dampratio" "" 1 positive "1" 1e-1;
    "pair" "margin" "pair_margin" 1 signed "m" 1e-3;
    "pair" "gap" "pair_gap" 1 signed "m" 1e-3;
    "site" "pos" "site_pos" 3 signed "m" 1e-3;
    "actuator" "gear" "actuator_gear" 6 signed "1" 1e-1;
    "actuator" "gainprm" "actuator_gainprm" 10 signed "" 1e-1;
    "actuator" "biasprm" "actuator_biasprm" 10 signed "" 1e-1;
    "actuator" "forcelimit" "" 1 positive "" 1e-1;
    "tendon" "stiffness" "tendon_stiffness" 1 positive "N/m" 1e-1;
    "tendon" "damping" "tendon_damping" 1 positive "N s/m" 1e-2;
    "tendon" "frictionloss" "tendon_frictionloss" 1 positive "N" 1e-2;
    "tendon" "springlength" "tendon_lengthspring" 1 signed "m" 1e-3;
    "equality" "solref" "eq_solref" 2 signed "s, 1" 1e-3;
    "equality" "solimp" "eq_solimp" 5 positive "1" 1e-3;
    "equality" "polycoef" "eq_data" 5 signed "" 1e-3;
    "option" "gravity" "" 3 signed "m/s^2" 1e-1;
    "option" "tilt" "" 2 signed "rad" 1e-2;
    "custom" "data" "numeric_data" 0 signed "" 1e-3;
}

/// Where one scalar of a model lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// numbers `first .. first + len` of an array, all equal
    Slots {
        /// of `mjModel`
        array: &'static str,
        /// index of the first
        first: usize,
        /// how many: the degrees of freedom of a joint
        len: usize,
    },
    /// mass of a body; its inertia keeps the ratio
    Mass(usize),
    /// a component of a body's relative log-Cholesky inertia, see [`super::inertia`]
    Inertia(usize, usize),
    /// rotation of a body frame about one of its own nominal axes
    Rotation(usize, usize),
    /// a component of gravity
    Gravity(usize),
    /// rotation of gravity about the world's x or y
    Tilt(usize),
    /// stiffness of a contact pair, N/m
    ContactStiffness(usize),
    /// damping of a contact pair, N s/m
    ContactDamping(usize),
    /// stiffness of a contact pair, N/m; its damping ratio stays
    ContactHardness(usize),
    /// damping ratio of a contact pair; its stiffness stays
    ContactRatio(usize),
    /// sliding friction of a contact pair in both directions, which keep their ratio
    Sliding(usize),
    /// distance of a body's origin from its parent's; the direction stays
    Length(usize),
    /// places and sizes of a body's geoms, relative to the nominal ones
    Geometry(usize),
    /// force of an actuator, limited to this both ways
    ForceLimit(usize),
}

/// One scalar of a model, with its address.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// what it is
    pub attribute: &'static Attribute,
    /// name of the element
    pub element: String,
    /// index of the element among its kind
    pub id: usize,
    /// component of the attribute
    pub component: usize,
    /// where it lives
    pub place: Place,
}

impl Target {
    /// `kind/element attribute[component]`, the component only where there are several.
    pub fn address(&self) -> String {
        let Self {
            attribute,
            element,
            component,
            ..
        } = self;
        let component = if attribute.width == 1 {
            String::new()
        } else {
            format!("[{component}]")
        };
        format!("{}/{element} {}{component}", attribute.kind, attribute.name)
    }

    /// Its unit; of an attribute that hinges have in one and slides in another, the joint's.
    pub fn unit(&self, model: &Model) -> &'static str {
        let both = self.attribute.unit;
        let of_joint = (self.attribute.kind == "joint").then(|| model.is_slide(self.id));
        match (both.split_once(" or "), of_joint.flatten()) {
            (Some((_, slide)), Some(true)) => slide,
            (Some((hinge, _)), Some(false)) => hinge,
            _ => both,
        }
    }
}

/// The kind of model object behind the first word of an address.
pub fn object_kind(kind: &str) -> Option<ObjectKind> {
    Some(match kind {
        "joint" => ObjectKind::Joint,
        "body" => ObjectKind::Body,
        "geom" => ObjectKind::Geom,
        "pair" => ObjectKind::Pair,
        "site" => ObjectKind::Site,
        "actuator" => ObjectKind::Actuator,
        "tendon" => ObjectKind::Tendon,
        "equality" => ObjectKind::Equality,
        "custom" => ObjectKind::Numeric,
        _ => return None,
    })
}

/// Every scalar that `element` (`kind/glob`), `attribute` and `components` (empty: all) mean in `model`. Elements that
/// the glob matches but that cannot have the attribute, as the mass of the world, are passed over.
///
/// # Errors
/// An unknown kind, attribute, element or component, with what there is instead.
pub fn resolve(
    model: &Model,
    element: &str,
    attribute: &str,
    components: &[usize],
) -> Result<Vec<Target>, MjcfError> {
    let refuse = |reason: String| MjcfError::Address {
        element: element.to_owned(),
        attribute: attribute.to_owned(),
        reason,
    };
    let (kind, pattern) = element
        .split_once('/')
        .ok_or_else(|| refuse("the element is not of the form `kind/name`".into()))?;
    let found = ATTRIBUTES
        .iter()
        .find(|a| a.kind == kind && a.name == attribute);
    let attribute = found.ok_or_else(|| refuse(unknown_attribute(kind)))?;
    for (i, &component) in components.iter().enumerate() {
        if components[..i].contains(&component) {
            return Err(refuse(format!("component {component} is listed twice")));
        }
    }
    let elements: Vec<(usize, String)> = match object_kind(kind) {
        None => vec![(0, "gravity".to_owned())],
        Some(object) => (0..model.count(object))
            .filter_map(|id| Some((id, model.name(object, id)?.to_owned())))
            .collect(),
    };
    let mut targets = Vec::new();
    let mut skipped = Vec::new();
    for (id, name) in &elements {
        if !glob::matches(pattern, name) {
            continue;
        }
        if let Some(reason) = without_effect(model, attribute, *id) {
            // a glob means those that can have it
            skipped.push(format!("{kind} `{name}` {reason}"));
            continue;
        }
        let width = match attribute.width {
            0 => model.numeric_size()[*id] as usize,
            width => width,
        };
        let all: Vec<usize> = (0..width).collect();
        for &component in if components.is_empty() {
            &all
        } else {
            components
        } {
            if component >= width {
                return Err(refuse(format!(
                    "there is no component {component}, it has {width}"
                )));
            }
            let place = place(model, attribute, *id, component);
            targets.push(Target {
                attribute,
                element: name.clone(),
                id: *id,
                component,
                place,
            });
        }
    }
    if targets.is_empty() && !skipped.is_empty() {
        return Err(refuse(skipped.join(", ")));
    }
    if targets.is_empty() {
        let names: Vec<&str> = elements.iter().map(|(_, n)| n.as_str()).collect();
        return Err(refuse(format!(
            "no {kind} is named `{pattern}`; there are: {}",
            names.join(", ")
        )));
    }
    Ok(targets)
}

fn unknown_attribute(kind: &str) -> String {
    let of_kind: Vec<&str> = ATTRIBUTES
        .iter()
        .filter(|a| a.kind == kind)
        .map(|a| a.name)
        .collect();
    if of_kind.is_empty() {
        return "unknown kind, known are joint, body, geom, pair, site, actuator, tendon, equality, option, custom"
            .into();
    }
    format!(
        "a {kind} has no such parameter, it has: {}",
        of_kind.join(", ")
    )
}

fn place(model: &Model, attribute: &Attribute, id: usize, component: usize) -> Place {
    match (attribute.kind, attribute.name) {
        ("body", "mass") => Place::Mass(id),
        ("body", "inertia") => Place::Inertia(id, component),
        ("body", "rotation") => Place::Rotation(id, component),
        ("option", "gravity") => Place::Gravity(component),
        ("option", "tilt") => Place::Tilt(component),
        ("pair", "stiffness") => Place::ContactStiffness(id),
        ("pair", "damping") => Place::ContactDamping(id),
        ("pair", "hardness") => Place::ContactHardness(id),
        ("pair", "dampratio") => Place::ContactRatio(id),
        ("pair", "slide") => Place::Sliding(id),
        ("body", "length") => Place::Length(id),
        ("body", "geometry") => Place::Geometry(id),
        ("actuator", "forcelimit") => Place::ForceLimit(id),
        ("custom", _) => slots(
            "numeric_data",
            model.numeric_adr()[id] as usize + component,
            1,
        ),
        (_, "springref") => slots("qpos_spring", model.jnt_qposadr()[id] as usize, 1),
        _ => {
            let array = attribute.array;
            let stride = model
                .numeric_field_shaped(array)
                .map_or(1, |(_, (_, width))| width);
            let rows = if array.starts_with("dof_") {
                dofs(model, id)
            } else {
                id..id + 1
            };
            if stride == 1 {
                slots(array, rows.start, rows.len())
            } else {
                slots(array, rows.start * stride + component, 1)
            }
        }
    }
}

fn slots(array: &'static str, first: usize, len: usize) -> Place {
    Place::Slots { array, first, len }
}

/// Degrees of freedom of a joint.
pub(crate) fn dofs(model: &Model, joint: usize) -> std::ops::Range<usize> {
    let first = model.jnt_dofadr()[joint] as usize;
    let next = model
        .jnt_dofadr()
        .get(joint + 1)
        .map_or(model.nv(), |&adr| adr as usize);
    first..next
}

/// Why a change of the attribute of element `id` would do nothing or break the model.
fn without_effect(model: &Model, attribute: &Attribute, id: usize) -> Option<&'static str> {
    let free = |body: usize| model.body_dofnum()[body] == 6 && model.body_jntnum()[body] == 1;
    let scalar = |joint: usize| dofs(model, joint).len() == 1;
    match (attribute.kind, attribute.name) {
        ("body", "pos" | "rotation" | "length") if id == 0 => {
            Some("is the world, which cannot be moved")
        }
        ("body", "pos" | "rotation" | "length") if free(id) => {
            Some("is free, its pose is part of the state")
        }
        ("body", "length") if norm(&model.body_pos()[3 * id..3 * id + 3]) == 0.0 => {
            Some("is where its parent is")
        }
        ("body", "geometry") if id == 0 => Some("is the world, which no file has as a body"),
        ("body", "geometry")
            if !body_geoms(model, id).all(|g| bounding_radius(model, g).is_some()) =>
        {
            Some("has a geom whose shape is not made of its size")
        }
        ("body", "geometry") if body_geoms(model, id).next().is_none() => Some("has no geom"),
        ("actuator", "forcelimit") if model.actuator_forcelimited()[id] == 0 => {
            Some("has no limited force")
        }
        ("body", "mass" | "inertia" | "ipos") if model.body_mass()[id] <= 0.0 => {
            Some("has no mass")
        }
        ("joint", "springref") if !scalar(id) => Some("is not a hinge or slide"),
        ("joint", "solreffriction" | "solimpfriction") if !scalar(id) => {
            Some("has several degrees of freedom")
        }
        ("geom", "size") if bounding_radius(model, id).is_none() => {
            Some("has a shape that is not made of its size")
        }
        ("pair", "stiffness" | "damping" | "hardness" | "dampratio")
            if pair_inverse_mass(model, id) <= 0.0 =>
        {
            Some("joins two bodies that cannot move")
        }
        _ => None,
    }
}

/// The geoms of a body.
pub(crate) fn body_geoms(model: &Model, body: usize) -> std::ops::Range<usize> {
    let first = usize::try_from(model.body_geomadr()[body]).unwrap_or(0);
    first..first + model.body_geomnum()[body] as usize
}

/// Length of a vector.
pub(crate) fn norm(vector: &[f64]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Sum of the translational inverse weights of the bodies of a pair, 1/kg: what the engine scales contacts with.
pub(crate) fn pair_inverse_mass(model: &Model, pair: usize) -> f64 {
    [model.pair_geom1()[pair], model.pair_geom2()[pair]]
        .iter()
        .map(|&geom| model.body_invweight0()[2 * model.geom_bodyid()[geom as usize] as usize])
        .sum()
}

// `mjtGeom` of the engine's model format
const SPHERE: i32 = 2;
const CAPSULE: i32 = 3;
const ELLIPSOID: i32 = 4;
const CYLINDER: i32 = 5;
const BOX: i32 = 6;

/// Radius of the smallest sphere about its centre that holds a geom; `None` for shapes not made of `size`.
pub(crate) fn bounding_radius(model: &Model, geom: usize) -> Option<f64> {
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
