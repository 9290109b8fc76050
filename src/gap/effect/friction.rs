//! Friction and drag of joints.
//!
//! Dry friction is the engine's `frictionloss`, a constraint that sticks; where its level changes with speed, direction or
//! load, a supplement moves that level ([`crate::supplement`]). The engine's default constraint is soft: it turns over
//! within about a millisecond's worth of f/I of speed, and creeps where it should stick. A joint that still has these
//! defaults gets values near the ideal.

use super::place::joints;
use super::{
    About, DRY, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows, Site,
};
use crate::mjcf::structure::Change;
use crate::mujoco::Model;

/// Level written where only a part that changes is asked for: the constraint must exist. Part of that size.
const FLOOR: f64 = 1e-3;
/// What a motor's torque is taken to be at least, N m or N: friction by load is a share of that.
const LEAST_LOAD: f64 = 1e-3;
/// The engine's defaults of `solreffriction` and `solimpfriction`.
const SOFT: ([f64; 2], [f64; 3]) = ([0.02, 1.0], [0.9, 0.95, 0.001]);
/// Impedance near 1, as far as solvers stay well behaved.
const FIRM: &str = "0.99 0.99 0.001";
/// What tells friction that differs with direction from an offset.
pub(super) const UNLOADED: &str = "the same motions with the joint's friction gone, oiled or unloaded: \
     an offset stays, and beside friction nothing tells";
/// Where the numbers of friction that changes have [`LEVEL`].
const AT: usize = 1;
const LEVEL: Parameter = Parameter::companion("level", Dimension::Force, [0.02, 0.5]);

/// A dry joint's attributes with `level` more friction, and the number it is; friction that is beside it changes by `extra`, N m or N.
fn dry(site: &Site<'_>, level: f64, extra: f64) -> Result<(Vec<Change>, Number), String> {
    let (model, dof) = (site.model, site.dof()?);
    let before = model.dof_frictionloss()[dof];
    let joint = site.place.name.clone();
    let attribute = |attribute, value: String| Change::Attribute {
        kind: "joint",
        element: joint.clone(),
        attribute,
        value,
    };
    let least = if before > 0.0 {
        0.0
    } else {
        FLOOR * extra.abs()
    };
    let mut changes = Vec::new();
    if before == 0.0 {
        changes.push(Change::Room { rows: 1 });
        changes.push(attribute(
            "frictionloss",
            format!("{}", (before + level).max(least)),
        ));
    }
    let (solref, solimp) = (
        &model.dof_solref()[2 * dof..2 * dof + 2],
        &model.dof_solimp()[5 * dof..5 * dof + 3],
    );
    if (solref, solimp) == (&SOFT.0[..], &SOFT.1[..]) {
        // two steps are the shortest time constant that stays stable
        changes.push(attribute(
            "solreffriction",
            format!("{} 1", 2.0 * model.timestep()),
        ));
        changes.push(attribute("solimpfriction", FIRM.to_owned()));
    }
    let number = Number::Of {
        element: format!("joint/{joint}"),
        attribute: "frictionloss",
        component: 0,
        origin: before,
        slope: 1.0,
        least,
    };
    Ok((changes, number))
}

/// A supplement of friction whose level changes by `extra`; value number [`AT`] is the level, the others are the supplement's.
fn changing(
    kind: &'static str,
    site: &Site<'_>,
    values: &[f64],
    extra: f64,
) -> Result<Expression, String> {
    let (changes, number) = dry(site, values[AT], extra)?;
    let own: Vec<f64> = values
        .iter()
        .enumerate()
        .filter(|(i, _)| *i != AT)
        .map(|(_, v)| *v)
        .collect();
    let mut numbers: Vec<Number> = (0..own.len()).map(Number::Custom).collect();
    numbers.insert(AT, number);
    let supplement = Some((kind, site.place.name.clone(), own));
    Ok(Expression {
        changes,
        supplement,
        numbers,
    })
}

/// Dry friction.
#[derive(Debug)]
pub(super) struct Coulomb;

impl Effect for Coulomb {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: DRY,
            law: "torque −f sgn v, up to f at rest",
            shows: Shows::Force,
            signature: "−f sgn(v): jumps at reversals, the same at every speed",
            parameters: &[Parameter::amplitude("level", Dimension::Force, [0.02, 0.5])],
            neighbours: &[
                Neighbour {
                    name: "stribeck_friction",
                    split: "slow constant speeds, from nearly none upwards",
                },
                Neighbour {
                    name: "load_dependent_friction",
                    split: "the same speed under different loads",
                },
                Neighbour {
                    name: "asymmetric_friction",
                    split: "holds approached from both sides",
                },
                Neighbour {
                    name: "viscous_friction",
                    split: "slow and fast constant speeds",
                },
                Neighbour {
                    name: "backlash",
                    split: "reversals without load",
                },
            ],
            behaviours: &["reversals"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let (changes, number) = dry(site, values[0], 0.0)?;
        Ok(Expression {
            changes,
            numbers: vec![number],
            supplement: None,
        })
    }
}

/// Dry friction that differs with direction.
#[derive(Debug)]
pub(super) struct Asymmetric;

impl Effect for Asymmetric {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "asymmetric_friction",
            law: "torque −(f + a) forwards, +(f − a) backwards",
            shows: Shows::Force,
            signature: "−f sgn(v) − a, either way up to that at rest: as an offset beside −f sgn(v)",
            parameters: &[
                Parameter::amplitude("asymmetry", Dimension::Force, [0.01, 0.3]).signed(),
                LEVEL,
            ],
            neighbours: &[
                Neighbour {
                    name: "torque_offset",
                    split: UNLOADED,
                },
                Neighbour {
                    name: "coulomb_friction",
                    split: "both directions at one speed",
                },
                Neighbour {
                    name: "gravity_tilt",
                    split: "several postures",
                },
            ],
            behaviours: &["reversals", "postures"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        changing("asymmetric_friction", site, values, values[0])
    }

    fn in_dry_joints(&self) -> Option<(&'static str, f64)> {
        Some(("torque_offset", -1.0))
    }
}

/// Dry friction that falls with speed.
#[derive(Debug)]
pub(super) struct Stribeck;

impl Effect for Stribeck {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "stribeck_friction",
            law: "torque −(f + e exp(−(v/s)²)) sgn v",
            shows: Shows::Force,
            signature: "−(f + e exp(−(v/s)²)) sgn(v): more friction at the slowest speeds",
            parameters: &[
                Parameter::amplitude("excess", Dimension::Force, [0.02, 0.5]),
                LEVEL,
                Parameter::shape("speed", Dimension::Speed, &[0.1, 0.03, 0.3], [0.0, 0.5]),
            ],
            neighbours: &[
                Neighbour {
                    name: "coulomb_friction",
                    split: "slow constant speeds, from nearly none upwards",
                },
                Neighbour {
                    name: "backlash",
                    split: "reversals without load",
                },
                Neighbour {
                    name: "transmission_compliance",
                    split: "small reversals of several sizes",
                },
            ],
            behaviours: &["reversals"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        changing("stribeck_friction", site, values, values[0])
    }
}

/// Dry friction of a loaded transmission.
#[derive(Debug)]
pub(super) struct LoadDependent;

impl Effect for LoadDependent {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "load_dependent_friction",
            law: "torque −(f + μ |motor torque|) sgn v",
            shows: Shows::Force,
            signature: "−(f + μ |u|) sgn(v): friction that grows with the torque passed on",
            parameters: &[
                Parameter::amplitude("coefficient", Dimension::Share, [0.01, 0.3]),
                LEVEL,
            ],
            neighbours: &[
                Neighbour {
                    name: "coulomb_friction",
                    split: "the same speed under different loads",
                },
                Neighbour {
                    name: "torque_gain",
                    split: "the same load forwards and backwards",
                },
            ],
            behaviours: &["reversals", "postures", "press"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        let driven: Vec<String> = (0..model.nu())
            .filter_map(|u| super::place::joint_of(model, u))
            .collect();
        joints(model)
            .into_iter()
            .filter(|place| driven.contains(&place.name))
            .collect()
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        changing(
            "load_dependent_friction",
            site,
            values,
            LEAST_LOAD * values[0],
        )
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, machine};

    /// A share of a small motor's torque is no more than a ten-thousandth of that, and so must be what is there without load.
    #[test]
    fn friction_by_load_has_no_level_that_shows() {
        const SHARE: f64 = 0.1;
        let base = machine("", "");
        let law = chosen(&base, "load_dependent_friction", "a", &[SHARE, 0.0]);
        let written = write(&base, law.effect, &law.place, &law.values).expect("written");
        let level = written.file.model.dof_frictionloss()[0];
        assert!(level > 0.0 && level < 1e-5 * SHARE, "{level}");
    }
}
