//! One update: its length, its direction, and what must not disturb it.

use crate::synthetic::{
    batch, cosine, difference, log_probability, normals, sample, some_policy, stream,
};
use nalgebra::{DMatrix, DVector};
use phantom::npg::baseline::Baseline;
use phantom::npg::fisher::FisherMode;
use phantom::npg::{self, Known, NpgConfig, NpgError, UpdateReport, ValueFrom, kl_divergence};
use phantom::policy::AffineGaussian;
use phantom::rng::Stream;
use phantom::rollout::{Diverged, ModelDraw, Start, Trajectory};
use phantom::task::ObservationGroup;
use phantom::team::Deal;

const HORIZON: usize = 20;

/// Default settings, for the white noise of the synthetic batches.
fn white() -> NpgConfig {
    NpgConfig {
        noise_correlation: 0.0,
        ..NpgConfig::default()
    }
}

fn observe(rng: &mut Stream) -> Vec<f64> {
    normals(rng, 3)
}

/// Best at a = `(s_0, -s_1)`: there is a clear direction to go.
fn reward(s: &[f64], a: &[f64]) -> f64 {
    -(a[0] - s[0]).powi(2) - (a[1] + s[1]).powi(2)
}

fn update(
    policy: &mut AffineGaussian,
    batch: &[Trajectory],
    config: &NpgConfig,
) -> Result<UpdateReport, NpgError> {
    let groups = [ObservationGroup {
        name: "first",
        columns: 0..1,
    }];
    let mut baseline = Baseline::zero(policy.n_observation());
    let deal = Deal::alone(batch.len());
    npg::update(
        policy,
        &mut baseline,
        batch,
        &deal,
        &Known {
            horizon: HORIZON,
            groups: &groups,
            symmetries: &[],
        },
        config,
    )
}

/// The change of θ from one update of a fresh policy.
fn change(batch: &[Trajectory], config: &NpgConfig) -> Vec<f64> {
    let mut policy = AffineGaussian::zeros(3, 2, -1.0);
    let before = policy.parameters();
    update(&mut policy, batch, config).expect("a step");
    difference(&policy.parameters(), &before)
}

#[test]
fn delta_is_twice_the_divergence() {
    for fisher in [FisherMode::Exact, FisherMode::Empirical] {
        let policy = some_policy(3, 2);
        let batch = batch(&policy, 200, HORIZON, observe, reward);
        for delta in [1e-6, 1e-4] {
            let config = NpgConfig {
                fisher,
                step_size_delta: delta,
                fisher_damping: 1e-6,
                ..white()
            };
            let report = update(&mut policy.clone(), &batch, &config).expect("a step");
            assert_eq!(report.kl_predicted, delta / 2.0);
            let ratio = report.kl_measured / report.kl_predicted;
            // third-order terms, and sampling error of the empirical matrix (4000 samples, 10 parameters)
            assert!(
                (ratio - 1.0).abs()
                    < if fisher == FisherMode::Exact {
                        0.02
                    } else {
                        0.1
                    },
                "{fisher:?} {ratio}"
            );
        }
    }
}

#[test]
fn divergence_is_the_mean_over_observations() {
    let old = some_policy(3, 2);
    let mut new = old.clone();
    let theta: Vec<f64> = old
        .parameters()
        .iter()
        .enumerate()
        .map(|(k, t)| t + 0.1 * (k as f64).sin())
        .collect();
    new.set_parameters(&theta).expect("finite");
    let mut rng = stream(5);
    let (mut second, mut direct, mut sampled) = (DMatrix::zeros(4, 4), 0.0, 0.0);
    let n = 40_000;
    let (mut a, mut z, mut b) = ([0.0; 2], [0.0; 2], [0.0; 2]);
    for _ in 0..n {
        let s = observe(&mut rng);
        let phi = DVector::from_iterator(4, s.iter().copied().chain([1.0]));
        second += &phi * phi.transpose() / f64::from(n);
        sample(&old, &s, &mut rng, &mut a, &mut z);
        sampled += (log_probability(&old, &s, &a) - log_probability(&new, &s, &a)) / f64::from(n);
        old.mean(&s, &mut a);
        new.mean(&s, &mut b);
        for i in 0..2 {
            let (p, q) = (old.log_sigma()[i].exp(), new.log_sigma()[i].exp());
            let kl = (q / p).ln() + (p * p + (a[i] - b[i]).powi(2)) / (2.0 * q * q) - 0.5;
            direct += kl / f64::from(n);
        }
    }
    let kl = kl_divergence(&old, &new, &second);
    assert!((kl / direct - 1.0).abs() < 1e-10, "{kl} {direct}");
    assert!((kl / sampled - 1.0).abs() < 0.1, "{kl} {sampled}");
    assert_eq!(kl_divergence(&old, &old, &second), 0.0);
}

#[test]
fn the_step_improves_the_reward_and_both_estimates_agree_on_it() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let batch = batch(&fresh, 500, HORIZON, observe, reward);
    let exact = change(&batch, &white());
    let empirical = change(
        &batch,
        &NpgConfig {
            fisher: FisherMode::Empirical,
            ..white()
        },
    );
    assert!(
        cosine(&exact, &empirical) > 0.98,
        "{}",
        cosine(&exact, &empirical)
    );
    // weights toward (1, 0, 0 | 0), (0, -1, 0 | 0)
    let ideal = [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0];
    assert!(cosine(&exact[..8], &ideal) > 0.95, "{exact:?}");
}

#[test]
fn units_of_an_observation_do_not_matter() {
    let rescaled = |rng: &mut Stream| {
        let s = observe(rng);
        vec![1000.0 * s[0] + 50.0, 0.01 * s[1] - 2.0, s[2]]
    };
    let original = |s: &[f64]| vec![(s[0] - 50.0) / 1000.0, (s[1] + 2.0) / 0.01, s[2]];
    for fisher in [FisherMode::Exact, FisherMode::Empirical] {
        let config = NpgConfig { fisher, ..white() };
        let mut policies = [
            AffineGaussian::zeros(3, 2, -1.0),
            AffineGaussian::zeros(3, 2, -1.0),
        ];
        let first = batch(&policies[0], 100, HORIZON, observe, reward);
        let second = batch(&policies[1], 100, HORIZON, rescaled, |s, a| {
            reward(&original(s), a)
        });
        update(&mut policies[0], &first, &config).expect("a step");
        update(&mut policies[1], &second, &config).expect("a step");
        let (mut a, mut b) = ([0.0; 2], [0.0; 2]);
        let states = second[0]
            .observations
            .chunks_exact(3)
            .zip(first[0].observations.chunks_exact(3));
        for (there, here) in states {
            policies[0].mean(here, &mut a);
            policies[1].mean(there, &mut b);
            for (a, b) in a.iter().zip(b) {
                assert!(
                    (a - b).abs() < 1e-7 * (1.0 + a.abs()),
                    "{fisher:?}: {a} {b}"
                );
            }
        }
        for (l, m) in policies[0].log_sigma().iter().zip(policies[1].log_sigma()) {
            assert!((l - m).abs() < 1e-8);
        }
    }
}

#[test]
fn one_absurd_trajectory_does_not_turn_the_step() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let good = batch(&fresh, 400, HORIZON, observe, reward);
    for absurd in [-1e2, -1e4, -1e9, 1e9] {
        let mut bad = good.clone();
        bad[6].rewards.fill(absurd);
        let cosine = cosine(&change(&good, &white()), &change(&bad, &white()));
        assert!(cosine > 0.9, "{absurd}: {cosine}");
    }
}

#[test]
fn broken_down_trajectories_take_no_part() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let good = batch(&fresh, 60, HORIZON, observe, reward);
    let mut bad = good.clone();
    let mut broken = good[0].clone();
    broken.rewards.fill(f64::NAN);
    broken.diverged = Some(diverged());
    // at the end: the others keep their indices, which decide about halves and order
    bad.push(broken.clone());
    assert_eq!(change(&good, &white()), change(&bad, &white()));
    // in their midst: whatever it holds
    let (mut one, mut other) = (good.clone(), good);
    one[31] = broken.clone();
    other[31].diverged.clone_from(&broken.diverged);
    assert_eq!(change(&one, &white()), change(&other, &white()));
    let error = update(&mut fresh.clone(), &[broken], &white()).expect_err("nothing left");
    assert_eq!(error.to_string(), "all 1 trajectories diverged");
}

fn diverged() -> Diverged {
    let start = Start {
        model: ModelDraw {
            iteration: 0,
            index: 0,
        },
        qpos: vec![],
        qvel: vec![],
    };
    Diverged {
        reason: String::new(),
        step: 3,
        start,
        mocap_pos: vec![],
        mocap_quat: vec![],
        actions: vec![],
    }
}

#[test]
fn the_worst_trajectories_alone_decide_if_asked() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let batch = batch(&fresh, 200, HORIZON, observe, reward);
    // the value of the last iteration, since the fit is made to all trajectories
    let epopt = |epopt_epsilon| NpgConfig {
        epopt_epsilon,
        value_from: ValueFrom::Previous,
        ..white()
    };
    let all = change(&batch, &epopt(1.0));
    assert_eq!(change(&batch, &epopt(0.999_999)), all, "200 of 200");

    let mut rewards: Vec<f64> = batch.iter().map(Trajectory::mean_reward).collect();
    rewards.sort_by(f64::total_cmp);
    for (epsilon, n) in [(0.1, 20), (1e-9, 1)] {
        let mut worst = batch.clone();
        for trajectory in &mut worst {
            if trajectory.mean_reward() > rewards[n - 1] {
                trajectory.diverged = Some(diverged());
            }
        }
        let mut policy = fresh.clone();
        let report = update(&mut policy, &batch, &epopt(epsilon)).expect("a step");
        assert_eq!(report.n_sample, n * HORIZON);
        let found = difference(&policy.parameters(), &fresh.parameters());
        assert_eq!(found, change(&worst, &epopt(1.0)), "{n} of 200");
        assert_ne!(found, all);
    }
}

#[test]
fn an_update_that_cannot_be_made_changes_nothing() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let mut batch = batch(&fresh, 60, HORIZON, observe, |_, _| 0.0);
    let mut policy = fresh.clone();
    let error = update(&mut policy, &batch, &white()).expect_err("no reward, no direction");
    assert!(
        matches!(error, NpgError::Gradient { value: 0.0 }),
        "{error}"
    );
    batch[0].observations[0] = f64::NAN;
    batch[0].rewards[0] = 1.0;
    assert!(update(&mut policy, &batch, &white()).is_err());
    assert_eq!(policy, fresh);
}

#[test]
fn noise_is_held_at_the_floor_and_the_search_ends() {
    let config = NpgConfig {
        log_sigma_floor: -0.5,
        ..white()
    };
    // far below the floor: the raise alone is further than any permitted step
    let mut policy = AffineGaussian::zeros(3, 2, -4.0);
    let batch = batch(&policy, 60, HORIZON, observe, reward);
    let report = update(&mut policy, &batch, &config).expect("a step");
    assert!(policy.log_sigma().iter().all(|l| *l >= -0.5));
    assert!(
        policy.weights().iter().any(|w| *w != 0.0),
        "and it moved on"
    );
    assert!(
        report.kl_measured > config.step_size_delta,
        "the raise is reported"
    );
}

#[test]
fn halves_that_say_the_same_have_cosine_one() {
    let fresh = AffineGaussian::zeros(3, 2, -1.0);
    let single = batch(&fresh, 40, HORIZON, observe, reward);
    let twice: Vec<Trajectory> = single.iter().flat_map(|t| [t.clone(), t.clone()]).collect();
    let report = update(&mut fresh.clone(), &twice, &white()).expect("a step");
    assert!(
        (report.half_cosine - 1.0).abs() < 1e-9,
        "{}",
        report.half_cosine
    );
    assert!((report.group_cosines[0].1 - 1.0).abs() < 1e-9);
    let noise = batch(&fresh, 400, HORIZON, observe, |s, _| s[0]); // the action is of no consequence
    let report = update(&mut fresh.clone(), &noise, &white()).expect("a step");
    assert!(report.half_cosine.abs() < 0.7, "{}", report.half_cosine);
}

#[test]
fn settings_out_of_range_are_named() {
    let base = white();
    let cases = [
        (
            NpgConfig {
                discount: 1.5,
                ..base.clone()
            },
            "npg.discount",
        ),
        (
            NpgConfig {
                gae_lambda: f64::NAN,
                ..base.clone()
            },
            "npg.gae_lambda",
        ),
        (
            NpgConfig {
                step_size_delta: 0.0,
                ..base.clone()
            },
            "npg.step_size_delta",
        ),
        (
            NpgConfig {
                fisher_damping: -1.0,
                ..base.clone()
            },
            "npg.fisher_damping",
        ),
        (
            NpgConfig {
                advantage_clip: f64::INFINITY,
                ..base.clone()
            },
            "npg.advantage_clip",
        ),
        (
            NpgConfig {
                value_ridge: 0.0,
                ..base.clone()
            },
            "npg.value_ridge",
        ),
        (
            NpgConfig {
                value_stride: 0,
                ..base.clone()
            },
            "npg.value_stride",
        ),
        (
            NpgConfig {
                log_sigma_floor: -99.0,
                ..base.clone()
            },
            "npg.log_sigma_floor",
        ),
        (
            NpgConfig {
                initial_log_sigma: -3.0,
                log_sigma_floor: -2.0,
                ..base.clone()
            },
            "npg.initial_log_sigma",
        ),
    ];
    for (config, key) in cases {
        let error = config.validate().expect_err(key).to_string();
        assert!(error.starts_with(&format!("`{key}` is ")), "{error}");
    }
    base.validate().expect("the defaults are fine");
}
