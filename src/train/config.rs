//! Settings of a training run: what a TOML file may hold, with defaults and ranges.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::npg::{NpgConfig, NpgError};
use crate::randomise::{Distribution, Ensemble, Rule};
use crate::task::push::PushConfig;

/// A setting out of range.
#[derive(Debug, Error)]
#[error("`{key}` is {value}, expected {expected}")]
pub struct SettingError {
    /// configuration key
    pub key: &'static str,
    /// found
    pub value: String,
    /// accepted range
    pub expected: &'static str,
}

/// A whole training run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// rollouts and schedule
    pub train: ScheduleConfig,
    /// reward and goals
    pub task: PushConfig,
    /// the learning rule
    pub npg: NpgConfig,
    /// model parameters drawn anew for each rollout
    pub randomise: Vec<Rule>,
    /// models drawn beforehand, of which each rollout takes one; rules act on top of it
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ensemble: Option<Ensemble>,
}

/// Rollouts and schedule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ScheduleConfig {
    /// number of policy updates
    pub iterations: u64,
    /// seed of every random stream
    pub seed: u64,
    /// trajectories of the first iteration
    pub trajectories: usize,
    /// the batch grows up to this while the gradients of its halves disagree
    pub max_trajectories: usize,
    /// cosine between the halves' natural gradients below which the batch grows; 0: it stays
    pub growth_cosine: f64,
    /// length of a trajectory, s
    pub trajectory_s: f64,
    /// physics step in training, s (evaluation uses the model's own)
    pub timestep_s: f64,
    /// physics steps for which one action is held
    pub control_hold: usize,
    /// probability to start from a state of a good trajectory of the last iteration
    pub continued_share: f64,
    /// share of trajectories, by mean reward, that count as good
    pub good_share: f64,
    /// object mass in training, kg; the model's when absent
    #[serde(skip_serializing_if = "Option::is_none")]
    pub object_mass_kg: Option<f64>,
    /// standard deviation of the object's mass between rollouts, kg
    pub object_mass_sigma_kg: f64,
    /// standard deviation of each base's position in x and y between rollouts, m
    pub base_sigma_m: f64,
    /// hold the policy the same after turns that change nothing of the model, which makes every sample worth several;
    /// rules of the configuration and ensembles of models rule that out
    pub symmetric: bool,
    /// every how many iterations the mean policy is evaluated on the spiral; 0: never
    pub evaluate_every: u64,
    /// rollouts of such an evaluation
    pub evaluation_rollouts: usize,
    /// every how many iterations a checkpoint is written
    pub checkpoint_every: u64,
}

impl Default for ScheduleConfig {
    fn default() -> Self {
        Self {
            iterations: 60,
            seed: 0,
            trajectories: 200,
            max_trajectories: 800,
            growth_cosine: 0.0,
            trajectory_s: 1.0,
            timestep_s: 0.004,
            control_hold: 2,
            continued_share: 0.4,
            good_share: 0.5,
            object_mass_kg: None,
            object_mass_sigma_kg: 0.0,
            base_sigma_m: 0.005,
            symmetric: true,
            evaluate_every: 5,
            evaluation_rollouts: 10,
            checkpoint_every: 1,
        }
    }
}

impl TrainConfig {
    /// Check every range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn validate(&self) -> Result<(), SettingError> {
        let train = &self.train;
        let check = |key, value: String, ok: bool, expected| {
            if ok {
                Ok(())
            } else {
                Err(SettingError {
                    key,
                    value,
                    expected,
                })
            }
        };
        for (key, value) in [
            ("train.trajectory_s", train.trajectory_s),
            ("train.timestep_s", train.timestep_s),
        ] {
            check(
                key,
                value.to_string(),
                value.is_finite() && value > 0.0,
                "a positive number",
            )?;
        }
        for (key, value) in [
            ("train.object_mass_sigma_kg", train.object_mass_sigma_kg),
            ("train.base_sigma_m", train.base_sigma_m),
        ] {
            check(
                key,
                value.to_string(),
                value.is_finite() && value >= 0.0,
                "a number of at least 0",
            )?;
        }
        for (key, value) in [
            ("train.continued_share", train.continued_share),
            ("train.good_share", train.good_share),
            ("train.growth_cosine", train.growth_cosine),
        ] {
            check(
                key,
                value.to_string(),
                (0.0..=1.0).contains(&value),
                "0 to 1",
            )?;
        }
        for (key, value) in [
            ("train.trajectories", train.trajectories),
            ("train.max_trajectories", train.max_trajectories),
            ("train.control_hold", train.control_hold),
            ("train.evaluation_rollouts", train.evaluation_rollouts),
            ("train.checkpoint_every", train.checkpoint_every as usize),
        ] {
            check(
                key,
                value.to_string(),
                (1..=10_000_000).contains(&value),
                "1 to 10000000",
            )?;
        }
        if let Some(mass) = train.object_mass_kg {
            check(
                "train.object_mass_kg",
                mass.to_string(),
                mass.is_finite() && mass > 0.0,
                "a positive number",
            )?;
        }
        check(
            "train.trajectory_s",
            train.trajectory_s.to_string(),
            (1.0..=1e6).contains(
                &(train.trajectory_s / (train.timestep_s * train.control_hold as f64)).round(),
            ),
            "at least one control step (timestep_s × control_hold) and at most a million",
        )?;
        self.npg.validate().map_err(|error| match error {
            NpgError::Setting {
                key,
                value,
                expected,
            } => SettingError {
                key,
                value: value.to_string(),
                expected,
            },
            other => SettingError {
                key: "npg",
                value: other.to_string(),
                expected: "valid settings",
            },
        })
    }

    /// Control steps a trajectory.
    pub fn horizon(&self) -> usize {
        let control_s = self.train.timestep_s * self.train.control_hold as f64;
        (self.train.trajectory_s / control_s).round() as usize
    }

    /// Whether what rollouts draw is spread the same after every turn of the model: rules and ensembles of the configuration
    /// may tell one robot from the others.
    pub(super) fn keeps_turns(&self) -> bool {
        self.randomise.is_empty() && self.ensemble.is_none()
    }

    /// All rules of the ensemble: bases, object mass, and those of the configuration.
    pub fn rules(&self) -> Vec<Rule> {
        let train = &self.train;
        let mut rules = ensemble_rules(
            train.base_sigma_m,
            train.object_mass_kg,
            train.object_mass_sigma_kg,
        );
        rules.extend(self.randomise.iter().cloned());
        rules
    }
}

/// The paper's ensemble: base positions N(0, `base_sigma_m`²) in the plane, object mass N(`mass_kg`, `mass_sigma_kg`²).
pub fn ensemble_rules(base_sigma_m: f64, mass_kg: Option<f64>, mass_sigma_kg: f64) -> Vec<Rule> {
    let mut rules = Vec::new();
    if let Some(mass) = mass_kg {
        rules.push(Rule::new(
            "body/object",
            "mass",
            &[],
            Distribution::Fixed(mass),
        ));
    }
    if mass_sigma_kg > 0.0 {
        rules.push(Rule::new(
            "body/object",
            "mass",
            &[],
            Distribution::Normal(mass_sigma_kg),
        ));
    }
    if base_sigma_m > 0.0 {
        rules.push(Rule::new(
            "body/p?_base",
            "pos",
            &[0, 1],
            Distribution::Normal(base_sigma_m),
        ));
    }
    rules
}
