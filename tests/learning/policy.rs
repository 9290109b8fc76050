//! The policy's mean, parameters and file.

use crate::synthetic::some_policy;
use phantom::policy::{AffineGaussian, PolicyError};

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
