//! Softness of contacts, and how thick what touches is.

use super::contact::share;
use super::place::{Site, contacts, geoms, is_free, moves, touches};
use super::{About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows};
use crate::mujoco::Model;

/// A contact harder or softer than in the model.
#[derive(Debug)]
pub(super) struct ContactStiffness;

impl Effect for ContactStiffness {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "contact_stiffness",
            law: "stiffness of a contact times 1 + s, its damping ratio kept",
            shows: Shows::Contact,
            signature: "indentation that grows with the normal force",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.1, 3.0]).signed()],
            neighbours: &[
                Neighbour {
                    name: "fingertip_radius",
                    split: "light and hard pushes",
                },
                Neighbour {
                    name: "base_pose",
                    split: "light and hard pushes",
                },
                Neighbour {
                    name: "transmission_compliance",
                    split: "pushing against something hard",
                },
                Neighbour {
                    name: "contact_damping",
                    split: "slow pushes and impacts",
                },
            ],
            behaviours: &["press", "touch"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        contacts(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        share(site, "hardness", 0)
    }
}

/// A contact that loses more or less energy than in the model.
#[derive(Debug)]
pub(super) struct ContactDamping;

impl Effect for ContactDamping {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "contact_damping",
            law: "damping ratio of a contact times 1 + s, its stiffness kept",
            shows: Shows::Contact,
            signature: "normal force in proportion to the speed of indentation: at impacts and releases",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.1, 3.0]).signed()],
            neighbours: &[
                Neighbour {
                    name: "contact_stiffness",
                    split: "slow pushes and impacts",
                },
                Neighbour {
                    name: "contact_friction",
                    split: "impacts along the normal",
                },
            ],
            behaviours: &["touch"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        contacts(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        share(site, "dampratio", 0)
    }
}

/// A tip thicker or thinner than in the model.
#[derive(Debug)]
pub(super) struct FingertipRadius;

impl Effect for FingertipRadius {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "fingertip_radius",
            law: "radius of a geom + d",
            shows: Shows::Contact,
            signature: "a constant gap or dent at every touch of this geom",
            parameters: &[
                Parameter::amplitude("change", Dimension::Length, [0.001, 0.05]).signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "contact_stiffness",
                    split: "light and hard pushes",
                },
                Neighbour {
                    name: "base_pose",
                    split: "touches from several sides",
                },
                Neighbour {
                    name: "length_scale",
                    split: "touches from several sides",
                },
            ],
            behaviours: &["touch", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        // `mjGEOM_SPHERE`, `mjGEOM_CAPSULE`, `mjGEOM_CYLINDER` of the engine's model format
        let round = |geom: usize| matches!(model.geom_type()[geom], 2 | 3 | 5);
        let free = |geom: usize| is_free(model, model.geom_bodyid()[geom] as usize);
        geoms(model, |g| {
            round(g) && touches(model, g) && moves(model, g) && !free(g)
        })
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let before = site.model.geom_size()[3 * site.id];
        if before + values[0] <= 0.0 {
            return Err(format!(
                "`change` is {}, which leaves no radius of {before}",
                values[0]
            ));
        }
        let element = format!("geom/{}", site.place.name);
        Ok(Expression::of(vec![Number::affine(
            element, "size", 0, before, 1.0,
        )]))
    }
}
