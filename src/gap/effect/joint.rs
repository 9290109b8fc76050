//! Springs, offsets, rotors and stops of joints.

use super::friction::UNLOADED;
use super::place::{Site, joint_of, joints};
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Periodic, Place, Shows,
};
use crate::mjcf::structure::Change;
use crate::mujoco::{Model, N_PRM, ObjectKind};

/// Periods of ripple in a travel to try: neighbours differ by what a motion over the travel can tell apart.
pub(super) const PERIODS: &[f64] = &[
    60.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0, 28.0, 30.0, 32.0, 34.0, 36.0, 38.0,
    40.0, 42.0, 44.0, 46.0, 48.0, 50.0, 52.0, 54.0, 56.0, 58.0, 62.0, 64.0, 66.0, 68.0, 70.0, 72.0,
    74.0, 76.0, 78.0, 80.0, 82.0, 84.0, 86.0, 88.0, 90.0, 92.0, 94.0, 96.0, 98.0, 100.0, 102.0,
    104.0, 106.0, 108.0, 110.0, 112.0, 114.0, 116.0, 118.0, 120.0, 124.0, 128.0, 132.0, 136.0,
    140.0, 144.0, 148.0, 152.0, 156.0, 160.0,
];

/// Less than one and a half periods in a travel are none: any force by position looks like a part of one.
pub(super) const LEAST_PERIODS: f64 = 3.0 * std::f64::consts::PI;
/// From two on they are told from what another effect leaves of such a force.
pub(in crate::gap) const TWO_PERIODS: f64 = 4.0 * std::f64::consts::PI;

/// A constant torque.
#[derive(Debug)]
pub(super) struct TorqueOffset;

impl Effect for TorqueOffset {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "torque_offset",
            law: "constant torque",
            shows: Shows::Force,
            signature: "b: the same moving and at rest",
            parameters: &[Parameter::amplitude("torque", Dimension::Force, [0.02, 0.5]).signed()],
            neighbours: &[
                Neighbour {
                    name: "asymmetric_friction",
                    split: UNLOADED,
                },
                Neighbour {
                    name: "joint_spring",
                    split: "holds over the whole range",
                },
                Neighbour {
                    name: "gravity_tilt",
                    split: "several postures",
                },
            ],
            behaviours: &["postures", "reversals"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let model = site.model;
        let joint = &site.place.name;
        let motor = (0..model.nu()).find(|&u| {
            model.is_motor(u)
                && joint_of(model, u).as_deref() == Some(joint)
                && gear(model, u) != 0.0
        });
        // joints that no motor drives have no element of the engine for it
        let Some((u, name)) =
            motor.and_then(|u| Some((u, model.name(ObjectKind::Actuator, u)?.to_owned())))
        else {
            return Ok(Expression::supplement("torque_offset", joint, values));
        };
        let before = model.actuator_biasprm()[N_PRM * u];
        let attribute = |attribute, value: String| Change::Attribute {
            kind: "actuator",
            element: name.clone(),
            attribute,
            value,
        };
        let mut changes = vec![Change::General {
            actuator: name.clone(),
        }];
        if model.actuator_biastype()[u] == 0 {
            changes.push(attribute("biastype", "affine".to_owned()));
            changes.push(attribute("biasprm", "0 0 0".to_owned()));
        }
        let number = Number::affine(
            format!("actuator/{name}"),
            "biasprm",
            0,
            before,
            1.0 / gear(model, u),
        );
        Ok(Expression {
            changes,
            numbers: vec![number],
            supplement: None,
        })
    }
}

/// Torque of a joint by a unit of its actuator's force.
pub(super) fn gear(model: &Model, actuator: usize) -> f64 {
    model.actuator_gear()[6 * actuator]
}

/// Inertia of a rotor.
#[derive(Debug)]
pub(super) struct RotorInertia;

impl Effect for RotorInertia {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "rotor_inertia",
            law: "torque −J a",
            shows: Shows::Force,
            signature: "−J a: proportional to the joint's own acceleration, in every posture",
            parameters: &[Parameter::amplitude(
                "inertia",
                Dimension::ForcePerAcceleration,
                [0.01, 1.0],
            )],
            neighbours: &[
                Neighbour {
                    name: "link_mass",
                    split: "fast motion in several postures",
                },
                Neighbour {
                    name: "torque_gain",
                    split: "holds, where inertia says nothing",
                },
                Neighbour {
                    name: "actuator_lag",
                    split: "a chirp to high frequencies",
                },
            ],
            behaviours: &["chirp", "multi_sine"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let before = site.model.dof_armature()[site.dof()?];
        let element = format!("joint/{}", site.place.name);
        Ok(Expression::of(vec![Number::affine(
            element, "armature", 0, before, 1.0,
        )]))
    }
}

/// Torque of magnets or teeth.
#[derive(Debug)]
pub(super) struct Cogging;

impl Effect for Cogging {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "cogging",
            law: "torque a sin(n q) + b cos(n q)",
            shows: Shows::Force,
            signature: "a sin(n q) + b cos(n q): periodic in the angle, without load and at any speed",
            parameters: &[
                Parameter::amplitude("sine", Dimension::Force, [0.02, 0.5]).signed(),
                Parameter::amplitude("cosine", Dimension::Force, [0.02, 0.5]).signed(),
                Parameter::shape(
                    "per_turn",
                    Dimension::PerTravel,
                    PERIODS,
                    [LEAST_PERIODS, 200.0],
                ),
            ],
            neighbours: &[Neighbour {
                name: "torque_ripple",
                split: "the same motion with and without load",
            }],
            behaviours: &["reversals", "multi_sine"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement("cogging", &site.place.name, values))
    }

    fn periodic(&self) -> Option<Periodic> {
        Some(Periodic::Torque)
    }
}
