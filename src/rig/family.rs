//! Families of rigs: a seed draws which effects a machine hides, where and how strong.

use serde::{Deserialize, Serialize};

use super::RigError;
use super::axes::Axis;
use super::config::setting;
use super::effects::{CATALOGUE, Effect, EffectConfig, Entry, Place, candidates, kind};
use crate::mjcf::glob;
use crate::mujoco::Model;
use crate::rng::{self, Stream};

/// How to draw.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FamilyConfig {
    /// globs over names of effects to draw from
    pub effects: Vec<String>,
    /// globs over `kind/name` of places to draw from
    pub places: Vec<String>,
    /// smallest and largest number of effects, drawn evenly
    pub count: [usize; 2],
    /// factor on the amplitudes of the catalogue, and above 1 on the friction that differs with direction
    pub severity: f64,
}

impl Default for FamilyConfig {
    fn default() -> Self {
        Self {
            effects: vec!["*".to_owned()],
            places: vec!["*".to_owned()],
            count: [1, 1],
            severity: 1.0,
        }
    }
}

impl FamilyConfig {
    pub(super) fn validate(&self) -> Result<(), RigError> {
        if self.count[0] > self.count[1] || self.count[1] > CATALOGUE.len() {
            let got = self.count[1] as f64;
            return Err(setting("family.count", got, "[least, most] effects"));
        }
        if !(self.severity.is_finite() && self.severity >= 0.0) {
            let got = self.severity;
            return Err(setting(
                "family.severity",
                got,
                "a finite number of at least 0",
            ));
        }
        let known = |glob: &&String| !CATALOGUE.iter().any(|e| glob::matches(glob, e.name));
        match self.effects.iter().find(known) {
            Some(glob) => Err(RigError::Family {
                reason: format!("`effects` has \"{glob}\", which matches no effect"),
            }),
            None => Ok(()),
        }
    }
}

/// The effects of one machine of the family.
///
/// # Errors
/// [`RigError::Family`] when fewer effects have a place in this model than are wanted.
pub(super) fn draw(
    family: &FamilyConfig,
    model: &Model,
    axes: &[Axis],
    rng: &mut Stream,
) -> Result<Vec<EffectConfig>, RigError> {
    let mut possible: Vec<(&Entry, Vec<String>)> = CATALOGUE
        .iter()
        .filter(|entry| family.effects.iter().any(|g| glob::matches(g, entry.name)))
        .map(|entry| (entry, places(family, model, axes, entry)))
        .filter(|(entry, places)| entry.place == Place::World || !places.is_empty())
        .collect();
    let [least, most] = family.count;
    let n = least + pick(rng, most - least + 1);
    if n > possible.len() {
        return Err(RigError::Family {
            reason: format!(
                "{n} effects are wanted, {} have a place in this model",
                possible.len()
            ),
        });
    }
    let mut drawn = Vec::new();
    for _ in 0..n {
        let chosen = pick(rng, possible.len());
        let (entry, places) = possible.swap_remove(chosen);
        let place = match places.len() {
            0 => String::new(),
            n => places[pick(rng, n)].clone(),
        };
        let with = (entry.effect == Effect::JointCoupling).then(|| {
            // the next joint of the list; a coupling with itself does nothing
            let at = places.iter().position(|p| *p == place).unwrap_or(0);
            places[(at + 1) % places.len()].clone()
        });
        let parameters = entry.parameters.iter().enumerate().map(|(i, p)| {
            let value = rng::uniform(rng, p.low, p.high);
            let factor = match entry.effect {
                Effect::FrictionCone => 1.0,
                _ if i == 0 => family.severity,
                // friction that differs by more than there is of it would push the joint on
                Effect::AsymmetricFriction => family.severity.max(1.0),
                _ => 1.0,
            };
            // the cut of a range is a share: keep it one
            let most = if entry.effect == Effect::TorqueSaturation && i == 0 {
                0.95
            } else {
                f64::INFINITY
            };
            (p.name.to_owned(), (factor * value).min(most))
        });
        drawn.push(EffectConfig {
            name: entry.effect,
            place,
            with,
            parameters: parameters.collect(),
        });
    }
    Ok(drawn)
}

/// Names of the elements an effect is drawn for: motorised joints, bodies with mass.
fn places(family: &FamilyConfig, model: &Model, axes: &[Axis], entry: &Entry) -> Vec<String> {
    candidates(model, axes, entry.place)
        .into_iter()
        .filter(|&id| suits(model, axes, entry.effect, entry.place, id))
        .filter_map(|id| model.name(kind(model, entry.place), id))
        .filter(|name| {
            let full = format!("{}/{name}", entry.place.text());
            family.places.iter().any(|glob| glob::matches(glob, &full))
        })
        .map(str::to_owned)
        .collect()
}

fn suits(model: &Model, axes: &[Axis], effect: Effect, place: Place, id: usize) -> bool {
    let axis = |pick: fn(&Axis) -> usize| axes.iter().find(|axis| pick(axis) == id);
    let free = || model.body_dofnum()[id] == 6;
    let fixed_base = || model.body_parentid()[id] == 0 && model.body_dofnum()[id] == 0;
    match effect {
        Effect::JointCoupling => axes.len() > 1 && axis(|a| a.joint).is_some(),
        Effect::ObjectMass => free(),
        Effect::BasePose => fixed_base() && model.body_mocapid()[id] < 0,
        Effect::LinkMass | Effect::Payload => model.body_mass()[id] > 0.0 && !free(),
        Effect::LengthScale => {
            model.body_dofnum()[id] < 6
                && model.body_pos()[3 * id..3 * id + 3] != [0.0; 3]
                && model.body_parentid()[id] != 0
        }
        Effect::FingertipRadius => touches(model, id) && model.geom_type()[id] == SPHERE,
        Effect::Backlash | Effect::TransmissionCompliance => {
            axis(|a| a.actuator).is_some_and(|a| a.is_plain_motor && a.armature > 0.0)
        }
        Effect::AnisotropicFriction => model.npair() > 0,
        _ if place == Place::Joint => axis(|a| a.joint).is_some(),
        _ => true,
    }
}

/// `mjtGeom` of the engine's model format.
const SPHERE: i32 = 2;

/// Whether a geom can touch another.
fn touches(model: &Model, geom: usize) -> bool {
    let id = geom as i32;
    model.geom_contype()[geom] != 0
        || model.pair_geom1().contains(&id)
        || model.pair_geom2().contains(&id)
}

/// A whole number below `n`.
fn pick(rng: &mut Stream, n: usize) -> usize {
    (rng::uniform(rng, 0.0, n as f64) as usize).min(n - 1)
}
