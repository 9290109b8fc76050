//! Trajectories of a policy on a task, on all threads, the same on any number of them.
//!
//! Every worker owns one [`Data`] with its own copy of the model, made once. Trajectory `i` of iteration `k` draws
//! from the streams (seed, purpose, k, i) and writes to slot `i`, so that neither the number of threads nor their
//! timing can change a bit of the batch.
//!
//! One control step holds the action for `control_hold` physics steps. The loop runs `mj_step2`, `mj_step1` instead of
//! `mj_step`: the same computation in the same order, cut at the point where positions and velocities have just been
//! evaluated, so that observation and reward always belong to the current state.

mod trajectory;

pub use trajectory::{Diverged, ModelDraw, Start, Trajectory};

use std::sync::{Arc, Mutex};

use rayon::prelude::*;
use thiserror::Error;

use crate::exploration::Exploration;
use crate::mujoco::{Data, Integrator, Model, MujocoError};
use crate::policy::{AffineGaussian, PolicyError};
use crate::randomise::{RandomiseError, Randomiser};
use crate::rng::{self, Purpose};
use crate::task::{Task, TaskError};

/// What can go wrong while rolling out (a diverged simulation is not an error, see [`Trajectory::diverged`]).
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RolloutError {
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The task failed.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// A model could not be drawn.
    #[error(transparent)]
    Randomise(#[from] RandomiseError),
    /// The policy does not fit the task.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A recorded breakdown does not belong to this task and model.
    #[error("the dump does not fit the model: {reason}")]
    Dump {
        /// which part, and how
        reason: String,
    },
    /// The threads could not be made.
    #[error("cannot start {threads} threads: {reason}")]
    Threads {
        /// asked for
        threads: usize,
        /// the system's reason
        reason: String,
    },
}

impl RolloutError {
    /// The engine's error at the bottom, if that is what it is.
    pub fn engine(&self) -> Option<&MujocoError> {
        match self {
            Self::Mujoco(engine) => Some(engine),
            Self::Task(error) => error.engine(),
            Self::Randomise(error) => error.engine(),
            _ => None,
        }
    }
}

/// Settings of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RolloutConfig {
    /// control steps a trajectory
    pub horizon: usize,
    /// physics steps for which one action is held
    pub control_hold: usize,
    /// correlation of the exploration noise between control steps
    pub noise_correlation: f64,
}

struct Worker {
    data: Data,
    observation: Vec<f64>,
    value_input: Vec<f64>,
    action: Vec<f64>,
}

/// Rolls out policies on all threads.
pub struct Sampler {
    pool: rayon::ThreadPool,
    workers: Vec<Mutex<Worker>>,
    task: Arc<dyn Task>,
    randomiser: Randomiser,
    config: RolloutConfig,
}

/// Which trajectories to make.
#[derive(Debug, Clone, Copy)]
pub struct BatchRequest<'a> {
    /// seed of the run
    pub seed: u64,
    /// iteration, part of every stream's address
    pub iteration: u64,
    /// number of trajectories
    pub n_trajectory: usize,
    /// states to continue from
    pub pool: &'a [Start],
    /// share of trajectories that begin in a state of `pool`
    pub pool_share: f64,
}

impl Sampler {
    /// Make `threads` workers, each with its own copy of `model`.
    ///
    /// # Errors
    /// When memory or threads cannot be had, or the task needs another number of motors than the model has.
    pub fn new(
        model: &Model,
        task: Arc<dyn Task>,
        randomiser: Randomiser,
        config: RolloutConfig,
        threads: usize,
    ) -> Result<Self, RolloutError> {
        // 0 would mean "as many as there are cores" to the pool, and no worker here
        if threads == 0 {
            let reason = "expected at least 1".to_owned();
            return Err(RolloutError::Threads { threads, reason });
        }
        if task.n_action() != model.nu() {
            let reason = format!("{} actuators, expected {}", model.nu(), task.n_action());
            return Err(TaskError::Model { reason }.into());
        }
        // mj_step2 integrates by Euler whatever the model says
        if model.option().integrator == Integrator::Rk4 {
            let reason =
                "integrator is RK4, which cannot be cut into mj_step1 and mj_step2".to_owned();
            return Err(TaskError::Model { reason }.into());
        }
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("rollout-{i}"))
            .build()
            .map_err(|e| RolloutError::Threads {
                threads,
                reason: e.to_string(),
            })?;
        let workers = (0..threads)
            .map(|_| {
                let data = Data::new(Arc::new(model.try_clone()?))?;
                Ok(Mutex::new(Worker {
                    data,
                    observation: vec![0.0; task.n_observation()],
                    value_input: vec![0.0; task.n_value_input()],
                    action: vec![0.0; task.n_action()],
                }))
            })
            .collect::<Result<_, RolloutError>>()?;
        Ok(Self {
            pool,
            workers,
            task,
            randomiser,
            config,
        })
    }

    /// The task.
    pub fn task(&self) -> &dyn Task {
        self.task.as_ref()
    }

    /// Settings of every trajectory.
    pub fn config(&self) -> RolloutConfig {
        self.config
    }

    /// The threads, for other parallel work.
    pub fn threads(&self) -> &rayon::ThreadPool {
        &self.pool
    }

    /// Roll out `policy`; `batch` is overwritten, its memory reused.
    ///
    /// # Errors
    /// A policy that does not fit the task; else the first failure by trajectory index. A diverged simulation is not
    /// one.
    pub fn sample(
        &self,
        policy: &AffineGaussian,
        request: &BatchRequest<'_>,
        batch: &mut Vec<Trajectory>,
    ) -> Result<(), RolloutError> {
        let all: Vec<usize> = (0..request.n_trajectory).collect();
        self.sample_some(policy, request, &all, batch)
    }

    /// Roll out only the trajectories `indices` of a batch.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn sample_some(
        &self,
        policy: &AffineGaussian,
        request: &BatchRequest<'_>,
        indices: &[usize],
        batch: &mut Vec<Trajectory>,
    ) -> Result<(), RolloutError> {
        policy.check(self.task.n_observation(), self.task.n_action())?;
        batch.resize_with(indices.len(), Trajectory::default);
        let results: Vec<Result<(), RolloutError>> = self.pool.install(|| {
            batch
                .par_iter_mut()
                .zip(indices)
                .with_max_len(1)
                .map(|(trajectory, index)| {
                    let thread = rayon::current_thread_index().unwrap_or(0);
                    // a worker is only ever used by its own thread; a poisoned lock means that thread panicked before
                    let mut worker = self.workers[thread]
                        .lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner);
                    self.roll_out(&mut worker, policy, request, *index as u64, trajectory)
                })
                .collect()
        });
        results.into_iter().collect()
    }

    /// Bring `data` into the start state of trajectory `index`; returns the model it is in.
    fn prepare(
        &self,
        data: &mut Data,
        request: &BatchRequest<'_>,
        index: u64,
    ) -> Result<ModelDraw, RolloutError> {
        let mut rng = rng::stream(request.seed, Purpose::Start, request.iteration, index);
        let continued =
            !request.pool.is_empty() && rng::uniform(&mut rng, 0.0, 1.0) < request.pool_share;
        let start = continued.then(|| {
            let position = rng::uniform(&mut rng, 0.0, request.pool.len() as f64) as usize;
            &request.pool[position.min(request.pool.len() - 1)]
        });
        let draw = start.map_or(
            ModelDraw {
                iteration: request.iteration,
                index,
            },
            |start| start.model,
        );
        self.draw_model(data, request.seed, draw)?;
        match start {
            None => self.task.start(data, &mut rng)?,
            Some(start) => {
                set_start(data, start)?;
                self.task.new_goal(data, &mut rng)?;
            }
        }
        Ok(draw)
    }

    /// A simulation in the start state of trajectory `index`, in the model it would be rolled out in.
    ///
    /// # Errors
    /// As [`Self::sample`].
    pub fn start(&self, request: &BatchRequest<'_>, index: u64) -> Result<Data, RolloutError> {
        let worker = self.workers[0]
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let mut data = Data::new(Arc::new(worker.data.model().try_clone()?))?;
        self.prepare(&mut data, request, index)?;
        Ok(data)
    }

    /// Draw the model of `draw` into `data` and reset it.
    fn draw_model(&self, data: &mut Data, seed: u64, draw: ModelDraw) -> Result<(), RolloutError> {
        let mut rng = rng::stream(seed, Purpose::Model, draw.iteration, draw.index);
        self.randomiser.draw(data, &mut rng)?;
        data.reset();
        Ok(())
    }

    fn roll_out(
        &self,
        worker: &mut Worker,
        policy: &AffineGaussian,
        request: &BatchRequest<'_>,
        index: u64,
        trajectory: &mut Trajectory,
    ) -> Result<(), RolloutError> {
        let Worker {
            data,
            observation,
            value_input,
            action,
        } = worker;
        let (task, horizon) = (self.task.as_ref(), self.config.horizon);
        let model = self.prepare(data, request, index)?;
        let start = Start {
            model,
            qpos: data.qpos().to_vec(),
            qvel: data.qvel().to_vec(),
        };
        let (mocap_pos, mocap_quat) = (data.mocap_pos().to_vec(), data.mocap_quat().to_vec());
        let mut rng = rng::stream(request.seed, Purpose::Exploration, request.iteration, index);
        let visit = rng::uniform(&mut rng, 0.0, horizon as f64) as usize;

        trajectory.clear();
        let control_s = self.control_s(data);
        let mut exploration = Exploration::new(action.len(), self.config.noise_correlation);
        let mut noise = vec![0.0; action.len()];
        task.observe_value(data, value_input);
        trajectory.value_inputs.extend_from_slice(value_input);
        for step in 0..horizon {
            task.observe(data, observation);
            trajectory.observations.extend_from_slice(observation);
            policy.mean(observation, action);
            exploration.perturb(policy.log_sigma(), &mut rng, action, &mut noise);
            trajectory.noise.extend_from_slice(&noise);
            // JSON has no infinities, and any number beyond MuJoCo's range breaks down in the same way
            trajectory.actions.extend(action.iter().map(|&a| {
                if a.is_finite() {
                    a
                } else {
                    f64::MAX.copysign(a)
                }
            }));
            hold(data, action, self.config.control_hold)?;
            task.pass(data, control_s);
            let reward = task.reward(data);
            if let Some(reason) = breakdown(data, reward) {
                let actions = trajectory.actions.clone();
                trajectory.diverged = Some(Diverged {
                    reason,
                    step,
                    start,
                    mocap_pos,
                    mocap_quat,
                    actions,
                });
                return Ok(());
            }
            trajectory.rewards.push(reward);
            task.observe_value(data, value_input);
            trajectory.value_inputs.extend_from_slice(value_input);
            trajectory.distances_m.push(task.distance_m(data));
            if step == visit {
                trajectory.visited = Some(Start {
                    model,
                    qpos: data.qpos().to_vec(),
                    qvel: data.qvel().to_vec(),
                });
            }
        }
        Ok(())
    }

    /// Length of a control step, s.
    fn control_s(&self, data: &Data) -> f64 {
        self.config.control_hold as f64 * data.model().timestep()
    }

    /// Run a recorded breakdown again; returns what is seen this time (`None`: it did not break down).
    ///
    /// # Errors
    /// When the dump does not fit the task and the model, or the engine fails.
    pub fn replay(
        &self,
        seed: u64,
        dump: &Diverged,
    ) -> Result<Option<(usize, String)>, RolloutError> {
        let mut worker = self.workers[0]
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        let data = &mut worker.data;
        let (n, width) = (dump.actions.len(), self.task.n_action());
        if !n.is_multiple_of(width) {
            let reason = format!("`actions` has {n} values, expected a multiple of {width}");
            return Err(RolloutError::Dump { reason });
        }
        self.draw_model(data, seed, dump.start.model)?;
        set_start(data, &dump.start)?;
        copy("mocap_pos", &dump.mocap_pos, data.mocap_pos_mut())?;
        copy("mocap_quat", &dump.mocap_quat, data.mocap_quat_mut())?;
        data.step1()?;
        let control_s = self.control_s(data);
        for (step, action) in dump.actions.chunks_exact(width.max(1)).enumerate() {
            hold(data, action, self.config.control_hold)?;
            self.task.pass(data, control_s);
            if let Some(reason) = breakdown(data, self.task.reward(data)) {
                return Ok(Some((step, reason)));
            }
        }
        Ok(None)
    }
}

/// Apply `action` for `steps` physics steps, leaving positions and velocities evaluated.
///
/// # Errors
/// When the engine fails or `action` has another length than `ctrl`.
pub fn hold(data: &mut Data, action: &[f64], steps: usize) -> Result<(), MujocoError> {
    copy("ctrl", action, data.ctrl_mut())?;
    for _ in 0..steps {
        data.step2()?;
        data.step1()?;
    }
    Ok(())
}

/// Why the simulation can no longer be trusted, if so.
pub fn breakdown(data: &Data, reward: f64) -> Option<String> {
    let warnings = data.warnings();
    if warnings.any() {
        return Some(warnings.to_string());
    }
    (!reward.is_finite()).then(|| format!("reward is {reward}"))
}

fn set_start(data: &mut Data, start: &Start) -> Result<(), MujocoError> {
    copy("qpos", &start.qpos, data.qpos_mut())?;
    copy("qvel", &start.qvel, data.qvel_mut())
}

fn copy(name: &'static str, from: &[f64], to: &mut [f64]) -> Result<(), MujocoError> {
    let (expected, got) = (to.len(), from.len());
    if expected != got {
        return Err(MujocoError::Length {
            name,
            expected,
            got,
        });
    }
    to.copy_from_slice(from);
    Ok(())
}
