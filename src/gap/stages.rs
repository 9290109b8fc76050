//! Finished stages, kept so that a search that was stopped goes on from them.
//!
//! | stage | what is kept |
//! | --- | --- |
//! | `fit` | the base model's parameters, first states and weights |
//! | `screen` | what the first screen says |
//! | `effect-1`, … | the model after each step of the search |
//! | `windows-of-0.1-s-fit`, … | the same in windows of another length |
//! | `without-payload-fit`, … | the same without an effect that was found |
//! | `toss`, `toss-1`, … | the same of tosses: the first look, then each step |
//! | `nudged`, `nudged-1`, … | the same of pulled simulations: the base model's fit, then each step |
//!
//! What is not kept follows from what is: the same report comes out, to the last bit. Whoever keeps them sees to it that
//! they belong to the same input ([`key`]).

use std::collections::HashMap;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::GapError;
use super::cuts::Cuts;
use super::effect::{Place, named};
use super::evidence::Evidence;
use super::model::{Built, Chosen};
use super::result::{Located, Tested};
use super::run::{Input, MissingSeries, Options};
use super::search::Search;
use super::windows::Windows;
use crate::sysid::shooting::window::State;

/// Where finished stages are kept.
pub trait Keeper {
    /// What was kept of a stage.
    fn load(&mut self, stage: &str) -> Option<Vec<u8>>;

    /// Keeps a stage; where that fails the work is done again another time.
    fn save(&mut self, stage: &str, bytes: &[u8]);
}

/// Keeps nothing.
#[derive(Debug, Clone, Copy)]
pub struct Nowhere;

impl Keeper for Nowhere {
    fn load(&mut self, _: &str) -> Option<Vec<u8>> {
        None
    }

    fn save(&mut self, _: &str, _: &[u8]) {}
}

/// Keeps stages while it lives.
#[derive(Debug, Clone, Default)]
pub struct Kept(HashMap<String, Vec<u8>>);

impl Keeper for Kept {
    fn load(&mut self, stage: &str) -> Option<Vec<u8>> {
        self.0.get(stage).cloned()
    }

    fn save(&mut self, stage: &str, bytes: &[u8]) {
        self.0.insert(stage.to_owned(), bytes.to_vec());
    }
}

/// Stages by longer names.
pub(super) struct Prefixed<'a> {
    pub keeper: &'a mut dyn Keeper,
    pub prefix: String,
}

impl Keeper for Prefixed<'_> {
    fn load(&mut self, stage: &str) -> Option<Vec<u8>> {
        self.keeper.load(&format!("{}{stage}", self.prefix))
    }

    fn save(&mut self, stage: &str, bytes: &[u8]) {
        self.keeper.save(&format!("{}{stage}", self.prefix), bytes);
    }
}

/// What stages depend on, as a hexadecimal number: model, parameters, recordings, options and version.
pub fn key(input: &Input<'_>, options: &Options) -> String {
    let mut hash = Sha256::new();
    hash.update(env!("CARGO_PKG_VERSION"));
    hash.update(input.model.xml.as_bytes());
    hash.update(format!(
        "{:?} {options:?} {:?}",
        input.config, input.protocol
    ));
    for (name, recording) in input.train.iter().chain(input.holdout) {
        hash.update(format!("{name} {recording:?}"));
    }
    hash.update(input.train.len().to_le_bytes());
    format!("{:x}", hash.finalize())
}

/// What the first screen says.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Screened {
    pub located: Vec<Located>,
    pub evidence: Vec<Tested>,
    pub n_candidates: usize,
    pub remaining: Option<f64>,
    pub missing: MissingSeries,
}

pub(super) fn load<T: DeserializeOwned>(keeper: &mut dyn Keeper, stage: &str) -> Option<T> {
    postcard::from_bytes(&keeper.load(stage)?).ok()
}

pub(super) fn save<T: Serialize>(keeper: &mut dyn Keeper, stage: &str, value: &T) {
    if let Ok(bytes) = postcard::to_allocvec(value) {
        keeper.save(stage, &bytes);
    }
}

/// Windows after a fit.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Fit {
    x: Vec<f64>,
    cost: f64,
    origin: Vec<(usize, f64)>,
    states: Vec<(Vec<f64>, Vec<f64>)>,
    trajectories: Vec<Vec<f64>>,
    sigma: Vec<f64>,
    factors: Vec<usize>,
    /// s of the windows
    pub length_s: f64,
}

impl Fit {
    pub(super) fn of(windows: &Windows, x: &[f64], cost: f64) -> Self {
        let state = |s: &State| (s.qpos.clone(), s.qvel.clone());
        Self {
            x: x.to_vec(),
            cost,
            origin: windows.origin.clone(),
            states: windows.states.iter().map(state).collect(),
            trajectories: windows.trajectories.clone(),
            sigma: windows.problem.sigma(),
            factors: windows.factors.clone(),
            length_s: windows.length_s,
        }
    }

    /// Puts it into the windows of the same recordings; parameters and cost, or nothing where it does not fit.
    pub(super) fn restore(self, windows: &mut Windows) -> Option<(Vec<f64>, f64)> {
        let index = |o: &(usize, f64)| windows.origin.iter().position(|p| p == o);
        let kept: Vec<usize> = self.origin.iter().filter_map(index).collect();
        let fits = kept.len() == self.origin.len()
            && self.states.len() == kept.len()
            && self.trajectories.len() == kept.len()
            && self.factors.len() == kept.len()
            && self.sigma.len() == windows.problem.channels.len()
            && self.x.len() == windows.problem.parameters.len();
        if !fits {
            return None;
        }
        *windows = windows.only(&kept);
        windows.states = (self.states.into_iter())
            .map(|(qpos, qvel)| State { qpos, qvel })
            .collect();
        windows.trajectories = self.trajectories;
        windows.factors = self.factors;
        windows.problem.take_sigma(&self.sigma);
        Some((self.x, self.cost))
    }
}

/// The search after a step.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Step {
    /// effect, place, values it was written with, values fitted
    effects: Vec<(String, Place, Vec<f64>, Vec<f64>)>,
    evidence: Vec<Evidence>,
    fit: Fit,
    /// whether nothing more was found
    pub ended: bool,
    /// whether what is known of friction counts little, see [`super::loose`]
    loose: bool,
}

impl Step {
    pub(super) fn of(search: &Search<'_>, ended: bool) -> Self {
        let effects = search.chosen.iter().zip(&search.written).map(|(c, w)| {
            let name = c.effect.about().name.to_owned();
            (name, c.place.clone(), w.values.clone(), c.values.clone())
        });
        Self {
            effects: effects.collect(),
            evidence: search.evidence.clone(),
            fit: Fit::of(&search.windows, &search.x, search.cost),
            ended,
            loose: search.is_loose(),
        }
    }

    /// Puts it into a search that has the base model fitted. `false`: it does not fit, and nothing was changed.
    ///
    /// # Errors
    /// An effect cannot be written.
    pub(super) fn restore(self, search: &mut Search<'_>, cuts: &Cuts) -> Result<bool, GapError> {
        let mut written = Vec::new();
        let mut chosen = Vec::new();
        for (name, place, before, after) in self.effects {
            let Some(effect) = named(&name) else {
                return Ok(false);
            };
            let of = |values| Chosen {
                effect,
                place: place.clone(),
                values,
            };
            written.push(of(before));
            chosen.push(of(after));
        }
        let rules = if self.loose {
            search.loose_rules()
        } else {
            search.rules.clone()
        };
        let built = Built::new(search.base, &rules, &written, &search.measured)?;
        let mut windows = cuts.train(self.fit.length_s)?;
        windows.problem = built.problem(&windows.problem)?;
        let Some((x, cost)) = self.fit.restore(&mut windows) else {
            return Ok(false);
        };
        search.go_on_in(windows, cuts)?;
        search.rules = rules;
        (search.built, search.x, search.cost) = (built, x, cost);
        (search.written, search.chosen) = (written, chosen);
        search.evidence = self.evidence;
        Ok(true)
    }
}
