//! The whole learning rule on a task whose solution is known: a spring and a damper.

use crate::common::{PointMass, point_mass_model};
use phantom::npg::baseline::Baseline;
use phantom::npg::{self, NpgConfig};
use phantom::policy::AffineGaussian;
use phantom::randomise::Randomiser;
use phantom::rollout::{BatchRequest, RolloutConfig, Sampler};
use phantom::task::Task;
use phantom::team::Deal;
use std::sync::Arc;

const ITERATIONS: u64 = 30;
const N_TRAJECTORY: usize = 100;

/// Mean distance to the goal at the end, over the batch of `iteration`.
fn final_distance(batch: &[phantom::rollout::Trajectory]) -> f64 {
    let sum: f64 = batch.iter().filter_map(|t| t.distances_m.last()).sum();
    sum / batch.len() as f64
}

#[test]
fn a_point_mass_is_brought_to_its_goal() {
    let rollout = RolloutConfig {
        horizon: 50,
        control_hold: 4,
        noise_correlation: 0.5,
    };
    let sampler = Sampler::new(
        &point_mass_model(),
        Arc::new(PointMass),
        Randomiser::default(),
        rollout,
        2,
    )
    .expect("sampler");
    for seed in 0..3 {
        let config = NpgConfig {
            step_size_delta: 0.1,
            initial_log_sigma: 0.0,
            ..NpgConfig::default()
        };
        let mut policy = AffineGaussian::zeros(6, 2, config.initial_log_sigma);
        let mut baseline = Baseline::zero(6);
        let mut batch = Vec::new();
        let request = |iteration| BatchRequest {
            seed,
            iteration,
            n_trajectory: N_TRAJECTORY,
            pool: &[],
            pool_share: 0.0,
        };
        let mut start = f64::NAN;
        let mut reward = Vec::new();
        for iteration in 0..ITERATIONS {
            sampler
                .sample(&policy, &request(iteration), &mut batch)
                .expect("rollouts");
            if iteration == 0 {
                start = final_distance(&batch);
            }
            reward.push(
                batch
                    .iter()
                    .map(phantom::rollout::Trajectory::mean_reward)
                    .sum::<f64>(),
            );
            let groups = PointMass.observation_groups();
            let deal = Deal::alone(batch.len());
            let report = npg::update(
                &mut policy,
                &mut baseline,
                &batch,
                &deal,
                &npg::Known {
                    horizon: 50,
                    groups: &groups,
                    symmetries: &[],
                },
                &config,
            )
            .expect("a step");
            let ratio = report.kl_measured / report.kl_predicted;
            assert!((0.2..2.1).contains(&ratio), "{ratio}");
        }
        // the mean policy: no noise to speak of
        let mut theta = policy.parameters();
        let n_weight = policy.weights().len();
        theta[n_weight..].fill(-19.0);
        policy.set_parameters(&theta).expect("finite");
        sampler
            .sample(&policy, &request(1000), &mut batch)
            .expect("rollouts");
        let end = final_distance(&batch);
        assert!(start > 0.4, "{start}");
        assert!(end < 0.1 * start, "seed {seed}: from {start} to {end} m");
        assert!(reward[ITERATIONS as usize - 1] > reward[0] + 0.2 * N_TRAJECTORY as f64);
    }
}
