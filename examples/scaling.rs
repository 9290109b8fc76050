//! What training costs by phase, and what messages cost: the parameters of the scaling model in docs/mpi.md, as JSON.
//!
//! ```sh
//! cargo build --release --features mpi --example scaling
//! target/release/examples/scaling                  # rollouts, update, evaluation, on one thread
//! mpirun -n 2 target/release/examples/scaling      # messages between processes, by length
//! ```

use std::hint::black_box;
use std::time::Instant;

use phantom::mujoco::Model;
use phantom::npg;
use phantom::rollout::{BatchRequest, Trajectory};
use phantom::team::{Deal, Team};
use phantom::train::Trainer;
use phantom::train::config::TrainConfig;

type Failure = Box<dyn std::error::Error>;

/// Iterations of training before anything is measured, so that the fingers are in contact.
const WARM_UP: usize = 3;
/// Trajectories of which each is timed.
const TIMED: usize = 60;
/// Of which the fastest counts: what else runs on the machine can only slow one down.
const PASSES: usize = 25;
/// Trajectories of the updates that are timed: from what a process has when there are many to more than all.
const UPDATES: [usize; 4] = [8, 50, 200, 600];

#[allow(clippy::print_stdout)] // an example
fn main() -> Result<(), Failure> {
    let team = Team::from_environment()?;
    let result = if team.size() > 1 {
        messages(&team)?
    } else {
        phases()?
    };
    if team.is_first() {
        println!("{}", serde_json::to_string_pretty(&result)?);
    }
    team.finish();
    Ok(())
}

/// Seconds of one sum over all processes, result to all, by the length of the sum in bytes.
fn messages(team: &Team) -> Result<serde_json::Value, Failure> {
    let deal = Deal::new(team, 0); // no trajectories: eight lanes of nothing, so that sending is what takes time
    let mut rows = Vec::new();
    for length in [1, 1 << 7, 1 << 10, 1 << 13, 1 << 15, 1 << 17, 1 << 19] {
        let times = (0..PASSES).map(|_| {
            team.all(&0, usize::max)?; // together again
            let begin = Instant::now();
            black_box(deal.halves(|_| vec![1.0; length])?);
            Ok::<_, Failure>(begin.elapsed().as_secs_f64())
        });
        let seconds = fastest(times)?;
        rows.push(serde_json::json!({ "bytes": 8 * length, "seconds": seconds }));
    }
    Ok(serde_json::json!({ "processes": team.size(), "sums": rows }))
}

/// Seconds of a processor for each phase of an iteration.
fn phases() -> Result<serde_json::Value, Failure> {
    let mut config = TrainConfig::default();
    config.train.evaluate_every = 0;
    let model = Model::from_xml_path("xml/phantom.xml")?;
    let mut trainer = Trainer::new(model, config.clone(), 1)?;
    for _ in 0..WARM_UP {
        trainer.advance()?;
    }
    let state = trainer.checkpoint();
    let sampler = trainer.sampler();
    let request = |n_trajectory| BatchRequest {
        seed: config.train.seed,
        iteration: state.iteration,
        n_trajectory,
        pool: &state.pool,
        pool_share: config.train.continued_share,
    };

    let mut one = Vec::new();
    let mut times = Vec::new();
    for index in 0..TIMED {
        let begin = sampler.threads().install(busy_s)?;
        sampler.sample_some(&state.policy, &request(TIMED), &[index], &mut one)?;
        times.push(sampler.threads().install(busy_s)? - begin);
    }
    let mean = times.iter().sum::<f64>() / TIMED as f64;
    let variance = times.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / TIMED as f64;

    // a constant part, and one in proportion to the trajectories
    let mut batch: Vec<Trajectory> = Vec::new();
    let mut update = |n| -> Result<f64, Failure> {
        sampler.sample(&state.policy, &request(n), &mut batch)?;
        let (deal, groups) = (Deal::alone(n), sampler.task().observation_groups());
        let known = npg::Known {
            horizon: sampler.config().horizon,
            groups: &groups,
            symmetries: trainer.symmetries(),
        };
        let compute = || -> Result<f64, Failure> {
            let begin = busy_s()?;
            black_box(npg::compute(
                &state.policy,
                &state.baseline,
                &batch,
                &deal,
                &known,
                &config.npg,
            )?);
            Ok(busy_s()? - begin)
        };
        let install = |_| {
            let time = sampler
                .threads()
                .install(|| compute().map_err(|e| e.to_string()));
            Ok(time?)
        };
        let times = (0..PASSES).map(install);
        fastest(times)
    };
    let points = UPDATES.map(|n| update(n).map(|seconds| (n as f64, seconds)));
    let points = points.into_iter().collect::<Result<Vec<_>, _>>()?;
    let (constant, slope) = line(&points);

    let begin = sampler.threads().install(busy_s)?;
    let evaluation = trainer.evaluate(1)?;
    let evaluation_s = sampler.threads().install(busy_s)? - begin;
    let evaluation_s = evaluation_s / evaluation.rollouts.len() as f64;
    Ok(serde_json::json!({
        "rollout_s": mean,
        "rollout_sigma_s": variance.sqrt(),
        "update_s_per_trajectory": slope,
        "update_s": constant,
        "updates": points.iter().map(|&(n, seconds)| serde_json::json!({
            "trajectories": n, "seconds": seconds, "line_s": constant + slope * n,
        })).collect::<Vec<_>>(),
        "evaluation_rollout_s": evaluation_s,
    }))
}

/// The line `a + b n` through points `(n, t)` of least relative errors. By least squares of seconds, the error of the longest
/// update would decide the constant part, and make it negative.
fn line(points: &[(f64, f64)]) -> (f64, f64) {
    let rows = nalgebra::DMatrix::from_fn(points.len(), 2, |row, column| {
        let (n, seconds) = points[row];
        [1.0, n][column] / seconds
    });
    let ones = nalgebra::DVector::repeat(points.len(), 1.0);
    let normal = rows.tr_mul(&rows);
    let solution = normal.cholesky().map_or_else(
        || nalgebra::DVector::repeat(2, f64::NAN),
        |f| f.solve(&rows.tr_mul(&ones)),
    );
    (solution[0], solution[1])
}

/// Seconds this thread has had a processor: other programs on the machine do not count.
fn busy_s() -> Result<f64, std::io::Error> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    let nanoseconds = text.split(' ').next().and_then(|ns| ns.parse::<f64>().ok());
    Ok(1e-9 * nanoseconds.unwrap_or(f64::NAN))
}

fn fastest(mut times: impl Iterator<Item = Result<f64, Failure>>) -> Result<f64, Failure> {
    times.try_fold(f64::INFINITY, |fastest, time| Ok(fastest.min(time?)))
}
