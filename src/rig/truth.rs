//! What is true of a rig, for those who score; nothing else reads it.

use serde::{Deserialize, Serialize};

use super::effects::{Bound, Effect, Place, kind};
use crate::mujoco::{Model, ModelEdit, MujocoError, ObjectKind};

/// The sealed truth of one machine.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// which machine of the rig file
    pub seed: u64,
    /// the effects it has, one entry an element
    pub effect: Vec<TrueEffect>,
    /// every number that differs from the model, or that the sensors add
    pub parameter: Vec<TrueParameter>,
}

/// An effect at one element.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrueEffect {
    /// as in the catalogue
    pub name: String,
    /// `kind/name`
    pub element: String,
    /// the other joint of a coupling
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub with: Option<String>,
}

/// One number.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrueParameter {
    /// `kind/name`
    pub element: String,
    /// attribute, of effects `effect.parameter`; a component is `attribute[i]`
    pub attribute: String,
    /// in the model
    pub nominal: f64,
    /// in truth
    pub value: f64,
    /// unit
    pub unit: String,
}

/// `array` of the engine, kind and attribute as in MJCF, unit.
type Attribute = (&'static str, ObjectKind, &'static str, &'static str);

/// The numbers of a model that are given; the engine derives the others from them.
const ATTRIBUTES: [Attribute; 21] = [
    ("body_pos", ObjectKind::Body, "pos", "m"),
    ("body_quat", ObjectKind::Body, "quat", "1"),
    ("body_mass", ObjectKind::Body, "mass", "kg"),
    ("body_ipos", ObjectKind::Body, "ipos", "m"),
    ("body_inertia", ObjectKind::Body, "inertia", "kg m^2"),
    ("jnt_pos", ObjectKind::Joint, "pos", "m"),
    ("jnt_stiffness", ObjectKind::Joint, "stiffness", "N m/rad"),
    ("dof_damping", ObjectKind::Joint, "damping", "N m s/rad"),
    ("dof_frictionloss", ObjectKind::Joint, "frictionloss", "N m"),
    ("dof_armature", ObjectKind::Joint, "armature", "kg m^2"),
    ("geom_size", ObjectKind::Geom, "size", "m"),
    ("geom_friction", ObjectKind::Geom, "friction", "1"),
    ("geom_solref", ObjectKind::Geom, "solref", "s, 1"),
    ("geom_solimp", ObjectKind::Geom, "solimp", "1"),
    ("pair_friction", ObjectKind::Pair, "friction", "1"),
    ("pair_solref", ObjectKind::Pair, "solref", "s, 1"),
    ("pair_solimp", ObjectKind::Pair, "solimp", "1"),
    ("site_pos", ObjectKind::Site, "pos", "m"),
    ("actuator_gear", ObjectKind::Actuator, "gear", "1"),
    ("actuator_gainprm", ObjectKind::Actuator, "gainprm", "1"),
    ("actuator_biasprm", ObjectKind::Actuator, "biasprm", "1"),
];

/// Every given number in which `truth` differs from `nominal`.
pub(super) fn model_differences(nominal: &Model, truth: &Model) -> Vec<TrueParameter> {
    let mut rows = Vec::new();
    for (array, kind, attribute, unit) in ATTRIBUTES {
        let Some((before, (_, width))) = nominal.numeric_field_shaped(array) else {
            continue;
        };
        let after = truth.numeric_field(array).unwrap_or(before);
        for (i, (&nominal_value, &value)) in before.iter().zip(after).enumerate() {
            if nominal_value == value {
                continue;
            }
            let row = i / width;
            let id = if array.starts_with("dof_") {
                nominal.dof_jntid()[row] as usize
            } else {
                row
            };
            rows.push(TrueParameter {
                element: element(nominal, kind, id),
                attribute: if width == 1 {
                    attribute.to_owned()
                } else {
                    format!("{attribute}[{}]", i % width)
                },
                nominal: nominal_value,
                value,
                unit: unit.to_owned(),
            });
        }
    }
    let (before, after) = (nominal.option().gravity, truth.option().gravity);
    for (i, (&nominal, &value)) in before.iter().zip(&after).enumerate() {
        if nominal != value {
            rows.push(TrueParameter {
                element: "option".to_owned(),
                attribute: format!("gravity[{i}]"),
                nominal,
                value,
                unit: "m/s^2".to_owned(),
            });
        }
    }
    rows
}

/// The effects, and their parameters as rows whose nominal value is 0.
pub(super) fn effects(model: &Model, bound: &[Bound]) -> (Vec<TrueEffect>, Vec<TrueParameter>) {
    let (mut effects, mut rows) = (Vec::new(), Vec::new());
    for bound in bound {
        let entry = bound.effect.entry();
        let elements = match entry.place {
            Place::World => vec!["world".to_owned()],
            place => bound
                .elements
                .iter()
                .map(|&id| element(model, kind(model, place), id))
                .collect(),
        };
        let partner = |joint| self::element(model, ObjectKind::Joint, joint);
        for element in elements {
            effects.push(TrueEffect {
                name: entry.name.to_owned(),
                element: element.clone(),
                with: bound.partner.map(partner),
            });
            for (parameter, &value) in entry.parameters.iter().zip(&bound.values) {
                rows.push(TrueParameter {
                    element: element.clone(),
                    attribute: format!("{}.{}", entry.name, parameter.name),
                    nominal: 0.0,
                    value,
                    unit: parameter.unit.to_owned(),
                });
            }
        }
    }
    (effects, rows)
}

/// Stiffness of a spring that is pulled so far that its torque is constant, N m/rad.
const SOFT: f64 = 1e-6;

/// Adds a spring of `stiffness` about `rest` to a joint that may have one.
fn add_spring(edit: &mut ModelEdit<'_>, joint: usize, stiffness: f64, rest: f64) {
    let address = edit.model().jnt_qposadr()[joint] as usize;
    let before = edit.model().jnt_stiffness()[joint];
    let own = edit.model().qpos_spring()[address];
    let both = before + stiffness;
    if both != 0.0 {
        edit.jnt_stiffness()[joint] = both;
        edit.qpos_spring()[address] = (before * own + stiffness * rest) / both;
    }
}

/// The machine as a model with the step and the integrator of `nominal`, and the effects that are not in it. Joint friction,
/// springs, constant torques and torque gains, which the rig has as torques, are there as the engine's own.
pub(super) fn as_model(
    nominal: &Model,
    truth: &Model,
    bound: &[Bound],
) -> Result<(Model, Vec<&'static str>), MujocoError> {
    let mut model = truth.try_clone()?;
    let mut left_out = Vec::new();
    let mut edit = model.edit();
    let mut option = edit.model().option();
    option.timestep = nominal.timestep();
    option.integrator = nominal.option().integrator;
    edit.set_option(&option)?;
    for bound in bound {
        let entry = bound.effect.entry();
        // inertia is changed in the rig's own model
        let mut in_model = bound.effect == Effect::RotorInertia;
        for &id in &bound.elements {
            match bound.effect {
                Effect::ViscousFriction => {
                    let dof = edit.model().jnt_dofadr()[id] as usize;
                    edit.dof_damping()[dof] += bound.values[0];
                }
                Effect::CoulombFriction => {
                    let dof = edit.model().jnt_dofadr()[id] as usize;
                    edit.dof_frictionloss()[dof] += bound.values[0];
                }
                Effect::TorqueGain => edit.actuator_gear()[6 * id] *= 1.0 + bound.values[0],
                Effect::JointSpring => add_spring(&mut edit, id, bound.values[0], bound.values[1]),
                Effect::TorqueOffset => add_spring(&mut edit, id, SOFT, bound.values[0] / SOFT),
                _ => continue,
            }
            in_model = true;
        }
        let torque = matches!(entry.place, Place::Joint | Place::Actuator);
        let sensed = matches!(bound.effect, Effect::EncoderOffset | Effect::EncoderScale);
        if (torque && !in_model && !sensed) || bound.effect == Effect::TorsionalFriction {
            left_out.push(entry.name);
        }
    }
    edit.finish()?;
    Ok((model, left_out))
}

/// `kind/name`, or the number of an element without a name.
pub(super) fn element(model: &Model, kind: ObjectKind, id: usize) -> String {
    let word = match kind {
        ObjectKind::Pair => "pair",
        other => other.text(),
    };
    match model.name(kind, id) {
        Some(name) => format!("{word}/{name}"),
        None => format!("{word}/{id}"),
    }
}
