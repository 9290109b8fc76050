//! The three robots are one after the other the same machine, as long as nothing tells them apart.

use std::sync::Arc;

use crate::common::{phantom_model, phantom_model_with};
use phantom::mujoco::Model;
use phantom::randomise::{Distribution, Rule};
use phantom::task::push::{PushConfig, PushTask};
use phantom::task::symmetry::has_all;
use phantom::train::Trainer;
use phantom::train::config::TrainConfig;

/// At the model's own time step and at that of training.
fn n_turn(mut model: Model) -> usize {
    let config = PushConfig {
        goal_speed_m_s: 0.1,
        ..PushConfig::default()
    };
    let task = PushTask::new(&model, config).expect("task");
    let fine = task
        .symmetries(&Arc::new(model.clone()))
        .expect("turns")
        .len();
    let mut edit = model.edit();
    edit.set_timestep(0.004).expect("a time step");
    edit.finish().expect("a model");
    assert_eq!(
        fine,
        task.symmetries(&Arc::new(model)).expect("turns").len()
    );
    fine
}

#[test]
fn equal_robots_have_two_turns_and_three_mirror_images() {
    assert_eq!(n_turn(phantom_model()), 5);
}

#[test]
fn what_one_robot_lacks_may_leave_the_mirror_image() {
    // finger 0 is its own mirror image
    let (of, changed) = (r#"<joint name="p0_upper""#, r#" damping="0.01""#);
    assert_eq!(n_turn(phantom_model_with(of, &format!("{of}{changed}"))), 1);
    // an arm bent to one side is not
    let (of, changed) = ("name=\"p0_tip\" class=\"tip\"", " pos=\"0 0.001 0\"");
    assert_eq!(n_turn(phantom_model_with(of, &format!("{of}{changed}"))), 0);
}

#[test]
fn whatever_tells_robots_apart_leaves_none() {
    for (of, changed) in [
        (r#"<motor name="p1_m2""#, r#" gear="1.05""#),
        (r#"<joint name="p1_upper""#, r#" damping="0.01""#),
        (r#"<geom name="p1_tip""#, r#" size="0.0101""#),
        (
            r#"<pair name="p1_table""#,
            r#" friction="0.5 0.5 0.005 0.0001 0.0001""#,
        ),
        (r#"<pair name="p0_p1""#, r#" solref="0.009 1""#),
        (r#"<body name="p1_turret""#, r#" quat="1 0.01 0 0""#),
    ] {
        let model = phantom_model_with(of, &format!("{of}{changed}"));
        assert_eq!(n_turn(model), 0, "{of}{changed}");
    }
    let (place, moved) = ("-0.259808 -0.150000 0", "-0.259808 -0.151000 0");
    assert_eq!(n_turn(phantom_model_with(place, moved)), 0);
}

fn small() -> TrainConfig {
    let mut config = TrainConfig::default();
    config.train.trajectories = 16;
    config.train.trajectory_s = 0.2;
    config.train.evaluate_every = 0;
    config
}

#[test]
fn a_policy_stays_the_same_after_turns() {
    let mut trainer = Trainer::new(phantom_model(), small(), 2).expect("trainer");
    for _ in 0..3 {
        trainer.advance().expect("iteration");
    }
    let policy = &trainer.checkpoint().policy;
    assert!(policy.weights().iter().any(|w| *w != 0.0));
    assert_eq!(trainer.symmetries().len(), 5);
    assert!(has_all(trainer.symmetries(), policy));
}

#[test]
fn rules_of_the_configuration_rule_turns_out() {
    let mut config = small();
    config.randomise = vec![Rule::new(
        "joint/p1_upper",
        "damping",
        &[],
        Distribution::Fixed(0.01),
    )];
    let trainer = Trainer::new(phantom_model(), config, 1).expect("trainer");
    assert!(trainer.symmetries().is_empty());
}
