//! The value function: planted functions, its own report, and which half it saw.

use crate::synthetic::{normals, stream};
use phantom::npg::Known;
use phantom::npg::baseline::{Baseline, Fit, Target, fit};
use phantom::rng;
use phantom::team::Deal;

const HORIZON: usize = 25;
const N: usize = 3;

#[derive(Clone)]
struct Sample {
    observations: Vec<f64>,
    returns: Vec<f64>,
}

/// Uniform observations, so that none is clipped; `y` of observation, time and a normal number.
fn samples(n: usize, y: impl Fn(&[f64], f64, f64) -> f64) -> Vec<Sample> {
    (0..n as u64)
        .map(|index| {
            let mut rng = stream(index);
            let (mut observations, mut returns) = (Vec::new(), Vec::new());
            for t in 0..HORIZON {
                let s: Vec<f64> = (0..N)
                    .map(|i| rng::uniform(&mut rng, -1.0, 1.0 + i as f64))
                    .collect();
                returns.push(y(&s, t as f64 / HORIZON as f64, normals(&mut rng, 1)[0]));
                observations.extend(s);
            }
            Sample {
                observations,
                returns,
            }
        })
        .collect()
}

fn fit_to(samples: &[Sample], stride: usize, ridge: f64) -> Option<Fit> {
    let targets: Vec<Target<'_>> = samples
        .iter()
        .map(|s| Target {
            inputs: &s.observations,
            returns: &s.returns,
        })
        .collect();
    let deal = Deal::alone(targets.len());
    let known = Known {
        horizon: HORIZON,
        groups: &[],
        symmetries: &[],
    };
    fit(&deal, &targets, N, &known, stride, ridge).expect("alone")
}

fn values(baseline: &Baseline, sample: &Sample) -> Vec<f64> {
    let mut out = Vec::new();
    baseline.values(&sample.observations, 0, HORIZON, &mut out);
    out
}

fn planted(s: &[f64], time: f64, _: f64) -> f64 {
    3.0 - s[0] + 2.0 * s[1] * s[2] - 0.5 * s[0] * s[0] + time * time * time - 4.0 * time
}

#[test]
fn recovers_a_planted_quadratic() {
    let samples = samples(40, planted);
    for stride in [1, 4] {
        let fit = fit_to(&samples, stride, 1e-12).expect("enough");
        for baseline in [&fit.all, &fit.crossed[0], &fit.crossed[1]] {
            for sample in &samples {
                for (v, y) in values(baseline, sample).iter().zip(&sample.returns) {
                    // bias of the ridge: 1e-12 × condition (1e5) × weights
                    assert!((v - y).abs() < 1e-5, "stride {stride}: {v} {y}");
                }
            }
        }
        assert!((fit.report.explained_variance - 1.0).abs() < 1e-9);
        assert!(fit.report.condition > 1.0 && fit.report.condition.is_finite());
    }
}

#[test]
fn a_stride_visits_every_time() {
    // a spike at odd times only: seen by a stride of 2 just if the phase moves
    let mut samples = samples(80, |_, _, _| 0.0);
    for sample in &mut samples {
        sample
            .returns
            .iter_mut()
            .skip(1)
            .step_by(2)
            .for_each(|y| *y = 1.0);
    }
    let fit = fit_to(&samples, 2, 1e-6).expect("enough");
    // and in each half, or one of them would take the spike for all there is
    for baseline in [&fit.all, &fit.crossed[0], &fit.crossed[1]] {
        let mean = samples
            .iter()
            .flat_map(|s| values(baseline, s))
            .sum::<f64>()
            / (80 * HORIZON) as f64;
        assert!((mean - 0.48).abs() < 0.03, "{mean}");
    }
    assert_eq!(fit.report.n_sample, 40 * 13 + 40 * 12);
}

#[test]
fn reports_what_direct_computation_gives() {
    let samples = samples(60, |s, time, z| {
        planted(s, time, 0.0) + 2.0 * z + (5.0 * s[0]).sin()
    });
    let fit = fit_to(&samples, 1, 1e-2).expect("enough");
    let count = (60 * HORIZON) as f64;
    let all = || samples.iter().flat_map(|s| s.returns.iter().copied());
    let mean = all().sum::<f64>() / count;
    let variance = all().map(|y| (y - mean).powi(2)).sum::<f64>() / count;
    let fitted = samples.iter().flat_map(|s| values(&fit.all, s));
    let residual = fitted.zip(all()).map(|(v, y)| (v - y).powi(2)).sum::<f64>() / count;
    let expected = 1.0 - residual / variance;
    assert!((0.2..0.9).contains(&expected), "{expected}");
    assert!((fit.report.explained_variance - expected).abs() < 1e-9);
    assert_eq!(fit.report.n_sample, 60 * HORIZON);
}

#[test]
fn each_half_is_judged_by_the_other() {
    let mut samples = samples(40, |s, time, z| planted(s, time, 0.0) + z);
    let before = fit_to(&samples, 1, 1e-4).expect("enough");
    for sample in samples.iter_mut().step_by(2) {
        sample.returns.iter_mut().for_each(|y| *y = 10.0 - *y);
    }
    let after = fit_to(&samples, 1, 1e-4).expect("enough");
    // the even trajectories changed: the function used on them did not, that used on the odd ones did
    assert_eq!(before.crossed[0], after.crossed[0]);
    assert_ne!(before.crossed[1], after.crossed[1]);
    assert_ne!(before.all, after.all);
    let judged = values(&after.crossed[1], &samples[1]);
    let even = judged
        .iter()
        .zip(&samples[1].returns)
        .map(|(v, y)| v + y)
        .sum::<f64>();
    assert!(
        (even / HORIZON as f64 - 10.0).abs() < 1.0,
        "fitted to the even ones: {even}"
    );
}

#[test]
fn too_few_samples_make_no_function() {
    // 1 + 3 + 6 + 4 features, and each half needs as many samples
    assert!(fit_to(&samples(1, planted), 1, 1e-4).is_none());
    assert!(fit_to(&samples(2, planted), 2, 1e-4).is_none());
    assert!(fit_to(&samples(2, planted), 1, 1e-4).is_some());
    assert!(fit_to(&[], 1, 1e-4).is_none());
}

#[test]
fn constant_targets_and_observations_are_harmless() {
    let mut samples = samples(10, |_, _, _| 7.0);
    for sample in &mut samples {
        sample
            .observations
            .iter_mut()
            .skip(1)
            .step_by(N)
            .for_each(|s| *s = 0.145);
    }
    let fit = fit_to(&samples, 1, 1e-6).expect("enough");
    for v in values(&fit.all, &samples[3]) {
        assert!((v - 7.0).abs() < 1e-4, "{v}");
    }
    assert_eq!(
        fit.report.explained_variance, 0.0,
        "there is nothing to explain"
    );
    let mut bad = samples;
    bad[0].returns[0] = f64::NAN;
    assert!(fit_to(&bad, 1, 1e-6).is_none());
}

#[test]
fn inputs_that_follow_from_others_take_no_part() {
    // a linkage: the second input is the first, scaled, moved and all but exact
    let mut linked = samples(40, planted);
    for sample in &mut linked {
        for s in sample.observations.chunks_exact_mut(N) {
            s[1] = 4.0 - 2.0 * s[0] + 1e-3 * s[2];
        }
    }
    let report = fit_to(&linked, 1, 1e-4).expect("enough");
    // as if it were a constant
    let mut constant = linked.clone();
    for sample in &mut constant {
        sample
            .observations
            .iter_mut()
            .skip(1)
            .step_by(N)
            .for_each(|s| *s = 1.0);
    }
    let without = fit_to(&constant, 1, 1e-4).expect("enough");
    for (a, b) in linked.iter().zip(&constant) {
        for (v, w) in values(&report.all, a).iter().zip(values(&without.all, b)) {
            assert!((v - w).abs() < 1e-9, "{v} {w}");
        }
    }
    // with a fifth of its deviation of its own it takes part: moving it alone changes the value
    for sample in &mut linked {
        for s in sample.observations.chunks_exact_mut(N) {
            s[1] = 4.0 - 2.0 * s[0] + 0.2 * s[2];
        }
    }
    let all = fit_to(&linked, 1, 1e-4).expect("enough").all;
    let mut moved = linked[0].clone();
    moved.observations[1] += 0.1;
    assert_ne!(values(&all, &moved)[0], values(&all, &linked[0])[0]);
}

#[test]
fn an_unfitted_function_is_zero_and_files_are_checked() {
    let zero = Baseline::zero(N);
    assert_eq!(values(&zero, &samples(1, planted)[0]), vec![0.0; HORIZON]);
    assert!(zero.is_sound(N) && !zero.is_sound(N + 1));
    let text = r#"{"mean":[0,0,0],"inverse_scale":[1,1,1],"weights":[1,2]}"#;
    let bad: Baseline = serde_json::from_str(text).expect("right types");
    assert!(!bad.is_sound(N));
}
