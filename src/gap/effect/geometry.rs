//! Where bodies are, and how long.

use super::place::{Site, bodies_that, is_free};
use super::{About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows};
use crate::mjcf::attribute::norm;
use crate::mujoco::Model;

/// A machine that stands elsewhere.
#[derive(Debug)]
pub(super) struct BasePose;

impl Effect for BasePose {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "base_pose",
            law: "a body that stands in the world moved, and turned about its z axis",
            shows: Shows::Contact,
            signature: "a gap or dent the same wherever the machine touches, and readings of places that are off by a shift and a turn",
            parameters: &[
                Parameter::amplitude("x", Dimension::Length, [0.005, 0.1]).signed(),
                Parameter::amplitude("y", Dimension::Length, [0.005, 0.1]).signed(),
                Parameter::amplitude("z", Dimension::Length, [0.005, 0.1]).signed(),
                Parameter::amplitude("yaw", Dimension::Angle, [0.002, 0.05]).signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "encoder_offset",
                    split: "touches all over the range",
                },
                Neighbour {
                    name: "length_scale",
                    split: "touches near and far",
                },
                Neighbour {
                    name: "fingertip_radius",
                    split: "touches from several sides",
                },
            ],
            behaviours: &["touch", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        bodies_that(model, |b| {
            let carries =
                (b..model.nbody()).any(|c| below(model, c, b) && model.body_dofnum()[c] > 0);
            model.body_parentid()[b] == 0
                && model.body_mocapid()[b] < 0
                && !is_free(model, b)
                && carries
        })
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let element = format!("body/{}", site.place.name);
        let pos = &site.model.body_pos()[3 * site.id..3 * site.id + 3];
        let mut numbers: Vec<Number> = (0..3)
            .map(|i| Number::affine(element.clone(), "pos", i, pos[i], 1.0))
            .collect();
        numbers.push(Number::is(element, "rotation", 2));
        Ok(Expression::of(numbers))
    }
}

/// Whether `body` is `above` or hangs on it.
fn below(model: &Model, body: usize, above: usize) -> bool {
    let mut at = body;
    while at > above {
        at = model.body_parentid()[at] as usize;
    }
    at == above
}

/// Lengths that are all wrong by one factor.
#[derive(Debug)]
pub(super) struct LengthScale;

impl Effect for LengthScale {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "length_scale",
            law: "a link's length, or the shape of a free body, times 1 + s",
            shows: Shows::Contact,
            signature: "places beyond the joint off by s times the length, torques of contact by the lever",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.002, 0.05]).signed()],
            neighbours: &[
                Neighbour {
                    name: "base_pose",
                    split: "touches near and far",
                },
                Neighbour {
                    name: "encoder_scale",
                    split: "touches all over the range",
                },
                Neighbour {
                    name: "fingertip_radius",
                    split: "touches from several sides",
                },
            ],
            behaviours: &["touch", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        bodies_that(model, |b| {
            let offset = norm(&model.body_pos()[3 * b..3 * b + 3]) > 0.0;
            let shaped = model.body_geomnum()[b] > 0;
            let link = model.body_parentid()[b] != 0 && offset && model.body_weldid()[b] != 0;
            if is_free(model, b) { shaped } else { link }
        })
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let element = format!("body/{}", site.place.name);
        if is_free(site.model, site.id) {
            return Ok(Expression::of(vec![Number::affine(
                element, "geometry", 0, 1.0, 1.0,
            )]));
        }
        let length = norm(&site.model.body_pos()[3 * site.id..3 * site.id + 3]);
        Ok(Expression::of(vec![Number::affine(
            element, "length", 0, length, length,
        )]))
    }
}
