//! What would be missing of a machine that is the fitted model.
//!
//! Such a machine moves in no steps, and its sensors have noise: residuals of the model are then those of its own steps
//! ([`super::step`]) and of the noise, the parameters fitted to that. Missing forces follow as from the recordings
//! ([`super::locate`]), in many draws.
//!
//! ```text
//! r = ε − 2 (r(h/2) − r(h))        r + J̃ dx, dx = −(J̃ᵀJ̃ + P)⁻¹ J̃ᵀ r        f = −(ΦᵀΦ)⁻¹ Φᵀ (r + J̃ dx)
//! ```
//!
//! A cell's size is its root mean square over what that is by the draws in the mean; the part of draws in which a cell is
//! as large as this one is the probability over all cells (Westfall and Young 1993). What steps alone leave, which is the
//! same in all draws, is known by itself.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::locate::{Cell, to_forces};
use super::screen::Screen;
use super::search::Search;
use super::step::WithoutSteps;
use crate::rng::{self, Purpose, Stream};

/// Draws.
const DRAWS: u64 = 399;

/// Missing forces (windows × joints).
pub(super) struct Null {
    draws: Vec<DMatrix<f64>>,
    /// without noise
    pub steps: DMatrix<f64>,
}

/// What makes them.
struct Maker<'s> {
    screen: &'s Screen,
    without: Option<&'s WithoutSteps<'s>>,
    to_forces: Vec<DMatrix<f64>>,
    /// of the noise of each channel, whitened
    sigma: Vec<f64>,
}

impl Maker<'_> {
    /// With so much of the noise.
    fn force(&self, noise: f64, rng: &mut Stream) -> DMatrix<f64> {
        let rows = &self.screen.linear.rows;
        let np = rows.first().map_or(0, |row| row.parameters.ncols());
        let mut along = DVector::zeros(np);
        let mut left = Vec::with_capacity(rows.len());
        for (w, row) in rows.iter().enumerate() {
            let each = (row.channel.iter().zip(&row.weight))
                .map(|(c, weight)| noise * weight * self.sigma[*c] * rng::normal(rng));
            let mut r = DVector::from_iterator(row.weight.len(), each);
            if let Some(without) = self.without {
                r -= &without.changes[w];
            }
            along.gemv_tr(-1.0, &row.parameters, &r, 1.0);
            left.push(r);
        }
        let dx = self.screen.normal.solve(&along);
        let joints = self.to_forces.first().map_or(0, DMatrix::nrows);
        let mut force = DMatrix::zeros(rows.len(), joints);
        for (w, (row, mut r)) in rows.iter().zip(left).enumerate() {
            r.gemv(1.0, &row.parameters, &dx, 1.0);
            force.set_row(w, &(&self.to_forces[w] * r).transpose());
        }
        force
    }
}

impl Null {
    /// Of the fitted model of `search`; `screen` is of that, and so is `without`, if the model can be simulated in half its
    /// steps.
    pub(super) fn new(
        search: &Search<'_>,
        screen: &Screen,
        without: Option<&WithoutSteps<'_>>,
        seed: u64,
    ) -> Self {
        let channels = &search.windows.problem.channels;
        let sigma = (channels.iter().zip(&search.noise)).map(|(c, noise)| noise / c.sigma);
        let maker = Maker {
            screen,
            without,
            to_forces: to_forces(&search.windows.problem.model, screen),
            sigma: sigma.collect(),
        };
        let stream = |draw| rng::stream(seed, Purpose::SensorNoise, u64::MAX - 1, draw);
        let draw = |draw| maker.force(1.0, &mut stream(draw));
        Self {
            draws: (0..DRAWS).into_par_iter().map(draw).collect(),
            steps: maker.force(0.0, &mut stream(DRAWS)),
        }
    }

    /// Chance that a cell of any draw is as large as each of these is in `force`.
    pub(super) fn chances(&self, force: &DMatrix<f64>, cells: &[Cell]) -> Vec<f64> {
        let n = self.draws.len() as f64;
        let each: Vec<Vec<f64>> = (self.draws.iter())
            .map(|draw| cells.iter().map(|cell| cell.rms(draw)).collect())
            .collect();
        let usual: Vec<f64> = (0..cells.len())
            .map(|c| (each.iter().map(|own| own[c].powi(2)).sum::<f64>() / n).sqrt())
            .map(|rms| rms.max(f64::MIN_POSITIVE))
            .collect();
        let most: Vec<f64> = (each.iter())
            .map(|own| {
                (own.iter().zip(&usual)).fold(0.0_f64, |most, (rms, usual)| most.max(rms / usual))
            })
            .collect();
        (cells.iter().zip(&usual))
            .map(|(cell, usual)| {
                let size = cell.rms(force) / usual;
                let as_large = most.iter().filter(|most| **most >= size).count();
                (1.0 + as_large as f64) / (1.0 + n)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::locate::Missing;

    const WINDOWS: usize = 80;
    const JOINTS: usize = 3;
    /// What steps leave everywhere, and the noise on it.
    const STEPS: f64 = 1.0;
    const NOISE: f64 = 0.3;

    fn forces(times: f64, seed: u64) -> DMatrix<f64> {
        let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
        DMatrix::from_fn(WINDOWS, JOINTS, |_, _| {
            times * (STEPS + NOISE * rng::normal(&mut rng))
        })
    }

    fn null() -> Null {
        Null {
            draws: (0..DRAWS).map(|d| forces(1.0, d + 1000)).collect(),
            steps: DMatrix::from_element(WINDOWS, JOINTS, STEPS),
        }
    }

    /// Joints that go to and fro, slowly and fast.
    fn missing(force: DMatrix<f64>) -> Missing {
        let speed = |w: usize| [0.5, -0.5, 1.5, -1.5, 0.0][w % 5];
        Missing {
            joints: ["a", "b", "c"].map(str::to_owned).to_vec(),
            units: vec!["N m"; JOINTS],
            force,
            position: DMatrix::zeros(WINDOWS, JOINTS),
            velocity: DMatrix::from_fn(WINDOWS, JOINTS, |w, _| speed(w)),
            motor: DMatrix::zeros(WINDOWS, JOINTS),
            touching: vec![vec![false; JOINTS]; WINDOWS],
            origin: (0..WINDOWS).map(|w| (0, w as f64)).collect(),
            names: vec!["one".to_owned(); WINDOWS],
            stretch_of: (0..WINDOWS).map(|w| w / 8).collect(),
        }
    }

    #[test]
    fn what_steps_and_noise_leave_is_no_disagreement() {
        let null = null();
        let located = |times: f64, seed: u64| missing(forces(times, seed)).located(Some(&null));
        // plain to see, and all of it the model's own
        assert_eq!(missing(forces(1.0, 1)).located(None).len(), 15);
        let false_alarms = (1..=50).filter(|s| !located(1.0, *s).is_empty()).count();
        assert!(false_alarms <= 2, "{false_alarms} of 50");
        assert_eq!(located(4.0, 1).len(), 15);
    }

    #[test]
    fn chances_are_of_all_cells_together() {
        let null = null();
        let least = |seed: u64| {
            let force = forces(1.0, seed);
            let cells = missing(force.clone()).cells();
            let chances = null.chances(&force, &cells);
            chances.into_iter().fold(1.0, f64::min)
        };
        let below = |p: f64| (1..=200).filter(|s| least(*s) < p).count();
        // binomial: 20 and 100 of 200, three standard deviations
        assert!((8..=33).contains(&below(0.1)), "{}", below(0.1));
        assert!((78..=122).contains(&below(0.5)), "{}", below(0.5));
    }
}
