//! What limits the speed of training, as ratios measured in one run.
//!
//! | quantity | definition |
//! | --- | --- |
//! | `closed_loop_ratio` | rate of the sampler on one thread (model draws, resets, observations, policy, noise, rewards) over that of a bare `mj_step` loop through the same states under the same controls |
//! | `thread_scaling` | rate of the sampler on all threads over that on one |
//! | `update_share` | share of the update in an iteration of training |
//! | `peak_mb` | peak resident memory of the process |
//!
//! The policy is one of a few iterations of training, so that the fingers are in contact. Passes alternate and medians
//! are taken, since machines are noisy.

mod recording;

use std::time::Instant;

use serde::Serialize;
use statrs::statistics::{self, OrderStatistics};

use crate::mujoco::{Data, Model};
use crate::rollout::{BatchRequest, Trajectory};
use crate::train::config::TrainConfig;
use crate::train::{TrainError, Trainer};

pub use recording::{RecordingFigures, measure_recording};

/// Alternating passes of which medians are taken.
const PASSES: usize = 7;

/// The figures; see the module.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// sampler over bare loop, one thread
    pub closed_loop_ratio: f64,
    /// all threads over one
    pub thread_scaling: f64,
    /// share of the update in an iteration
    pub update_share: f64,
    /// peak resident memory, MB
    pub peak_mb: f64,
    /// threads
    pub threads: usize,
    /// bare loop, physics steps a second on one thread
    pub bare_steps_per_s: f64,
    /// sampler on one thread, physics steps a second
    pub closed_loop_steps_per_s: f64,
    /// sampler on all threads, physics steps a second
    pub all_threads_steps_per_s: f64,
    /// contacts in the states measured, mean
    pub mean_contacts: f64,
    /// constraint rows in the states measured, mean
    pub mean_constraint_rows: f64,
}

/// Measure, after `warm_up` iterations of training; `progress` is called after each of the phases.
///
/// # Errors
/// When training cannot be set up or the engine fails.
pub fn measure(
    model: &Model,
    config: &TrainConfig,
    threads: usize,
    warm_up: usize,
    mut progress: impl FnMut(),
) -> Result<Figures, TrainError> {
    let mut config = config.clone();
    config.train.evaluate_every = 0;
    let mut trainer = Trainer::new(model.clone(), config.clone(), threads)?;
    for _ in 0..warm_up {
        trainer.advance()?;
        progress();
    }
    let (mut rollout_s, mut update_s) = (0.0, 0.0);
    for _ in 0..PASSES {
        let record = trainer.advance()?;
        rollout_s += record.rollout_s;
        update_s += record.update_s;
        progress();
    }

    // one batch on one thread, its bare replay, and the same batch on all threads
    let single = Trainer::new(model.clone(), config.clone(), 1)?;
    let state = trainer.checkpoint();
    let request = BatchRequest {
        seed: config.train.seed,
        iteration: state.iteration,
        n_trajectory: 64,
        pool: &state.pool,
        pool_share: config.train.continued_share,
    };
    let mut batch = Vec::new();
    let (mut bare, mut closed, mut parallel) = (Vec::new(), Vec::new(), Vec::new());
    let (mut contacts, mut rows, mut steps) = (0, 0, 0);
    for pass in 0..=PASSES {
        let one = rate(&single, &request, &mut batch, state)?;
        let replayed = bare_loop(&single, &request, &batch)?;
        let all = rate(&trainer, &request, &mut batch, state)?;
        progress();
        if pass > 0 {
            closed.push(one);
            bare.push(replayed.rate);
            parallel.push(all);
            contacts += replayed.contacts;
            rows += replayed.rows;
            steps += replayed.steps;
        }
    }
    let ratios = |a: &[f64], b: &[f64]| median(a.iter().zip(b).map(|(x, y)| x / y).collect());
    Ok(Figures {
        closed_loop_ratio: ratios(&closed, &bare),
        thread_scaling: ratios(&parallel, &closed),
        update_share: update_s / (update_s + rollout_s),
        peak_mb: peak_mb().unwrap_or(f64::NAN),
        threads,
        bare_steps_per_s: median(bare),
        closed_loop_steps_per_s: median(closed),
        all_threads_steps_per_s: median(parallel),
        mean_contacts: contacts as f64 / steps as f64,
        mean_constraint_rows: rows as f64 / steps as f64,
    })
}

/// Physics steps a second of one batch.
fn rate(
    trainer: &Trainer,
    request: &BatchRequest<'_>,
    batch: &mut Vec<Trajectory>,
    state: &crate::train::Checkpoint,
) -> Result<f64, TrainError> {
    let begin = Instant::now();
    trainer.sampler().sample(&state.policy, request, batch)?;
    let seconds = begin.elapsed().as_secs_f64();
    let control_steps: usize = batch.iter().map(Trajectory::len).sum();
    Ok((control_steps * trainer.sampler().config().control_hold) as f64 / seconds)
}

struct BareLoop {
    rate: f64,
    contacts: usize,
    rows: usize,
    steps: usize,
}

/// The batch again by `mj_step` alone; only the stepping is timed.
fn bare_loop(
    trainer: &Trainer,
    request: &BatchRequest<'_>,
    batch: &[Trajectory],
) -> Result<BareLoop, TrainError> {
    let sampler = trainer.sampler();
    let n_action = sampler.task().n_action();
    let hold = sampler.config().control_hold;
    let mut result = BareLoop {
        rate: 0.0,
        contacts: 0,
        rows: 0,
        steps: 0,
    };
    let mut seconds = 0.0;
    for (index, trajectory) in batch.iter().enumerate() {
        let mut data: Data = sampler.start(request, index as u64)?;
        let begin = Instant::now();
        for action in trajectory.actions.chunks_exact(n_action) {
            data.ctrl_mut().copy_from_slice(action);
            for _ in 0..hold {
                data.step().map_err(crate::rollout::RolloutError::from)?;
            }
        }
        seconds += begin.elapsed().as_secs_f64();
        result.contacts += data.ncon();
        result.rows += data.nefc();
        result.steps += 1;
        result.rate += (trajectory.len() * hold) as f64;
    }
    result.rate /= seconds;
    Ok(result)
}

fn median(values: Vec<f64>) -> f64 {
    statistics::Data::new(values).median()
}

/// Peak resident memory of this process in MB, where the system tells.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kilobytes / 1024.0)
}
