//! Drawing the parameters of a model anew for each rollout: the ensembles of the paper.
//!
//! A rule names an element by a glob (`body/p*_base`), an attribute of it, and a distribution. Draws are made from the
//! nominal value, never from the last draw, so that a rollout depends on its own random stream only. When several rules
//! hit the same number they act one after the other: the second draws around what the first left.
//!
//! ```toml
//! [[randomise]]
//! element = "body/p*_base"        # kind/name, `*` and `?` match within the name
//! attribute = "pos"
//! components = [0, 1]             # x and y; all components when absent
//! distribution = { normal = 0.005 }
//! ```

mod ensemble;
mod resolve;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use ensemble::Ensemble;

use crate::mjcf::attribute::bounding_radius;
use crate::mjcf::edit::SURFACE;
use crate::mujoco::{Data, Model, ModelEdit, MujocoError};
use crate::rng::{self, Stream};
use ensemble::Entry;

/// What can be wrong with a rule.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RandomiseError {
    /// The engine refused the edited model.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The rule cannot be applied to this model.
    #[error("randomise rule `{element} {attribute}`: {reason}")]
    Rule {
        /// as configured
        element: String,
        /// as configured
        attribute: String,
        /// what is wrong
        reason: String,
    },
    /// The ensemble does not fit this model.
    #[error("ensemble: {reason}")]
    Ensemble {
        /// what is wrong
        reason: String,
    },
}

/// How a component is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Distribution {
    /// nominal + N(0, sigma²), sigma in the attribute's unit
    Normal(f64),
    /// nominal + U(-half width, half width)
    Uniform(f64),
    /// nominal × exp(N(0, sigma²)); keeps the sign
    LogNormal(f64),
    /// the value itself, the same in every rollout; not below 0 where that makes no sense
    Fixed(f64),
}

/// One rule; see the module.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// `kind/glob`
    pub element: String,
    /// attribute of that kind
    pub attribute: String,
    /// components to draw; empty: all
    #[serde(default)]
    pub components: Vec<usize>,
    /// distribution of each component, independent of the others
    pub distribution: Distribution,
}

impl Rule {
    /// A rule from its parts.
    pub fn new(
        element: &str,
        attribute: &str,
        components: &[usize],
        distribution: Distribution,
    ) -> Self {
        Self {
            element: element.to_owned(),
            attribute: attribute.to_owned(),
            components: components.to_vec(),
            distribution,
        }
    }
}

/// One number of `mjModel` and its nominal value.
#[derive(Debug, Clone, Copy)]
struct Slot {
    array: &'static str,
    index: usize,
    nominal: f64,
}

#[derive(Debug, Clone)]
struct Target {
    slot: Slot,
    positive: bool,
    distribution: Distribution,
    /// numbers that keep their ratio to this one: a body's inertia follows its mass
    followers: Vec<Slot>,
}

impl Target {
    fn sample(&self, around: f64, rng: &mut Stream) -> f64 {
        let value = match self.distribution {
            Distribution::Normal(sigma) => around + sigma * rng::normal(rng),
            Distribution::Uniform(half_width) => {
                around + rng::uniform(rng, -half_width, half_width)
            }
            Distribution::LogNormal(sigma) => around * (sigma * rng::normal(rng)).exp(),
            Distribution::Fixed(value) => return value,
        };
        // a far draw of a wide distribution must not make a body of negative mass: keep a hundredth
        if self.positive {
            value.max(0.01 * around)
        } else {
            value
        }
    }
}

/// Rules bound to a model.
#[derive(Debug, Clone, Default)]
pub struct Randomiser {
    targets: Vec<Target>,
    /// whether the engine's derived constants (inverse weights, subtree masses) depend on a target
    inertial: bool,
    /// geoms whose size is drawn: their bounding radius, which the engine only computes when it compiles, follows
    resized: Vec<usize>,
    /// numbers of the ensemble, and a row of values a model
    entries: Vec<Entry>,
    models: Vec<Vec<f64>>,
}

impl Randomiser {
    /// Resolve `rules` against the elements of `model`.
    ///
    /// # Errors
    /// A rule that matches nothing, an unknown attribute, a component out of range, a spread that is not a number of
    /// at least 0.
    pub fn new(model: &Model, rules: &[Rule]) -> Result<Self, RandomiseError> {
        let mut targets = Vec::new();
        for rule in rules {
            resolve::resolve(model, rule, &mut targets).map_err(|reason| RandomiseError::Rule {
                element: rule.element.clone(),
                attribute: rule.attribute.clone(),
                reason,
            })?;
        }
        let inertial = targets.iter().any(|t| match t.slot.array {
            "body_pos" => model.body_parentid()[t.slot.index / 3] != 0,
            array => !SURFACE.contains(&array),
        });
        let mut resized: Vec<usize> = targets
            .iter()
            .filter(|t| t.slot.array == "geom_size")
            .map(|t| t.slot.index / 3)
            .collect();
        resized.dedup();
        Ok(Self {
            targets,
            inertial,
            resized,
            ..Self::default()
        })
    }

    /// Also take a row of `ensemble` for each draw, before the rules act.
    ///
    /// # Errors
    /// A table that is not whole, or was drawn for another model.
    pub fn with_ensemble(
        mut self,
        model: &Model,
        ensemble: &Ensemble,
    ) -> Result<Self, RandomiseError> {
        self.entries = ensemble
            .resolve(model)
            .map_err(|reason| RandomiseError::Ensemble { reason })?;
        self.inertial |= self
            .entries
            .iter()
            .filter_map(|entry| entry.array())
            .any(|array| !SURFACE.contains(&array) && array != "geom_rbound");
        self.models.clone_from(&ensemble.models);
        Ok(self)
    }

    /// Draw every target from its nominal value into the model of `data`, which should be reset afterwards.
    ///
    /// # Errors
    /// When the engine refuses the drawn model.
    pub fn draw(&self, data: &mut Data, rng: &mut Stream) -> Result<(), RandomiseError> {
        if self.targets.is_empty() && self.models.is_empty() {
            return Ok(());
        }
        // no random number is used up where there is no ensemble: older runs keep their bits
        let row = (!self.models.is_empty()).then(|| {
            let at = rng::uniform(rng, 0.0, self.models.len() as f64) as usize;
            &self.models[at.min(self.models.len() - 1)]
        });
        data.edit_model(|edit| {
            for target in &self.targets {
                for slot in std::iter::once(&target.slot).chain(&target.followers) {
                    slot.set(edit, slot.nominal);
                }
            }
            for (entry, value) in self.entries.iter().zip(row.into_iter().flatten()) {
                entry.set(edit, *value);
            }
            for target in &self.targets {
                let around = target.slot.get(edit);
                let value = target.sample(around, rng);
                target.slot.set(edit, value);
                for follower in &target.followers {
                    let of_follower = follower.get(edit);
                    follower.set(edit, of_follower * value / around);
                }
            }
            for &geom in &self.resized {
                let radius = bounding_radius(edit.model(), geom);
                if let (Some(radius), Some(bound)) = (radius, edit.geom_rbound().get_mut(geom)) {
                    *bound = radius;
                }
            }
            if self.inertial {
                edit.recompute_constants();
            }
        })?;
        Ok(())
    }
}

impl Slot {
    fn get(&self, edit: &ModelEdit<'_>) -> f64 {
        edit.model()
            .numeric_field(self.array)
            .map_or(self.nominal, |array| array[self.index])
    }

    fn set(&self, edit: &mut ModelEdit<'_>, value: f64) {
        if let Some(array) = edit.numeric_field_mut(self.array) {
            array[self.index] = value;
        }
    }
}
