//! Contacts: friction, softness, shape.
//!
//! A model with explicit contact pairs says it there. Geoms that touch without one get one ([`super::couple`]).

use super::couple;
use super::place::{Site, contacts};
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, PlaceKind, Role,
    Shows, Sign,
};
use crate::mjcf::structure::Change;
use crate::mujoco::{Cone, Model, ObjectKind};

/// Spin at which torsional friction is nearly whole, rad/s.
const SPIN: f64 = 0.1;

/// A contact's pair, and what makes it where there is none.
pub(super) fn contact(site: &Site<'_>) -> Result<(String, Vec<Change>), String> {
    let name = &site.place.name;
    if site.place.kind == PlaceKind::Pair {
        return Ok((name.clone(), Vec::new()));
    }
    let other = site.place.with.as_deref().unwrap_or_default();
    let other = (site.model.id(ObjectKind::Geom, other)).map_err(|e| e.to_string())?;
    let (name, change) = couple::pair(site.model, site.id, other)?;
    Ok((name, change.into_iter().collect()))
}

/// A number of a contact's pair times 1 + share.
pub(super) fn share(
    site: &Site<'_>,
    attribute: &'static str,
    component: usize,
) -> Result<Expression, String> {
    let (pair, changes) = contact(site)?;
    let element = format!("pair/{pair}");
    Ok(Expression {
        changes,
        numbers: vec![Number::Share {
            element,
            attribute,
            component,
        }],
        supplement: None,
    })
}

/// Contacts of so many dimensions.
fn of_dimension(model: &Model, keep: impl Fn(i32) -> bool) -> Vec<Place> {
    let kept = |place: &Place| match Site::new(model, place) {
        Ok(site) if place.kind == PlaceKind::Pair => keep(model.pair_dim()[site.id]),
        Ok(site) => couple::dimension(&site).is_some_and(&keep),
        Err(_) => false,
    };
    contacts(model).into_iter().filter(kept).collect()
}

/// Sliding friction more or less than in the model.
#[derive(Debug)]
pub(super) struct ContactFriction;

impl Effect for ContactFriction {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "contact_friction",
            law: "sliding friction times 1 + s",
            shows: Shows::Contact,
            signature: "tangential force while sliding, proportional to the normal force",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.05, 0.8]).signed()],
            neighbours: &[
                Neighbour {
                    name: "friction_cone",
                    split: "sliding in several directions",
                },
                Neighbour {
                    name: "anisotropic_friction",
                    split: "sliding in several directions",
                },
                Neighbour {
                    name: "object_mass",
                    split: "slow and fast pushes",
                },
                Neighbour {
                    name: "torsional_friction",
                    split: "turning on the spot",
                },
            ],
            behaviours: &["slide", "push"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        contacts(model)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        share(site, "slide", 0)
    }
}

/// Friction that is not the same in all directions.
#[derive(Debug)]
pub(super) struct AnisotropicFriction;

impl Effect for AnisotropicFriction {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "anisotropic_friction",
            law: "friction of the second tangent times 1 + s",
            shows: Shows::Contact,
            signature: "tangential force while sliding that depends on the direction",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.05, 0.9]).signed()],
            neighbours: &[
                Neighbour {
                    name: "contact_friction",
                    split: "sliding in several directions",
                },
                Neighbour {
                    name: "friction_cone",
                    split: "sliding in several directions",
                },
                Neighbour {
                    name: "gravity_tilt",
                    split: "opposite pushes: a tilt helps one and hinders the other",
                },
            ],
            behaviours: &["push", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        of_dimension(model, |dimension| dimension >= 3)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        share(site, "friction", 1)
    }
}

/// Friction against turning on the spot.
#[derive(Debug)]
pub(super) struct TorsionalFriction;

impl Effect for TorsionalFriction {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "torsional_friction",
            law: "moment −c N sgn(spin) about the normal",
            shows: Shows::Contact,
            signature: "moment about the normal while turning, proportional to the normal force",
            parameters: &[
                Parameter::amplitude("coefficient", Dimension::Length, [0.005, 0.2]),
                Parameter::choice("speed", Dimension::Spin, &[SPIN], [0.01, 1.0]),
            ],
            neighbours: &[
                Neighbour {
                    name: "contact_friction",
                    split: "turning on the spot",
                },
                Neighbour {
                    name: "object_mass",
                    split: "slow and fast turns",
                },
            ],
            behaviours: &["push", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        of_dimension(model, |dimension| dimension == 3)
    }

    /// `condim` 4 with elliptic cones. With pyramidal ones it would also make the contact stiffer, by the two edges that
    /// the pyramid gets: there a supplement.
    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let (pair, mut changes) = contact(site)?;
        if site.model.option().cone == Cone::Pyramidal {
            return Ok(Expression {
                changes,
                ..Expression::supplement("torsional_friction", &pair, values)
            });
        }
        changes.push(Change::Attribute {
            kind: "pair",
            element: pair.clone(),
            attribute: "condim",
            value: "4".to_owned(),
        });
        let element = format!("pair/{pair}");
        let numbers = vec![Number::is(element, "friction", 2), Number::Fixed];
        Ok(Expression {
            changes,
            numbers,
            supplement: None,
        })
    }
}

/// The other shape of friction cones.
#[derive(Debug)]
pub(super) struct FrictionCone;

impl Effect for FrictionCone {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "friction_cone",
            law: "the other friction cone: round for pyramidal, pyramidal for round",
            shows: Shows::Contact,
            signature: "tangential force while sliding that is greater along four directions by √2",
            parameters: &[Parameter {
                name: "changed",
                dimension: Dimension::Share,
                role: Role::Switch,
                sign: Sign::Positive,
                low: 1.0,
                high: 1.0,
            }],
            neighbours: &[
                Neighbour {
                    name: "contact_friction",
                    split: "sliding in several directions",
                },
                Neighbour {
                    name: "anisotropic_friction",
                    split: "sliding in several directions",
                },
            ],
            behaviours: &["push", "slide"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        let touching = model.npair() > 0 || !contacts(model).is_empty();
        if touching {
            vec![Place::world()]
        } else {
            Vec::new()
        }
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let value = match site.model.option().cone {
            Cone::Pyramidal => "elliptic",
            Cone::Elliptic => "pyramidal",
        };
        Ok(Expression {
            changes: vec![Change::Option {
                attribute: "cone",
                value: value.to_owned(),
            }],
            numbers: vec![Number::Fixed],
            supplement: None,
        })
    }
}
