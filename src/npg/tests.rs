//! Ends of trajectories: what is cut off at the horizon counts with the value of the state it really ended in.

use super::{
    Baseline, Deal, Known, NpgConfig, Target, Trajectory, advantages, baseline, fit_baseline,
};

const HORIZON: usize = 30;
const KNOWN: Known<'_> = Known {
    horizon: HORIZON,
    groups: &[],
    symmetries: &[],
};
const DISCOUNT: f64 = 0.9;

/// A process that stays at `s` and pays `s` a step: its value is s / (1 - γ) at any time.
fn standing(s: f64) -> Trajectory {
    Trajectory {
        observations: vec![s; HORIZON],
        rewards: vec![s; HORIZON],
        value_inputs: vec![s; HORIZON + 1],
        ..Trajectory::default()
    }
}

fn known_value(trajectories: &[Trajectory]) -> Baseline {
    let returns: Vec<Vec<f64>> = trajectories
        .iter()
        .map(|t| {
            t.observations
                .iter()
                .map(|s| s / (1.0 - DISCOUNT))
                .collect()
        })
        .collect();
    let targets: Vec<Target<'_>> = trajectories
        .iter()
        .zip(&returns)
        .map(|(t, returns)| Target {
            inputs: &t.value_inputs[..HORIZON],
            returns,
        })
        .collect();
    baseline::fit(&Deal::alone(targets.len()), &targets, 1, &KNOWN, 1, 1e-12)
        .expect("alone")
        .expect("enough samples")
        .all
}

fn config() -> NpgConfig {
    NpgConfig {
        discount: DISCOUNT,
        gae_lambda: 0.8,
        value_ridge: 1e-12,
        value_stride: 1,
        ..NpgConfig::default()
    }
}

fn process() -> Vec<Trajectory> {
    (0..40).map(|i| standing(f64::from(i % 7) - 2.0)).collect()
}

fn fit(value: &Baseline, batch: &[Trajectory]) -> Baseline {
    fit_baseline(value, batch, &Deal::alone(batch.len()), &KNOWN, &config())
        .expect("alone")
        .expect("enough samples")
        .all
}

#[test]
fn a_known_value_leaves_no_advantage() {
    let mut batch = process();
    let value = known_value(&batch);
    batch[3].value_inputs[HORIZON] += 1.0; // ends one higher than where it was last seen
    for (index, trajectory) in batch.iter().enumerate() {
        let row = advantages(&value, trajectory, HORIZON, &config());
        for (t, a) in row.iter().enumerate() {
            let surprise = DISCOUNT / (1.0 - DISCOUNT);
            let expected = if index == 3 {
                (DISCOUNT * 0.8).powi((HORIZON - 1 - t) as i32) * surprise
            } else {
                0.0
            };
            assert!((a - expected).abs() < 1e-6, "{index} {t}: {a} {expected}");
        }
    }
}

#[test]
fn the_value_of_a_process_without_end_is_kept() {
    let batch = process();
    let mut value = known_value(&batch);
    // were the end of the horizon the end of the process, the value would fall to the last reward there
    for _ in 0..5 {
        value = fit(&value, &batch);
    }
    let mut values = Vec::new();
    value.values(&batch[6].observations, 0, HORIZON, &mut values);
    for v in values {
        assert!((v - 4.0 / (1.0 - DISCOUNT)).abs() < 1e-4, "{v}");
    }
}

#[test]
fn an_absurd_trajectory_does_not_bend_the_value_of_the_others() {
    let mut batch = process();
    let value = known_value(&batch);
    batch[3].rewards.fill(-1e9);
    let fitted = fit(&value, &batch);
    let mut values = Vec::new();
    for t in [&batch[0], &batch[10]] {
        fitted.values(&t.observations, 0, HORIZON, &mut values);
    }
    assert!(values.iter().all(|v| v.abs() < 200.0), "{values:?}");
}
