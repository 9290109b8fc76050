//! One learning step on a small batch of real trajectories, under several settings.

use std::path::Path;

use serde::Serialize;

use super::pushing::random_policy;
use crate::mujoco::Model;
use crate::npg::baseline::Baseline;
use crate::npg::fisher::FisherMode;
use crate::npg::{self, NpgConfig, ValueFrom};
use crate::policy::AffineGaussian;
use crate::rollout::{BatchRequest, Diverged, Trajectory};
use crate::task::push::PushTask;
use crate::team::Deal;
use crate::train::config::TrainConfig;
use crate::train::{Checkpoint, TrainError, Trainer};

/// Trajectories whose values are recorded.
const N_VALUED: usize = 6;
/// The trajectory that is marked as broken down, to see that it is left out.
const BROKEN: usize = 17;

/// A batch and what was made of it.
#[derive(Debug, Serialize)]
pub struct UpdateRecord {
    /// control steps a trajectory
    pub horizon: usize,
    /// the policy that made the trajectories
    pub policy: AffineGaussian,
    /// the value function of the iteration before
    pub previous: Baseline,
    /// groups of observations: name, first column, column after the last
    pub groups: Vec<(&'static str, usize, usize)>,
    /// the batch
    pub trajectories: Vec<BatchEntry>,
    /// updates of the same policy from the same batch
    pub cases: Vec<Case>,
}

/// One trajectory of the batch.
#[derive(Debug, Serialize)]
pub struct BatchEntry {
    /// whether the simulation broke down
    pub diverged: bool,
    /// (T × 36)
    pub observations: Vec<f64>,
    /// (T × 9)
    pub noise: Vec<f64>,
    /// (T)
    pub rewards: Vec<f64>,
    /// (T × 9)
    pub actions: Vec<f64>,
    /// (T + 1 × 38) what the value function sees, the state after the last step included
    pub value_inputs: Vec<f64>,
}

/// One update. Values and advantages are those of the trajectories that did not break down.
#[derive(Debug, Serialize)]
pub struct Case {
    /// settings
    pub config: NpgConfig,
    /// values along the first trajectories, their last states included: from all, from odd, from even trajectories
    pub values: [Vec<Vec<f64>>; 3],
    /// samples of the value fit
    pub value_samples: usize,
    /// its explained variance
    pub explained_variance: f64,
    /// normalised and clipped, of every trajectory
    pub advantages: Vec<Vec<f64>>,
    /// their standard deviation before
    pub advantage_sigma: f64,
    /// share that was clipped
    pub clipped_share: f64,
    /// g
    pub gradient: Vec<f64>,
    /// F⁻¹g
    pub natural_gradient: Vec<f64>,
    /// gᵀF⁻¹g
    pub gradient_norm2: f64,
    /// between the natural gradients of even and odd trajectories
    pub half_cosine: f64,
    /// the same for each group
    pub group_cosines: Vec<f64>,
    /// θ after the step
    pub theta: Vec<f64>,
    /// as promised by the step size
    pub kl_predicted: f64,
    /// as it is
    pub kl_measured: f64,
}

/// Make one iteration of training, roll out the next batch, and compute its update under several settings.
///
/// # Errors
/// When the model does not fit the task, the engine fails, or an update is not defined.
pub fn record(root: &Path, seed: u64) -> Result<UpdateRecord, TrainError> {
    let mut config = TrainConfig::default();
    config.train.seed = seed;
    config.train.trajectories = 81;
    config.train.trajectory_s = 0.5;
    config.train.evaluate_every = 0;
    config.npg.value_stride = 2; // which leaves just enough samples for each half
    let model = Model::from_xml_path(root.join("xml/phantom.xml"))?;
    let task = PushTask::new(&model, config.task.clone())?;
    let mut trainer = Trainer::new(model, config.clone(), 2)?;
    let policy = random_policy(&task, seed, config.npg.initial_log_sigma);
    trainer.restore(Checkpoint {
        policy,
        ..trainer.checkpoint().clone()
    })?;
    trainer.advance()?;

    let Checkpoint {
        iteration,
        policy,
        baseline: previous,
        pool,
        ..
    } = trainer.checkpoint();
    let sampler = trainer.sampler();
    let (n_trajectory, pool_share) = (config.train.trajectories, config.train.continued_share);
    let request = BatchRequest {
        seed,
        iteration: *iteration,
        n_trajectory,
        pool,
        pool_share,
    };
    let mut batch = Vec::new();
    sampler.sample(policy, &request, &mut batch)?;
    mark_as_broken(&mut batch[BROKEN]);

    let groups = sampler.task().observation_groups();
    let horizon = sampler.config().horizon;
    let known = npg::Known {
        horizon,
        groups: &groups,
        symmetries: &[],
    };
    let cases = settings(&config.npg).into_iter().map(|config| {
        let deal = Deal::alone(batch.len());
        let update = || npg::compute(policy, previous, &batch, &deal, &known, &config);
        Ok(case(
            sampler.threads().install(update)?,
            &batch,
            horizon,
            config,
        ))
    });
    let cases = cases.collect::<Result<_, TrainError>>()?;
    Ok(UpdateRecord {
        horizon,
        policy: policy.clone(),
        previous: previous.clone(),
        groups: groups
            .iter()
            .map(|g| (g.name, g.columns.start, g.columns.end))
            .collect(),
        trajectories: batch.iter().map(entry).collect(),
        cases,
    })
}

/// Both metrics with both value functions, white noise, the worst trajectories alone, and one step so long that clipping,
/// floor and step control all act.
fn settings(base: &NpgConfig) -> Vec<NpgConfig> {
    let mut settings = Vec::new();
    for fisher in [FisherMode::Exact, FisherMode::Empirical] {
        for value_from in [ValueFrom::Crossed, ValueFrom::Previous] {
            settings.push(NpgConfig {
                fisher,
                value_from,
                ..base.clone()
            });
        }
    }
    // white noise, as far as the update is concerned
    settings.push(NpgConfig {
        noise_correlation: 0.0,
        ..base.clone()
    });
    settings.push(NpgConfig {
        epopt_epsilon: 0.3,
        ..base.clone()
    });
    settings.push(NpgConfig {
        discount: 0.9,
        gae_lambda: 0.5,
        step_size_delta: 2.0,
        advantage_clip: 1.0,
        fisher_damping: 1e-2,
        log_sigma_floor: base.initial_log_sigma,
        ..base.clone()
    });
    settings
}

fn case(update: npg::Update, batch: &[Trajectory], horizon: usize, config: NpgConfig) -> Case {
    let usable = batch.iter().filter(|t| t.diverged.is_none());
    let valued: Vec<&Trajectory> = usable.take(N_VALUED).collect();
    let values = |baseline: &Baseline| -> Vec<Vec<f64>> {
        let along = |trajectory: &&Trajectory| {
            let mut values = Vec::new();
            baseline.values(&trajectory.value_inputs, 0, horizon, &mut values);
            values
        };
        valued.iter().map(along).collect()
    };
    let fits = update.fit.as_ref();
    let values = fits.map_or_else(Default::default, |fit| {
        let [from_odd, from_even] = &fit.crossed;
        [values(&fit.all), values(from_odd), values(from_even)]
    });
    let report = update.report;
    Case {
        config,
        values,
        value_samples: report.value_fit.map_or(0, |fit| fit.n_sample),
        explained_variance: report
            .value_fit
            .map_or(f64::NAN, |fit| fit.explained_variance),
        advantages: with_samples(update.advantages),
        advantage_sigma: report.advantage_sigma,
        clipped_share: report.clipped_share,
        gradient: update.gradient,
        natural_gradient: update.natural_gradient,
        gradient_norm2: report.gradient_norm2,
        half_cosine: report.half_cosine,
        group_cosines: report
            .group_cosines
            .into_iter()
            .map(|(_, cosine)| cosine)
            .collect(),
        theta: update.policy.parameters(),
        kl_predicted: report.kl_predicted,
        kl_measured: report.kl_measured,
    }
}

/// Those of the trajectories that take part.
fn with_samples(advantages: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let rows = advantages.into_iter();
    rows.filter(|row| !row.is_empty()).collect()
}

fn entry(trajectory: &Trajectory) -> BatchEntry {
    BatchEntry {
        diverged: trajectory.diverged.is_some(),
        observations: trajectory.observations.clone(),
        noise: trajectory.noise.clone(),
        rewards: trajectory.rewards.clone(),
        actions: trajectory.actions.clone(),
        value_inputs: trajectory.value_inputs.clone(),
    }
}

fn mark_as_broken(trajectory: &mut Trajectory) {
    trajectory.diverged = trajectory.visited.clone().map(|start| Diverged {
        reason: "marked".to_owned(),
        step: trajectory.len(),
        start,
        mocap_pos: Vec::new(),
        mocap_quat: Vec::new(),
        actions: Vec::new(),
    });
}
