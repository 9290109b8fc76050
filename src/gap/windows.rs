//! Recordings in short windows, each simulated from a first state of its own.
//!
//! A missing force shows as a bend of the motion. Over a window of length T, whose first state is free, it moves the
//! readings by about f T²/M; noise of the readings hides that the less, the longer the window. Whatever acts between
//! the joints and the sensors, contact and sticking included, is in the simulation, so that forces and readings are
//! judged by one residual:
//!
//! ```text
//! r = W (ŝ(s₀, x) − s)        r̃ = r − Q Qᵀ r        Q: orthonormal basis of ∂ŝ/∂s₀
//! ```
//!
//! | symbol | name |
//! | --- | --- |
//! | s, ŝ, W | samples, predictions, one over `Channel::sigma` |
//! | s₀, x | first state of the window, parameters |
//! | r̃ | [`Row::residual`] |

use nalgebra::{DMatrix, DVector};

use crate::mujoco::Model;
use crate::sysid::SysidError;
use crate::sysid::fit::{Fit, Iteration, Start};
use crate::sysid::holdout::hold;
use crate::sysid::problem::{Problem, Sample, Stage, Trial};
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::simulate::{Pool, Simulated};
use crate::sysid::shooting::window::{Placed, State, Window, place};
use crate::sysid::shooting::{self, ShootingSettings};
use crate::sysid::start;

/// Lengths to choose from, s.
const LENGTHS_S: [f64; 4] = [0.1, 0.2, 0.4, 0.8];
/// Noise of a window's acceleration that is small enough, as a part of what the motion has.
const FINE: f64 = 0.02;
/// Samples of a channel in a window that are kept; more say the same again.
const SAMPLES: usize = 48;
/// Least steps of a window.
const LEAST_STEPS: usize = 4;
/// Part of a column's length that must be its own for it to count.
const OWN: f64 = 1e-6;

/// All windows of some recordings.
#[derive(Debug, Clone)]
pub(super) struct Windows {
    /// one trial a window
    pub problem: Problem,
    /// of each window: index of its recording, s from the start of that
    pub origin: Vec<(usize, f64)>,
    /// (knots × nq) of each window
    pub trajectories: Vec<Vec<f64>>,
    /// s
    pub length_s: f64,
}

/// A window's rows: whitened, what its first state explains taken out.
#[derive(Debug, Clone)]
pub(super) struct Row {
    /// (rows × rank) orthonormal
    basis: DMatrix<f64>,
    /// (rows) predictions
    predicted: Vec<f64>,
    /// (rows) of a prediction in its row
    factor: Vec<f64>,
    /// (rows) index of its channel
    pub channel: Vec<usize>,
    /// (rows × free parameters)
    pub parameters: DMatrix<f64>,
    /// (rows)
    pub residual: DVector<f64>,
}

/// The linearised problem.
pub(super) struct Linear {
    windows: Vec<Window>,
    placed: Vec<Vec<Placed>>,
    states: Vec<State>,
    /// of each window
    pub rows: Vec<Row>,
}

/// What a change of the model does to the rows of every window, and its squared length before projection.
#[derive(Debug, Clone)]
pub(super) struct Column {
    /// per window (rows)
    pub parts: Vec<DVector<f64>>,
    /// Σ of squares with the first states held
    pub raw: f64,
}

/// The shortest length whose accelerations are not noise.
pub(super) fn length_s(whole: &Problem) -> f64 {
    let fine = |length: f64| {
        let mut ratios: Vec<f64> = Vec::new();
        for (c, channel) in whole.channels.iter().enumerate() {
            if channel.stage != Stage::Position {
                continue;
            }
            let (mut bends, mut n, mut rate) = (0.0, 0.0, 0.0_f64);
            for trial in &whole.trials {
                let own: Vec<&Sample> = trial.samples.iter().filter(|s| s.channel == c).collect();
                let (Some(first), Some(last)) = (own.first(), own.last()) else {
                    continue;
                };
                let interval = (last.time - first.time) / (own.len() as f64 - 1.0).max(1.0);
                let half = (0.5 * length / interval).round() as usize;
                rate = rate.max(interval.recip());
                if half == 0 {
                    continue;
                }
                for k in (half..own.len().saturating_sub(half)).step_by(half) {
                    let bend = own[k + half].value - 2.0 * own[k].value + own[k - half].value;
                    bends += (bend / (half as f64 * interval).powi(2)).powi(2);
                    n += 1.0;
                }
            }
            if n > 0.0 && bends > 0.0 {
                // standard deviation of twice the quadratic coefficient of a parabola through equal samples
                let noise =
                    channel.sigma * (720.0 / (rate * length).max(3.0)).sqrt() / (length * length);
                ratios.push(noise / (bends / n).sqrt());
            }
        }
        ratios.sort_by(f64::total_cmp);
        ratios.get(ratios.len() / 2).is_none_or(|r| *r < FINE)
    };
    let longest = LENGTHS_S[LENGTHS_S.len() - 1];
    LENGTHS_S.into_iter().find(|l| fine(*l)).unwrap_or(longest)
}

impl Windows {
    /// Cuts every trial of `whole` into windows of `length_s`, of which at most about `most` are kept, evenly. The
    /// motion is estimated with parameters `x`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn cut(
        whole: &Problem,
        x: &[f64],
        length_s: f64,
        most: usize,
    ) -> Result<Self, SysidError> {
        let (h, nq) = (whole.model.timestep(), whole.model.nq());
        let count = |t: &Trial| {
            let steps = t.n_knots - 1;
            let n = (steps as f64 * h / length_s).round() as usize;
            n.clamp(1, (steps / LEAST_STEPS).max(1))
        };
        let total: usize = whole.trials.iter().map(count).sum();
        let stride = total.div_ceil(most.max(1));
        let mut problem = Problem {
            trials: Vec::new(),
            ..whole.clone()
        };
        let (mut origin, mut trajectories) = (Vec::new(), Vec::new());
        let mut seen = 0;
        for (i, trial) in whole.trials.iter().enumerate() {
            let motion = start::trajectory(whole, trial, x)?;
            let (n, steps) = (count(trial), trial.n_knots - 1);
            for w in 0..n {
                let (first, last) = (w * steps / n, (w + 1) * steps / n);
                seen += 1;
                if seen % stride != 0 {
                    continue;
                }
                let part = part(whole, trial, first, last);
                if part.samples.is_empty() {
                    continue;
                }
                problem.trials.push(part);
                origin.push((i, trial.start_s + first as f64 * h));
                trajectories.push(motion[first * nq..(last + 1) * nq].to_vec());
            }
        }
        Ok(Self {
            problem,
            origin,
            trajectories,
            length_s,
        })
    }

    /// Number of windows.
    pub(super) fn len(&self) -> usize {
        self.problem.trials.len()
    }

    fn windows(&self) -> Vec<Window> {
        let window = |(trial, t): (usize, &Trial)| Window {
            trial,
            first: 0,
            last: t.n_knots - 1,
            followed: false,
            whole: true,
        };
        self.problem.trials.iter().enumerate().map(window).collect()
    }

    fn states(&self, windows: &[Window]) -> Result<Vec<State>, SysidError> {
        let pairs = windows.iter().zip(&self.trajectories);
        pairs.map(|(w, t)| State::on(&self.problem, w, t)).collect()
    }

    /// Estimates the parameters and first states from `x`.
    ///
    /// # Errors
    /// Nothing can be simulated; the engine refuses a number.
    pub(super) fn fit(
        &mut self,
        x: &[f64],
        max_iterations: usize,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Fit, SysidError> {
        self.drop_diverging(x)?;
        let settings = ShootingSettings {
            window_s: f64::INFINITY,
            max_iterations,
            tolerance: 1e-4,
            ..ShootingSettings::default()
        };
        let from = Start {
            x: x.to_vec(),
            trajectories: Some(self.trajectories.clone()),
            force_scale: None,
        };
        let fit = shooting::solve(&self.problem, &settings, &from, watch)?;
        self.trajectories.clone_from(&fit.trajectories);
        Ok(fit)
    }

    /// Leaves out the windows that cannot be simulated at parameters `x`.
    fn drop_diverging(&mut self, x: &[f64]) -> Result<(), SysidError> {
        let windows = self.windows();
        let states = self.states(&windows)?;
        let placed = place(&self.problem, &windows, x);
        let pool = Pool::default();
        let point = Point {
            problem: &self.problem,
            windows: &windows,
            placed: &placed,
            x,
            states: &states,
            free_states: true,
            pool: &pool,
        };
        let sound: Vec<bool> = point.simulate()?.iter().map(Option::is_some).collect();
        if sound.iter().all(|s| *s) {
            return Ok(());
        }
        if sound.iter().all(|s| !s) {
            let reason = "the simulation diverges from the measured motion everywhere: check units and signs".into();
            return Err(SysidError::Setting { reason });
        }
        let keep = |i: &usize| sound[*i];
        let kept: Vec<usize> = (0..sound.len()).filter(keep).collect();
        self.problem.trials = kept
            .iter()
            .map(|&i| self.problem.trials[i].clone())
            .collect();
        self.origin = kept.iter().map(|&i| self.origin[i]).collect();
        self.trajectories = kept.iter().map(|&i| self.trajectories[i].clone()).collect();
        Ok(())
    }

    /// The linearised problem at parameters `x` and the present motion.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn linearise(&self, x: &[f64]) -> Result<Linear, SysidError> {
        let windows = self.windows();
        let placed = place(&self.problem, &windows, x);
        let states = self.states(&windows)?;
        let pool = Pool::default();
        let point = Point {
            problem: &self.problem,
            windows: &windows,
            placed: &placed,
            x,
            states: &states,
            free_states: true,
            pool: &pool,
        };
        let base: Option<Vec<Simulated>> = point.simulate()?.into_iter().collect();
        let base = base.ok_or_else(|| SysidError::Setting {
            reason: "the fitted model does not follow its own motion".into(),
        })?;
        let columns = point.columns(&base)?;
        let free = self.problem.free_values(x);
        let mut rows = Vec::with_capacity(windows.len());
        for (w, (columns, simulated)) in columns.iter().zip(&base).enumerate() {
            let linear = point.rows(w, simulated, columns, None)?;
            let (n_state, np) = (2 * self.problem.model.nv(), x.len());
            let n = placed[w].len();
            let at = |i: usize, j: usize| linear.values[i * linear.width + j];
            let basis = orthonormal(&DMatrix::from_fn(n, n_state, at));
            let mut parameters = DMatrix::from_fn(n, np, |i, j| at(i, 2 * n_state + j));
            let mut residual = DVector::from_fn(n, |i, _| at(i, linear.width - 1));
            parameters -= &basis * basis.tr_mul(&parameters);
            residual -= &basis * basis.tr_mul(&residual);
            let samples = &self.problem.trials[w].samples;
            let channel: Vec<usize> = placed[w]
                .iter()
                .map(|p| samples[p.sample].channel)
                .collect();
            let predicted: Vec<f64> = (simulated.samples(&self.problem, &windows[w], &placed[w]))
                .map(|(z, _)| z)
                .collect();
            let factor = placed[w].iter().zip(&predicted).map(|(p, z)| {
                let s = &samples[p.sample];
                let c = &self.problem.channels[s.channel];
                let (gain, bias) = (c.gain.value(&free), c.bias.value(&free));
                let weight = c.norm.weight((gain * z + bias - s.value) / c.sigma).sqrt();
                weight * gain / c.sigma
            });
            rows.push(Row {
                factor: factor.collect(),
                basis,
                predicted,
                channel,
                parameters,
                residual,
            });
        }
        Ok(Linear {
            windows,
            placed,
            states,
            rows,
        })
    }

    /// The problem with another model of the same state, parameters held at `x`; `rules` of that model, those of the
    /// present one first.
    pub(super) fn held(&self, problem: &Problem, x: &[f64]) -> Problem {
        let values = self.problem.parameters.values(x);
        let names = &self.problem.parameters.all;
        let own = |name: &str| names.iter().position(|p| p.name == name).map(|i| values[i]);
        hold(problem, |p| own(&p.name).unwrap_or(p.start))
    }
}

/// Knots `first ..= last` of a trial as one of its own.
fn part(whole: &Problem, trial: &Trial, first: usize, last: usize) -> Trial {
    const SLACK: f64 = 1e-9;
    let h = whole.model.timestep();
    let (from, to) = (first as f64 * h, last as f64 * h);
    let inside = |s: &&Sample| s.time >= from - SLACK && s.time <= to + SLACK;
    let mut counts = vec![0_usize; whole.channels.len()];
    for s in trial.samples.iter().filter(inside) {
        counts[s.channel] += 1;
    }
    let mut seen = vec![0_usize; whole.channels.len()];
    let thinned = trial.samples.iter().filter(inside).filter(|s| {
        let every = counts[s.channel].div_ceil(SAMPLES);
        seen[s.channel] += 1;
        (seen[s.channel] - 1).is_multiple_of(every)
    });
    let samples = thinned
        .map(|s| Sample {
            time: s.time - from,
            ..*s
        })
        .collect();
    let controls = trial.controls.iter().map(|series| {
        // some before the window: commands may act late
        let begin = series.partition_point(|(t, _)| *t <= from - crate::supplement::MAX_DELAY_S);
        let end = series.partition_point(|(t, _)| *t <= to);
        let own = &series[begin.saturating_sub(1)..end.max(begin).max(1)];
        own.iter().map(|(t, u)| (t - from, *u)).collect()
    });
    Trial {
        name: format!("{} from {:.3} s", trial.name, trial.start_s + from),
        n_knots: last - first + 1,
        start_s: trial.start_s + from,
        controls: controls.collect(),
        samples,
        recording: std::sync::Arc::clone(&trial.recording),
    }
}

/// An orthonormal basis of the space of the columns, by Gram-Schmidt done twice.
fn orthonormal(columns: &DMatrix<f64>) -> DMatrix<f64> {
    let mut kept: Vec<DVector<f64>> = Vec::new();
    for column in columns.column_iter() {
        let mut own = DVector::from(column);
        let before = own.norm();
        for _ in 0..2 {
            for k in &kept {
                let along = k.dot(&own);
                own.axpy(-along, k, 1.0);
            }
        }
        let after = own.norm();
        if after > OWN * before && after > 0.0 {
            kept.push(own / after);
        }
    }
    if kept.is_empty() {
        DMatrix::zeros(columns.nrows(), 0)
    } else {
        DMatrix::from_columns(&kept)
    }
}

impl Linear {
    /// What another model makes of the same windows, per unit of `size`; `held` has no free parameter. Only every
    /// `stride`-th window is simulated, the others are 0.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn column(
        &self,
        held: &Problem,
        size: f64,
        stride: usize,
    ) -> Result<Column, SysidError> {
        let some: Vec<usize> = (0..self.windows.len()).step_by(stride).collect();
        let pick = |i: &usize| self.windows[*i].clone();
        let windows: Vec<Window> = some.iter().map(pick).collect();
        let placed: Vec<Vec<Placed>> = some.iter().map(|i| self.placed[*i].clone()).collect();
        let states: Vec<State> = some.iter().map(|i| self.states[*i].clone()).collect();
        let pool = Pool::default();
        let point = Point {
            problem: held,
            windows: &windows,
            placed: &placed,
            x: &[],
            states: &states,
            free_states: true,
            pool: &pool,
        };
        let mut parts: Vec<DVector<f64>> = (self.rows.iter())
            .map(|row| DVector::zeros(row.residual.len()))
            .collect();
        let mut raw = 0.0;
        for (k, simulated) in point.simulate()?.into_iter().enumerate() {
            let (w, row) = (some[k], &self.rows[some[k]]);
            // where it diverges nothing can be said
            let Some(simulated) = simulated else { continue };
            let moved = simulated.samples(held, &windows[k], &placed[k]);
            for (i, (z, _)) in moved.enumerate() {
                parts[w][i] = row.factor[i] * (z - row.predicted[i]) / size;
            }
            raw += parts[w].norm_squared();
            let along = row.basis.tr_mul(&parts[w]);
            parts[w] -= &row.basis * along;
        }
        Ok(Column { parts, raw })
    }
}

/// Whether a channel is the velocity of a hinge or slide.
pub(super) fn is_velocity(model: &Model, source: usize) -> bool {
    use crate::mujoco::Measures;
    if source >= model.nsensordata() {
        return source >= model.nsensordata() + model.nq();
    }
    (0..model.nsensor()).any(|s| {
        model.sensor_adr()[s] as usize == source
            && matches!(model.measures(s), Measures::Velocity(_))
    })
}
