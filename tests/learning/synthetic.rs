//! Batches of made-up trajectories.

use phantom::exploration::Exploration;
use phantom::policy::AffineGaussian;
use phantom::rng::{self, Purpose, Stream};
use phantom::rollout::Trajectory;

pub(crate) fn stream(index: u64) -> Stream {
    rng::stream(42, Purpose::Exploration, 0, index)
}

pub(crate) fn normals(rng: &mut Stream, n: usize) -> Vec<f64> {
    (0..n).map(|_| rng::normal(rng)).collect()
}

/// A policy with arbitrary weights and a different noise on every action.
pub(crate) fn some_policy(n_observation: usize, n_action: usize) -> AffineGaussian {
    let mut policy = AffineGaussian::zeros(n_observation, n_action, 0.0);
    let n_weight = policy.weights().len();
    let theta: Vec<f64> = (0..policy.n_parameter())
        .map(|k| {
            if k < n_weight {
                (1.3 * k as f64).sin()
            } else {
                -1.5 + 0.4 * (k - n_weight) as f64
            }
        })
        .collect();
    policy.set_parameters(&theta).expect("finite");
    policy
}

/// One action of `policy` with white noise.
pub(crate) fn sample(
    policy: &AffineGaussian,
    observation: &[f64],
    rng: &mut Stream,
    action: &mut [f64],
    noise: &mut [f64],
) {
    policy.mean(observation, action);
    Exploration::new(policy.n_action(), 0.0).perturb(policy.log_sigma(), rng, action, noise);
}

/// log of the density of `action`, but for a constant.
pub(crate) fn log_probability(policy: &AffineGaussian, observation: &[f64], action: &[f64]) -> f64 {
    let mut mean = vec![0.0; policy.n_action()];
    policy.mean(observation, &mut mean);
    let terms = mean.iter().zip(action).zip(policy.log_sigma());
    terms
        .map(|((m, a), l)| -0.5 * ((a - m) / l.exp()).powi(2) - l)
        .sum()
}

/// `n` trajectories of independent observations that `observe` makes, actions drawn from `policy`.
pub(crate) fn batch(
    policy: &AffineGaussian,
    n: usize,
    horizon: usize,
    observe: impl Fn(&mut Stream) -> Vec<f64>,
    reward: impl Fn(&[f64], &[f64]) -> f64,
) -> Vec<Trajectory> {
    let (mut action, mut noise) = (vec![0.0; policy.n_action()], vec![0.0; policy.n_action()]);
    (0..n as u64)
        .map(|index| {
            let mut rng = stream(index);
            let mut trajectory = Trajectory::default();
            for _ in 0..horizon {
                let observation = observe(&mut rng);
                sample(policy, &observation, &mut rng, &mut action, &mut noise);
                trajectory.rewards.push(reward(&observation, &action));
                trajectory.distances_m.push(0.0);
                trajectory.noise.extend_from_slice(&noise);
                trajectory.actions.extend_from_slice(&action);
                trajectory.value_inputs.extend_from_slice(&observation);
                trajectory.observations.extend(observation);
            }
            trajectory.value_inputs.extend(observe(&mut rng));
            trajectory
        })
        .collect()
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

pub(crate) fn cosine(a: &[f64], b: &[f64]) -> f64 {
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

pub(crate) fn difference(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(x, y)| x - y).collect()
}
