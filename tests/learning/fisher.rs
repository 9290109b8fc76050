//! Both estimates of the metric: against dense matrices, against each other, and on degenerate observations.

use crate::synthetic::{batch, cosine, normals, some_policy};
use nalgebra::{DMatrix, DVector};
use phantom::npg::fisher::Fisher;
use phantom::policy::AffineGaussian;
use phantom::rollout::Trajectory;

const DAMPING: f64 = 1e-3;

/// E[φφᵀ], and E[u uᵀ] with the score in units of σ, sample by sample.
fn moments(policy: &AffineGaussian, batch: &[Trajectory]) -> (DMatrix<f64>, DMatrix<f64>) {
    let (n, n_action) = (policy.n_observation(), policy.n_action());
    let mut second = DMatrix::zeros(n + 1, n + 1);
    let mut outer = DMatrix::zeros(policy.n_parameter(), policy.n_parameter());
    let mut count = 0.0;
    for trajectory in batch {
        let noise = trajectory.noise.chunks_exact(n_action);
        for (observation, z) in trajectory.observations.chunks_exact(n).zip(noise) {
            let phi = DVector::from_iterator(n + 1, observation.iter().copied().chain([1.0]));
            let mut score = DVector::<f64>::zeros(policy.n_parameter());
            let weights = z.iter().flat_map(|z| phi.iter().map(move |f| z * f));
            let spreads = z.iter().map(|z| z * z - 1.0);
            for (out, value) in score.iter_mut().zip(weights.chain(spreads)) {
                *out = value;
            }
            second += &phi * phi.transpose();
            outer += &score * score.transpose();
            count += 1.0;
        }
    }
    (second / count, outer / count)
}

/// What damping the standardised matrix amounts to in raw coordinates: d T⁻¹T⁻ᵀ, where s = mean + scale s̃.
fn raw_damping(second: &DMatrix<f64>) -> DMatrix<f64> {
    let n = second.nrows() - 1;
    let mut back = DMatrix::identity(n + 1, n + 1);
    for j in 0..n {
        let mean = second[(n, j)];
        back[(j, j)] = (second[(j, j)] - mean * mean).sqrt();
        back[(j, n)] = mean;
    }
    &back * back.transpose() * DAMPING
}

fn correlated(rng: &mut phantom::rng::Stream) -> Vec<f64> {
    let x = normals(rng, 3);
    vec![x[0] + 2.0, 30.0 * (x[0] + x[1]), 0.02 * x[2] - 0.5]
}

fn gradient(n: usize) -> Vec<f64> {
    (0..n).map(|k| (0.7 * k as f64 + 0.3).cos()).collect()
}

#[test]
fn solve_inverts_the_damped_matrix() {
    let policy = some_policy(3, 2);
    let batch = batch(&policy, 40, 50, correlated, |_, _| 0.0);
    let (second, outer) = moments(&policy, &batch);
    let n = policy.n_parameter();
    let (mut exact, mut empirical) = (DMatrix::zeros(n, n), outer.clone());
    let (width, damping) = (second.nrows(), raw_damping(&second));
    for (i, l) in policy.log_sigma().iter().enumerate() {
        let at = (i * width, i * width);
        let block = (&second + &damping) / (2.0 * l).exp();
        exact.view_mut(at, (width, width)).copy_from(&block);
        let mut view = empirical.view_mut(at, (width, width));
        view += &damping;
        let k = policy.weights().len() + i;
        exact[(k, k)] = 2.0 * (1.0 + DAMPING);
        empirical[(k, k)] += 2.0 * DAMPING;
    }
    // out of units of σ
    let sigma = |k: usize| policy.log_sigma().get(k / width).map_or(1.0, |l| l.exp());
    let sigma = |k: usize| {
        if k < policy.weights().len() {
            sigma(k)
        } else {
            1.0
        }
    };
    empirical = DMatrix::from_fn(n, n, |i, j| empirical[(i, j)] / (sigma(i) * sigma(j)));

    let g = gradient(n);
    let log_sigma = policy.log_sigma();
    for (name, matrix, fisher) in [
        ("exact", exact, Fisher::exact(&second, log_sigma, DAMPING)),
        (
            "empirical",
            empirical,
            Fisher::empirical(&outer, &second, log_sigma, DAMPING),
        ),
    ] {
        let x = DVector::from_vec(fisher.expect("factored").solve(&g));
        let back = matrix * x;
        // condition of the raw matrix about 1e6 (scales 0.02 and 30)
        for (k, (b, g)) in back.iter().zip(&g).enumerate() {
            assert!((b - g).abs() < 1e-8, "{name} {k}: {b} {g}");
        }
    }
}

#[test]
fn both_estimates_agree_on_a_large_batch() {
    let policy = some_policy(3, 2);
    let batch = batch(&policy, 200, 200, correlated, |_, _| 0.0);
    let (second, outer) = moments(&policy, &batch);
    let exact = Fisher::exact(&second, policy.log_sigma(), 1e-4).expect("factored");
    let empirical = Fisher::empirical(&outer, &second, policy.log_sigma(), 1e-4).expect("factored");
    // a gradient of natural scale: F times a step that is 1 in standard coordinates
    let step = gradient(policy.n_parameter());
    let n_weight = policy.weights().len();
    let scale = [1.0, 42.4, 0.02, 1.0];
    let g: Vec<f64> = step
        .iter()
        .enumerate()
        .map(|(k, s)| if k < n_weight { s * scale[k % 4] } else { *s })
        .collect();
    let whiten = |x: Vec<f64>| -> Vec<f64> {
        x.iter()
            .enumerate()
            .map(|(k, x)| if k < n_weight { x * scale[k % 4] } else { *x })
            .collect()
    };
    let (a, b) = (whiten(exact.solve(&g)), whiten(empirical.solve(&g)));
    let cosine = cosine(&a, &b);
    assert!(cosine > 0.98, "{cosine}");
    assert!(cosine < 1.0 - 1e-9, "two estimates, not one");
}

#[test]
fn constant_observations_get_no_step() {
    let policy = some_policy(3, 2);
    let observe = |rng: &mut phantom::rng::Stream| vec![normals(rng, 1)[0], 0.145, 0.0];
    let batch = batch(&policy, 20, 50, observe, |_, _| 0.0);
    let (second, outer) = moments(&policy, &batch);
    let log_sigma = policy.log_sigma();
    let n_weight = policy.weights().len();
    for fisher in [
        Fisher::exact(&second, log_sigma, 1e-4),
        Fisher::empirical(&outer, &second, log_sigma, 1e-4),
    ] {
        let x = fisher
            .expect("factored")
            .solve(&gradient(policy.n_parameter()));
        assert!(x.iter().all(|v| v.is_finite()));
        for row in x[..n_weight].chunks_exact(4) {
            assert!(row[0] != 0.0 && row[3] != 0.0);
            assert_eq!(row[1..3], [0.0, 0.0]);
        }
    }
}

#[test]
fn dependent_observations_share_the_step() {
    let policy = AffineGaussian::zeros(3, 1, 0.0);
    let observe = |rng: &mut phantom::rng::Stream| {
        let x = normals(rng, 2);
        vec![x[0], x[1], x[0]] // the third repeats the first
    };
    let batch = batch(&policy, 20, 50, observe, |_, _| 0.0);
    let (second, outer) = moments(&policy, &batch);
    // a gradient that such observations can have
    let g = [1.0, 0.5, 1.0, 0.2, 0.1];
    for fisher in [
        Fisher::exact(&second, &[0.0], 1e-6),
        Fisher::empirical(&outer, &second, &[0.0], 1e-6),
    ] {
        let x = fisher.expect("factored").solve(&g);
        assert!(x.iter().all(|v| v.abs() < 10.0), "{x:?}");
        assert!((x[0] - x[2]).abs() < 1e-6 * x[0].abs(), "{x:?}");
    }
}

#[test]
fn unusable_moments_are_refused() {
    let second = DMatrix::from_element(3, 3, f64::NAN);
    assert!(Fisher::exact(&second, &[0.0], 1e-4).is_none());
}
