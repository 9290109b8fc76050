//! Rollouts: breakdowns and their replay, continued states, and input that does not fit.

use crate::common::{PointMass, phantom_model, point_mass_model, unlimited_model};
use phantom::mujoco::Integrator;
use phantom::policy::AffineGaussian;
use phantom::randomise::{Distribution, Randomiser, Rule};
use phantom::rng::{self, Purpose};
use phantom::rollout::{BatchRequest, Diverged, RolloutConfig, Sampler, Start, Trajectory};
use phantom::task::push::{PushConfig, PushTask};
use phantom::train::config::ensemble_rules;
use std::sync::Arc;

fn sampler(threads: usize) -> Sampler {
    let config = RolloutConfig {
        horizon: 20,
        control_hold: 5,
        noise_correlation: 0.5,
    };
    let rule = Rule::new("body/mass", "mass", &[], Distribution::LogNormal(0.5));
    let model = point_mass_model();
    let randomiser = Randomiser::new(&model, &[rule]).expect("rule");
    Sampler::new(&model, Arc::new(PointMass), randomiser, config, threads).expect("sampler")
}

fn sample(
    sampler: &Sampler,
    policy: &AffineGaussian,
    iteration: u64,
    pool: &[Start],
) -> Vec<Trajectory> {
    let request = BatchRequest {
        seed: 5,
        iteration,
        n_trajectory: 12,
        pool,
        pool_share: 0.5,
    };
    let mut batch = Vec::new();
    sampler
        .sample(policy, &request, &mut batch)
        .expect("rollouts");
    batch
}

/// Pushes harder the further away it is: diverges, after a while.
fn runaway(gain: f64) -> AffineGaussian {
    let mut policy = AffineGaussian::zeros(6, 2, -2.0);
    let mut theta = policy.parameters();
    for i in 0..2 {
        theta[7 * i + i] = gain;
        theta[7 * i + 2 + i] = gain;
    }
    policy.set_parameters(&theta).expect("finite");
    policy
}

#[test]
fn a_breakdown_is_recorded_and_replays() {
    for (gain, what) in [(300.0, "bad_"), (1e12, "bad_ctrl"), (1e308, "bad_ctrl")] {
        let sampler = sampler(2);
        let batch = sample(&sampler, &runaway(gain), 0, &[]);
        let mut n_broken = 0;
        for trajectory in &batch {
            let Some(dump) = &trajectory.diverged else {
                continue;
            };
            n_broken += 1;
            assert!(dump.reason.contains(what), "{}", dump.reason);
            assert_eq!(
                trajectory.len(),
                dump.step,
                "nothing is kept of the fatal step"
            );
            assert_eq!(dump.actions.len(), 2 * (dump.step + 1));
            // through a file
            let text = serde_json::to_string(dump).expect("json");
            let read: Diverged = serde_json::from_str(&text).expect("json");
            assert_eq!(&read, dump);
            let replayed = sampler
                .replay(5, &read)
                .expect("replay")
                .expect("breaks down again");
            assert_eq!(replayed, (dump.step, dump.reason.clone()));
        }
        assert_eq!(n_broken, batch.len(), "gain {gain}");
        if gain == 300.0 {
            let steps: Vec<usize> = batch.iter().map(Trajectory::len).collect();
            assert!(
                steps.iter().all(|s| *s > 1),
                "the state breaks down, not the first action: {steps:?}"
            );
        }
    }
}

#[test]
fn after_a_breakdown_a_worker_is_as_new() {
    let (used, fresh) = (sampler(1), sampler(1));
    sample(&used, &runaway(1e9), 0, &[]);
    let policy = runaway(-1.0);
    let (a, b) = (
        sample(&used, &policy, 1, &[]),
        sample(&fresh, &policy, 1, &[]),
    );
    for (a, b) in a.iter().zip(&b) {
        assert!(a.diverged.is_none());
        assert_eq!((&a.observations, &a.rewards), (&b.observations, &b.rewards));
    }
}

#[test]
fn a_sound_dump_replays_without_a_breakdown_and_a_bad_one_is_refused() {
    let sampler = sampler(1);
    let batch = sample(&sampler, &runaway(1e9), 0, &[]);
    let good = batch[0].diverged.clone().expect("broken");
    let calm = Diverged {
        actions: vec![0.0; 40],
        ..good.clone()
    };
    assert_eq!(sampler.replay(5, &calm).expect("replay"), None);
    let with_start = |qpos: usize, qvel: usize| Diverged {
        start: Start {
            qpos: vec![0.0; qpos],
            qvel: vec![0.0; qvel],
            ..good.start.clone()
        },
        ..good.clone()
    };
    let cases = [
        (with_start(3, 2), "qpos needs 2 numbers, got 3"),
        (with_start(2, 0), "qvel needs 2 numbers, got 0"),
        (
            Diverged {
                mocap_pos: vec![],
                ..good.clone()
            },
            "mocap_pos needs 3 numbers, got 0",
        ),
        (
            Diverged {
                mocap_quat: vec![0.0; 3],
                ..good.clone()
            },
            "mocap_quat needs 4 numbers, got 3",
        ),
        (
            Diverged {
                actions: vec![0.0; 3],
                ..good.clone()
            },
            "`actions` has 3 values, expected a multiple of 2",
        ),
        (
            Diverged {
                mocap_pos: vec![f64::NAN; 3],
                ..good.clone()
            },
            "mocap_pos[0] is NaN",
        ),
    ];
    for (dump, expected) in cases {
        let error = sampler.replay(5, &dump).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    }
    assert!(sampler.replay(5, &good).expect("still usable").is_some());
}

#[test]
fn continued_states_keep_their_model() {
    let sampler = sampler(2);
    let policy = runaway(-2.0);
    let first = sample(&sampler, &policy, 0, &[]);
    let pool: Vec<Start> = first.iter().filter_map(|t| t.visited.clone()).collect();
    assert_eq!(pool.len(), 12);
    let second = sample(&sampler, &policy, 1, &pool);
    let mut continued = 0;
    for trajectory in &second {
        let visited = trajectory.visited.as_ref().expect("visited");
        let start = &trajectory.observations[..4];
        match pool
            .iter()
            .find(|s| s.qpos == start[..2] && s.qvel == start[2..])
        {
            Some(from) => {
                continued += 1;
                assert_eq!(visited.model, from.model);
            }
            None => assert_eq!(visited.model.iteration, 1),
        }
    }
    assert!((1..12).contains(&continued), "{continued} of 12");
    // goals are new
    let goals = |batch: &[Trajectory]| {
        batch
            .iter()
            .map(|t| t.observations[4].to_bits())
            .collect::<Vec<_>>()
    };
    assert!(goals(&second).iter().all(|g| !goals(&first).contains(g)));
    // a mass of another draw would move differently: the same start replays to the same path only in its own
    let start = &pool[0];
    let masses: Vec<f64> = [start.model.index, start.model.index + 1]
        .map(|i| rng::normal(&mut rng::stream(5, Purpose::Model, 0, i)))
        .to_vec();
    assert_ne!(masses[0], masses[1]);
}

#[test]
fn batches_are_the_same_on_any_number_of_threads() {
    let policy = runaway(-2.0);
    let (one, two) = (
        sample(&sampler(1), &policy, 3, &[]),
        sample(&sampler(2), &policy, 3, &[]),
    );
    for (a, b) in one.iter().zip(&two) {
        assert_eq!(a.observations, b.observations);
        assert_eq!(a.noise, b.noise);
        assert_eq!(a.rewards, b.rewards);
        assert_eq!(a.value_inputs, b.value_inputs);
        assert_eq!(a.actions, b.actions);
        assert_eq!(a.visited, b.visited);
    }
    assert_ne!(one[0].observations, one[1].observations);
    assert_ne!(
        one[0].observations,
        sample(&sampler(1), &policy, 4, &[])[0].observations
    );
}

#[test]
fn the_recorded_states_belong_together() {
    let sampler = sampler(1);
    let trajectory = &sample(&sampler, &runaway(-2.0), 0, &[])[0];
    assert_eq!((trajectory.len(), trajectory.observations.len()), (20, 120));
    // this task's value function sees the observation
    let row = |t: usize| &trajectory.value_inputs[6 * t..6 * t + 6];
    assert_eq!(trajectory.value_inputs[..120], trajectory.observations);
    for t in 0..20 {
        // rewards and distances are those of the state after the step
        let next = row(t + 1);
        let distance = (next[0] - next[4]).hypot(next[1] - next[5]);
        assert!((trajectory.distances_m[t] - distance).abs() < 1e-15);
        assert!(trajectory.rewards[t] <= 1.0 - distance);
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let config = RolloutConfig {
        horizon: 5,
        control_hold: 1,
        noise_correlation: 0.5,
    };
    let new = |threads, model: &phantom::mujoco::Model| {
        Sampler::new(
            model,
            Arc::new(PointMass),
            Randomiser::default(),
            config,
            threads,
        )
    };
    let Err(error) = new(0, &point_mass_model()) else {
        panic!("0 threads")
    };
    assert_eq!(
        error.to_string(),
        "cannot start 0 threads: expected at least 1"
    );
    let Err(error) = new(1, &phantom_model()) else {
        panic!("wrong model")
    };
    assert!(
        error.to_string().contains("9 actuators, expected 2"),
        "{error}"
    );

    let sampler = sampler(1);
    let request = |pool| BatchRequest {
        seed: 0,
        iteration: 0,
        n_trajectory: 4,
        pool,
        pool_share: 1.0,
    };
    let mut batch = Vec::new();
    let error = sampler.sample(&AffineGaussian::zeros(5, 2, 0.0), &request(&[]), &mut batch);
    assert!(
        error
            .expect_err("size")
            .to_string()
            .contains("maps 5 observations")
    );
    let mut wrong = sample(&sampler, &runaway(-1.0), 0, &[])[0]
        .visited
        .clone()
        .expect("visited");
    wrong.qpos.push(0.0);
    let error = sampler
        .sample(&runaway(-1.0), &request(&[wrong]), &mut batch)
        .expect_err("length");
    assert!(
        error.to_string().contains("qpos needs 2 numbers, got 3"),
        "{error}"
    );
}

#[test]
fn the_arm_breaks_down_and_replays_too() {
    let model = unlimited_model();
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let randomiser = Randomiser::new(&model, &ensemble_rules(0.005, None, 0.02)).expect("rules");
    let config = RolloutConfig {
        horizon: 20,
        control_hold: 5,
        noise_correlation: 0.5,
    };
    let sampler = Sampler::new(&model, Arc::new(task), randomiser, config, 1).expect("sampler");
    let mut policy = AffineGaussian::zeros(36, 9, -1.0);
    let mut theta = policy.parameters();
    theta[36] = 1e200; // beyond what the engine takes
    policy.set_parameters(&theta).expect("finite");
    for trajectory in sample(&sampler, &policy, 0, &[]) {
        let dump = trajectory.diverged.expect("breaks down");
        assert_eq!(dump.step, 0);
        let replayed = sampler.replay(5, &dump).expect("replay");
        assert_eq!(replayed, Some((0, dump.reason)));
    }
}

#[test]
fn runge_kutta_is_refused() {
    let mut model = point_mass_model();
    let mut option = model.option();
    option.integrator = Integrator::Rk4;
    let mut edit = model.edit();
    edit.set_option(&option).expect("a legal option");
    edit.finish().expect("edited");
    let config = RolloutConfig {
        horizon: 1,
        control_hold: 1,
        noise_correlation: 0.0,
    };
    let sampler = Sampler::new(
        &model,
        Arc::new(PointMass),
        Randomiser::default(),
        config,
        1,
    );
    let Err(error) = sampler else {
        panic!("accepted")
    };
    assert!(error.to_string().contains("RK4"), "{error}");
}
