//! Algorithm 1 of the paper: roll out, update, repeat.
//!
//! A [`Trainer`] is advanced one iteration at a time and hands back a record of it; it neither prints nor writes. Its
//! whole state is a [`Checkpoint`], from which a run continues to the same bits.

mod batch_size;
pub mod config;

use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::evaluate::{self, Evaluation, EvaluationRequest};
use crate::mujoco::{Model, MujocoError};
use crate::npg::baseline::Baseline;
use crate::npg::{self, NpgConfig, NpgError, UpdateReport};
use crate::policy::{AffineGaussian, PolicyError};
use crate::randomise::{RandomiseError, Randomiser};
use crate::rollout::{
    BatchRequest, Diverged, RolloutConfig, RolloutError, Sampler, Start, Trajectory,
};
use crate::task::push::PushTask;
use crate::task::{ObservationGroup, Task, TaskError};
pub use batch_size::BatchSize;
use config::{SettingError, TrainConfig};

/// Seed of every evaluation during training, so that the figures of a run compare.
const EVALUATION_SEED: u64 = 20_180_604;

/// What can go wrong in training.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A setting is out of range.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The model does not fit the task.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// A randomisation rule is wrong.
    #[error(transparent)]
    Randomise(#[from] RandomiseError),
    /// Rolling out failed.
    #[error(transparent)]
    Rollout(#[from] RolloutError),
    /// The update failed.
    #[error(transparent)]
    Npg(#[from] NpgError),
    /// The checkpoint's policy is unusable.
    #[error("checkpoint: {0}")]
    Policy(#[from] PolicyError),
    /// The checkpoint is unusable.
    #[error("checkpoint: {0}")]
    Checkpoint(String),
}

/// Everything a run needs to go on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkpoint {
    /// iterations done
    pub iteration: u64,
    /// current policy
    pub policy: AffineGaussian,
    /// how many trajectories the next iteration takes
    pub batch_size: BatchSize,
    /// current value function
    pub baseline: Baseline,
    /// states to continue from
    pub pool: Vec<Start>,
    /// physics steps simulated so far
    pub physics_steps: u64,
    /// seconds spent so far
    pub seconds: f64,
    /// trajectories that diverged so far
    pub n_diverged: u64,
    /// best evaluation so far, cm
    pub best_distance_cm: Option<f64>,
}

/// One iteration, as logged.
#[derive(Debug, Clone)]
pub struct IterationRecord {
    /// number of this iteration, from 1
    pub iteration: u64,
    /// mean reward a control step
    pub reward: f64,
    /// mean distance between object and goal, cm
    pub distance_cm: f64,
    /// the same at the end of the trajectories, cm
    pub final_distance_cm: f64,
    /// the update; an error message when it was not made
    pub update: Result<UpdateReport, String>,
    /// mean of exp(log σ), N m
    pub sigma: f64,
    /// trajectories that broke down in this iteration
    pub diverged: Vec<Diverged>,
    /// trajectories of this iteration
    pub n_trajectory: usize,
    /// physics steps of this iteration
    pub physics_steps: u64,
    /// seconds of rolling out
    pub rollout_s: f64,
    /// seconds of the update
    pub update_s: f64,
    /// seconds of the evaluation
    pub evaluate_s: f64,
    /// evaluation, when one was due
    pub evaluation: Option<Evaluation>,
    /// whether it is the best so far
    pub is_best: bool,
}

/// A training run.
pub struct Trainer {
    config: TrainConfig,
    sampler: Sampler,
    groups: Vec<ObservationGroup>,
    task: Arc<PushTask>,
    model: Arc<Model>, // as loaded, for evaluation
    evaluation_randomiser: Randomiser,
    batch: Vec<Trajectory>,
    state: Checkpoint,
}

impl Trainer {
    /// A new run of `config` on `model`.
    ///
    /// # Errors
    /// When a setting is out of range or the model does not fit the task.
    pub fn new(model: Model, config: TrainConfig, threads: usize) -> Result<Self, TrainError> {
        config.validate()?;
        let task = Arc::new(PushTask::new(&model, config.task.clone())?);
        let mut training_model = model.clone();
        let mut edit = training_model.edit();
        edit.set_timestep(config.train.timestep_s)?;
        edit.set_sensors(false); // observations are read from the state
        edit.finish()?;
        let mut randomiser = Randomiser::new(&training_model, &config.rules())?;
        if let Some(ensemble) = &config.ensemble {
            randomiser = randomiser.with_ensemble(&training_model, ensemble)?;
        }
        let rollout = RolloutConfig {
            horizon: config.horizon(),
            control_hold: config.train.control_hold,
            noise_correlation: config.npg.noise_correlation,
        };
        let sampler = Sampler::new(
            &training_model,
            Arc::clone(&task) as Arc<dyn Task>,
            randomiser,
            rollout,
            threads,
        )?;
        // the true mass, whatever mass is trained with; the bases are as uncertain as in training
        let rules = config::ensemble_rules(config.train.base_sigma_m, None, 0.0);
        let evaluation_randomiser = Randomiser::new(&model, &rules)?;
        let policy = AffineGaussian::zeros(
            task.n_observation(),
            task.n_action(),
            config.npg.initial_log_sigma,
        )
        .with_names(task.observation_names(), task.action_names());
        let state = Checkpoint {
            iteration: 0,
            policy,
            batch_size: BatchSize::new(config.train.trajectories),
            baseline: Baseline::zero(task.n_value_input()),
            pool: Vec::new(),
            physics_steps: 0,
            seconds: 0.0,
            n_diverged: 0,
            best_distance_cm: None,
        };
        Ok(Self {
            groups: task.observation_groups(),
            config,
            sampler,
            task,
            model: Arc::new(model),
            evaluation_randomiser,
            batch: Vec::new(),
            state,
        })
    }

    /// Continue from `checkpoint`.
    ///
    /// # Errors
    /// When it does not fit the task or holds a number that is not finite; the trainer is then unchanged.
    pub fn restore(&mut self, checkpoint: Checkpoint) -> Result<(), TrainError> {
        checkpoint
            .policy
            .check(self.task.n_observation(), self.task.n_action())?;
        if !checkpoint.batch_size.is_sound() {
            return Err(TrainError::Checkpoint(
                "`batch_size` has no trajectory or a number that is not finite".into(),
            ));
        }
        if !checkpoint.baseline.is_sound(self.task.n_value_input()) {
            return Err(TrainError::Checkpoint(
                "`baseline` has a wrong length or a number that is not finite".into(),
            ));
        }
        let (nq, nv) = (self.model.nq(), self.model.nv());
        for (index, start) in checkpoint.pool.iter().enumerate() {
            let finite = start.qpos.iter().chain(&start.qvel).all(|x| x.is_finite());
            if start.qpos.len() != nq || start.qvel.len() != nv || !finite {
                return Err(TrainError::Checkpoint(format!(
                    "`pool[{index}]` is not a state of this model (nq {nq}, nv {nv}, all finite)"
                )));
            }
        }
        self.state = checkpoint;
        Ok(())
    }

    /// The whole state.
    pub fn checkpoint(&self) -> &Checkpoint {
        &self.state
    }

    /// The settings.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The rollout machinery, for replay and measurements.
    pub fn sampler(&self) -> &Sampler {
        &self.sampler
    }

    /// Breakdowns of the last batch that no record has handed out: after [`Trainer::advance`] failed because every
    /// trajectory diverged, all of them.
    pub fn unreported_breakdowns(&self) -> impl Iterator<Item = &Diverged> {
        self.batch.iter().filter_map(|t| t.diverged.as_ref())
    }

    /// Make one iteration.
    ///
    /// # Errors
    /// When the engine fails or every trajectory diverged. An update that cannot be made leaves the policy as it was
    /// and is reported in the record.
    pub fn advance(&mut self) -> Result<IterationRecord, TrainError> {
        let begin = Instant::now();
        let train = &self.config.train;

        // this iteration's step length and exploration
        let (delta, ceiling) = self.config.npg.annealed(self.state.iteration);
        self.state
            .policy
            .lower_log_sigma(ceiling.max(self.config.npg.log_sigma_floor));
        let npg_config = NpgConfig {
            step_size_delta: delta,
            ..self.config.npg.clone()
        };

        // trajectories of the current policy
        let request = BatchRequest {
            seed: train.seed,
            iteration: self.state.iteration,
            n_trajectory: self.state.batch_size.n_trajectory(),
            pool: &self.state.pool,
            pool_share: train.continued_share,
        };
        self.sampler
            .sample(&self.state.policy, &request, &mut self.batch)?;
        let rollout_s = begin.elapsed().as_secs_f64();

        // policy and value function
        let update_begin = Instant::now();
        let (policy, baseline) = (&mut self.state.policy, &mut self.state.baseline);
        let horizon = self.sampler.config().horizon;
        let update = self.sampler.threads().install(|| {
            npg::update(
                policy,
                baseline,
                &self.batch,
                horizon,
                &self.groups,
                &npg_config,
            )
        });
        let update = match update {
            Err(error @ NpgError::NoTrajectory { .. }) => return Err(error.into()),
            other => other.map_err(|error| error.to_string()),
        };
        if let Ok(report) = &update {
            self.state.batch_size.follow(report.half_cosine, train);
        }
        let update_s = update_begin.elapsed().as_secs_f64();

        // states to start from
        let good: Vec<&Trajectory> = self.batch.iter().filter(|t| t.diverged.is_none()).collect();
        self.state.pool = start_pool(&good, train.good_share);

        let steps: usize = self
            .batch
            .iter()
            .map(|t| t.len() + usize::from(t.diverged.is_some()))
            .sum();
        let physics_steps = (steps * train.control_hold) as u64;
        let n = good.len().max(1) as f64;
        let mean = |f: &dyn Fn(&Trajectory) -> f64| good.iter().map(|t| f(t)).sum::<f64>() / n;
        let reward = mean(&Trajectory::mean_reward);
        let distance_cm = 100.0 * mean(&|t| t.distances_m.iter().sum::<f64>() / t.len() as f64);
        let final_distance_cm =
            100.0 * mean(&|t| t.distances_m.last().copied().unwrap_or(f64::NAN));
        let diverged: Vec<Diverged> = self
            .batch
            .iter_mut()
            .filter_map(|t| t.diverged.take())
            .collect();

        self.state.iteration += 1;
        self.state.physics_steps += physics_steps;
        self.state.n_diverged += diverged.len() as u64;

        // evaluation of the mean policy
        let evaluate_begin = Instant::now();
        let every = train.evaluate_every;
        let due = every > 0
            && (self.state.iteration.is_multiple_of(every)
                || self.state.iteration == train.iterations);
        let evaluation = if due {
            Some(self.evaluate(EVALUATION_SEED)?)
        } else {
            None
        };
        let is_best = evaluation.as_ref().is_some_and(|e| {
            e.rollouts.iter().all(|r| r.diverged.is_none())
                && self
                    .state
                    .best_distance_cm
                    .is_none_or(|best| e.mean_distance_cm < best)
        });
        if let (true, Some(evaluation)) = (is_best, &evaluation) {
            self.state.best_distance_cm = Some(evaluation.mean_distance_cm);
        }
        let evaluate_s = evaluate_begin.elapsed().as_secs_f64();
        self.state.seconds += begin.elapsed().as_secs_f64();

        let log_sigma = self.state.policy.log_sigma();
        let sigma = log_sigma.iter().map(|l| l.exp()).sum::<f64>() / log_sigma.len() as f64;
        Ok(IterationRecord {
            iteration: self.state.iteration,
            reward,
            distance_cm,
            final_distance_cm,
            update,
            sigma,
            diverged,
            n_trajectory: self.batch.len(),
            physics_steps,
            rollout_s,
            update_s,
            evaluate_s,
            evaluation,
            is_best,
        })
    }

    /// Evaluate the current mean policy on the spiral, with the model's own time step and mass.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn evaluate(&self, seed: u64) -> Result<Evaluation, TrainError> {
        let request = EvaluationRequest {
            n_rollout: self.config.train.evaluation_rollouts,
            seed,
        };
        Ok(self.sampler.threads().install(|| {
            evaluate::evaluate(
                &self.model,
                &self.task,
                &self.evaluation_randomiser,
                &self.state.policy,
                request,
            )
        })?)
    }
}

/// One visited state of each trajectory in the best `share` by mean reward, in trajectory order.
fn start_pool(trajectories: &[&Trajectory], share: f64) -> Vec<Start> {
    let mut rewards: Vec<f64> = trajectories.iter().map(|t| t.mean_reward()).collect();
    rewards.sort_by(f64::total_cmp);
    let n_good = (share * rewards.len() as f64).round() as usize;
    let Some(threshold) = rewards
        .len()
        .checked_sub(n_good)
        .and_then(|i| rewards.get(i))
    else {
        return Vec::new();
    };
    trajectories
        .iter()
        .filter(|t| t.mean_reward() >= *threshold)
        .filter_map(|t| t.visited.clone())
        .collect()
}
