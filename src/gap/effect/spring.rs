//! Springs: of a joint, between joints, at the end of a range.

use super::place::{joint_of, joints};
use super::{
    About, Dimension, Effect, Expression, Neighbour, Number, Parameter, Place, PlaceKind, Shows,
    Site,
};
use crate::mjcf::structure::Change;
use crate::mujoco::{Model, ObjectKind};

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
                    let mut place = Place::at(PlaceKind::Joint, a);
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
                // one that begins at 0 would stay there, and a stop that damps is a late motor beside one that does not
                Parameter::shape("damping", Dimension::ForcePerSpeed, &[0.1], [0.0, 10.0]),
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

#[cfg(test)]
mod tests {
    use crate::gap::effect::write;
    use crate::gap::masses::{chosen, machine, searching};

    /// A stop whose damping stayed at 0 was found with a motor that is late.
    #[test]
    fn a_stop_is_found_with_its_damping() {
        const STOP: [f64; 4] = [60.0, 0.02, 1.0, 2.0];
        let base = machine(r#"damping="2" stiffness="5""#, "");
        let law = chosen(&base, "joint_stop", "a", &STOP);
        let hidden = write(&base, law.effect, &law.place, &law.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"damping\"\n";
        searching(&base, &hidden.file, config, |search, watch| {
            while search.forward(None, watch).expect("searched").is_none() {}
            let [found] = &search.chosen[..] else {
                panic!("{:?}", search.chosen);
            };
            assert_eq!(found.effect.about().name, "joint_stop");
            for (own, hidden) in found.values.iter().zip(STOP) {
                assert!((own / hidden - 1.0).abs() < 0.02, "{:?}", found.values);
            }
        });
    }
}
