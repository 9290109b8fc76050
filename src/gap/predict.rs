//! How much of the missing forces follows from position, velocity and motor force, whatever the law.
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

use nalgebra::DMatrix;

use super::locate::Missing;
use super::score::rms;

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

/// Part of Σ f² that is predicted from other stretches, of every joint's missing force.
pub(super) fn predicted(missing: &Missing, inputs: Inputs) -> Vec<f64> {
    let (rows, n) = missing.force.shape();
    let joints: Vec<Joint> = (0..n).map(|j| Joint::new(missing, j, inputs)).collect();
    let square = |f: &DMatrix<f64>, j: usize| f.column(j).norm_squared();
    let mut best = vec![f64::NEG_INFINITY; n];
    for length in LENGTHS {
        let kernel = kernel(&joints, rows, length);
        let diagonal = kernel.diagonal().mean();
        for ridge in RIDGES {
            let mut a = kernel.clone();
            for i in 0..rows {
                a[(i, i)] += ridge * diagonal;
            }
            let Some(wrong) = wrong(a, &missing.force, &missing.stretch_of) else {
                continue;
            };
            for (j, best) in best.iter_mut().enumerate() {
                let total = square(&missing.force, j).max(f64::MIN_POSITIVE);
                *best = best.max(1.0 - square(&wrong, j) / total);
            }
        }
    }
    best
}

/// f − f̂ of every column, each stretch predicted from the others, with A of the module.
fn wrong(a: DMatrix<f64>, f: &DMatrix<f64>, stretch_of: &[usize]) -> Option<DMatrix<f64>> {
    let inverse = a.cholesky()?.inverse();
    let mut wrong = &inverse * f;
    let count = stretch_of.iter().max().map_or(0, |m| m + 1);
    for stretch in 0..count {
        let of = stretch_of.iter().enumerate();
        let own: Vec<usize> = of.filter(|(_, s)| **s == stretch).map(|(w, _)| w).collect();
        let block = inverse.select_rows(&own).select_columns(&own);
        let solved = block.cholesky()?.solve(&wrong.select_rows(&own));
        for (row, &w) in solved.row_iter().zip(&own) {
            wrong.set_row(w, &row);
        }
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
        let size = rms(&velocity);
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
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    for v in &mut x {
        *v -= mean;
    }
    let sigma = rms(&x).max(f64::MIN_POSITIVE);
    for v in &mut x {
        *v /= sigma;
    }
    x
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;
    use crate::rng::{self, Purpose};

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
            origin: Vec::new(),
            names: Vec::new(),
            stretch_of: (0..n).map(|w| w / 10).collect(),
        }
    }

    /// Of one joint's force.
    fn part(f: Vec<f64>, inputs: Inputs) -> f64 {
        let force = DMatrix::from_vec(f.len(), 1, f);
        predicted(&Missing { force, ..missing() }, inputs)[0]
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
        assert!(part(stiffening, Inputs::ALL) > 0.99);
        let by_place = of(&|q, v, _| -(1.0 + (4.0 * q).sin()) * v.signum());
        let all = part(by_place.clone(), Inputs::ALL);
        assert!(all > 0.9);
        let blind = Inputs {
            position: false,
            ..Inputs::ALL
        };
        assert!(all - part(by_place, blind) > 0.2, "position");
    }

    #[test]
    fn chance_is_not_predicted() {
        let mut rng = rng::stream(1, Purpose::SensorNoise, 0, 0);
        let noise = (0..200)
            .map(|_| rng::uniform(&mut rng, -0.5, 0.5))
            .collect();
        assert!(part(noise, Inputs::ALL) < 0.1);
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
        let mut expected = 0.0;
        for stretch in 0..20 {
            let (own, rest): (Vec<usize>, Vec<usize>) =
                (0..200).partition(|w| m.stretch_of[*w] == stretch);
            let of = |i: &[usize], j: &[usize]| {
                DMatrix::from_fn(i.len(), j.len(), |r, c| a[(i[r], j[c])])
            };
            let y = DVector::from_fn(rest.len(), |i, _| f[rest[i]]);
            let factor = of(&rest, &rest).cholesky().expect("positive");
            let told = of(&own, &rest) * factor.solve(&y);
            expected += own
                .iter()
                .zip(told.iter())
                .map(|(w, t)| (f[*w] - t).powi(2))
                .sum::<f64>();
        }
        let f = DMatrix::from_vec(200, 1, f);
        let found = wrong(a, &f, &m.stretch_of)
            .expect("positive")
            .norm_squared();
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
    }
}
