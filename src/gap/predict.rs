//! How much of a force follows from position, velocity and motor force, whatever the law.
//!
//! Kernel ridge regression on a sum of kernels, of any quadratic function of all joints' inputs, and for each joint any
//! function of its position times 1, its direction, velocity and motor force, and any of its velocity times 1 and motor
//! force: Coulomb friction by place, springs that stiffen and friction by speed are among them. What is predicted of a
//! stretch of time comes from the others,
//!
//! ```text
//! A = K + λ I        f − f̂ = (A⁻¹)ᵍᵍ⁻¹ (A⁻¹ f)ᵍ  in stretch g        explainable = 1 − Σ (f − f̂)²/Σ f²
//! ```
//!
//! the best of a few λ and lengths. References: Rasmussen and Williams 2006, 2.2 and 5.4.2 (leave-one-out, here by blocks);
//! Duvenaud, Nickisch and Rasmussen 2011 (additive kernels).

use nalgebra::{DMatrix, DVector};

use super::locate::Missing;

/// λ, as parts of the kernel's mean diagonal.
const RIDGES: [f64; 4] = [1e-3, 1e-2, 1e-1, 1.0];
/// Distances over which functions of one input change, in its standard deviations.
const LENGTHS: [f64; 2] = [0.3, 1.0];
/// Root mean square of velocity, by the part of it at which a direction is full.
const FULL: f64 = 10.0;

/// Which inputs are looked at.
#[derive(Clone, Copy)]
pub(super) struct Inputs {
    /// of all joints
    pub position: bool,
    /// with its direction
    pub velocity: bool,
    /// motor force
    pub motor: bool,
}

impl Inputs {
    pub(super) const ALL: Self = Self {
        position: true,
        velocity: true,
        motor: true,
    };
}

/// One joint's, of mean 0 and variance 1, one a window; empty where not looked at.
struct Joint {
    position: Vec<f64>,
    velocity: Vec<f64>,
    direction: Vec<f64>,
    motor: Vec<f64>,
}

/// Part of Σ f² that is predicted from other stretches.
pub(super) fn predicted(missing: &Missing, f: &[f64], inputs: Inputs) -> f64 {
    let joints: Vec<Joint> = (0..missing.joints.len())
        .map(|j| Joint::new(missing, j, inputs))
        .collect();
    let total: f64 = f.iter().map(|v| v * v).sum();
    let mut best = f64::NEG_INFINITY;
    for length in LENGTHS {
        let kernel = kernel(&joints, f.len(), length);
        let diagonal = kernel.diagonal().mean();
        for ridge in RIDGES {
            let mut a = kernel.clone();
            for i in 0..f.len() {
                a[(i, i)] += ridge * diagonal;
            }
            let Some(wrong) = held_out(a, f, &missing.stretch_of) else {
                continue;
            };
            best = best.max(1.0 - wrong / total.max(f64::MIN_POSITIVE));
        }
    }
    best
}

/// Σ (f − f̂)², each stretch predicted from the others, with A of the module.
fn held_out(a: DMatrix<f64>, f: &[f64], stretch_of: &[usize]) -> Option<f64> {
    let inverse = a.cholesky()?.inverse();
    let weight = &inverse * DVector::from_column_slice(f);
    let count = stretch_of.iter().max().map_or(0, |m| m + 1);
    let mut wrong = 0.0;
    for stretch in 0..count {
        let own: Vec<usize> = (0..f.len()).filter(|w| stretch_of[*w] == stretch).collect();
        let block = DMatrix::from_fn(own.len(), own.len(), |i, j| inverse[(own[i], own[j])]);
        let right = DVector::from_fn(own.len(), |i, _| weight[own[i]]);
        wrong += block.cholesky()?.solve(&right).norm_squared();
    }
    Some(wrong)
}

fn kernel(joints: &[Joint], rows: usize, length: f64) -> DMatrix<f64> {
    let n: usize = joints.iter().map(|j| j.all().count()).sum();
    let near = |x: &[f64], a: usize, b: usize| f64::exp(-0.5 * ((x[a] - x[b]) / length).powi(2));
    let product = |x: &[f64], a: usize, b: usize| x.get(a).map_or(0.0, |own| own * x[b]);
    let mut out = DMatrix::zeros(rows, rows);
    for a in 0..rows {
        for b in 0..=a {
            let (mut linear, mut own) = (0.0, 0.0);
            for j in joints {
                linear += j.all().map(|x| x[a] * x[b]).sum::<f64>();
                let [v, s, u] = [&j.velocity, &j.direction, &j.motor].map(|x| product(x, a, b));
                if !j.position.is_empty() {
                    own += near(&j.position, a, b) * (1.0 + v + s + u);
                }
                if !j.velocity.is_empty() {
                    own += near(&j.velocity, a, b) * (1.0 + u);
                }
            }
            let quadratic = (1.0 + linear / n.max(1) as f64).powi(2);
            let k = quadratic + own / joints.len() as f64;
            (out[(a, b)], out[(b, a)]) = (k, k);
        }
    }
    out
}

impl Joint {
    fn new(missing: &Missing, joint: usize, inputs: Inputs) -> Self {
        let column = |m: &DMatrix<f64>, looked_at: bool| -> Vec<f64> {
            let rows = if looked_at { m.nrows() } else { 0 };
            (0..rows).map(|w| m[(w, joint)]).collect()
        };
        let velocity = column(&missing.velocity, inputs.velocity);
        let size = (velocity.iter().map(|v| v * v).sum::<f64>() / velocity.len() as f64).sqrt();
        let way = |v: &f64| (FULL * v / size.max(f64::MIN_POSITIVE)).tanh();
        Self {
            position: standard(column(&missing.position, inputs.position)),
            direction: standard(velocity.iter().map(way).collect()),
            velocity: standard(velocity),
            motor: standard(column(&missing.motor, inputs.motor)),
        }
    }

    /// Inputs that are looked at.
    fn all(&self) -> impl Iterator<Item = &Vec<f64>> {
        let all = [&self.position, &self.velocity, &self.direction, &self.motor];
        all.into_iter().filter(|x| !x.is_empty())
    }
}

fn standard(mut x: Vec<f64>) -> Vec<f64> {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    let sigma = (x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
    for v in &mut x {
        *v = (*v - mean) / sigma.max(f64::MIN_POSITIVE);
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One joint in 200 windows of 20 stretches, with a force by position, direction and motor.
    fn missing() -> Missing {
        let n = 200;
        let column = |of: &dyn Fn(f64) -> f64| DMatrix::from_fn(n, 1, |w, _| of(w as f64));
        Missing {
            joints: vec!["joint".into()],
            units: vec!["N m"],
            force: DMatrix::zeros(n, 1),
            position: column(&|t| (0.31 * t).sin() + 0.3 * (0.83 * t).cos()),
            velocity: column(&|t| (0.31 * t).cos()),
            motor: column(&|t| (1.7 * t).sin()),
            touching: vec![vec![false]; n],
            time_s: Vec::new(),
            stretch_of: (0..n).map(|w| w / 10).collect(),
        }
    }

    #[test]
    fn any_law_of_one_joint_is_predicted_from_what_it_depends_on() {
        let m = missing();
        let of = |law: &dyn Fn(f64, f64, f64) -> f64| -> Vec<f64> {
            (0..200)
                .map(|w| law(m.position[w], m.velocity[w], m.motor[w]))
                .collect()
        };
        let stiffening = of(&|q, _, _| -q * q * q);
        assert!(predicted(&m, &stiffening, Inputs::ALL) > 0.99);
        let by_place = of(&|q, v, _| -(1.0 + (4.0 * q).sin()) * v.signum());
        assert!(predicted(&m, &by_place, Inputs::ALL) > 0.9);
        let blind = Inputs {
            position: false,
            ..Inputs::ALL
        };
        assert!(
            predicted(&m, &by_place, Inputs::ALL) - predicted(&m, &by_place, blind) > 0.2,
            "position"
        );
    }

    #[test]
    fn chance_is_not_predicted() {
        let m = missing();
        let mut state = 1_u64;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 33) as f64 / f64::from(1_u32 << 31) - 0.5
        };
        let noise: Vec<f64> = (0..200).map(|_| next()).collect();
        assert!(predicted(&m, &noise, Inputs::ALL) < 0.1);
    }

    /// The blocks' formula against a fit without each stretch.
    #[test]
    fn a_stretch_is_predicted_by_the_others() {
        let m = missing();
        let f: Vec<f64> = (0..200).map(|w| m.position[w] + 0.1 * m.motor[w]).collect();
        let mut a = kernel(&[Joint::new(&m, 0, Inputs::ALL)], 200, 1.0);
        for i in 0..200 {
            a[(i, i)] += 0.5;
        }
        let mut wrong = 0.0;
        for stretch in 0..20 {
            let (own, rest): (Vec<usize>, Vec<usize>) =
                (0..200).partition(|w| m.stretch_of[*w] == stretch);
            let of = |i: &[usize], j: &[usize]| {
                DMatrix::from_fn(i.len(), j.len(), |r, c| a[(i[r], j[c])])
            };
            let y = DVector::from_fn(rest.len(), |i, _| f[rest[i]]);
            let factor = of(&rest, &rest).cholesky().expect("positive");
            let told = of(&own, &rest) * factor.solve(&y);
            wrong += own
                .iter()
                .zip(told.iter())
                .map(|(w, t)| (f[*w] - t).powi(2))
                .sum::<f64>();
        }
        let found = held_out(a, &f, &m.stretch_of).expect("positive");
        assert!((found / wrong - 1.0).abs() < 1e-6, "{found} {wrong}");
    }
}
