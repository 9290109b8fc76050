//! The policy's density, score and sampling against their definitions.

use crate::synthetic::{normals, some_policy, stream};
use phantom::policy::{AffineGaussian, PolicyError};

#[test]
fn score_is_the_derivative_of_the_log_probability() {
    let policy = some_policy(4, 3);
    let mut rng = stream(0);
    let observation = normals(&mut rng, 4);
    let (mut action, mut noise) = (vec![0.0; 3], vec![0.0; 3]);
    policy.sample(&observation, &mut rng, &mut action, &mut noise);
    let mut score = vec![0.0; policy.n_parameter()];
    policy.score(&observation, &noise, &mut score);
    let theta = policy.parameters();
    for k in 0..theta.len() {
        let h = 1e-5;
        let at = |offset: f64| {
            let (mut moved, mut t) = (policy.clone(), theta.clone());
            t[k] += offset;
            moved.set_parameters(&t).expect("finite");
            moved.log_probability(&observation, &action)
        };
        let difference = (at(h) - at(-h)) / (2.0 * h);
        // truncation h² times the third derivative (up to 8 z² here), rounding 1e-16 / h
        let tolerance = 1e-8 * (1.0 + score[k].abs()) * (1.0 + noise[k % 3].powi(2));
        assert!(
            (difference - score[k]).abs() < 10.0 * tolerance,
            "θ[{k}]: {difference} {}",
            score[k]
        );
    }
}

#[test]
fn density_integrates_to_one_about_the_mean() {
    let policy = some_policy(2, 1);
    let observation = [0.7, -1.1];
    let mut mean = [0.0];
    policy.mean(&observation, &mut mean);
    let sigma = policy.log_sigma()[0].exp();
    let (mut mass, mut first, mut second) = (0.0, 0.0, 0.0);
    let step = 0.01 * sigma;
    for k in -1000..=1000 {
        let a = mean[0] + f64::from(k) * step;
        let p = policy.log_probability(&observation, &[a]).exp() * step;
        mass += p;
        first += p * (a - mean[0]);
        second += p * (a - mean[0]).powi(2);
    }
    // the trapezoidal rule on an analytic function: exact to rounding
    assert!((mass - 1.0).abs() < 1e-10, "{mass}");
    assert!(first.abs() < 1e-12);
    assert!((second / (sigma * sigma) - 1.0).abs() < 1e-10);
}

#[test]
fn actions_are_independent_of_each_other() {
    let policy = some_policy(2, 2);
    let (observation, action) = ([0.3, 0.2], [0.5, -0.4]);
    let mut mean = [0.0; 2];
    policy.mean(&observation, &mut mean);
    let expected: f64 = (0..2)
        .map(|i| {
            let variance = (2.0 * policy.log_sigma()[i]).exp();
            -0.5 * (action[i] - mean[i]).powi(2) / variance
                - 0.5 * (std::f64::consts::TAU * variance).ln()
        })
        .sum();
    assert!((policy.log_probability(&observation, &action) - expected).abs() < 1e-12);
}

#[test]
fn a_sample_is_the_mean_plus_scaled_noise() {
    let policy = some_policy(3, 4);
    let mut rng = stream(1);
    let (mut action, mut noise, mut mean) = ([0.0; 4], [0.0; 4], [0.0; 4]);
    let mut squares = [0.0; 4];
    let n = 20_000;
    for _ in 0..n {
        let observation = normals(&mut rng, 3);
        policy.sample(&observation, &mut rng, &mut action, &mut noise);
        policy.mean(&observation, &mut mean);
        for i in 0..4 {
            assert_eq!(action[i], mean[i] + policy.log_sigma()[i].exp() * noise[i]);
            squares[i] += (action[i] - mean[i]).powi(2) / f64::from(n);
        }
    }
    for (square, l) in squares.iter().zip(policy.log_sigma()) {
        // four standard errors, sqrt(2 / n) each
        assert!((square / (2.0 * l).exp() - 1.0).abs() < 0.04);
    }
}

#[test]
fn mean_is_rows_times_observation_plus_bias() {
    let mut policy = AffineGaussian::zeros(2, 2, 0.0);
    policy
        .set_parameters(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 0.0])
        .expect("finite");
    let mut mean = [0.0; 2];
    policy.mean(&[10.0, 100.0], &mut mean);
    assert_eq!(mean, [213.0, 546.0]);
}

#[test]
fn parameters_are_replaced_whole_or_not_at_all() {
    let mut policy = some_policy(2, 2);
    let before = policy.clone();
    let n = policy.n_parameter();
    assert!(matches!(
        policy.set_parameters(&vec![0.0; n + 1]),
        Err(PolicyError::Length { .. })
    ));
    let mut theta = vec![0.5; n];
    theta[n - 1] = f64::NAN;
    let error = policy.set_parameters(&theta).expect_err("NaN");
    assert_eq!(
        error.to_string(),
        format!("`parameters[{}]` is NaN, not a finite number", n - 1)
    );
    assert_eq!(policy, before);
}

#[test]
fn json_reads_back_to_the_same_bits() {
    let policy = some_policy(5, 3).with_names(vec!["a".into(); 5], vec!["b".into(); 3]);
    let text = serde_json::to_string(&policy).expect("json");
    assert_eq!(
        serde_json::from_str::<AffineGaussian>(&text).expect("json"),
        policy
    );
}

#[test]
fn a_policy_from_a_file_is_checked() {
    let good = serde_json::to_value(some_policy(2, 1)).expect("json");
    let cases: [(&str, serde_json::Value, &str); 7] = [
        ("format", "other".into(), "format is `other`"),
        (
            "n_observation",
            3.into(),
            "maps 3 observations to 1 actions, the task needs 2 to 1",
        ),
        ("n_action", 0.into(), "maps 2 observations to 0 actions"),
        (
            "weights",
            vec![1.0, 2.0].into(),
            "`weights` has 2 values, expected 3",
        ),
        (
            "log_sigma",
            Vec::<f64>::new().into(),
            "`log_sigma` has 0 values, expected 1",
        ),
        (
            "log_sigma",
            vec![800.0].into(),
            "`log_sigma[0]` is 800, expected -20 to 20",
        ),
        (
            "observation_names",
            vec!["x"].into(),
            "`observation_names` has 1 values, expected 2",
        ),
    ];
    for (key, value, expected) in cases {
        let mut bad = good.clone();
        bad[key] = value;
        let policy: AffineGaussian = serde_json::from_value(bad).expect("right types");
        let error = policy.check(2, 1).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error}");
    }
    serde_json::from_value::<AffineGaussian>(good)
        .expect("json")
        .check(2, 1)
        .expect("good");
}
