//! Two geoms that may touch without the model saying so in a pair.
//!
//! What a contact is like the engine takes then from both geoms ([`Shared`]). An effect of one contact is said in a pair of the
//! two, which has all of that as it is: with an effect of size 0 nothing changes.
//!
//! Source: "Collision detection" and "Contact parameters" in the engine's documentation of version 2.2.

use super::place::{Place, PlaceKind, Site};
use crate::mjcf::structure::Change;
use crate::mujoco::{Model, ObjectKind};

/// Weights of both geoms below this are none, `mjMINVAL`.
const LEAST_MIX: f64 = 1e-15;

/// Geoms with names that may touch by their masks, a moving one first, and are in no pair.
pub(super) fn couples(model: &Model) -> Vec<Place> {
    let name = |g: usize| model.name(ObjectKind::Geom, g);
    let mut out = Vec::new();
    for a in 0..model.ngeom() {
        for b in a + 1..model.ngeom() {
            let (Some(one), Some(other)) = (name(a), name(b)) else {
                continue;
            };
            if !model.may_touch(a, b) || pair_of(model, a, b).is_some() {
                continue;
            }
            let still = |g: usize| model.weld(g) == 0;
            let (first, second) = if still(a) { (other, one) } else { (one, other) };
            out.push(Place {
                with: Some(second.to_owned()),
                ..Place::at(PlaceKind::Geom, first)
            });
        }
    }
    out
}

/// The pair of two geoms.
fn pair_of(model: &Model, a: usize, b: usize) -> Option<usize> {
    let mut pairs = model.pair_geom1().iter().zip(model.pair_geom2());
    pairs.position(|(&g, &h)| [[a, b], [b, a]].contains(&[g as usize, h as usize]))
}

/// What a contact has of its two geoms.
#[derive(Debug, PartialEq)]
struct Shared {
    condim: i32,
    /// two tangents, spin, two of rolling
    friction: [f64; 5],
    solref: [f64; 2],
    solimp: [f64; 5],
    margin: f64,
    gap: f64,
}

impl Shared {
    /// Of the geom of higher priority, or of both.
    fn of(model: &Model, a: usize, b: usize) -> Self {
        let priority = model.geom_priority();
        // the part of the first one
        let part = match priority[a].cmp(&priority[b]) {
            std::cmp::Ordering::Greater => 1.0,
            std::cmp::Ordering::Less => 0.0,
            std::cmp::Ordering::Equal => part(model.geom_solmix()[a], model.geom_solmix()[b]),
        };
        let alike = priority[a] == priority[b];
        let greater = |one: f64, other: f64| match (alike, part == 1.0) {
            (true, _) => one.max(other),
            (false, true) => one,
            (false, false) => other,
        };
        let between = |one: f64, other: f64| part * one + (1.0 - part) * other;
        let of = |all: &[f64], width: usize, k: usize| [a, b].map(|g| all[width * g + k]);
        let both = |[one, other]: [f64; 2], rule: &dyn Fn(f64, f64) -> f64| rule(one, other);
        let slide_spin_roll = [0, 1, 2].map(|k| both(of(model.geom_friction(), 3, k), &greater));
        let [slide, spin, roll] = slide_spin_roll;
        let times = [a, b].map(|g| model.geom_solref()[2 * g] > 0.0);
        let direct = alike && times != [true, true];
        let solref = [0, 1].map(|k| {
            let pair = of(model.geom_solref(), 2, k);
            both(pair, if direct { &f64::min } else { &between })
        });
        let condim = [a, b].map(|g| f64::from(model.geom_condim()[g]));
        Self {
            condim: both(condim, &greater) as i32,
            friction: [slide, slide, spin, roll, roll],
            solref,
            solimp: std::array::from_fn(|k| both(of(model.geom_solimp(), 5, k), &between)),
            margin: both(of(model.geom_margin(), 1, 0), &f64::max),
            gap: both(of(model.geom_gap(), 1, 0), &f64::max),
        }
    }
}

/// Dimensions of the contact of a couple.
pub(super) fn dimension(site: &Site<'_>) -> Option<i32> {
    let other = site.place.with.as_deref()?;
    let other = site.model.id(ObjectKind::Geom, other).ok()?;
    Some(Shared::of(site.model, site.id, other).condim)
}

/// Part of the first of two with these weights.
fn part(one: f64, other: f64) -> f64 {
    match (one >= LEAST_MIX, other >= LEAST_MIX) {
        (true, true) => one / (one + other),
        (false, false) => 0.5,
        (true, false) => 1.0,
        (false, true) => 0.0,
    }
}

/// Name of the pair that the couple `a`, `b` is said in, and what makes it, if it is not there.
pub(super) fn pair(model: &Model, a: usize, b: usize) -> Result<(String, Option<Change>), String> {
    if let Some(pair) = pair_of(model, a, b) {
        let name = model.name(ObjectKind::Pair, pair);
        let name = name.ok_or("their contact pair has no name")?;
        return Ok((name.to_owned(), None));
    }
    let [one, other] = [a, b].map(|g| model.name(ObjectKind::Geom, g).unwrap_or_default());
    let name = format!("{one}_{other}");
    let own = Shared::of(model, a, b);
    let list = |all: &[f64]| {
        let each: Vec<String> = all.iter().map(ToString::to_string).collect();
        each.join(" ")
    };
    let xml = format!(
        r#"<pair name="{name}" geom1="{one}" geom2="{other}" condim="{}" friction="{}" solref="{}" solimp="{}" margin="{}" gap="{}"/>"#,
        own.condim,
        list(&own.friction),
        list(&own.solref),
        list(&own.solimp),
        own.margin,
        own.gap,
    );
    let section = "contact";
    Ok((name, Some(Change::Element { section, xml })))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mjcf::structure;
    use crate::mujoco::Data;

    /// A block that is let go over a table, turned; attributes of both geoms.
    fn block(table: &str, block: &str) -> String {
        format!(
            r#"<mujoco><worldbody><geom name="table" type="plane" size="5 5 1" {table}/>
            <body name="b" pos="0 0 0.06"><freejoint/><geom name="block" type="box" size="0.05 0.04 0.03" {block}/>
            <body name="c" pos="0 0 0.03"><joint axis="1 0 0"/><geom name="lid" size="0.01" mass="0.01"/></body></body>
            </worldbody></mujoco>"#
        )
    }

    /// Where it is after half a second, having been pushed.
    fn end(xml: &str) -> Vec<f64> {
        let model = Arc::new(Model::from_xml_text(xml, "m.xml").expect("a model"));
        let mut data = Data::new(model).expect("data");
        data.qvel_mut()[..6].copy_from_slice(&[1.0, 0.3, 0.0, 0.5, 2.0, 3.0]);
        for _ in 0..250 {
            data.step().expect("a step");
        }
        data.qpos().to_vec()
    }

    #[test]
    fn a_couple_said_as_a_pair_moves_as_it_did() {
        for (table, own) in [
            (
                r#"friction="0.4 0.02 0.001""#,
                r#"friction="0.7 0.001 0.002" condim="4""#,
            ),
            (r#"friction="0.4 0.02 0.001" priority="1" condim="6""#, ""),
            (
                "",
                r#"friction="0.3 0.02 0.001" priority="2" solref="0.01 0.8""#,
            ),
            (
                r#"solref="0.03 1" solmix="3""#,
                r#"solref="0.01 0.7" solimp="0.8 0.9 0.002" margin="0.003""#,
            ),
            (
                r#"solref="-3000 -80" solmix="0""#,
                r#"solref="0.01 0.7" margin="0.004" gap="0.001""#,
            ),
        ] {
            let xml = block(table, own);
            let model = Model::from_xml_text(&xml, "m.xml").expect("a model");
            let places: Vec<String> = couples(&model).iter().map(ToString::to_string).collect();
            // the lid may touch the table, not what it sits on
            assert_eq!(places, ["block+table", "lid+table"]);
            let (_, change) = pair(&model, 1, 0).expect("names");
            let said = structure::change(&xml, &[change.expect("a new pair")]).expect("changed");
            let (before, after) = (end(&xml), end(&said));
            let off = before.iter().zip(&after).map(|(a, b)| (a - b).abs());
            assert!(
                off.fold(0.0, f64::max) < 1e-9,
                "{table} {own}: {before:?} {after:?}"
            );
            let model = Model::from_xml_text(&said, "m.xml").expect("a model");
            assert_eq!(couples(&model).len(), 1);
            assert_eq!(
                pair(&model, 0, 1).expect("names"),
                ("block_table".to_owned(), None)
            );
        }
    }

    #[test]
    fn what_is_kept_apart_does_not_touch() {
        let xml = block("", "").replace(
            "</mujoco>",
            r#"<contact><exclude body1="world" body2="c"/></contact></mujoco>"#,
        );
        let model = Model::from_xml_text(&xml, "m.xml").expect("a model");
        let places: Vec<String> = couples(&model).iter().map(ToString::to_string).collect();
        assert_eq!(places, ["block+table"]);
        let masked = block(r#"contype="2" conaffinity="2""#, "");
        let model = Model::from_xml_text(&masked, "m.xml").expect("a model");
        assert!(couples(&model).is_empty());
    }
}
