//! Physics a rig has and its model has not.
//!
//! [`CATALOGUE`] names each effect, where it may sit, and its parameters with units. The first parameter is the
//! amplitude: at 0 the effect is absent, to the bit. Three ways in:
//!
//! | way | module | when |
//! | --- | --- | --- |
//! | the numbers of the true model | `model` | once |
//! | torques and altered controls | `joint`, `drive`, `transmission`, `contact` | every inner step |
//! | the samples | `sensing` | every sample |
//!
//! `friction_map` and `cubic_spring` are not in the catalogue of [`crate::gap`]: they are there to be called unknown.
//!
//! Friction, springs, stops, lag and play are written here from their own equations, not with the engine's elements of
//! the same purpose: what looks for an effect must not meet its own code.

pub(super) mod contact;
pub(super) mod drive;
pub(super) mod joint;
pub(super) mod model;
pub(super) mod transmission;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::RigError;
use super::axes::Axis;
use crate::mjcf::glob;
use crate::mujoco::{Model, ObjectKind};

/// What the `where` of an effect selects by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// nothing: it has no `where`
    World,
    /// hinge and slide joints
    Joint,
    /// actuators that drive one joint
    Actuator,
    /// bodies
    Body,
    /// geoms
    Geom,
    /// contact pairs, or geoms of a model without pairs
    Contact,
    /// force and torque sensors
    Sensor,
}

impl Place {
    /// As in `kind/name`.
    pub fn text(self) -> &'static str {
        match self {
            Self::World => "world",
            Self::Joint => "joint",
            Self::Actuator => "actuator",
            Self::Body => "body",
            Self::Geom => "geom",
            Self::Contact => "contact",
            Self::Sensor => "sensor",
        }
    }
}

/// A number of an effect.
#[derive(Debug, Clone, Copy)]
pub struct Parameter {
    /// key in the rig file; carries the unit where there is one
    pub name: &'static str,
    /// unit
    pub unit: &'static str,
    /// smallest value a family draws
    pub low: f64,
    /// largest value a family draws
    pub high: f64,
    /// value when the rig file is silent; none: it must be given
    pub default: Option<f64>,
}

/// One row of the catalogue.
#[derive(Debug, Clone, Copy)]
pub struct Entry {
    /// which
    pub effect: Effect,
    /// key in the rig file
    pub name: &'static str,
    /// what `where` selects
    pub place: Place,
    /// amplitude first
    pub parameters: &'static [Parameter],
    /// its law in words
    pub summary: &'static str,
}

macro_rules! catalogue {
    ($($variant:ident $name:literal $place:ident $summary:literal
        [$($key:ident $unit:literal $low:literal $high:literal $default:expr;)+])+) => {
        /// The effects a rig may hide.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
        pub enum Effect {
            $(#[doc = $summary] #[serde(rename = $name)] $variant,)+
        }

        /// All effects.
        pub const CATALOGUE: &[Entry] = &[$(Entry {
            effect: Effect::$variant,
            name: $name,
            place: Place::$place,
            parameters: &[$(Parameter {
                name: stringify!($key), unit: $unit, low: $low, high: $high, default: $default,
            }),+],
            summary: $summary,
        }),+];
    };
}

// Ranges: visible to the paper's sensors, small beside torques of 0.1 to 2 N m and angles of half a radian.
catalogue! {
    ViscousFriction "viscous_friction" Joint "torque -d v"
        [damping_nms "N m s/rad" 0.003 0.02 None;]
    CoulombFriction "coulomb_friction" Joint "torque -c sgn v, with stiction"
        [torque_nm "N m" 0.005 0.04 None;]
    AsymmetricFriction "asymmetric_friction" Joint "torque -(c + a) forwards, +(c - a) backwards"
        [difference_nm "N m" 0.004 0.01 None; torque_nm "N m" 0.01 0.03 Some(0.01);]
    StribeckFriction "stribeck_friction" Joint "torque -(c + s exp(-(v/v_s)^2)) sgn v"
        [excess_nm "N m" 0.01 0.04 None; torque_nm "N m" 0.005 0.02 Some(0.0);
         speed_rad_s "rad/s" 0.02 0.2 Some(0.1);]
    LoadDependentFriction "load_dependent_friction" Joint "torque -m |motor torque| sgn v"
        [coefficient "1" 0.03 0.15 None;]
    QuadraticDrag "quadratic_drag" Joint "torque -c v |v|"
        [drag_nms2 "N m s^2/rad^2" 0.002 0.02 None;]
    JointSpring "joint_spring" Joint "torque -k (q - q0)"
        [stiffness_nm_rad "N m/rad" 0.03 0.3 None; rest_rad "rad" -0.2 0.2 Some(0.0);]
    TorqueOffset "torque_offset" Joint "constant torque"
        [torque_nm "N m" 0.005 0.05 None;]
    RotorInertia "rotor_inertia" Joint "more inertia of the rotor"
        [inertia_kgm2 "kg m^2" 0.0001 0.001 None;]
    LinkMass "link_mass" Body "mass and inertia of a body scaled by 1 + s"
        [share "1" 0.1 0.3 None;]
    Payload "payload" Body "point mass on a body"
        [mass_kg "kg" 0.01 0.08 None; x_m "m" -0.01 0.01 Some(0.0); y_m "m" -0.01 0.01 Some(0.0);
         z_m "m" -0.01 0.01 Some(0.0);]
    GravityTilt "gravity_tilt" World "gravity turned: the table is not level"
        [tilt_rad "rad" 0.01 0.05 None; heading_rad "rad" 0.0 6.0 Some(0.0);]
    TorqueGain "torque_gain" Actuator "motor torque times 1 + g"
        [gain "1" 0.03 0.15 None;]
    TorqueSaturation "torque_saturation" Actuator "motor torque limited to 1 - c of the range of its control"
        [cut "1" 0.85 0.92 None;]
    ActuatorLag "actuator_lag" Actuator "first-order lag of the motor torque"
        [time_s "s" 0.001 0.008 None;]
    ActuatorDelay "actuator_delay" Actuator "motor torque later by a time"
        [time_s "s" 0.0005 0.005 None;]
    TorqueRipple "torque_ripple" Actuator "motor torque times 1 + a sin(n q + p)"
        [amplitude "1" 0.03 0.15 None; per_turn "1" 20.0 120.0 Some(60.0); phase_rad "rad" 0.0 6.0 Some(0.0);]
    Cogging "cogging" Joint "torque a sin(n q + p)"
        [amplitude_nm "N m" 0.005 0.03 None; per_turn "1" 20.0 120.0 Some(60.0); phase_rad "rad" 0.0 6.0 Some(0.0);]
    Backlash "backlash" Actuator "play between motor and joint"
        [play_rad "rad" 0.001 0.01 None;]
    TransmissionCompliance "transmission_compliance" Actuator "spring between motor and joint"
        [compliance_rad_nm "rad/(N m)" 0.002 0.02 None;]
    JointCoupling "joint_coupling" Joint "spring k/2 (q - p)^2, p of the joint named by `with`"
        [stiffness_nm_rad "N m/rad" 0.03 0.3 None;]
    JointStop "joint_stop" Joint "one-sided spring beyond an angle"
        [stiffness_nm_rad "N m/rad" 2.0 20.0 None; at_rad "rad" 0.02 0.08 Some(0.05);]
    EncoderOffset "encoder_offset" Joint "measured position + b"
        [offset_rad "rad" 0.003 0.02 None;]
    EncoderScale "encoder_scale" Joint "measured position times 1 + s"
        [scale "1" 0.005 0.05 None;]
    SensorDelay "sensor_delay" World "joint samples older than their stamps say"
        [time_s "s" 0.0005 0.005 None;]
    ForceSensorBias "force_sensor_bias" Sensor "constant added to every component"
        [bias "N, N m" 0.05 0.3 None;]
    BasePose "base_pose" Body "body moved in the plane and turned about z"
        [shift_m "m" 0.003 0.01 None; heading_rad "rad" 0.0 6.0 Some(0.0); yaw_rad "rad" -0.03 0.03 Some(0.0);]
    ObjectMass "object_mass" Body "mass and inertia of a free body scaled by 1 + s"
        [share "1" 0.1 0.4 None;]
    ContactFriction "contact_friction" Contact "sliding friction times 1 + s"
        [share "1" 0.15 0.5 None;]
    TorsionalFriction "torsional_friction" Contact "moment -c N sgn(spin) about the normal"
        [coefficient_m "m" 0.002 0.01 None;]
    FrictionCone "friction_cone" World "the other friction cone (1: changed)"
        [changed "1" 1.0 1.0 None;]
    ContactStiffness "contact_stiffness" Contact "stiffness times 1 + s, the damping ratio kept"
        [share "1" 0.3 1.5 None;]
    ContactDamping "contact_damping" Contact "damping ratio times 1 + s, the stiffness kept"
        [share "1" 0.3 1.5 None;]
    AnisotropicFriction "anisotropic_friction" Contact "friction of the second tangent times 1 + s"
        [share "1" 0.2 0.8 None;]
    FingertipRadius "fingertip_radius" Geom "size of a geom + d"
        [change_m "m" 0.0005 0.002 None;]
    FrictionMap "friction_map" Joint "torque -c (1 + sin(n q)) sgn v: friction that depends on the place"
        [torque_nm "N m" 0.01 0.04 None; per_turn "1" 6.0 12.0 Some(8.0);]
    CubicSpring "cubic_spring" Joint "torque -k q^3"
        [stiffness_nm_rad3 "N m/rad^3" 0.3 3.0 None;]
    LengthScale "length_scale" Body "place of a body in its parent times 1 + s"
        [share "1" 0.005 0.03 None;]
}

impl Effect {
    /// Its row of the catalogue.
    pub fn entry(self) -> &'static Entry {
        // the macro makes one row a variant, in the same order
        &CATALOGUE[self as usize]
    }
}

/// An effect as a rig file has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffectConfig {
    /// which
    pub name: Effect,
    /// glob over names of its place
    #[serde(default, rename = "where")]
    pub place: String,
    /// the other joint, for `joint_coupling`
    #[serde(default)]
    pub with: Option<String>,
    /// by name, see [`CATALOGUE`]
    #[serde(flatten)]
    pub parameters: BTreeMap<String, f64>,
}

/// An effect bound to the elements of a model.
#[derive(Debug, Clone)]
pub(super) struct Bound {
    pub(super) effect: Effect,
    /// ids by the kind of the effect's place
    pub(super) elements: Vec<usize>,
    /// the joint of `with`
    pub(super) partner: Option<usize>,
    /// in the order of the catalogue
    pub(super) values: Vec<f64>,
}

impl Bound {
    /// Whether it does anything.
    fn is_present(&self) -> bool {
        self.values[0] != 0.0
    }
}

/// Largest magnitude of a parameter; the engine refuses more.
const MAX_VALUE: f64 = 1e6;

/// Bind effects to `model`; those of amplitude 0 are checked and left out.
///
/// # Errors
/// [`RigError::Effect`] for a `where` that selects nothing, a parameter unknown, missing or not usable.
pub(super) fn bind(
    model: &Model,
    axes: &[Axis],
    configs: &[EffectConfig],
) -> Result<Vec<Bound>, RigError> {
    let mut effects = Vec::new();
    for config in configs {
        let bound = bind_one(model, axes, config).map_err(|reason| RigError::Effect {
            name: config.name.entry().name,
            reason,
        })?;
        if bound.is_present() {
            effects.push(bound);
        }
    }
    Ok(effects)
}

fn bind_one(model: &Model, axes: &[Axis], config: &EffectConfig) -> Result<Bound, String> {
    let entry = config.name.entry();
    let known = |key: &String| entry.parameters.iter().any(|p| p.name == key);
    if let Some(key) = config.parameters.keys().find(|key| !known(key)) {
        let names: Vec<_> = entry.parameters.iter().map(|p| p.name).collect();
        return Err(format!(
            "it has no parameter `{key}`, expected {}",
            names.join(", ")
        ));
    }
    let values = entry
        .parameters
        .iter()
        .map(|p| {
            let given = config.parameters.get(p.name).copied().or(p.default);
            let value = given.ok_or_else(|| format!("`{}` is missing", p.name))?;
            if value.is_finite() && value.abs() <= MAX_VALUE {
                Ok(value)
            } else {
                Err(format!("`{}` is {value}, expected a finite number", p.name))
            }
        })
        .collect::<Result<Vec<f64>, String>>()?;
    check_range(config.name, &values)?;
    let partner = match (&config.with, config.name) {
        (Some(name), Effect::JointCoupling) => Some(
            model
                .id(ObjectKind::Joint, name)
                .map_err(|e| e.to_string())?,
        ),
        (None, Effect::JointCoupling) => return Err("`with` is missing".to_owned()),
        (Some(_), _) => return Err("it has no `with`".to_owned()),
        (None, _) => None,
    };
    let elements = select(model, axes, entry.place, &config.place)?;
    Ok(Bound {
        effect: config.name,
        elements,
        partner,
        values,
    })
}

/// Amplitudes that have no meaning.
fn check_range(effect: Effect, values: &[f64]) -> Result<(), String> {
    use Effect as E;
    let amplitude = values[0];
    let (low, high) = match effect {
        E::TorqueGain | E::EncoderScale | E::LengthScale | E::LinkMass | E::ObjectMass => {
            (-0.9, 10.0)
        }
        E::ContactFriction
        | E::ContactStiffness
        | E::ContactDamping
        | E::AnisotropicFriction
        | E::TorqueSaturation => (
            -0.95,
            if effect == E::TorqueSaturation {
                0.99
            } else {
                20.0
            },
        ),
        E::ActuatorLag | E::ActuatorDelay | E::SensorDelay | E::FrictionCone => (0.0, 1.0),
        E::FingertipRadius
        | E::TorqueOffset
        | E::EncoderOffset
        | E::ForceSensorBias
        | E::TorqueRipple
        | E::Cogging
        | E::BasePose
        | E::GravityTilt
        | E::AsymmetricFriction
        | E::StribeckFriction => (-10.0, 10.0),
        _ => (0.0, MAX_VALUE),
    };
    if (low..=high).contains(&amplitude) {
        return Ok(());
    }
    let name = effect.entry().parameters[0].name;
    Err(format!("`{name}` is {amplitude}, expected {low} to {high}"))
}

/// Ids of the elements of a place whose names match `glob`.
fn select(model: &Model, axes: &[Axis], place: Place, glob: &str) -> Result<Vec<usize>, String> {
    if place == Place::World {
        return if glob.is_empty() {
            Ok(Vec::new())
        } else {
            Err("it acts on everything and has no `where`".to_owned())
        };
    }
    if glob.is_empty() {
        return Err("`where` is missing".to_owned());
    }
    let candidates = candidates(model, axes, place);
    let kind = kind(model, place);
    let name = |&id: &usize| model.name(kind, id).unwrap_or_default();
    let found: Vec<usize> = candidates
        .iter()
        .copied()
        .filter(|id| glob::matches(glob, name(id)))
        .collect();
    if found.is_empty() {
        let names: Vec<_> = candidates.iter().map(name).collect();
        return Err(format!(
            "`where` = \"{glob}\" matches no {}; there are: {}",
            place.text(),
            names.join(", ")
        ));
    }
    Ok(found)
}

/// What the ids of a place count.
pub(super) fn kind(model: &Model, place: Place) -> ObjectKind {
    match place {
        Place::Joint => ObjectKind::Joint,
        Place::Actuator => ObjectKind::Actuator,
        Place::World | Place::Body => ObjectKind::Body,
        Place::Contact if model.npair() > 0 => ObjectKind::Pair,
        Place::Geom | Place::Contact => ObjectKind::Geom,
        Place::Sensor => ObjectKind::Sensor,
    }
}

/// Ids of all elements that may be selected at a place.
pub(super) fn candidates(model: &Model, axes: &[Axis], place: Place) -> Vec<usize> {
    let all = 0..model.count(kind(model, place));
    match place {
        Place::World => Vec::new(),
        Place::Joint => all
            .filter(|&j| super::axes::is_scalar(model.jnt_type()[j]))
            .collect(),
        Place::Actuator => axes.iter().map(|axis| axis.actuator).collect(),
        Place::Body => all.skip(1).collect(),
        Place::Geom | Place::Contact => all.collect(),
        Place::Sensor => all
            .filter(|&s| super::sensing::is_force(model.sensor_type()[s]))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_effect_finds_its_own_row() {
        for entry in CATALOGUE {
            assert_eq!(entry.effect.entry().name, entry.name);
            assert!(entry.parameters[0].default.is_none(), "{}", entry.name);
        }
    }
}
