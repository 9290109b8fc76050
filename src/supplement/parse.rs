//! From the custom elements of a model to its supplements.

use super::law::Built;
use super::{MAX_DELAY_S, SupplementError, Term};
use super::{command, contact, encoder, friction, joint, sensor, transmission};
use crate::mujoco::{Integrator, Measures, Model, MujocoError, ObjectKind};

/// What the names of all supplements begin with.
pub const PREFIX: &str = "phantom:";

/// What the last part of the name is a name of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// a hinge or slide
    Joint,
    /// an actuator
    Actuator,
    /// an actuator that drives a hinge or slide, and stands apart from it
    Motor,
    /// a contact pair, or a geom in all its contacts
    Contact,
    /// a force or torque sensor
    Wrench,
    /// the word `encoders`: all of them
    Encoders,
}

/// One of the numbers of a kind.
#[derive(Debug, Clone, Copy)]
pub struct Number {
    /// name
    pub name: &'static str,
    /// unit
    pub unit: &'static str,
    /// least value
    pub least: f64,
    /// greatest value
    pub most: f64,
}

/// One kind of supplement.
#[derive(Debug)]
pub struct Kind {
    /// as in the name of the custom element
    pub name: &'static str,
    /// where it acts
    pub element: Element,
    /// in the order of `data`
    pub numbers: &'static [Number],
    build: fn(&Model, usize) -> Built,
}

macro_rules! kinds {
    ($($name:literal $element:ident $build:path [$($number:ident $unit:literal $least:expr, $most:expr;)+])+) => {
        /// Every kind, in the order in which those of one step act.
        pub const KINDS: &[Kind] = &[$(Kind {
            name: $name,
            element: Element::$element,
            numbers: &[$(Number {
                name: stringify!($number), unit: $unit, least: $least, most: $most,
            }),+],
            build: $build,
        }),+];
    };
}

const ANY: f64 = 1e10; // the engine's own limit
const TINY: f64 = 1e-9;

kinds! {
    "actuator_delay" Actuator command::delay [time "s" 0.0, MAX_DELAY_S;]
    "actuator_lag" Actuator command::lag [time "s" 0.0, ANY;]
    "torque_ripple" Actuator command::ripple [sine "1" -1.0, 1.0; cosine "1" -1.0, 1.0; per_turn "1" 0.0, ANY;]
    "backlash" Motor transmission::backlash [play "rad or m" 0.0, ANY;]
    "transmission_compliance" Motor transmission::compliance
        [compliance "rad/(N m) or m/N" 0.0, ANY; damping_ratio "1" 0.0, 0.999;]
    "asymmetric_friction" Joint friction::asymmetric [asymmetry "N m or N" -ANY, ANY;]
    "stribeck_friction" Joint friction::stribeck [excess "N m or N" -ANY, ANY; speed "rad/s or m/s" TINY, ANY;]
    "load_dependent_friction" Joint friction::load_dependent [coefficient "1" -ANY, ANY;]
    "quadratic_drag" Joint joint::quadratic_drag [drag "N m s^2/rad^2 or N s^2/m^2" -ANY, ANY;]
    "torque_offset" Joint joint::torque_offset [torque "N m or N" -ANY, ANY;]
    "cogging" Joint joint::cogging [sine "N m or N" -ANY, ANY; cosine "N m or N" -ANY, ANY; per_turn "1 or rad/m" 0.0, ANY;]
    "joint_stop" Joint joint::joint_stop
        [stiffness "N m/rad or N/m" 0.0, ANY; at "rad or m" -ANY, ANY; side "1" -1.0, 1.0; damping "N m s/rad or N s/m" 0.0, ANY;]
    "torsional_friction" Contact contact::torsion [coefficient "m" 0.0, ANY; speed "rad/s" TINY, ANY;]
    "encoder_scale" Joint encoder::scale [scale "1" -0.9, ANY;]
    "encoder_offset" Joint encoder::offset [offset "rad or m" -ANY, ANY;]
    "sensor_delay" Encoders encoder::delay [time "s" 0.0, MAX_DELAY_S;]
    "force_sensor_bias" Wrench sensor::bias [x "N or N m" -ANY, ANY; y "N or N m" -ANY, ANY; z "N or N m" -ANY, ANY;]
}

/// Name of the custom element of a kind at an element of the model.
pub fn name_of(kind: &str, element: &str) -> String {
    format!("{PREFIX}{kind}:{element}")
}

/// The hinge or slide that an actuator drives.
pub(super) fn joint_of(model: &Model, actuator: usize) -> Option<usize> {
    const JOINT: i32 = 0; // `mjTRN_JOINT` of the engine's model format
    if model.actuator_trntype()[actuator] != JOINT {
        return None;
    }
    let joint = usize::try_from(model.actuator_trnid()[2 * actuator]).ok()?;
    model.is_slide(joint).map(|_| joint)
}

/// All supplements of a model.
pub(super) fn terms(model: &Model) -> Result<Vec<Term>, SupplementError> {
    let refuse = |name: &str, reason: String| SupplementError::Element {
        name: name.to_owned(),
        reason,
    };
    for kind in [ObjectKind::Text, ObjectKind::Tuple] {
        let mut names = (0..model.count(kind)).filter_map(|i| model.name(kind, i));
        if let Some(name) = names.find(|n| n.starts_with(PREFIX)) {
            let reason = format!("it is a {}, expected a numeric", kind.text());
            return Err(refuse(name, reason));
        }
    }
    let mut terms = Vec::new();
    for id in 0..model.count(ObjectKind::Numeric) {
        let name = model.name(ObjectKind::Numeric, id).unwrap_or_default();
        let Some(rest) = name.strip_prefix(PREFIX) else {
            continue;
        };
        let term = term(model, id, rest).map_err(|reason| refuse(name, reason))?;
        terms.push(term);
    }
    if !terms.is_empty() && model.option().integrator == Integrator::Rk4 {
        return Err(MujocoError::RungeKutta.into());
    }
    let place = |term: &Term| KINDS.iter().position(|k| k.name == term.kind.name);
    terms.sort_by_key(place);
    Ok(terms)
}

fn term(model: &Model, id: usize, name: &str) -> Result<Term, String> {
    let Some((kind, element)) = name.split_once(':') else {
        return Err(format!("expected the name {PREFIX}KIND:ELEMENT"));
    };
    let Some(kind) = KINDS.iter().find(|k| k.name == kind) else {
        let known: Vec<&str> = KINDS.iter().map(|k| k.name).collect();
        return Err(format!(
            "there is no kind `{kind}`; there are: {}",
            known.join(", ")
        ));
    };
    let (first, n) = (
        model.numeric_adr()[id] as usize,
        model.numeric_size()[id] as usize,
    );
    if n != kind.numbers.len() {
        let names: Vec<String> = kind
            .numbers
            .iter()
            .map(|n| format!("{} ({})", n.name, n.unit))
            .collect();
        return Err(format!(
            "it has {n} numbers, expected {}: {}",
            kind.numbers.len(),
            names.join(", ")
        ));
    }
    for (value, number) in model.numeric_data()[first..first + n]
        .iter()
        .zip(kind.numbers)
    {
        let Number {
            name, least, most, ..
        } = number;
        if !(*least..=*most).contains(value) {
            return Err(format!("`{name}` is {value}, expected {least} to {most}"));
        }
    }
    let law = (kind.build)(model, kind.element.find(model, element)?)?;
    Ok(Term {
        kind,
        element: element.to_owned(),
        first,
        law,
    })
}

impl Element {
    /// Id of the element named `name`; of contacts first the pairs, then the geoms.
    fn find(self, model: &Model, name: &str) -> Result<usize, String> {
        if self == Self::Contact {
            return contact(model, name);
        }
        let kind = match self {
            Self::Joint => ObjectKind::Joint,
            Self::Actuator | Self::Motor => ObjectKind::Actuator,
            Self::Contact => ObjectKind::Pair,
            Self::Wrench => ObjectKind::Sensor,
            Self::Encoders if name == "encoders" => return Ok(0),
            Self::Encoders => return Err(format!("it is for `{name}`, expected `encoders`")),
        };
        let id = model.id(kind, name).map_err(|e| e.to_string())?;
        match self {
            Self::Joint if model.is_slide(id).is_none() => {
                Err("the joint is not a hinge or slide".to_owned())
            }
            Self::Wrench if !matches!(model.measures(id), Measures::Wrench(_)) => {
                Err("the sensor is not one of force or torque".to_owned())
            }
            _ => Ok(id),
        }
    }
}

fn contact(model: &Model, name: &str) -> Result<usize, String> {
    if let Ok(pair) = model.id(ObjectKind::Pair, name) {
        return Ok(pair);
    }
    let geom = model.id(ObjectKind::Geom, name);
    let geom = geom.map_err(|e| format!("{e}, and no contact pair of that name"))?;
    Ok(model.npair() + geom)
}
