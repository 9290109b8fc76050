//! Training gives the same bits on any number of threads, and after a resume.

use crate::common::{phantom_model, unlimited_model};
use phantom::train::config::TrainConfig;
use phantom::train::{Checkpoint, TrainError, Trainer};

fn config(seed: u64) -> TrainConfig {
    let mut config = TrainConfig::default();
    config.train.seed = seed;
    config.train.iterations = 20;
    config.train.trajectories = 16;
    config.train.trajectory_s = 0.2;
    config.train.timestep_s = 0.002;
    config.train.control_hold = 5;
    config.train.evaluate_every = 0;
    config.train.object_mass_sigma_kg = 0.02;
    config.npg.value_stride = 1;
    config
}

fn trainer(seed: u64, threads: usize) -> Trainer {
    Trainer::new(phantom_model(), config(seed), threads).expect("trainer")
}

fn advance(trainer: &mut Trainer, n: usize) {
    for _ in 0..n {
        let record = trainer.advance().expect("iteration");
        record.update.expect("a step");
    }
}

/// All that has to be the same; the clock is not.
fn bits(checkpoint: &Checkpoint) -> String {
    let timeless = Checkpoint {
        seconds: 0.0,
        ..checkpoint.clone()
    };
    serde_json::to_string(&timeless).expect("json")
}

#[test]
fn threads_and_seeds() {
    let run = |seed, threads| {
        let mut trainer = trainer(seed, threads);
        advance(&mut trainer, 3);
        assert!(!trainer.checkpoint().pool.is_empty());
        bits(trainer.checkpoint())
    };
    let one = run(3, 1);
    assert_eq!(one, run(3, 2), "threads");
    assert_eq!(one, run(3, 1), "repetition");
    assert_ne!(one, run(4, 2), "seed");
}

#[test]
fn a_value_function_is_learned_and_resumed_to_the_same_bits() {
    // few enough observations would be needed for 16 × 20 samples; so make more of them here
    let make = |threads| {
        let mut config = config(1);
        config.train.trajectories = 80;
        config.train.trajectory_s = 0.1;
        config.train.timestep_s = 0.001;
        config.train.control_hold = 5;
        Trainer::new(phantom_model(), config, threads).expect("trainer")
    };
    let (mut straight, mut first) = (make(2), make(2));
    advance(&mut straight, 2);
    advance(&mut first, 1);
    let mut second = make(1);
    let text = serde_json::to_string(first.checkpoint()).expect("json");
    second
        .restore(serde_json::from_str(&text).expect("json"))
        .expect("restored");
    let record = second.advance().expect("iteration");
    assert!(
        record.update.expect("a step").value_fit.is_some(),
        "the value function is part of it"
    );
    assert_eq!(bits(second.checkpoint()), bits(straight.checkpoint()));
}

#[test]
fn ten_and_ten_are_twenty() {
    let mut straight = trainer(0, 2);
    advance(&mut straight, 20);
    let text = {
        let mut first = trainer(0, 2);
        advance(&mut first, 10);
        serde_json::to_string(first.checkpoint()).expect("json")
    };
    let mut second = trainer(0, 1);
    second
        .restore(serde_json::from_str(&text).expect("json"))
        .expect("restored");
    advance(&mut second, 10);
    assert_eq!(bits(second.checkpoint()), bits(straight.checkpoint()));
    assert_eq!(second.checkpoint().iteration, 20);
}

#[test]
fn a_checkpoint_that_does_not_fit_is_refused_and_changes_nothing() {
    let mut trainer = trainer(0, 1);
    advance(&mut trainer, 1);
    let before = bits(trainer.checkpoint());
    let good = serde_json::to_value(trainer.checkpoint()).expect("json");
    let cases = [
        (
            "/policy/weights",
            serde_json::json!([1.0]),
            "`weights` has 1 values",
        ),
        ("/policy/format", serde_json::json!("x"), "format is `x`"),
        ("/baseline/mean", serde_json::json!([1.0]), "`baseline`"),
        (
            "/pool/0/qpos",
            serde_json::json!([1.0]),
            "`pool[0]` is not a state",
        ),
        (
            "/pool/0/qvel",
            serde_json::json!([]),
            "`pool[0]` is not a state",
        ),
    ];
    for (pointer, value, expected) in cases {
        let mut bad = good.clone();
        *bad.pointer_mut(pointer).expect(pointer) = value;
        let error = trainer
            .restore(serde_json::from_value(bad).expect("types"))
            .expect_err(pointer);
        assert!(error.to_string().contains(expected), "{error}");
        assert_eq!(bits(trainer.checkpoint()), before);
    }
}

#[test]
fn settings_out_of_range_are_named() {
    type Change = fn(&mut TrainConfig);
    let cases: [(Change, &str); 12] = [
        (|c| c.train.trajectories = 0, "train.trajectories"),
        (|c| c.train.control_hold = 0, "train.control_hold"),
        (
            |c| c.train.evaluation_rollouts = 0,
            "train.evaluation_rollouts",
        ),
        (|c| c.train.checkpoint_every = 0, "train.checkpoint_every"),
        (|c| c.train.trajectory_s = -1.0, "train.trajectory_s"),
        (|c| c.train.trajectory_s = 1e-4, "train.trajectory_s"),
        (|c| c.train.timestep_s = f64::NAN, "train.timestep_s"),
        (|c| c.train.continued_share = 1.1, "train.continued_share"),
        (
            |c| c.train.object_mass_kg = Some(0.0),
            "train.object_mass_kg",
        ),
        (|c| c.train.base_sigma_m = -0.1, "train.base_sigma_m"),
        (|c| c.npg.discount = 2.0, "npg.discount"),
        (
            |c| c.task.goal_diameter_m = f64::NAN,
            "task.goal_diameter_m",
        ),
    ];
    for (change, key) in cases {
        let mut config = config(0);
        change(&mut config);
        let Err(error) = Trainer::new(phantom_model(), config, 1) else {
            panic!("{key} accepted")
        };
        assert!(
            error.to_string().starts_with(&format!("`{key}` is ")),
            "{error}"
        );
    }
    let Err(error) = Trainer::new(phantom_model(), config(0), 0) else {
        panic!("0 threads accepted")
    };
    assert!(matches!(error, TrainError::Rollout(_)), "{error}");
}

#[test]
fn examples_are_settings() {
    for entry in std::fs::read_dir("examples").expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.extension().is_none_or(|e| e != "toml") {
            continue;
        }
        let text = std::fs::read_to_string(&path).expect("readable");
        let config: TrainConfig =
            toml::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        config
            .validate()
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert_ne!(config, TrainConfig::default());
    }
}

#[test]
fn breakdowns_are_handed_out_even_when_nothing_is_left_to_learn_from() {
    let mut trainer = Trainer::new(unlimited_model(), config(0), 1).expect("trainer");
    let mut checkpoint = trainer.checkpoint().clone();
    let mut theta = checkpoint.policy.parameters();
    theta[36] = 1e200; // beyond what the engine takes
    checkpoint.policy.set_parameters(&theta).expect("finite");
    trainer.restore(checkpoint.clone()).expect("restored");
    let error = trainer.advance().expect_err("all broken");
    assert_eq!(error.to_string(), "all 16 trajectories diverged");
    assert_eq!(trainer.unreported_breakdowns().count(), 16);
    assert_eq!(bits(trainer.checkpoint()), bits(&checkpoint));
}
