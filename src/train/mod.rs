//! Algorithm 1 of the paper: roll out, update, repeat.
//!
//! A [`Trainer`] is advanced one iteration at a time and hands back a record of it; it neither prints nor writes. Its
//! whole state is a [`Checkpoint`], from which a run continues to the same bits. In a [`Team`] of processes every one has
//! a trainer and advances it; their states stay the same, to the bit, as that of one process alone.

mod batch_size;
mod checkpoint;
mod columns;
pub mod config;
mod error;
pub mod folder;
mod start_pool;

use std::sync::Arc;
use std::time::Instant;

use crate::evaluate::{self, Evaluation, Rollout};
use crate::mujoco::{Model, MujocoError};
use crate::npg::baseline::Baseline;
use crate::npg::{self, Known, NpgConfig, NpgError, UpdateReport};
use crate::policy::AffineGaussian;
use crate::randomise::Randomiser;
use crate::rollout::{BatchRequest, Diverged, RolloutConfig, Sampler, Trajectory};
use crate::task::push::PushTask;
use crate::task::symmetry::{self, Symmetry};
use crate::task::{ObservationGroup, Task};
use crate::team::{Deal, Team, TeamError};
pub use batch_size::BatchSize;
pub use checkpoint::Checkpoint;
use config::TrainConfig;
pub use error::TrainError;
use start_pool::start_pool;

/// Breakdowns an iteration hands out at most: more of them say nothing new.
const BREAKDOWNS: usize = 100;
/// Seed of every evaluation during training, so that the figures of a run compare.
const EVALUATION_SEED: u64 = 20_180_604;

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
    /// number of trajectories that broke down in this iteration
    pub n_diverged: u64,
    /// the first of them
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
    /// bytes sent and received by the process that had most to do with others
    pub message_bytes: u64,
    /// seconds this process spent on that, waiting included
    pub message_s: f64,
}

/// A training run.
pub struct Trainer {
    team: Arc<Team>,
    config: TrainConfig,
    sampler: Sampler,
    groups: Vec<ObservationGroup>,
    symmetries: Vec<Symmetry>,
    task: Arc<PushTask>,
    model: Arc<Model>, // as loaded, for evaluation
    evaluation_randomiser: Randomiser,
    batch: Vec<Trajectory>, // this process's
    unreported: Vec<Diverged>,
    state: Checkpoint,
}

impl Trainer {
    /// A new run of `config` on `model`, by this process alone.
    ///
    /// # Errors
    /// When a setting is out of range or the model does not fit the task.
    pub fn new(model: Model, config: TrainConfig, threads: usize) -> Result<Self, TrainError> {
        Self::in_team(Arc::new(Team::alone()), model, config, threads)
    }

    /// A new run of `config` on `model` by `team`, on `threads` threads of this process. The others have to be given the
    /// same.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn in_team(
        team: Arc<Team>,
        model: Model,
        config: TrainConfig,
        threads: usize,
    ) -> Result<Self, TrainError> {
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
        let training_model = Arc::new(training_model);
        // single robots that differ from the others by intent make no turn of the whole
        let symmetries = if config.train.symmetric && config.keeps_turns() {
            task.symmetries(&training_model)?
        } else {
            Vec::new()
        };
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
            team,
            groups: task.observation_groups(),
            symmetries,
            config,
            sampler,
            task,
            model: Arc::new(model),
            evaluation_randomiser,
            batch: Vec::new(),
            unreported: Vec::new(),
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

    /// Begin with `policy` in place of zero weights; where it explores less than the settings ask for at the start, it
    /// explores as they say.
    ///
    /// # Errors
    /// When it does not fit the task; the trainer is then unchanged.
    pub fn begin_with(&mut self, mut policy: AffineGaussian) -> Result<(), TrainError> {
        policy.check(self.task.n_observation(), self.task.n_action())?;
        policy.raise_log_sigma(self.config.npg.initial_log_sigma);
        self.state.policy = policy;
        Ok(())
    }

    /// The whole state.
    pub fn checkpoint(&self) -> &Checkpoint {
        &self.state
    }

    /// The processes that advance together.
    pub fn team(&self) -> &Team {
        &self.team
    }

    /// Turns that make no difference to the model: the policy is held the same after each.
    pub fn symmetries(&self) -> &[Symmetry] {
        &self.symmetries
    }

    /// The settings.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// The rollout machinery, for replay and measurements.
    pub fn sampler(&self) -> &Sampler {
        &self.sampler
    }

    /// Breakdowns of the last batch that no record has handed out: those after which [`Trainer::advance`] failed because
    /// every trajectory diverged.
    pub fn unreported_breakdowns(&self) -> impl Iterator<Item = &Diverged> {
        self.unreported.iter()
    }

    /// Make one iteration.
    ///
    /// # Errors
    /// When the engine fails, here or in another process, or every trajectory diverged. An update that cannot be made leaves the policy as it was
    /// and is reported in the record.
    pub fn advance(&mut self) -> Result<IterationRecord, TrainError> {
        let begin = Instant::now();
        let team = Arc::clone(&self.team);
        let traffic = team.traffic();
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
        let n_trajectory = self.state.batch_size.n_trajectory();
        let request = BatchRequest {
            seed: train.seed,
            iteration: self.state.iteration,
            n_trajectory,
            pool: &self.state.pool,
            pool_share: train.continued_share,
        };
        let deal = Deal::new(&team, request.n_trajectory);
        let sampled =
            self.sampler
                .sample_some(&self.state.policy, &request, deal.mine(), &mut self.batch);
        agree(&team, sampled.map_err(TrainError::from))?;
        self.unreported = breakdowns(&deal, &self.batch)?;
        let rollout_s = begin.elapsed().as_secs_f64();

        // policy and value function
        let update_begin = Instant::now();
        let (policy, baseline) = (&mut self.state.policy, &mut self.state.baseline);
        let symmetries = if symmetry::has_all(&self.symmetries, policy) {
            self.symmetries.as_slice()
        } else {
            &[]
        };
        let known = Known {
            horizon: self.sampler.config().horizon,
            groups: &self.groups,
            symmetries,
        };
        let update = self
            .sampler
            .threads()
            .install(|| npg::update(policy, baseline, &self.batch, &deal, &known, &npg_config));
        let update = match update {
            Err(error @ (NpgError::NoTrajectory { .. } | NpgError::Team(_))) => {
                return Err(error.into());
            }
            other => other.map_err(|error| error.to_string()),
        };
        if let Ok(report) = &update {
            self.state.batch_size.follow(report.half_cosine, train);
        }
        let update_s = update_begin.elapsed().as_secs_f64();

        // states to start from
        self.state.pool = start_pool(&deal, &self.batch, train.good_share)?;

        let [n_good, n_diverged, steps, reward, distance, last_distance] =
            deal.totals(|place| {
                let t = &self.batch[place];
                let steps = t.len() as f64;
                if t.diverged.is_some() {
                    return [0.0, 1.0, steps + 1.0, 0.0, 0.0, 0.0];
                }
                let distance = t.distances_m.iter().sum::<f64>() / steps;
                let last_distance = t.distances_m.last().copied().unwrap_or(f64::NAN);
                [1.0, 0.0, steps, t.mean_reward(), distance, last_distance]
            })?;
        let (n_good, n_diverged) = (n_good.max(1.0), n_diverged as u64);
        let physics_steps = steps as u64 * train.control_hold as u64;

        self.state.iteration += 1;
        self.state.physics_steps += physics_steps;
        self.state.n_diverged += n_diverged;

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

        // sums of the same bits make the same policy, on the same kind of processor
        team.same("policy", &(&self.state.policy, &self.state.baseline))?;
        let exchanged = team.traffic();
        let message_bytes = team.all(&(exchanged.bytes - traffic.bytes), u64::max)?;
        self.state.seconds += begin.elapsed().as_secs_f64();

        let log_sigma = self.state.policy.log_sigma();
        let sigma = log_sigma.iter().map(|l| l.exp()).sum::<f64>() / log_sigma.len() as f64;
        Ok(IterationRecord {
            iteration: self.state.iteration,
            reward: reward / n_good,
            distance_cm: 100.0 * distance / n_good,
            final_distance_cm: 100.0 * last_distance / n_good,
            update,
            sigma,
            n_diverged,
            diverged: std::mem::take(&mut self.unreported),
            n_trajectory,
            physics_steps,
            rollout_s,
            update_s,
            evaluate_s,
            evaluation,
            is_best,
            message_bytes,
            message_s: exchanged.time.saturating_sub(traffic.time).as_secs_f64(),
        })
    }

    /// Evaluate the current mean policy on the spiral, with the model's own time step and mass; the steps of the rollouts
    /// are not kept.
    ///
    /// # Errors
    /// When the engine fails, here or in another process.
    pub fn evaluate(&self, seed: u64) -> Result<Evaluation, TrainError> {
        let team = &self.team;
        let n_rollout = self.config.train.evaluation_rollouts;
        let mine: Vec<usize> = (team.rank()..n_rollout).step_by(team.size()).collect();
        let rollouts = self.sampler.threads().install(|| {
            evaluate::rollouts(
                &self.model,
                &self.task,
                &self.evaluation_randomiser,
                &self.state.policy,
                seed,
                &mine,
            )
        });
        let rollouts = agree(team, rollouts.map_err(TrainError::from))?;
        let summaries = mine.into_iter().zip(rollouts).map(|(index, rollout)| {
            (
                index,
                rollout.mean_distance_cm,
                rollout.rms_torque_nm,
                rollout.diverged,
            )
        });
        let mut summaries = team.all(&summaries.collect::<Vec<_>>(), concatenated)?;
        summaries.sort_unstable_by_key(|(index, ..)| *index);
        let rollouts =
            summaries
                .into_iter()
                .map(|(_, mean_distance_cm, rms_torque_nm, diverged)| Rollout {
                    mean_distance_cm,
                    rms_torque_nm,
                    diverged,
                    steps: Vec::new(),
                });
        Ok(Evaluation::of(rollouts.collect()))
    }
}

/// Go on only if everyone can.
fn agree<T>(team: &Team, result: Result<T, TrainError>) -> Result<T, TrainError> {
    team.agree(result, |error| {
        error.engine().is_some_and(MujocoError::is_fatal)
    })
}

/// The first breakdowns of the batch, in trajectory order.
fn breakdowns(deal: &Deal<'_>, batch: &[Trajectory]) -> Result<Vec<Diverged>, TeamError> {
    let broken = deal.mine().iter().zip(batch);
    let mut broken: Vec<(usize, Diverged)> = broken
        .filter_map(|(&index, t)| Some((index, t.diverged.clone()?)))
        .collect();
    broken.truncate(BREAKDOWNS);
    let broken = deal.team().all(&broken, |left, right| {
        let mut all = concatenated(left, right);
        all.sort_unstable_by_key(|(index, _)| *index);
        all.truncate(BREAKDOWNS);
        all
    })?;
    Ok(broken.into_iter().map(|(_, breakdown)| breakdown).collect())
}

fn concatenated<T>(mut left: Vec<T>, right: Vec<T>) -> Vec<T> {
    left.extend(right);
    left
}
