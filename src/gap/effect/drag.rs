//! Drag of joints: torques against the motion that vanish with it.

use super::place::joints;
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows, Site,
};
use crate::mujoco::Model;

/// Damping.
#[derive(Debug)]
pub(super) struct Viscous;

impl Effect for Viscous {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "viscous_friction",
            law: "torque −d v",
            shows: Shows::Force,
            signature: "−d v: odd in speed and proportional to it, in every posture",
            parameters: &[Parameter::amplitude(
                "damping",
                Dimension::ForcePerSpeed,
                [0.01, 1.0],
            )],
            neighbours: &[
                Neighbour {
                    name: "quadratic_drag",
                    split: "one motion at three speeds",
                },
                Neighbour {
                    name: "coulomb_friction",
                    split: "slow and fast constant speeds",
                },
            ],
            behaviours: &["multi_sine", "reversals"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let before = site.model.dof_damping()[site.dof()?];
        let element = format!("joint/{}", site.place.name);
        Ok(Expression::of(vec![Number::affine(
            element, "damping", 0, before, 1.0,
        )]))
    }
}

/// Drag of a medium or of a fast rotor.
#[derive(Debug)]
pub(super) struct QuadraticDrag;

impl Effect for QuadraticDrag {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "quadratic_drag",
            law: "torque −c v |v|",
            shows: Shows::Force,
            signature: "−c v |v|: odd in speed, growing with its square",
            parameters: &[Parameter::amplitude(
                "drag",
                Dimension::ForcePerSpeedSquared,
                [0.01, 1.0],
            )],
            neighbours: &[Neighbour {
                name: "viscous_friction",
                split: "one motion at three speeds",
            }],
            behaviours: &["multi_sine", "chirp"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joints(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "quadratic_drag",
            &site.place.name,
            values,
        ))
    }
}
