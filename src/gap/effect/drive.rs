//! What motors make of their commands.

use super::joint::{LEAST_PERIODS, PERIODS, gear};
use super::place::{Site, joint_motors, motors};
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Periodic, Place, Role,
    Shows, Sign,
};
use crate::mjcf::structure::Change;
use crate::mujoco::{Model, N_PRM, ObjectKind};

/// The greatest force of an actuator before its gear, if its control is limited.
fn full_force(model: &Model, actuator: usize) -> Option<f64> {
    let range = &model.actuator_ctrlrange()[2 * actuator..2 * actuator + 2];
    let force =
        model.actuator_gainprm()[N_PRM * actuator].abs() * range[0].abs().max(range[1].abs());
    (model.actuator_ctrllimited()[actuator] != 0 && force > 0.0).then_some(force)
}

/// The greatest torque of an actuator, if its control is limited.
pub(super) fn full_torque(model: &Model, actuator: usize) -> Option<f64> {
    full_force(model, actuator).map(|force| force * gear(model, actuator).abs())
}

/// A motor stronger or weaker than in the model.
#[derive(Debug)]
pub(super) struct TorqueGain;

impl Effect for TorqueGain {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "torque_gain",
            law: "motor torque times 1 + g",
            shows: Shows::Force,
            signature: "g u: proportional to the command",
            parameters: &[Parameter::amplitude("gain", Dimension::Share, [0.01, 0.3]).signed()],
            neighbours: &[
                Neighbour {
                    name: "link_mass",
                    split: "a known load or a force sensor: without one, all masses, rotors and friction scaled look the same",
                },
                Neighbour {
                    name: "rotor_inertia",
                    split: "holds, where inertia says nothing",
                },
                Neighbour {
                    name: "torque_saturation",
                    split: "small and large commands",
                },
            ],
            behaviours: &["postures", "press"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        motors(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let before = gear(site.model, site.id);
        let element = format!("actuator/{}", site.place.name);
        Ok(Expression::of(vec![Number::affine(
            element, "gear", 0, before, before,
        )]))
    }
}

/// A motor that gives less than asked for at its most.
#[derive(Debug)]
pub(super) struct TorqueSaturation;

impl Effect for TorqueSaturation {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "torque_saturation",
            law: "motor torque limited to 1 − c of what the range of its control allows",
            shows: Shows::Force,
            signature: "clip(u) − u: nothing up to a command, then all that is beyond",
            parameters: &[Parameter {
                name: "cut",
                dimension: Dimension::Share,
                role: Role::Threshold(&[
                    0.5, 0.2, 0.3, 0.4, 0.6, 0.7, 0.8, 0.85, 0.88, 0.9, 0.92, 0.95, 0.97,
                ]),
                sign: Sign::Positive,
                low: 0.1,
                high: 0.98,
            }],
            neighbours: &[Neighbour {
                name: "torque_gain",
                split: "small and large commands",
            }],
            behaviours: &["chirp", "press"],
        };
        &ABOUT
    }

    /// A command may be at its bound in single samples.
    fn is_quick(&self) -> bool {
        true
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        let full = |place: &Place| {
            let id = model.id(ObjectKind::Actuator, &place.name);
            id.is_ok_and(|u| full_force(model, u).is_some())
        };
        motors(model).into_iter().filter(full).collect()
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let full =
            full_force(site.model, site.id).ok_or("the range of its control is not limited")?;
        let limit = (1.0 - values[0]) * full;
        if limit <= 0.0 {
            return Err(format!("`cut` is {}, which leaves nothing", values[0]));
        }
        let name = &site.place.name;
        let attribute = |attribute, value: String| Change::Attribute {
            kind: "actuator",
            element: name.clone(),
            attribute,
            value,
        };
        Ok(Expression {
            changes: vec![
                attribute("forcelimited", "true".to_owned()),
                attribute("forcerange", format!("{} {limit}", -limit)),
            ],
            numbers: vec![Number::affine(
                format!("actuator/{name}"),
                "forcelimit",
                0,
                full,
                -full,
            )],
            supplement: None,
        })
    }
}

/// A drive that takes its time.
#[derive(Debug)]
pub(super) struct ActuatorLag;

impl Effect for ActuatorLag {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "actuator_lag",
            law: "first-order lag of the command",
            shows: Shows::Force,
            signature: "−T u̇: the command's rate, weaker at high frequencies",
            parameters: &[Parameter::amplitude("time", Dimension::Time, [5e-4, 0.02])],
            neighbours: &[
                Neighbour {
                    name: "actuator_delay",
                    split: "a chirp beyond 1/(2π T): a delay keeps the size, a lag does not",
                },
                Neighbour {
                    name: "rotor_inertia",
                    split: "a chirp to high frequencies",
                },
                Neighbour {
                    name: "sensor_delay",
                    split: "a clock common to commands and sensors, such as a tap",
                },
            ],
            behaviours: &["chirp"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        motors(model)
    }

    /// A supplement: the engine's `filter` puts an actuator behind all without activation, which changes the order of
    /// controls.
    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "actuator_lag",
            &site.place.name,
            values,
        ))
    }
}

/// A drive that is late.
#[derive(Debug)]
pub(super) struct ActuatorDelay;

impl Effect for ActuatorDelay {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "actuator_delay",
            law: "command later by a time",
            shows: Shows::Force,
            signature: "−T u̇ + T² ü/2: the command's rate, at all frequencies",
            parameters: &[Parameter::amplitude(
                "time",
                Dimension::Time,
                [2.5e-4, 0.01],
            )],
            neighbours: &[
                Neighbour {
                    name: "actuator_lag",
                    split: "a chirp beyond 1/(2π T): a delay keeps the size, a lag does not",
                },
                Neighbour {
                    name: "sensor_delay",
                    split: "a clock common to commands and sensors, such as a tap",
                },
                Neighbour {
                    name: "rotor_inertia",
                    split: "a chirp to high frequencies",
                },
            ],
            behaviours: &["chirp"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        motors(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "actuator_delay",
            &site.place.name,
            values,
        ))
    }
}

/// A motor whose torque depends on its angle.
#[derive(Debug)]
pub(super) struct TorqueRipple;

impl Effect for TorqueRipple {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "torque_ripple",
            law: "motor torque times 1 + a sin(n q) + b cos(n q)",
            shows: Shows::Force,
            signature: "u (a sin(n q) + b cos(n q)): periodic in the angle, growing with the command",
            parameters: &[
                Parameter::amplitude("sine", Dimension::Share, [0.01, 0.2]).signed(),
                Parameter::amplitude("cosine", Dimension::Share, [0.01, 0.2]).signed(),
                Parameter::shape(
                    "per_turn",
                    Dimension::PerTravel,
                    PERIODS,
                    [LEAST_PERIODS, 200.0],
                ),
            ],
            neighbours: &[
                Neighbour {
                    name: "cogging",
                    split: "the same motion with and without load",
                },
                Neighbour {
                    name: "torque_gain",
                    split: "motion over the whole range",
                },
            ],
            behaviours: &["multi_sine", "postures"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joint_motors(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "torque_ripple",
            &site.place.name,
            values,
        ))
    }

    fn periodic(&self) -> Option<Periodic> {
        Some(Periodic::Command)
    }
}
