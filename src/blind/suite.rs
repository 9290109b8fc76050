//! The suite file: which machines are made, and what is asked of each.

use std::path::PathBuf;

use serde::Deserialize;

use super::BlindError;
use crate::mjcf::glob;
use crate::mujoco::Model;
use crate::rig::effects::{CATALOGUE, Effect};
use crate::rig::{FamilyConfig, Rig, RigConfig, RigError};

/// A suite file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SuiteConfig {
    /// rig file, relative to this one; what it hides itself is left out
    pub rig: PathBuf,
    /// parameters that are fitted anyway, relative to this file
    pub parameters: PathBuf,
    /// recordings to search in
    pub train: Vec<TrialConfig>,
    /// recordings to verify with
    pub holdout: Vec<TrialConfig>,
    /// most effects a search may name, the same at several places counted once; by default 4
    #[serde(default = "four")]
    pub max_effects: usize,
    /// most windows of a search; by default that of `phantom gap`
    pub most_windows: Option<usize>,
    /// Hz at which simulations are pulled along the recordings; by default as `phantom gap` does
    pub pull_hz: Option<f64>,
    /// s of the search's steps; by default those of `phantom gap`
    pub timestep: Option<f64>,
    /// number of the first machine; by default 0
    #[serde(default)]
    pub first_seed: u64,
    /// groups of cases
    pub arm: Vec<Arm>,
}

/// A recording of every machine.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialConfig {
    /// of [`crate::rig::behaviour`]
    pub behaviour: String,
    /// s; the behaviour's own when absent
    pub seconds: Option<f64>,
    /// which trial of the behaviour; by default 0
    #[serde(default)]
    pub trial: u64,
}

/// What the search should answer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Expect {
    /// `none`, where nothing is hidden; else the name
    #[default]
    Truth,
    /// `unknown`: what is hidden is not in its catalogue
    Unknown,
    /// that nothing can be told: `none`, with the hidden effect among the untestable, or a class with it
    CannotTell,
}

/// A group of cases.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// its name
    pub name: String,
    /// globs of hidden effects, each a case of its own; none: nothing is hidden
    #[serde(default)]
    pub effects: Vec<String>,
    /// globs of `kind/name` of places; by default all
    #[serde(default = "any")]
    pub places: Vec<String>,
    /// effects of a machine at once, drawn among `effects`; by default 1
    #[serde(default = "one")]
    pub together: usize,
    /// factors on the amplitudes of the rig's catalogue, each a case of its own; by default 1
    #[serde(default = "unit")]
    pub severity: Vec<f64>,
    /// factors on the noise of all sensors, each a case of its own; by default 1
    #[serde(default = "unit")]
    pub noise: Vec<f64>,
    /// machines of every kind
    pub machines: u64,
    /// right answer
    #[serde(default)]
    pub expect: Expect,
    /// recordings instead of the suite's
    pub train: Option<Vec<TrialConfig>>,
}

fn four() -> usize {
    4
}

fn one() -> usize {
    1
}

fn any() -> Vec<String> {
    vec!["*".into()]
}

fn unit() -> Vec<f64> {
    vec![1.0]
}

/// One machine, and where it belongs.
#[derive(Debug, Clone, PartialEq)]
pub struct Case {
    /// index of the arm
    pub arm: usize,
    /// effect that is hidden; none: nothing, or several drawn
    pub effect: Option<&'static str>,
    /// factor on amplitudes
    pub severity: f64,
    /// factor on noise
    pub noise: f64,
    /// which machine
    pub seed: u64,
}

impl Case {
    /// Its name in lists of results.
    pub fn key(&self, suite: &SuiteConfig) -> String {
        let arm = &suite.arm[self.arm].name;
        let effect = self.effect.unwrap_or("-");
        format!(
            "{arm}/{effect}/{}/{}/{}",
            self.severity, self.noise, self.seed
        )
    }
}

impl SuiteConfig {
    /// Every case, in order. Effects that have no place in `model` make none.
    ///
    /// # Errors
    /// An arm that makes no case, a number out of range.
    pub fn cases(&self, model: &Model, rig: &RigConfig) -> Result<Vec<Case>, BlindError> {
        let refuse = |reason: String| BlindError::Suite { reason };
        if self.train.is_empty() {
            return Err(refuse("`train` lists no recording".into()));
        }
        let mut cases = Vec::new();
        for (a, arm) in self.arm.iter().enumerate() {
            let bad = |f: &&f64| !(f.is_finite() && **f > 0.0);
            if let Some(f) = arm.severity.iter().chain(&arm.noise).find(bad) {
                return Err(refuse(format!(
                    "arm `{}` has the factor {f}, expected a positive number",
                    arm.name
                )));
            }
            let mut effects: Vec<Option<&'static str>> = vec![None];
            if arm.together == 1 && !arm.effects.is_empty() {
                effects.clear();
                for entry in CATALOGUE {
                    let wanted = arm.effects.iter().any(|g| glob::matches(g, entry.name));
                    if wanted && self.has_place(model, rig, arm, entry.effect)? {
                        effects.push(Some(entry.name));
                    }
                }
            }
            let before = cases.len();
            for &effect in &effects {
                for &severity in &arm.severity {
                    for &noise in &arm.noise {
                        cases.extend((0..arm.machines).map(|i| Case {
                            arm: a,
                            effect,
                            severity,
                            noise,
                            seed: self.first_seed + i,
                        }));
                    }
                }
            }
            if cases.len() == before {
                return Err(refuse(format!(
                    "arm `{}` makes no case: none of its effects has a place in the model",
                    arm.name
                )));
            }
        }
        Ok(cases)
    }

    fn has_place(
        &self,
        model: &Model,
        rig: &RigConfig,
        arm: &Arm,
        effect: Effect,
    ) -> Result<bool, BlindError> {
        let case = Case {
            arm: 0,
            effect: Some(effect.entry().name),
            severity: 1.0,
            noise: 1.0,
            seed: self.first_seed,
        };
        match Rig::new(
            model.try_clone().map_err(RigError::from)?,
            hide(rig, arm, &case),
        ) {
            Ok(_) => Ok(true),
            Err(RigError::Family { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }
}

/// The rig of a case: what its file hides is left out, what the case hides is put in.
pub(super) fn hide(rig: &RigConfig, arm: &Arm, case: &Case) -> RigConfig {
    let mut rig = rig.clone();
    rig.seed = case.seed;
    rig.effect.clear();
    rig.family = None;
    let effects = match case.effect {
        Some(name) => vec![name.to_owned()],
        None => arm.effects.clone(),
    };
    if !effects.is_empty() {
        rig.family = Some(FamilyConfig {
            effects,
            places: arm.places.clone(),
            count: [arm.together; 2],
            severity: case.severity,
        });
    }
    let s = &mut rig.sensing;
    s.encoder_steps_per_rad /= case.noise;
    for sigma in [
        &mut s.command_step,
        &mut s.mocap_sigma_m,
        &mut s.force_sigma_n,
        &mut s.torque_sigma_nm,
        &mut s.force_drift_sigma_n,
        &mut s.torque_drift_sigma_nm,
    ] {
        *sigma *= case.noise;
    }
    rig
}
