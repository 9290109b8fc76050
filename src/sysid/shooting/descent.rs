//! Damped Gauss-Newton over parameters and the first states of windows.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::ShootingSettings;
use super::columns::{Columns, Point};
use super::loops::Loops;
use super::rows::Rows;
use super::simulate::{Pool, Simulated};
use super::window::{Placed, State, Window, place};
use crate::sysid::SysidError;
use crate::sysid::arrow::Arrow;
use crate::sysid::box_qp::solve_in_box;
use crate::sysid::fit::{Iteration, Status};
use crate::sysid::parameter::Parameter;
use crate::sysid::problem::Problem;

const FIRST_DAMPING: f64 = 1e-3;
/// Where something else than the user says where to begin.
const NEAR_DAMPING: f64 = 1e-6;
pub(super) const LEAST_DAMPING: f64 = 1e-10;
const MOST_DAMPING: f64 = 1e6;
/// Fall of the cost that is not worth a step: what moves an estimate by a thousandth of its standard deviation.
const LEAST_FALL: f64 = 1e-6;
/// Changes of parameters, in parts of their typical change, and of states, rad, m and per second, by which derivatives
/// change no more than matters for intervals.
const NEAR: f64 = 1e-3;
const NEAR_STATE: f64 = 1e-5;
/// Parts of the change of a window's state that are tried.
const PARTS: [f64; 3] = [1.0, 0.3, 0.0];
/// Sensitivity that a state is taken to have at least, so that one which nothing measures stays where it is.
const LEAST_SENSITIVITY: f64 = 1e-6;

/// The present point of the search.
pub(super) struct Descent<'a> {
    pub(super) problem: &'a Problem,
    settings: &'a ShootingSettings,
    pool: &'a Pool,
    pub(super) windows: Vec<Window>,
    pub(super) placed: Vec<Vec<Placed>>,
    pub(super) x: Vec<f64>,
    states: Vec<State>,
    /// that states change along, see [`super::loops`]; none: everything
    directions: Vec<DMatrix<f64>>,
    pub(super) simulated: Vec<Simulated>,
    linear: Option<Linear>,
    damping: f64,
    /// fall of the cost that the linearised problem promises from here
    foreseen: f64,
    pub(super) history: Vec<Iteration>,
}

/// Derivatives of all windows, and where they were taken.
struct Linear {
    x: Vec<f64>,
    states: Vec<State>,
    placed: Vec<Vec<Placed>>,
    columns: Vec<Columns>,
}

/// A step that lowers the cost.
struct Taken {
    x: Vec<f64>,
    states: Vec<State>,
    simulated: Vec<Simulated>,
    cost: f64,
    length: f64,
    /// fall of the cost by the linearised problem
    expected: f64,
}

impl<'a> Descent<'a> {
    /// The search from that of the parameters `starts` which costs least.
    pub(super) fn best_of(
        (problem, settings, pool): (&'a Problem, &'a ShootingSettings, &'a Pool),
        windows: &[Window],
        starts: &[Vec<f64>],
        states: &[State],
    ) -> Result<Self, SysidError> {
        let all: Vec<Result<(f64, Self), SysidError>> = (starts.par_iter().enumerate())
            .map(|(i, x)| {
                let windows = windows.to_vec();
                let new = Self::new(
                    (problem, settings, pool),
                    windows,
                    x.clone(),
                    states.to_vec(),
                )?;
                let damping = if i == 0 { FIRST_DAMPING } else { NEAR_DAMPING };
                Ok((new.cost()?, Self { damping, ..new }))
            })
            .collect();
        // the first start is the user's, and so is its error
        let mut first_error = None;
        let mut best: Option<(f64, Self)> = None;
        for found in all {
            match found {
                Ok(found) if best.as_ref().is_none_or(|b| found.0 < b.0) => best = Some(found),
                Ok(_) => {}
                Err(error) => {
                    first_error.get_or_insert(error);
                }
            }
        }
        best.map(|(_, descent)| descent).ok_or_else(|| {
            first_error.unwrap_or_else(|| SysidError::Setting {
                reason: "there is nothing to start from".into(),
            })
        })
    }

    fn new(
        (problem, settings, pool): (&'a Problem, &'a ShootingSettings, &'a Pool),
        windows: Vec<Window>,
        x: Vec<f64>,
        states: Vec<State>,
    ) -> Result<Self, SysidError> {
        let mut descent = Self {
            placed: place(problem, &windows, &x),
            problem,
            settings,
            pool,
            windows,
            x,
            states,
            directions: Vec::new(),
            simulated: Vec::new(),
            linear: None,
            damping: FIRST_DAMPING,
            foreseen: f64::INFINITY,
            history: Vec::new(),
        };
        if let Some(mut loops) = descent.loops(&descent.x)? {
            for state in &mut descent.states {
                *state = loops.close(state)?;
            }
            descent.directions = loops.directions(&descent.states)?;
        }
        let simulated = descent.point(&descent.x, &descent.states).simulate()?;
        let simulated: Option<Vec<Simulated>> = simulated.into_iter().collect();
        descent.simulated = simulated.ok_or_else(|| SysidError::Setting {
            reason: "the simulation diverges from the measured motion with the first parameters: \
                     take shorter windows, or start nearer"
                .into(),
        })?;
        Ok(descent)
    }

    /// The same search over other parts of the windows.
    pub(super) fn over(self, windows: Vec<Window>) -> Result<Self, SysidError> {
        let history = self.history;
        let of = (self.problem, self.settings, self.pool);
        let next = Self::new(of, windows, self.x, self.states)?;
        Ok(Self { history, ..next })
    }

    /// Descends as far as it goes.
    pub(super) fn run(
        &mut self,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Status, SysidError> {
        let mut status = Status::MaxIterations;
        let mut small = 0;
        for _ in 0..self.settings.max_iterations {
            // a changed delay moves samples between windows
            self.placed = place(self.problem, &self.windows, &self.x);
            let cost = self.cost()?;
            let rows = self.rows()?;
            let Some(taken) = self.search(&rows, cost)? else {
                status = if small > 0 || self.foreseen < LEAST_FALL {
                    Status::Converged
                } else {
                    Status::Stalled
                };
                break;
            };
            let fall = cost - taken.cost;
            let decrease = fall / cost.max(f64::MIN_POSITIVE);
            // what the damping kept back, and what the problem is not linear in
            let left = self.damping.powi(2) * taken.expected + (taken.expected - fall).abs();
            let record = Iteration {
                level: 0.0,
                cost: taken.cost,
                damping: self.damping,
                horizon_s: None,
                step: taken.length,
                x: taken.x.clone(),
            };
            (self.x, self.states, self.simulated) = (taken.x, taken.states, taken.simulated);
            self.damping = (self.damping * 0.1).max(LEAST_DAMPING);
            let go_on = watch(&record);
            self.history.push(record);
            if !go_on {
                status = Status::Interrupted;
                break;
            }
            // twice in a row, as one small step may be the damping's doing
            small = if decrease < self.settings.tolerance {
                small + 1
            } else {
                0
            };
            if small >= 2 || left < LEAST_FALL {
                status = Status::Converged;
                break;
            }
        }
        Ok(status)
    }

    /// Where first states are unknown, and need not lead from one window to the next.
    fn loops(&self, x: &[f64]) -> Result<Option<Loops>, SysidError> {
        if self.settings.free_states && self.settings.jump_sigma.is_none() {
            Loops::new(self.problem, x)
        } else {
            Ok(None)
        }
    }

    fn point<'b>(&'b self, x: &'b [f64], states: &'b [State]) -> Point<'b> {
        Point {
            problem: self.problem,
            windows: &self.windows,
            placed: &self.placed,
            x,
            states,
            free_states: self.settings.free_states,
            directions: &self.directions,
            pool: self.pool,
        }
    }

    /// Unknowns of a window's first state.
    pub(super) fn n_state(&self) -> usize {
        self.point(&self.x, &self.states).n_state()
    }

    pub(super) fn cost(&self) -> Result<f64, SysidError> {
        let point = self.point(&self.x, &self.states);
        let mut sum = self.problem.parameters.prior_cost(&self.x);
        for (w, simulated) in self.simulated.iter().enumerate() {
            sum += point.window_cost(w, simulated, self.settings.jump_sigma)?;
        }
        Ok(sum)
    }

    /// The linearised problem, window by window.
    pub(super) fn rows(&mut self) -> Result<Vec<Rows>, SysidError> {
        if !(self.linear.as_ref()).is_some_and(|linear| self.is_near(linear)) {
            if let Some(mut loops) = self.loops(&self.x)? {
                self.directions = loops.directions(&self.states)?;
            }
            let point = self.point(&self.x, &self.states);
            self.linear = Some(Linear {
                columns: point.columns(&self.simulated)?,
                x: self.x.clone(),
                states: self.states.clone(),
                placed: self.placed.clone(),
            });
        }
        let columns = self.linear.iter().flat_map(|l| &l.columns);
        let point = self.point(&self.x, &self.states);
        (columns.enumerate())
            .map(|(w, c)| point.rows(w, &self.simulated[w], c, self.settings.jump_sigma))
            .collect()
    }

    /// Whether derivatives taken there hold here.
    fn is_near(&self, linear: &Linear) -> bool {
        let parameters = self.problem.parameters.iter_free();
        let near = |(p, (a, b)): (&Parameter, (&f64, &f64))| (a - b).abs() < NEAR * p.typical;
        let same = |(a, b): (&State, &State)| {
            let (a, b) = (a.qpos.iter().chain(&a.qvel), b.qpos.iter().chain(&b.qvel));
            a.zip(b).all(|(a, b)| (a - b).abs() < NEAR_STATE)
        };
        self.placed == linear.placed
            && parameters.zip(self.x.iter().zip(&linear.x)).all(near)
            && self.states.iter().zip(&linear.states).all(same)
    }

    /// More and more damping until the true cost falls; `None` where none makes it fall.
    fn search(&mut self, rows: &[Rows], cost: f64) -> Result<Option<Taken>, SysidError> {
        self.foreseen = f64::INFINITY;
        while self.damping <= MOST_DAMPING {
            let arrows = self.eliminate(rows, self.damping);
            let dx = self.parameter_step(&arrows);
            let length = dx.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
            let x: Vec<f64> = self.x.iter().zip(&dx).map(|(x, d)| x + d).collect();
            let changes = changes(&arrows, &dx);
            let expected = self.expected(rows, &changes, &dx);
            // more damping would hide what there is to gain
            if self.foreseen.is_infinite() && self.damping <= FIRST_DAMPING {
                self.foreseen = expected;
            }
            let best = self.best(&x, &changes)?;
            if let Some(taken) = best.filter(|taken| taken.cost <= cost) {
                return Ok(Some(Taken {
                    length,
                    expected,
                    ..taken
                }));
            }
            self.damping *= if self.damping < 1e-6 { 1e3 } else { 10.0 };
        }
        self.damping = FIRST_DAMPING;
        Ok(None)
    }

    /// The point at parameters `x` and the states after `changes` (windows × unknowns of each); `None` where it diverges.
    ///
    /// Windows that know nothing of each other each take the part of their change that suits them best, where the whole
    /// of it does not lower their cost: one that stands before a kink, as where a joint begins to stick, must not hold
    /// back the rest.
    fn best(&self, x: &[f64], changes: &[f64]) -> Result<Option<Taken>, SysidError> {
        let parts: &[f64] = if self.settings.jump_sigma.is_none() && self.settings.free_states {
            &PARTS
        } else {
            &[1.0]
        };
        let here = self.point(&self.x, &self.states);
        let before = (self.simulated.iter().enumerate())
            .map(|(w, simulated)| here.window_cost(w, simulated, self.settings.jump_sigma))
            .collect::<Result<Vec<f64>, _>>()?;
        let mut best: Vec<Option<(f64, State, Simulated)>> = vec![None; self.windows.len()];
        let mut left: Vec<usize> = (0..self.windows.len()).collect();
        for part in parts {
            let states = self.moved(changes, *part, x)?;
            let point = self.point(x, &states);
            // a step may leave what the engine accepts: then it is none
            let Ok(simulated) = point.simulate_some(&left) else {
                return Ok(None);
            };
            for (&w, simulated) in left.iter().zip(simulated) {
                if let Some(simulated) = simulated {
                    let cost = point.window_cost(w, &simulated, self.settings.jump_sigma)?;
                    if best[w].as_ref().is_none_or(|b| cost < b.0) {
                        best[w] = Some((cost, states[w].clone(), simulated));
                    }
                }
            }
            left.retain(|&w| best[w].as_ref().is_none_or(|b| b.0 > before[w]));
        }
        let Some(best) = best.into_iter().collect::<Option<Vec<_>>>() else {
            return Ok(None);
        };
        let cost = best.iter().map(|b| b.0).sum::<f64>() + self.problem.parameters.prior_cost(x);
        let (states, simulated) = best.into_iter().map(|(_, state, s)| (state, s)).unzip();
        Ok(Some(Taken {
            x: x.to_vec(),
            states,
            simulated,
            cost,
            length: 0.0,
            expected: 0.0,
        }))
    }

    /// Fall of the cost by the linearised problem for a step of states and parameters.
    fn expected(&self, rows: &[Rows], changes: &[f64], dx: &[f64]) -> f64 {
        let n_state = self.n_state();
        let x: Vec<f64> = self.x.iter().zip(dx).map(|(x, d)| x + d).collect();
        let mut fall =
            self.problem.parameters.prior_cost(&self.x) - self.problem.parameters.prior_cost(&x);
        for (w, rows) in rows.iter().enumerate() {
            let from = w * n_state;
            let states = &changes[from..(from + 2 * n_state).min(changes.len())];
            for (_, row) in rows.iter() {
                let (own, rest) = row.split_at(2 * n_state);
                let (by_x, r) = rest.split_at(dx.len());
                let along = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
                let new = r[0] + along(own, states) + along(by_x, dx);
                fall += 0.5 * (r[0] - new) * (r[0] + new);
            }
        }
        fall
    }

    /// States of every trial eliminated, each damped in proportion to what its samples say about it.
    pub(super) fn eliminate(&self, rows: &[Rows], damping: f64) -> Vec<Arrow> {
        let (n_state, np) = (self.n_state(), self.x.len());
        let mut arrows: Vec<Arrow> = Vec::new();
        let mut k = 0;
        for (window, rows) in self.windows.iter().zip(rows) {
            if window.first == 0 {
                arrows.push(Arrow::new(n_state, np));
                k = 0;
            }
            let Some(arrow) = arrows.last_mut() else {
                break;
            };
            let mut square = vec![LEAST_SENSITIVITY.powi(2); n_state];
            for (_, row) in rows.iter() {
                for (s, v) in square.iter_mut().zip(row) {
                    *s += v * v;
                }
                // no row reaches back to the window before
                let out = arrow.row();
                out[n_state..].copy_from_slice(row);
                out[3 * n_state + np] *= -1.0;
            }
            for (i, square) in square.iter().enumerate() {
                arrow.row()[n_state + i] = (damping * square).sqrt();
            }
            arrow.close(k);
            k += 1;
            if !window.followed {
                arrow.finish(k);
            }
        }
        arrows
    }

    /// Change of the parameters within their bounds.
    fn parameter_step(&self, arrows: &[Arrow]) -> Vec<f64> {
        let np = self.x.len();
        let mut normal = DMatrix::<f64>::zeros(np, np);
        let mut right = DVector::zeros(np);
        for row in (arrows.iter()).flat_map(|a| a.innovations.chunks_exact(np + 1)) {
            for i in 0..np {
                right[i] += row[i] * row[np];
                for j in 0..np {
                    normal[(i, j)] += row[i] * row[j];
                }
            }
        }
        let parameters = &self.problem.parameters;
        for (i, (precision, slope)) in parameters.prior_slopes(&self.x).enumerate() {
            normal[(i, i)] += precision;
            right[i] -= slope;
            normal[(i, i)] += self.damping * normal[(i, i)].max(LEAST_SENSITIVITY.powi(2));
        }
        let (low, high): (Vec<f64>, Vec<f64>) = parameters.reach(&self.x).unzip();
        solve_in_box(&normal, &right, &low, &high)
    }

    /// States after a part of their changes, on the loops of the model with parameters `x`.
    fn moved(&self, changes: &[f64], part: f64, x: &[f64]) -> Result<Vec<State>, SysidError> {
        let n_state = self.n_state();
        if n_state == 0 {
            return Ok(self.states.clone());
        }
        let mut loops = self.loops(x)?;
        let each = self.states.iter().zip(changes.chunks_exact(n_state));
        each.enumerate()
            .map(|(w, (state, change))| {
                let change = part * DVector::from_column_slice(change);
                let change = match self.directions.get(w) {
                    Some(directions) => directions * change,
                    None => change,
                };
                let moved = state.moved(self.problem, change.as_slice())?;
                match &mut loops {
                    Some(loops) => loops.close(&moved),
                    None => Ok(moved),
                }
            })
            .collect()
    }
}

/// Changes of all states (windows × unknowns of each) for a step of the parameters.
pub(super) fn changes(arrows: &[Arrow], dx: &[f64]) -> Vec<f64> {
    arrows.iter().flat_map(|a| a.back_substitute(dx)).collect()
}
