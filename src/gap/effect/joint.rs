//! Springs, offsets, rotors and stops of joints.

use super::place::{Site, is_motor, joint_of, joints};
use super::{About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows};
use crate::mjcf::structure::Change;
use crate::mujoco::{Model, ObjectKind};

/// Periods of ripple in a travel to try: neighbours differ by what a motion over the travel can tell apart.
pub(super) const PERIODS: &[f64] = &[
    60.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0, 28.0, 30.0, 32.0,
    34.0, 36.0, 38.0, 40.0, 42.0, 44.0, 46.0, 48.0, 50.0, 52.0, 54.0, 56.0, 58.0, 62.0, 64.0, 66.0,
    68.0, 70.0, 72.0, 74.0, 76.0, 78.0, 80.0, 82.0, 84.0, 86.0, 88.0, 90.0, 92.0, 94.0, 96.0, 98.0,
    100.0, 102.0, 104.0, 106.0, 108.0, 110.0, 112.0, 114.0, 116.0, 118.0, 120.0, 124.0, 128.0,
    132.0, 136.0, 140.0, 144.0, 148.0, 152.0, 156.0, 160.0,
];

/// A spring on a joint.
#[derive(Debug)]
pub(super) struct Spring;

impl Effect for Spring {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "joint_spring",
            law: "torque −k (q − q₀)",
            shows: Shows::Force,
            signature: "−k (q − q₀): proportional to the angle, at rest too",
            parameters: &[
                Parameter::amplitude("stiffness", Dimension::ForcePerTravel, [0.03, 3.0]),
                Parameter::shape("rest", Dimension::Travel, &[0.0, 0.3, -0.3], [-1.0, 1.0])
                    .signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "gravity_tilt",
                    split: "postures over the whole range: gravity follows sines, and couples joints",
                },
                Neighbour {
                    name: "torque_offset",
                    split: "holds over the whole range",
                },
                Neighbour {
                    name: "payload",
                    split: "holds over the whole range, and fast motion",
                },
                Neighbour {
                    name: "joint_coupling",
                    split: "one joint alone, then the other",
                },
            ],
            behaviours: &["postures"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        let without = |place: &Place| {
            let joint = model.id(ObjectKind::Joint, &place.name);
            joint.is_ok_and(|j| model.jnt_stiffness()[j] == 0.0)
        };
        joints(model).into_iter().filter(without).collect()
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        if site.model.jnt_stiffness()[site.id] != 0.0 {
            return Err("the joint has a spring; estimate its stiffness and springref".to_owned());
        }
        let element = format!("joint/{}", site.place.name);
        Ok(Expression::of(vec![
            Number::is(element.clone(), "stiffness", 0),
            Number::is(element, "springref", 0),
        ]))
    }
}

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
                    split: "holds approached from both sides: an offset stays, friction does not",
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
            is_motor(model, u)
                && joint_of(model, u).as_deref() == Some(joint)
                && gear(model, u) != 0.0
        });
        // joints that no motor drives have no element of the engine for it
        let Some((u, name)) =
            motor.and_then(|u| Some((u, model.name(ObjectKind::Actuator, u)?.to_owned())))
        else {
            return Ok(Expression::supplement("torque_offset", joint, values));
        };
        const PRM: usize = 10;
        let before = model.actuator_biasprm()[PRM * u];
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
                Parameter::amplitude("sine", Dimension::Force, [0.02, 0.3]).signed(),
                Parameter::amplitude("cosine", Dimension::Force, [0.02, 0.3]).signed(),
                Parameter::shape("per_turn", Dimension::PerTravel, PERIODS, [3.0, 200.0]),
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
}

/// A spring between two joints of one mechanism.
#[derive(Debug)]
pub(super) struct Coupling;

impl Effect for Coupling {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "joint_coupling",
            law: "torque −k (q − p) on a joint and +k (q − p) on another, at p",
            shows: Shows::Force,
            signature: "∓k (q − p): proportional to another joint's angle",
            parameters: &[Parameter::amplitude(
                "stiffness",
                Dimension::ForcePerTravel,
                [0.03, 3.0],
            )],
            neighbours: &[
                Neighbour {
                    name: "joint_spring",
                    split: "one joint alone, then the other",
                },
                Neighbour {
                    name: "gravity_tilt",
                    split: "postures over the whole range",
                },
            ],
            behaviours: &["postures", "multi_sine"],
        };
        &ABOUT
    }

    /// Pairs of driven joints of one mechanism; of all where none is driven.
    fn places(&self, model: &Model) -> Vec<Place> {
        let driven: Vec<String> = (0..model.nu()).filter_map(|u| joint_of(model, u)).collect();
        let all: Vec<String> = joints(model).into_iter().map(|p| p.name).collect();
        let some: Vec<&String> = all
            .iter()
            .filter(|j| driven.is_empty() || driven.contains(j))
            .collect();
        let root = |name: &str| {
            let joint = model.id(ObjectKind::Joint, name).ok()?;
            Some(model.body_rootid()[model.jnt_bodyid()[joint] as usize])
        };
        let mut places = Vec::new();
        for (i, a) in some.iter().enumerate() {
            for b in &some[i + 1..] {
                if root(a) == root(b) {
                    let mut place = Place::at(super::PlaceKind::Joint, a);
                    place.with = Some((*b).clone());
                    places.push(place);
                }
            }
        }
        places
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let a = &site.place.name;
        let b = site
            .place
            .with
            .as_deref()
            .ok_or("a coupling needs a second joint")?;
        site.model
            .id(ObjectKind::Joint, b)
            .map_err(|e| e.to_string())?;
        let name = format!("{a}_{b}_coupling");
        let xml = format!(
            "<fixed name=\"{name}\" stiffness=\"{}\"> <joint joint=\"{a}\" coef=\"1\"/> <joint joint=\"{b}\" coef=\"-1\"/> </fixed>",
            values[0]
        );
        Ok(Expression {
            changes: vec![Change::Element {
                section: "tendon",
                xml,
            }],
            numbers: vec![Number::is(format!("tendon/{name}"), "stiffness", 0)],
            supplement: None,
        })
    }
}

/// A soft stop inside the range.
#[derive(Debug)]
pub(super) struct Stop;

impl Effect for Stop {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "joint_stop",
            law: "torque −k (q − q₀) beyond q₀, on one side",
            shows: Shows::Force,
            signature: "−k max(0, ±(q − q₀)): one-sided, in one part of the range",
            parameters: &[
                Parameter::amplitude("stiffness", Dimension::ForcePerTravel, [1.0, 100.0]),
                Parameter::shape(
                    "at",
                    Dimension::Travel,
                    &[0.1, 0.0, -0.1, 0.2, -0.2, 0.3, -0.3, 0.4, -0.4],
                    [-1.0, 1.0],
                )
                .signed(),
                Parameter::choice("side", Dimension::Share, &[1.0, -1.0], [-1.0, 1.0]).signed(),
                Parameter::shape("damping", Dimension::ForcePerSpeed, &[0.0], [0.0, 10.0]),
            ],
            neighbours: &[
                Neighbour {
                    name: "joint_spring",
                    split: "motion on both sides of the place",
                },
                Neighbour {
                    name: "contact_stiffness",
                    split: "the same angle in another posture of the other joints",
                },
            ],
            behaviours: &["postures", "multi_sine"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    /// A supplement: the engine's limit is a constraint, whose stiffness goes with the inertia, the same on both sides.
    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "joint_stop",
            &site.place.name,
            values,
        ))
    }
}
