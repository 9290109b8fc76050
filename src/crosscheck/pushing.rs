//! The pushing task on the three-finger model: simulations, observations, actions, rewards.

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use super::physics::{Advance, Physics, random_controls};
use crate::exploration::Exploration;
use crate::mujoco::{Data, Model};
use crate::policy::AffineGaussian;
use crate::randomise::Randomiser;
use crate::rng::{self, Purpose};
use crate::task::Task;
use crate::task::push::{PushConfig, PushTask, TipDistance};
use crate::train::TrainError;
use crate::train::config::TrainConfig;

const FILE: &str = "xml/phantom.xml";
/// Name of the simulation under the policy.
const UNDER_POLICY: &str = "phantom, policy";
/// Physics steps for which the policy's action is held.
const HOLD: usize = 5;
/// Standard deviations of the random policy's weights: gentle enough for velocities not to be fed back to instability.
const WEIGHT_SIGMA: [(&str, f64); 4] = [
    ("joint_position", 0.1),
    ("joint_velocity", 0.001),
    ("object", 0.5),
    ("goal", 0.5),
];
/// Mean torque that brings each fingertip to the object in the time simulated, N m: turret, upper link, crank.
const INWARD_NM: [f64; 3] = [0.0, 0.0, 0.15];

/// What task and policy made of the states of one simulation.
#[derive(Debug, Serialize)]
pub struct Pushing {
    /// name of the simulation
    pub physics: &'static str,
    /// the policy as it is written to files
    pub policy: AffineGaussian,
    /// names of the observations
    pub observation_names: Vec<String>,
    /// two settings of the reward
    pub configs: Vec<PushConfig>,
    /// states after each control step
    pub samples: Vec<Sample>,
}

/// One state, and what belongs to it.
#[derive(Debug, Serialize)]
pub struct Sample {
    /// (nq)
    pub qpos: Vec<f64>,
    /// (nv)
    pub qvel: Vec<f64>,
    /// (nmocap × 3)
    pub mocap_pos: Vec<f64>,
    /// (36)
    pub observation: Vec<f64>,
    /// (9) mean action here
    pub mean: Vec<f64>,
    /// (9) action that was held on the way here
    pub action: Vec<f64>,
    /// reward of that action, for each setting
    pub rewards: Vec<f64>,
    /// between object and goal, m
    pub distance_m: f64,
}

/// A policy with small random weights whose fingers close on the object.
pub(super) fn random_policy(task: &PushTask, seed: u64, log_sigma: f64) -> AffineGaussian {
    let mut policy = AffineGaussian::zeros(task.n_observation(), task.n_action(), log_sigma)
        .with_names(task.observation_names(), task.action_names());
    let mut theta = policy.parameters();
    let mut rng = rng::stream(seed, Purpose::Policy, 0, 0);
    let width = task.n_observation() + 1;
    for (motor, row) in theta
        .chunks_exact_mut(width)
        .take(task.n_action())
        .enumerate()
    {
        for group in task.observation_groups() {
            let sigma = WEIGHT_SIGMA
                .iter()
                .find(|(name, _)| *name == group.name)
                .map_or(0.0, |(_, sigma)| *sigma);
            row[group.columns]
                .iter_mut()
                .for_each(|weight| *weight = sigma * rng::normal(&mut rng));
        }
        row[width - 1] += INWARD_NM[motor % INWARD_NM.len()];
    }
    for (i, log_sigma) in theta[width * task.n_action()..].iter_mut().enumerate() {
        *log_sigma += 0.02 * i as f64;
    }
    // finite by construction
    policy
        .set_parameters(&theta)
        .unwrap_or_else(|error| unreachable!("{error}"));
    policy
}

/// Simulate the model in randomised start states: under random torques both ways, and under the policy.
///
/// # Errors
/// When the model does not fit the task or the engine fails.
pub fn record(root: &Path, seed: u64) -> Result<(Vec<Physics>, Pushing), TrainError> {
    let model = Arc::new(Model::from_xml_path(root.join(FILE))?);
    let configs = vec![
        PushConfig::default(),
        PushConfig {
            tip_distance: TipDistance::Plane,
            tip_weight: 0.7,
            ..PushConfig::default()
        },
    ];
    let tasks = configs
        .iter()
        .map(|c| PushTask::new(&model, c.clone()))
        .collect::<Result<Vec<_>, _>>()?;
    let task = &tasks[0];
    let mut config = TrainConfig::default();
    config.train.object_mass_sigma_kg = 0.05;
    let randomiser = Randomiser::new(&model, &config.rules())?;
    let start = |index: u64| -> Result<Data, TrainError> {
        let mut data = Data::new(Arc::clone(&model))?;
        randomiser.draw(&mut data, &mut rng::stream(seed, Purpose::Model, 0, index))?;
        data.reset();
        task.start(&mut data, &mut rng::stream(seed, Purpose::Start, 0, index))?;
        Ok(data)
    };

    let mut cases = Vec::new();
    let inward: Vec<f64> = (0..task.n_action())
        .map(|motor| INWARD_NM[motor % INWARD_NM.len()])
        .collect();
    let ways = [
        ("phantom, mj_step", Advance::Step),
        ("phantom, halves", Advance::Halves),
    ];
    for (index, (name, advance)) in (1..).zip(ways) {
        let mut data = start(index)?;
        let mut physics = Physics::new(name, FILE, &model, data.model());
        let control = random_controls(
            rng::stream(seed, Purpose::Exploration, 100, index),
            inward.clone(),
            0.3,
        );
        let mut rng = rng::stream(seed, Purpose::Evaluation, 100, index);
        physics.simulate(&mut data, advance, &mut rng, control)?;
        cases.push(physics);
    }

    let policy = random_policy(task, seed, -2.0);
    let mut data = start(0)?;
    let mut physics = Physics::new(UNDER_POLICY, FILE, &model, data.model());
    let mut samples: Vec<Sample> = Vec::new();
    let mut exploration = Exploration::new(task.n_action(), 0.5);
    let mut noise_rng = rng::stream(seed, Purpose::Exploration, 0, 0);
    let mut noise = vec![0.0; task.n_action()];
    let mut observation = vec![0.0; task.n_observation()];
    let mut rng = rng::stream(seed, Purpose::Evaluation, 0, 0);
    physics.simulate(&mut data, Advance::Halves, &mut rng, |t, data, ctrl| {
        if t % HOLD != 0 {
            return;
        }
        task.observe(data, &mut observation);
        if t > 0 {
            let mut mean = vec![0.0; ctrl.len()];
            policy.mean(&observation, &mut mean);
            samples.push(Sample {
                qpos: data.qpos().to_vec(),
                qvel: data.qvel().to_vec(),
                mocap_pos: data.mocap_pos().to_vec(),
                observation: observation.clone(),
                mean,
                action: ctrl.to_vec(),
                rewards: tasks.iter().map(|task| task.reward(data)).collect(),
                distance_m: task.distance_m(data),
            });
        }
        policy.mean(&observation, ctrl);
        exploration.perturb(policy.log_sigma(), &mut noise_rng, ctrl, &mut noise);
    })?;
    cases.push(physics);
    let observation_names = task.observation_names();
    Ok((
        cases,
        Pushing {
            physics: UNDER_POLICY,
            policy,
            observation_names,
            configs,
            samples,
        },
    ))
}
