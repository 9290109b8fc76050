//! Masses, gravity and geometry.

use nalgebra::{Isometry3, Point3, Quaternion, UnitQuaternion, Vector3};

use super::place::{Site, bodies, bodies_that};
use super::{About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, Shows};
use crate::mjcf::attribute::norm;
use crate::mjcf::structure::Change;
use crate::mujoco::Model;

/// Radius of the ball that a payload is written as, m: nearly a point.
const PAYLOAD_RADIUS: f64 = 1e-3;
/// Where a payload is looked for along each axis, in lengths: on a joint's axis it shows nothing.
const SIDES: &[f64] = &[0.0, 0.5, -0.5];

/// The mass of a body times 1 + value.
fn mass(site: &Site<'_>) -> Expression {
    let before = site.model.body_mass()[site.id];
    let element = format!("body/{}", site.place.name);
    Expression::of(vec![Number::affine(element, "mass", 0, before, before)])
}

/// A link heavier than in the model.
#[derive(Debug)]
pub(super) struct LinkMass;

impl Effect for LinkMass {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "link_mass",
            law: "mass and inertia of a link times 1 + s",
            shows: Shows::Force,
            signature: "−s Y(q, v, a): the link's inertial and gravity torques, in all joints below it",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.02, 0.5]).signed()],
            neighbours: &[
                Neighbour {
                    name: "payload",
                    split: "postures and fast motion: a point changes other moments",
                },
                Neighbour {
                    name: "rotor_inertia",
                    split: "holds, where rotors say nothing",
                },
                Neighbour {
                    name: "torque_gain",
                    split: "a known load",
                },
            ],
            behaviours: &["multi_sine", "postures"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        bodies(model, false)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        Ok(mass(site))
    }
}

/// A free body heavier than in the model.
#[derive(Debug)]
pub(super) struct ObjectMass;

impl Effect for ObjectMass {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "object_mass",
            law: "mass and inertia of a free body times 1 + s",
            shows: Shows::Contact,
            signature: "−s m (a − g) of the body: forces on it grow with its acceleration",
            parameters: &[Parameter::amplitude("share", Dimension::Share, [0.02, 0.5]).signed()],
            neighbours: &[Neighbour {
                name: "contact_friction",
                split: "slow and fast pushes: friction does not grow with acceleration",
            }],
            behaviours: &["push"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        bodies(model, true)
    }

    fn express(&self, site: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        Ok(mass(site))
    }
}

/// Something on a link.
#[derive(Debug)]
pub(super) struct Payload;

impl Effect for Payload {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "payload",
            law: "a point mass on a body",
            shows: Shows::Force,
            signature: "−Jᵀ m (a − g) of the point",
            parameters: &[
                Parameter::amplitude("mass", Dimension::Mass, [0.01, 0.5]),
                Parameter::shape("x", Dimension::Length, SIDES, [-0.5, 0.5]).signed(),
                Parameter::shape("y", Dimension::Length, SIDES, [-0.5, 0.5]).signed(),
                Parameter::shape("z", Dimension::Length, SIDES, [-0.5, 0.5]).signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "link_mass",
                    split: "postures and fast motion: a point changes other moments",
                },
                Neighbour {
                    name: "gravity_tilt",
                    split: "fast motion, where gravity says nothing",
                },
                Neighbour {
                    name: "joint_spring",
                    split: "holds over the whole range",
                },
            ],
            behaviours: &["postures", "multi_sine"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        let mut links: Vec<i32> = Vec::new();
        let mut all = bodies(model, false);
        all.extend(bodies(model, true));
        all.retain(|place| {
            let link = place.body(model).map(|b| model.body_weldid()[b]);
            let new = link.filter(|link| !links.contains(link));
            links.extend(new);
            new.is_some()
        });
        all
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        let [mass, x, y, z] = values else {
            return Err("a payload has four numbers".to_owned());
        };
        let body = site.place.name.clone();
        let name = format!("{body}_payload");
        let inertia = 0.4 * mass * PAYLOAD_RADIUS * PAYLOAD_RADIUS;
        let xml = format!(
            "<body name=\"{name}\" pos=\"{x} {y} {z}\"> <inertial pos=\"0 0 0\" mass=\"{mass}\" diaginertia=\"{inertia:e} {inertia:e} {inertia:e}\"/> </body>"
        );
        let element = format!("body/{name}");
        let place = |i| Number::is(element.clone(), "pos", i);
        Ok(Expression {
            changes: vec![Change::Child { body, xml }],
            numbers: vec![
                Number::is(element.clone(), "mass", 0),
                place(0),
                place(1),
                place(2),
            ],
            supplement: None,
        })
    }

    fn nearest(&self, model: &Model, place: &Place, values: &[f64]) -> Option<(Place, Vec<f64>)> {
        let &[mass, x, y, z] = values else {
            return None;
        };
        let own = place.body(model)?;
        let point = on_link(model, own) * Point3::new(x, y, z);
        let fixed = bodies_that(model, |b| {
            model.body_mass()[b] > 0.0 && model.body_weldid()[b] == model.body_weldid()[own]
        });
        let seen = fixed.into_iter().filter_map(|other| {
            let frame = on_link(model, other.body(model)?);
            let there = frame.inverse_transform_point(&point).coords;
            Some((other, there))
        });
        let (nearest, at) = seen.min_by(|a, b| a.1.norm().total_cmp(&b.1.norm()))?;
        let is_nearer = at.norm() < Vector3::new(x, y, z).norm();
        (nearest != *place && is_nearer).then(|| (nearest, vec![mass, at.x, at.y, at.z]))
    }
}

/// Where a body is on its link: in the frame of the first of the bodies that are fixed to one another.
fn on_link(model: &Model, body: usize) -> Isometry3<f64> {
    let first = model.body_weldid()[body] as usize;
    let (mut pose, mut at) = (Isometry3::identity(), body);
    while at != first {
        let pos = Vector3::from_column_slice(&model.body_pos()[3 * at..3 * at + 3]);
        let q = &model.body_quat()[4 * at..4 * at + 4];
        let turn = UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]));
        pose = Isometry3::from_parts(pos.into(), turn) * pose;
        at = model.body_parentid()[at] as usize;
    }
    pose
}

/// A machine that does not stand level.
#[derive(Debug)]
pub(super) struct GravityTilt;

impl Effect for GravityTilt {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "gravity_tilt",
            law: "gravity turned about x and y",
            shows: Shows::Force,
            signature: "∂G/∂g(q) δg: two numbers for all joints, sines of posture",
            parameters: &[
                Parameter::amplitude("about_x", Dimension::Angle, [0.003, 0.1]).signed(),
                Parameter::amplitude("about_y", Dimension::Angle, [0.003, 0.1]).signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "joint_spring",
                    split: "postures over the whole range",
                },
                Neighbour {
                    name: "payload",
                    split: "fast motion, where gravity says nothing",
                },
                Neighbour {
                    name: "torque_offset",
                    split: "several postures",
                },
                Neighbour {
                    name: "anisotropic_friction",
                    split: "opposite pushes: a tilt helps one and hinders the other",
                },
                Neighbour {
                    name: "encoder_offset",
                    split: "the tip against a fixture",
                },
            ],
            behaviours: &["postures", "push"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        if norm(&model.option().gravity) == 0.0 {
            Vec::new()
        } else {
            vec![Place::world()]
        }
    }

    fn express(&self, _: &Site<'_>, _: &[f64]) -> Result<Expression, String> {
        let about = |i| Number::is("option/gravity".to_owned(), "tilt", i);
        Ok(Expression::of(vec![about(0), about(1)]))
    }
}

#[cfg(test)]
mod tests {
    use super::{Effect, Payload};
    use crate::gap::effect::{ModelFile, Place, PlaceKind};

    /// A link of three bodies, the last of which is turned by 90 degrees about x, and has no mass: its y is z of the link.
    const LINK: &str = r#"<mujoco><worldbody><body name="arm"><joint name="j" axis="0 1 0"/><geom size=".01" mass="1"/>
        <body name="hand" pos="0 0 -.2" quat=".70710678 .70710678 0 0"><geom size=".01" mass=".1"/>
        <body name="tip" pos="0 -.05 0"/></body></body></worldbody></mujoco>"#;

    #[test]
    fn a_payload_is_on_the_nearest_body_with_a_mass() {
        let file = ModelFile::of_text(LINK.into(), "link.xml").expect("loads");
        let model = &file.model;
        assert_eq!(Payload.places(model), [Place::at(PlaceKind::Body, "arm")]);
        let from = |name: &str, at: [f64; 3]| {
            let values = [&[0.3][..], &at].concat();
            Payload.nearest(model, &Place::at(PlaceKind::Body, name), &values)
        };
        let (place, values) = from("arm", [0.01, 0.02, -0.24]).expect("another");
        assert_eq!(place.name, "hand");
        for (own, known) in values.iter().zip([0.3, 0.01, -0.04, -0.02]) {
            assert!((own - known).abs() < 1e-7, "{values:?}");
        }
        let (place, values) = from("hand", [0.0, 0.15, 0.0]).expect("another");
        assert_eq!(place.name, "arm");
        assert!((values[3] + 0.05).abs() < 1e-7, "{values:?}");
        assert!(from("hand", [0.0, -0.04, 0.0]).is_none());
        assert!(from("arm", [0.0, 0.0, 0.1]).is_none());
    }
}
