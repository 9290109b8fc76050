//! Contacts: friction, softness, shape.
//!
//! A model with explicit contact pairs says it there. In others the moving geoms that can touch get their own contact
//! parameters, by a `priority` above those they touch.

use super::place::{Site, contacts, pairs, touches};
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, PlaceKind, Role,
    Shows, Sign,
};
use crate::mjcf::structure::Change;
use crate::mujoco::{Cone, Model};

/// Spin at which torsional friction is nearly whole, rad/s.
const SPIN: f64 = 0.1;

/// The element of a contact, and what makes a geom's own parameters count.
pub(super) fn contact(site: &Site<'_>) -> (String, Vec<Change>) {
    let name = &site.place.name;
    if site.place.kind == PlaceKind::Pair {
        return (format!("pair/{name}"), Vec::new());
    }
    let most = site
        .model
        .geom_priority()
        .iter()
        .max()
        .copied()
        .unwrap_or(0);
    let mut changes = Vec::new();
    if site.model.geom_priority()[site.id] < most || most == 0 {
        changes.push(Change::Attribute {
            kind: "geom",
            element: name.clone(),
            attribute: "priority",
            value: format!("{}", most + 1),
        });
    }
    (format!("geom/{name}"), changes)
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
        let (element, changes) = contact(site);
        if site.place.kind == PlaceKind::Pair {
            let before = site.model.pair_friction()[5 * site.id];
            let numbers = vec![Number::affine(element, "slide", 0, before, before)];
            return Ok(Expression {
                changes,
                numbers,
                supplement: None,
            });
        }
        // two geoms share the greater of their coefficients
        let others = (0..site.model.ngeom()).filter(|g| touches(site.model, *g));
        let before = others
            .map(|g| site.model.geom_friction()[3 * g])
            .fold(0.0, f64::max);
        let numbers = vec![Number::affine(element, "friction", 0, before, before)];
        Ok(Expression {
            changes,
            numbers,
            supplement: None,
        })
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
        pairs(model, |p| model.pair_dim()[p] >= 3)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let before = site.model.pair_friction()[5 * site.id + 1];
        let element = format!("pair/{}", site.place.name);
        Ok(Expression::of(vec![Number::affine(
            element, "friction", 1, before, before,
        )]))
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
        let without = |place: &Place| match Site::new(model, place) {
            Ok(site) if place.kind == PlaceKind::Pair => model.pair_dim()[site.id] == 3,
            Ok(site) => model.geom_condim()[site.id] == 3,
            Err(_) => false,
        };
        contacts(model).into_iter().filter(without).collect()
    }

    /// `condim` 4 with elliptic cones. With pyramidal ones it would also make the contact stiffer, by the two edges that
    /// the pyramid gets: there a supplement.
    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        if site.model.option().cone == Cone::Pyramidal {
            return Ok(Expression::supplement(
                "torsional_friction",
                &site.place.name,
                values,
            ));
        }
        let (element, mut changes) = contact(site);
        let (kind, component) = if site.place.kind == PlaceKind::Pair {
            ("pair", 2)
        } else {
            ("geom", 1)
        };
        changes.push(Change::Attribute {
            kind,
            element: site.place.name.clone(),
            attribute: "condim",
            value: "4".to_owned(),
        });
        let numbers = vec![Number::is(element, "friction", component), Number::Fixed];
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
