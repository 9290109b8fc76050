//! What is between motors and joints.

use super::place::{Site, joint_motors};
use super::{About, Dimension, Effect, Expression, Neighbour, Parameter, Place, Shows};
use crate::mujoco::Model;

/// Play.
#[derive(Debug)]
pub(super) struct Backlash;

impl Effect for Backlash {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "backlash",
            law: "play p between motor and joint",
            shows: Shows::Reading,
            signature: "p/2 sgn(u): the encoder jumps where the torque reverses, and no torque passes meanwhile",
            parameters: &[Parameter::bent(
                "play",
                Dimension::Travel,
                &[8e-4, 2.5e-3, 8e-3],
                [5e-4, 0.02],
            )],
            neighbours: &[
                Neighbour {
                    name: "transmission_compliance",
                    split: "light and heavy loads: play does not grow",
                },
                Neighbour {
                    name: "coulomb_friction",
                    split: "reversals without load",
                },
                Neighbour {
                    name: "stribeck_friction",
                    split: "reversals without load",
                },
            ],
            behaviours: &["reversals", "postures"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joint_motors(model)
    }

    /// A motor on its own follows commands within a millisecond.
    fn is_quick(&self) -> bool {
        true
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement("backlash", &site.place.name, values))
    }
}

/// Stretch.
#[derive(Debug)]
pub(super) struct Compliance;

impl Effect for Compliance {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "transmission_compliance",
            law: "spring 1/c between motor and joint",
            shows: Shows::Reading,
            signature: "c u: the encoder runs ahead of the joint in proportion to the torque",
            parameters: &[
                // soft ones swing about as fast as a controller shakes them: a phase that is a radian off says nothing. Stiff
                // ones follow in proportion
                Parameter::bent(
                    "compliance",
                    Dimension::TravelPerForce,
                    &[1e-3, 4e-3, 1.5e-2, 3e-2, 6e-2, 9e-2, 0.12],
                    [1e-4, 0.05],
                ),
                Parameter::choice("damping_ratio", Dimension::Share, &[0.3], [0.05, 0.95]),
            ],
            neighbours: &[
                Neighbour {
                    name: "backlash",
                    split: "light and heavy loads: play does not grow",
                },
                Neighbour {
                    name: "encoder_scale",
                    split: "the same angle under different loads",
                },
                Neighbour {
                    name: "contact_stiffness",
                    split: "pushing against something hard",
                },
            ],
            behaviours: &["press", "postures", "chirp"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        joint_motors(model)
    }

    /// A motor on its own follows commands within a millisecond.
    fn is_quick(&self) -> bool {
        true
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "transmission_compliance",
            &site.place.name,
            values,
        ))
    }
}
