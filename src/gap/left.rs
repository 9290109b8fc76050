//! Is there more to explain than the catalogue has? A flexible regression says what could be.
//!
//! The missing forces f of the windows are predicted from position, velocity and motor force of all joints, by ridge
//! regression on a polynomial with the directions of motion, each stretch of time from the others:
//!
//! ```text
//! explainable = 1 − Σ (f − f̂)² / Σ f²        f̂ without the stretch that is predicted
//! ```
//!
//! A force is reported that is of practical size and of which a good part can be predicted; or any of practical size,
//! where a good part of the readings is left:
//!
//! ```text
//! remaining² = (|r̃|² − noise²)/|m̃|²        of the channel where it is largest
//! ```
//!
//! with m̃ what the motors do to the readings. Then whatever was found is not what is missing, or not all of it. Small arms
//! whose one effect was named rightly kept 0.2 to 1.3 % of the motors (11 % of 109 with a delay of 19 ms), a real double
//! pendulum with two frictions 20 % of 99; arms whose effect is in no catalogue 13 to 98 %, at least 0.6 of what they had, or,
//! friction by place, 6 to 9 % of 8 to 21.

use nalgebra::{DMatrix, DVector};

use super::GapError;
use super::linear::Linear;
use super::locate::Missing;
use super::result::{Left, Remaining};
use super::screen::largest_part;
use super::search::Search;

/// Part of the motors' force below which nothing is reported.
const SIZE: f64 = 0.02;
/// Predictable part from which there is structure.
const STRUCTURE: f64 = 0.25;
/// Part of the motors' response, and of what there was at first, from which what is left is a force that the catalogue
/// does not have.
const MUCH: f64 = 0.03;
const MOST: f64 = 1.0 / 3.0;
/// Parts of the features' variance that ridges are.
const RIDGES: [f64; 3] = [1e-3, 1e-1, 10.0];

impl Search<'_> {
    /// Of the module; `linear` is of the present model, `motors` the squared length of what they do to each channel.
    /// None where they do nothing.
    pub(super) fn remaining(&self, linear: &Linear, motors: Option<&[f64]>) -> Option<f64> {
        let rows = &linear.rows;
        let mut left = linear.by_channel(rows.iter().map(|row| &row.residual));
        for row in rows {
            for (&c, weight) in row.channel.iter().zip(&row.weight) {
                left[c] -= weight * weight * self.noise_square(c);
            }
        }
        for square in &mut left {
            *square = square.max(0.0);
        }
        largest_part(&left, motors?)
    }

    /// Whether what remains is at most `part` of what there was `before`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn takes(&self, part: f64, before: Option<f64>) -> Result<bool, GapError> {
        let linear = self.windows.linearise(&self.x)?;
        let motors = linear.motors(&self.windows, &self.x)?;
        let motors = motors.map(|m| linear.by_channel(&m.parts));
        let after = self.remaining(&linear, motors.as_deref());
        Ok((before.zip(after)).is_some_and(|(before, after)| after <= part * before))
    }
}

/// Whether what remains is another force than those found.
pub(super) fn much(remaining: &Remaining) -> bool {
    let most = remaining
        .before
        .map_or(MUCH, |before| MUCH.max(MOST * before));
    remaining.after.is_some_and(|after| after >= most)
}

/// Joints at which structure is left, or all with a force of practical size if `much` is left of the readings.
pub(super) fn left(missing: &Missing, much: bool) -> Vec<Left> {
    let n = missing.joints.len();
    let mut out = Vec::new();
    for joint in 0..n {
        let f: Vec<f64> = missing.force.column(joint).iter().copied().collect();
        let rms = |v: &mut dyn Iterator<Item = f64>| {
            let (sum, n) = v.fold((0.0, 0.0), |(s, n), x| (s + x * x, n + 1.0));
            f64::sqrt(sum / f64::max(n, 1.0))
        };
        let size = rms(&mut f.iter().copied());
        let motor = rms(&mut missing.motor.column(joint).iter().copied());
        if size < SIZE * motor || motor == 0.0 {
            continue;
        }
        let all: Vec<usize> = (0..n).collect();
        let explainable = predicted(missing, &f, &all, Inputs::ALL);
        if explainable < STRUCTURE && !much {
            continue;
        }
        let without = [
            (
                "position",
                Inputs {
                    position: false,
                    ..Inputs::ALL
                },
            ),
            (
                "velocity",
                Inputs {
                    velocity: false,
                    ..Inputs::ALL
                },
            ),
            (
                "motor force",
                Inputs {
                    motor: false,
                    ..Inputs::ALL
                },
            ),
        ];
        let inputs = without.into_iter().map(|(name, inputs)| {
            (
                name.to_owned(),
                explainable - predicted(missing, &f, &all, inputs),
            )
        });
        out.push(Left {
            channel: missing.joints[joint].clone(),
            size,
            unit: missing.units[joint].to_owned(),
            explainable: explainable.max(0.0),
            inputs: inputs.collect(),
        });
    }
    out
}

#[derive(Clone, Copy)]
struct Inputs {
    position: bool,
    velocity: bool,
    motor: bool,
}

impl Inputs {
    const ALL: Self = Self {
        position: true,
        velocity: true,
        motor: true,
    };
}

/// Part of Σ f² that is predicted held out, at the best ridge.
fn predicted(missing: &Missing, f: &[f64], joints: &[usize], inputs: Inputs) -> f64 {
    let rows = f.len();
    let mut base: Vec<Vec<f64>> = Vec::new();
    for &j in joints {
        let column = |m: &DMatrix<f64>| -> Vec<f64> { m.column(j).iter().copied().collect() };
        if inputs.position {
            base.push(column(&missing.position));
        }
        if inputs.velocity {
            let v = column(&missing.velocity);
            let size = (v.iter().map(|x| x * x).sum::<f64>() / rows as f64).sqrt();
            base.push(
                v.iter()
                    .map(|x| (10.0 * x / size.max(f64::MIN_POSITIVE)).tanh())
                    .collect(),
            );
            base.push(v);
        }
        if inputs.motor {
            base.push(column(&missing.motor));
        }
    }
    for column in &mut base {
        let mean = column.iter().sum::<f64>() / rows as f64;
        let sigma = (column.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / rows as f64).sqrt();
        for x in column.iter_mut() {
            *x = (*x - mean) / sigma.max(f64::MIN_POSITIVE);
        }
    }
    let mut features: Vec<Vec<f64>> = vec![vec![1.0; rows]];
    for (i, a) in base.iter().enumerate() {
        features.push(a.clone());
        for b in &base[i..] {
            features.push(a.iter().zip(b).map(|(x, y)| x * y).collect());
        }
    }
    let x = DMatrix::from_fn(rows, features.len(), |i, j| features[j][i]);
    let count = missing.stretch_of.iter().max().map_or(0, |m| m + 1);
    let mut best = f64::NEG_INFINITY;
    for ridge in RIDGES {
        let mut wrong = 0.0;
        for stretch in 0..count {
            let (out, kept): (Vec<usize>, Vec<usize>) =
                (0..rows).partition(|w| missing.stretch_of[*w] == stretch);
            let rows_of =
                |which: &[usize]| DMatrix::from_fn(which.len(), x.ncols(), |i, j| x[(which[i], j)]);
            let a = rows_of(&kept);
            let y = DVector::from_fn(kept.len(), |i, _| f[kept[i]]);
            let mut normal = a.tr_mul(&a);
            for j in 0..normal.nrows() {
                normal[(j, j)] += ridge * kept.len() as f64;
            }
            let Some(factor) = normal.cholesky() else {
                return 0.0;
            };
            let told = rows_of(&out) * factor.solve(&a.tr_mul(&y));
            wrong += out
                .iter()
                .zip(told.iter())
                .map(|(w, t)| (f[*w] - t).powi(2))
                .sum::<f64>();
        }
        let total: f64 = f.iter().map(|v| v * v).sum();
        best = best.max(1.0 - wrong / total.max(f64::MIN_POSITIVE));
    }
    best
}
