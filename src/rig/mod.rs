//! A virtual rig: a machine to identify whose truth is known and sealed.
//!
//! ```text
//! rig file + seed ──> true machine ── inner steps ──> sensors ──> recording
//!        model ──> controller (sensed state only) ──^
//! ```
//!
//! The truth differs from the model in the integration step, in parameters drawn by the seed, in hidden [`effects`], and
//! is seen through `sensing`. It leaves this module in [`Truth`] alone: a recording says nothing of it.
//!
//! One control step: read the encoders, command, `plant` through the inner steps, record. The samples of a control
//! step are those of its beginning.

mod axes;
pub mod behaviour;
mod config;
pub mod effects;
mod estimate;
mod family;
mod plant;
mod sensing;
pub mod tracking;
mod truth;

pub use axes::{Axis, axes};
pub use config::{Physics, RigConfig, Scheme, SensingConfig};
pub use estimate::Estimate;
pub use family::FamilyConfig;
pub use truth::{TrueEffect, TrueParameter, Truth};

use std::sync::Arc;
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::mujoco::{Data, Model, MujocoError, ObjectKind};
use crate::policy::PolicyError;
use crate::randomise::{RandomiseError, Randomiser};
use crate::recording::{Meta, Recording};
use crate::rng::{self, Purpose};
use crate::task::TaskError;
use behaviour::Behaviour;
use effects::Bound;
use plant::Plant;
use sensing::{Calibration, Sensors};

/// What can be wrong with a rig.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RigError {
    /// The engine refused.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// A rule of `[[randomise]]` is wrong.
    #[error(transparent)]
    Randomise(#[from] RandomiseError),
    /// The model is not one of the pushing task.
    #[error(transparent)]
    Task(#[from] TaskError),
    /// The policy is not one of the pushing task.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// A number of the rig file is out of range.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// key
        key: &'static str,
        /// found
        value: f64,
        /// accepted
        expected: &'static str,
    },
    /// An effect does not fit the model.
    #[error("effect `{name}`: {reason}")]
    Effect {
        /// as in the catalogue
        name: &'static str,
        /// what is wrong
        reason: String,
    },
    /// A family cannot be drawn.
    #[error("family: {reason}")]
    Family {
        /// what is wrong
        reason: String,
    },
    /// No such behaviour.
    #[error("there is no behaviour `{name}`; there are: {known}")]
    Behaviour {
        /// asked for
        name: String,
        /// those there are
        known: String,
    },
    /// The model lacks something.
    #[error("the model does not fit: {reason}")]
    Model {
        /// what
        reason: String,
    },
}

/// One recording of a machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// number; sensor noise and random phases differ from one to the next
    pub number: u64,
    /// what is done, for the notes of the recording
    pub label: String,
    /// duration, s
    pub seconds: f64,
}

impl Trial {
    /// Address of its random streams: trials of other behaviours share no noise.
    fn stream(&self) -> u64 {
        // FNV-1a of the label; spreads short names over all bits
        let hash = self
            .label
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
            });
        hash.wrapping_add(self.number)
    }
}

/// Where the time of a recording went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Cost {
    /// inner steps of the true machine
    pub simulation: Duration,
    /// the controller
    pub control: Duration,
    /// sensors and recording
    pub recording: Duration,
}

/// What came of a trial.
#[derive(Debug)]
pub struct Outcome {
    /// up to the breakdown, if there was one
    pub recording: Recording,
    /// why the simulation broke down
    pub diverged: Option<String>,
    /// where the time went
    pub cost: Cost,
    /// largest overrun of a joint limit by an axis in truth, rad or m; negative: the smallest distance kept
    pub limit_overrun: f64,
}

/// A machine drawn from a rig file.
#[derive(Debug)]
pub struct Rig {
    config: RigConfig,
    seed: u64,
    nominal: Arc<Model>,
    truth_model: Arc<Model>,
    axes: Vec<Axis>,      // as the controller has them
    true_axes: Vec<Axis>, // as they are
    effects: Vec<Bound>,
    calibration: Calibration,
    truth: Truth,
    start: Option<usize>, // keyframe
    rate_hz: f64,
}

impl Rig {
    /// Draw the machine of `config` and its seed, described by `model`.
    ///
    /// # Errors
    /// [`RigError`] for a configuration that does not fit the model.
    pub fn new(model: Model, config: RigConfig) -> Result<Self, RigError> {
        config.validate()?;
        let seed = config.seed;
        let axes = axes(&model);
        if axes.is_empty() {
            return Err(RigError::Model {
                reason: "no actuator drives a joint".to_owned(),
            });
        }
        let start = start(&model, &config)?;
        let rate_hz = config.physics.rate_hz.unwrap_or(1.0 / model.timestep());
        let mut configs = config.effect.clone();
        if let Some(family) = &config.family {
            let mut rng = rng::stream(seed, Purpose::Rig, 0, 2);
            configs.extend(family::draw(family, &model, &axes, &mut rng)?);
        }
        let effects = effects::bind(&model, &axes, &configs)?;
        let mut truth_model = draw_parameters(&model, &config, seed)?;
        change(&mut truth_model, &effects, &config, rate_hz)?;
        let true_axes = axes::axes(&truth_model);
        let calibration = Calibration::draw(&model, &axes, &config.sensing, &effects, seed);
        let (true_effects, mut parameters) = truth::effects(&model, &effects);
        parameters.extend(truth::model_differences(&model, &truth_model));
        parameters.extend(calibration.rows(&model, &axes));
        plant::move_rotors(&mut truth_model, &plant::sprung_dofs(&axes, &effects))?;
        Ok(Self {
            truth: Truth {
                seed,
                effect: true_effects,
                parameter: parameters,
            },
            config,
            seed,
            nominal: Arc::new(model),
            truth_model: Arc::new(truth_model),
            axes,
            true_axes,
            effects,
            calibration,
            start,
            rate_hz,
        })
    }

    /// What is true of the machine.
    pub fn truth(&self) -> &Truth {
        &self.truth
    }

    /// The machine as a model, to train on what no real machine tells, and the names of effects it cannot express.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn true_model(&self) -> Result<(Model, Vec<&'static str>), RigError> {
        Ok(truth::as_model(
            &self.nominal,
            &self.truth_model,
            &self.effects,
        )?)
    }

    /// The model the machine is described by.
    pub fn model(&self) -> &Model {
        &self.nominal
    }

    /// Control steps a second.
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// The controller's view at the start.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn estimate(&self) -> Result<Estimate, RigError> {
        let data = self.at_start(&self.nominal)?;
        Ok(Estimate::new(&self.nominal, &self.axes, data.qpos())?)
    }

    /// A named behaviour for a trial.
    ///
    /// # Errors
    /// When the model lacks what the behaviour acts on.
    pub fn behaviour(
        &self,
        entry: &behaviour::Entry,
        trial: &Trial,
    ) -> Result<Box<dyn Behaviour>, RigError> {
        let rng = rng::stream(trial.number, Purpose::Excitation, trial.stream(), 0);
        entry.build(&mut self.estimate()?, trial.seconds, rng)
    }

    fn at_start(&self, model: &Arc<Model>) -> Result<Data, MujocoError> {
        let mut data = Data::new(Arc::clone(model))?;
        if let Some(key) = self.start {
            data.reset_to_keyframe(key)?;
        }
        Ok(data)
    }

    /// Make the machine do something and record it; `progress` is told the share done, now and then.
    ///
    /// # Errors
    /// When the engine refuses; a simulation that breaks down is an [`Outcome`].
    pub fn record(
        &self,
        behaviour: &mut dyn Behaviour,
        trial: &Trial,
        mut progress: impl FnMut(f64),
    ) -> Result<Outcome, RigError> {
        let data = self.at_start(&self.truth_model)?;
        let mut plant = Plant::new(data, &self.true_axes, &self.effects)?;
        let mut estimate = self.estimate()?;
        let mut sensors = Sensors::new(self, behaviour.goal(0.0).is_some(), trial)?;
        let n = self.axes.len();
        let (mut position, mut velocity) = (vec![0.0; n], vec![0.0; n]);
        let mut ctrl = vec![0.0; self.nominal.nu()];
        let substeps = self.config.physics.substeps;
        let n_tick = (trial.seconds * self.rate_hz).round() as u64;
        let inner_s = 1.0 / (self.rate_hz * substeps as f64);
        let mut cost = Cost::default();
        let mut diverged = None;
        let mut limit_overrun = f64::NEG_INFINITY;
        for tick in 0..n_tick {
            let time_s = tick as f64 / self.rate_hz;
            let begin = Instant::now();
            let (data, springs) = (&plant.data, &plant.transmissions);
            sensors.read_encoders(&self.axes, data, springs, &mut position, &mut velocity);
            let sensed = Instant::now();
            estimate.update(&position, &velocity, sensors.last_place())?;
            behaviour.command(time_s, &mut estimate, &mut ctrl)?;
            let controlled = Instant::now();
            sensors.quantise(&mut ctrl);
            let samples = [&position[..], &velocity, &ctrl];
            sensors.record(tick, time_s, samples, behaviour.goal(time_s));
            let mut watching = controlled.elapsed();
            let stepping = Instant::now();
            let mut watched = Duration::ZERO;
            for k in 0..substeps {
                plant.step(&ctrl)?;
                // a clock costs more than most looks; those that may store something are timed
                let first = k == 0;
                let look = first.then(Instant::now);
                let time_s = time_s + k as f64 * inner_s;
                sensors.observe(time_s, &plant.data, first.then_some(tick));
                watched += look.map_or(Duration::ZERO, |look| look.elapsed());
            }
            cost.simulation += stepping.elapsed().saturating_sub(watched);
            watching += watched;
            cost.recording += (sensed - begin) + watching;
            cost.control += controlled - sensed;
            limit_overrun = limit_overrun.max(self.overrun(&plant.data));
            let warnings = plant.data.warnings();
            if warnings.diverged() {
                diverged = Some(format!("{warnings} at {time_s:.4} s"));
                break;
            }
            if tick.is_multiple_of(200) {
                progress(tick as f64 / n_tick as f64);
            }
        }
        Ok(Outcome {
            recording: Recording {
                meta: Meta {
                    model_hash: self.nominal.fingerprint()?,
                    source: "virtual rig".to_owned(),
                    trial: format!("{} {}", trial.label, trial.number),
                    ..Meta::default()
                },
                streams: sensors.into_streams(),
            },
            diverged,
            cost,
            limit_overrun,
        })
    }

    /// The simulation of a trial without sensors and recording, driven by `controls` (one row a control step).
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn replay(&self, controls: &[f64]) -> Result<Duration, RigError> {
        let mut model = self.truth_model.try_clone()?;
        model.edit().set_sensors(false);
        let data = self.at_start(&Arc::new(model))?;
        let mut plant = Plant::new(data, &self.true_axes, &self.effects)?;
        let begin = Instant::now();
        for ctrl in controls.chunks_exact(self.nominal.nu()) {
            for _ in 0..self.config.physics.substeps {
                plant.step(ctrl)?;
            }
        }
        Ok(begin.elapsed())
    }

    fn overrun(&self, data: &Data) -> f64 {
        self.axes
            .iter()
            .filter_map(|axis| {
                let [low, high] = axis.joint_range?;
                let q = data.qpos()[axis.qpos];
                Some((low - q).max(q - high))
            })
            .fold(f64::NEG_INFINITY, f64::max)
    }
}

/// The keyframe to start from.
fn start(model: &Model, config: &RigConfig) -> Result<Option<usize>, RigError> {
    match &config.keyframe {
        Some(name) => Ok(Some(model.id(ObjectKind::Keyframe, name)?)),
        None => Ok((model.count(ObjectKind::Keyframe) > 0).then_some(0)),
    }
}

/// The model with the parameters of the machine `seed`.
fn draw_parameters(model: &Model, config: &RigConfig, seed: u64) -> Result<Model, RigError> {
    let randomiser = Randomiser::new(model, &config.randomise)?;
    let mut data = Data::new(Arc::new(model.try_clone()?))?;
    randomiser.draw(&mut data, &mut rng::stream(seed, Purpose::Rig, 0, 0))?;
    Ok(data.model().try_clone()?)
}

/// Put the effects that are numbers into `model`, and the finer integration.
fn change(
    model: &mut Model,
    effects: &[Bound],
    config: &RigConfig,
    rate_hz: f64,
) -> Result<(), RigError> {
    let mut edit = model.edit();
    for bound in effects {
        effects::model::apply(&mut edit, bound).map_err(|reason| RigError::Effect {
            name: bound.effect.entry().name,
            reason,
        })?;
    }
    let mut option = edit.model().option();
    option.timestep = 1.0 / (rate_hz * config.physics.substeps as f64);
    if let Some(scheme) = config.physics.integrator {
        option.integrator = scheme.into();
    }
    edit.set_option(&option)?;
    edit.set_sensors(true);
    if effects.is_empty() {
        return Ok(());
    }
    Ok(edit.finish()?)
}
