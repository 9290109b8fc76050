//! The evaluation against a loop of its own.

use crate::common::{phantom_model, unlimited_model};
use phantom::evaluate::{Evaluation, EvaluationRequest, evaluate};
use phantom::mujoco::{Data, Model};
use phantom::policy::AffineGaussian;
use phantom::randomise::Randomiser;
use phantom::rng::{self, Purpose};
use phantom::task::push::{PushConfig, PushTask};
use phantom::task::{Task, spiral};
use phantom::train::config::ensemble_rules;
use std::sync::Arc;

/// Damps the motors and leans on the goal a little: enough to move.
fn policy() -> AffineGaussian {
    let mut policy = AffineGaussian::zeros(36, 9, -1.0);
    let mut theta = policy.parameters();
    for motor in 0..9 {
        let joint = 5 * (motor / 3) + motor % 3;
        theta[37 * motor + joint] = -0.5;
        theta[37 * motor + 15 + joint] = -0.01;
        theta[37 * motor + 33] = 1.0;
        theta[37 * motor + 36] = 0.02 * motor as f64;
    }
    policy.set_parameters(&theta).expect("finite");
    policy
}

fn run(policy: &AffineGaussian, n_rollout: usize) -> Evaluation {
    run_on(phantom_model(), policy, n_rollout)
}

fn run_on(model: Model, policy: &AffineGaussian, n_rollout: usize) -> Evaluation {
    let model = Arc::new(model);
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let randomiser = Randomiser::new(&model, &ensemble_rules(0.005, None, 0.0)).expect("rules");
    let request = EvaluationRequest {
        n_rollout,
        seed: 11,
    };
    evaluate(&model, &task, &randomiser, policy, request).expect("evaluation")
}

#[test]
fn equals_an_independent_simulation() {
    let policy = policy();
    let evaluation = run(&policy, 1);
    let rollout = &evaluation.rollouts[0];
    assert_eq!(rollout.diverged, None);

    let model = Arc::new(phantom_model());
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let mut data = Data::new(Arc::clone(&model)).expect("data");
    let randomiser = Randomiser::new(&model, &ensemble_rules(0.005, None, 0.0)).expect("rules");
    randomiser
        .draw(&mut data, &mut rng::stream(11, Purpose::Model, 0, 0))
        .expect("draw");
    data.reset();
    task.start(&mut data, &mut rng::stream(11, Purpose::Evaluation, 0, 0))
        .expect("start");
    let n_step = (4.0 / model.timestep()).round() as usize;
    assert_eq!(rollout.steps.len(), n_step);
    let (mut sum, mut action) = (0.0, [0.0; 9]);
    for (k, step) in rollout.steps.iter().enumerate() {
        let time = k as f64 * model.timestep();
        let radius = 0.04 * (time / 2.0).min(1.0);
        let (sin, cos) = (std::f64::consts::PI * time).sin_cos();
        let target = [radius * cos, radius * sin];
        let mut observation = [data.qpos()[..15].to_vec(), data.qvel()[..15].to_vec()].concat();
        observation.extend_from_slice(task.object(&data));
        observation.extend_from_slice(&target);
        observation.push(data.mocap_pos()[2]);
        policy.mean(&observation, &mut action);
        data.ctrl_mut().copy_from_slice(&action);
        data.step().expect("step"); // one whole step, not two halves
        let object = task.object(&data);
        let distance = 100.0 * (object[0] - target[0]).hypot(object[1] - target[1]);
        // the two ways to the sine differ in the last bit, which the contacts amplify
        assert!(
            (step.distance_cm - distance).abs() < 1e-6,
            "step {k}: {} {distance}",
            step.distance_cm
        );
        sum += distance;
    }
    assert!((rollout.mean_distance_cm - sum / n_step as f64).abs() < 1e-6);
    assert_eq!(evaluation.mean_distance_cm, rollout.mean_distance_cm);
    assert_eq!(evaluation.std_cm, 0.0);
    assert!(rollout.rms_torque_nm > 0.01);
}

#[test]
fn an_object_at_rest_is_as_far_as_the_path() {
    // the mean of the target's radius over the path: half of it grows from 0 to 4 cm, the other stays
    let evaluation = run(&AffineGaussian::zeros(36, 9, -1.0), 2);
    let expected = 100.0 * (0.5 * spiral::RADIUS_M / 2.0 + 0.5 * spiral::RADIUS_M);
    assert!(
        (evaluation.mean_distance_cm - expected).abs() < 0.4,
        "{}",
        evaluation.mean_distance_cm
    );
}

#[test]
fn a_breakdown_at_once_is_no_good_figure() {
    let mut broken = AffineGaussian::zeros(36, 9, -1.0);
    let mut theta = broken.parameters();
    theta[36] = 1e200; // beyond what the engine takes
    broken.set_parameters(&theta).expect("finite");
    let evaluation = run_on(unlimited_model(), &broken, 2);
    for rollout in &evaluation.rollouts {
        assert!(rollout.diverged.is_some() && rollout.steps.is_empty());
    }
    // the object stays at the origin
    assert!(
        (evaluation.mean_distance_cm - 3.0).abs() < 0.01,
        "{}",
        evaluation.mean_distance_cm
    );
}

#[test]
fn no_rollouts_and_wrong_sizes_are_not_zero_centimetres() {
    assert!(run(&policy(), 0).mean_distance_cm.is_nan());
    let model = Arc::new(phantom_model());
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let request = EvaluationRequest {
        n_rollout: 1,
        seed: 0,
    };
    let small = AffineGaussian::zeros(35, 9, 0.0);
    let error = evaluate(&model, &task, &Randomiser::default(), &small, request).expect_err("size");
    assert!(
        error.to_string().contains("maps 35 observations"),
        "{error}"
    );
}

#[test]
fn seeds_and_rollouts_differ_and_repeat() {
    let (a, b) = (run(&policy(), 2), run(&policy(), 2));
    assert_eq!(a, b);
    assert_ne!(
        a.rollouts[0].mean_distance_cm,
        a.rollouts[1].mean_distance_cm
    );
    let mean = f64::midpoint(
        a.rollouts[0].mean_distance_cm,
        a.rollouts[1].mean_distance_cm,
    );
    assert!((a.mean_distance_cm - mean).abs() < 1e-12);
}
