//! A symmetric update is the plain update of a batch to which every turned trajectory was added.

use crate::synthetic::{batch, difference, normals, some_policy};
use nalgebra::DMatrix;
use phantom::npg::baseline::Baseline;
use phantom::npg::fisher::FisherMode;
use phantom::npg::{self, Known, NpgConfig, Update};
use phantom::policy::AffineGaussian;
use phantom::rollout::Trajectory;
use phantom::task::symmetry::{Symmetry, has_all, mean_of_parameters};
use phantom::team::Deal;

const HORIZON: usize = 20;

/// Three motors in a ring; a place in the plane and a height are seen.
fn turns() -> Vec<Symmetry> {
    let turn = |k: usize| {
        let (sin, cos) = (k as f64 * std::f64::consts::TAU / 3.0).sin_cos();
        let mut action = DMatrix::zeros(3, 3);
        for i in 0..3 {
            action[((i + k) % 3, i)] = 1.0;
        }
        let observation =
            DMatrix::from_row_slice(3, 3, &[cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0]);
        Symmetry {
            action,
            value_input: observation.clone(),
            observation,
        }
    };
    vec![turn(1), turn(2)]
}

fn symmetric_policy() -> AffineGaussian {
    let mut policy = some_policy(3, 3);
    let mean = mean_of_parameters(&turns(), &policy.parameters());
    policy.set_parameters(&mean).expect("finite");
    policy
}

fn turned(trajectory: &Trajectory, turn: &Symmetry) -> Trajectory {
    let rows = |matrix: &DMatrix<f64>, all: &[f64]| -> Vec<f64> {
        let turned = matrix * DMatrix::from_column_slice(matrix.ncols(), all.len() / 3, all);
        turned.as_slice().to_vec()
    };
    Trajectory {
        observations: rows(&turn.observation, &trajectory.observations),
        value_inputs: rows(&turn.value_input, &trajectory.value_inputs),
        actions: rows(&turn.action, &trajectory.actions),
        noise: rows(&turn.action, &trajectory.noise),
        ..trajectory.clone()
    }
}

fn update(
    policy: &AffineGaussian,
    batch: &[Trajectory],
    symmetries: &[Symmetry],
    fisher: FisherMode,
) -> Update {
    let config = NpgConfig {
        noise_correlation: 0.0,
        value_stride: 1,
        fisher,
        ..NpgConfig::default()
    };
    let known = Known {
        horizon: HORIZON,
        groups: &[],
        symmetries,
    };
    let deal = Deal::alone(batch.len());
    npg::compute(policy, &Baseline::zero(3), batch, &deal, &known, &config).expect("a step")
}

#[test]
fn turns_stand_for_turned_trajectories() {
    let (turns, policy) = (turns(), symmetric_policy());
    let reward = |s: &[f64], a: &[f64]| s[0] * a[0] - a[1] * a[1] + s[2] * s[2];
    let few = batch(&policy, 60, HORIZON, |rng| normals(rng, 3), reward);
    // turned ones stay in the half of the trajectory they come from
    let mut many = Vec::new();
    for pair in few.chunks(2) {
        many.extend_from_slice(pair);
        for turn in &turns {
            many.extend(pair.iter().map(|t| turned(t, turn)));
        }
    }
    for fisher in [FisherMode::Exact, FisherMode::Empirical] {
        let short = update(&policy, &few, &turns, fisher);
        let long = update(&policy, &many, &[], fisher);
        let plain = update(&policy, &few, &[], fisher);
        let off = |update: &Update| {
            let change = difference(&update.policy.parameters(), &long.policy.parameters());
            change.iter().fold(0.0_f64, |max, c| max.max(c.abs()))
        };
        assert!(off(&short) < 1e-9, "{fisher:?}: {}", off(&short));
        assert!(off(&plain) > 1e-3, "{fisher:?}: {}", off(&plain));
        let cosines = [&short, &long].map(|u| u.report.half_cosine);
        assert!((cosines[0] - cosines[1]).abs() < 1e-9, "{cosines:?}");
        let [a, b] = [&short, &long].map(|u| u.fit.as_ref().expect("a fit").all.clone());
        let values = |baseline: &Baseline| {
            let mut values = Vec::new();
            baseline.values(&few[0].value_inputs, 0, HORIZON, &mut values);
            values
        };
        for (a, b) in values(&a).iter().zip(values(&b)) {
            assert!((a - b).abs() < 1e-8, "{a} {b}");
        }
        assert!(has_all(&turns, &short.policy));
        assert!(!has_all(&turns, &plain.policy));
    }
}
