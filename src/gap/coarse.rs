//! The windows in steps of another length: derivatives in longer ones.
//!
//! What a change of the model does to a window is needed to a few percent; what is left unexplained, to the last digit.
//! Residuals are therefore simulated in the model's own step h, and derivatives, as differences of two simulations alike,
//! in steps of c h. c is the largest of 8, 4, 2 with which the motors and every parameter act as in steps of h, in a part of the
//! windows, looked at as a whole. Where joints stick a few windows spoil that for all: then it is chosen for each by itself.
//! Fits halve it, or take single steps where it differs, where no step of theirs leads on ([`super::fit`]), but not those of rivals
//! that are behind; where they have ended it is chosen anew, for the screen and for what is fitted next.

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::followed::Followed;
use super::linear::{Column, Row, squares};
use super::windows::Windows;
use crate::mujoco::Model;
use crate::sysid::SysidError;
use crate::sysid::norm::Norm;
use crate::sysid::problem::{Problem, Stage, Trial};
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::simulate::{Pool, Simulated};
use crate::sysid::shooting::window::{Placed, State, Window};

/// Factors to choose from.
const FACTORS: [usize; 3] = [8, 4, 2];
/// Steps of a window that must be left.
const LEAST_STEPS: usize = 16;
/// Windows that are looked at to choose.
const LOOKS: usize = 16;
/// Part of a column that may be wrong.
const WRONG: f64 = 0.1;
/// The same in a single window, which others make up for; of one that is less than a part of the usual, of that.
const WRONG_ALONE: f64 = 0.2;
const USUAL: f64 = 0.3;
/// Columns of which first states leave less than this part of the length say nothing on the step.
const OWN: f64 = 1e-3;

/// What lengths of windows, in steps, are multiples of.
pub(super) fn aligned(steps: usize) -> usize {
    let fits = |f: &usize| steps >= f * LEAST_STEPS;
    FACTORS.into_iter().find(fits).unwrap_or(1)
}

/// The model in steps `factor` times as long.
fn paced(model: &Arc<Model>, factor: f64) -> Result<Arc<Model>, SysidError> {
    if factor == 1.0 {
        return Ok(Arc::clone(model));
    }
    let mut own = model.try_clone()?;
    let mut edit = own.edit();
    edit.set_timestep(model.timestep() * factor)?;
    edit.finish()?;
    Ok(Arc::new(own))
}

/// Windows in steps of another length.
pub(super) struct Paced {
    problem: Problem,
    windows: Vec<Window>,
    placed: Vec<Vec<Placed>>,
}

impl Paced {
    /// The windows `some`, with where their samples lie, in steps `factor` times as long.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn new(
        (problem, windows, placed): (&Problem, &[Window], &[Vec<Placed>]),
        some: &[usize],
        factor: f64,
    ) -> Result<Self, SysidError> {
        let window = |&i: &usize| Window {
            last: steps(windows[i].last, factor),
            ..windows[i].clone()
        };
        let lie = |&i: &usize| {
            let trial = &problem.trials[windows[i].trial];
            (placed[i].iter())
                .map(|p| moved(problem, trial, p, factor))
                .collect()
        };
        Ok(Self {
            windows: some.iter().map(window).collect(),
            placed: some.iter().map(lie).collect(),
            problem: self::problem(problem, factor)?,
        })
    }

    /// From these first states, which may change along `directions`, of each window.
    pub(super) fn point<'a>(
        &'a self,
        x: &'a [f64],
        states: &'a [State],
        directions: &'a [DMatrix<f64>],
        pool: &'a Pool,
    ) -> Point<'a> {
        Point {
            problem: &self.problem,
            windows: &self.windows,
            placed: &self.placed,
            x,
            states,
            free_states: true,
            directions,
            pool,
        }
    }

    /// What the sensors of window `w` show.
    pub(super) fn samples<'a>(
        &'a self,
        w: usize,
        simulated: &'a Simulated,
    ) -> impl Iterator<Item = f64> + 'a {
        let samples = simulated.samples(&self.problem, &self.windows[w], &self.placed[w]);
        samples.map(|(z, _)| z)
    }
}

/// The windows `some` by the steps that each takes at once.
pub(super) fn by_factor(factors: &[usize], some: &[usize]) -> BTreeMap<usize, Vec<usize>> {
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for &w in some {
        groups.entry(factors[w]).or_default().push(w);
    }
    groups
}

/// The problem in steps `factor` times as long. Residuals have no norm there: rows are weighed where they are simulated exactly.
fn problem(problem: &Problem, factor: f64) -> Result<Problem, SysidError> {
    let mut own = Problem {
        model: paced(&problem.model, factor)?,
        ..problem.clone()
    };
    for channel in &mut own.channels {
        channel.norm = Norm::Quadratic;
    }
    for trial in &mut own.trials {
        trial.n_knots = steps(trial.n_knots - 1, factor) + 1;
    }
    Ok(own)
}

/// So many steps in ones `factor` times as long.
fn steps(n: usize, factor: f64) -> usize {
    (n as f64 / factor) as usize
}

/// Where a sample lies in those steps.
fn moved(problem: &Problem, trial: &Trial, p: &Placed, factor: f64) -> Placed {
    const ROUNDING: f64 = 1e-9;
    let at = (p.knot as f64 + p.part) / factor;
    let knot = (at + ROUNDING).floor() as usize;
    let held = problem.channels[trial.samples[p.sample].channel].stage == Stage::Acceleration;
    let part = if held {
        0.0
    } else {
        (at - knot as f64).max(0.0)
    };
    Placed {
        knot,
        part,
        sample: p.sample,
    }
}

impl Windows {
    /// Chooses the step of derivatives at parameters `x`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn choose_step(&mut self, x: &[f64]) -> Result<(), SysidError> {
        self.factors.fill(1);
        let whole = |f: &usize| {
            let ends =
                |t: &Trial| t.n_knots > f * LEAST_STEPS && (t.n_knots - 1).is_multiple_of(*f);
            self.problem.trials.iter().all(ends)
        };
        let possible: Vec<usize> = FACTORS.into_iter().filter(whole).collect();
        if possible.is_empty() {
            return Ok(());
        }
        let mut look = self.at_most(LOOKS);
        // where nothing can be simulated the fit says so
        let Ok(here) = look.followed(x) else {
            return Ok(());
        };
        let exact = look.responses(x, &here)?;
        for &factor in &possible {
            look.factors.fill(factor);
            // what breaks down in longer steps is no use
            let Ok(found) = look.responses(x, &here) else {
                continue;
            };
            if exact.iter().zip(&found).all(|(a, b)| alike(a, b)) {
                self.factors.fill(factor);
                return Ok(());
            }
        }
        self.choose_each(x, &possible);
        Ok(())
    }

    /// The same for each window by itself, all in single steps yet.
    fn choose_each(&mut self, x: &[f64], possible: &[usize]) {
        let Ok(Some(here)) = self.simulate(x, &self.states) else {
            return;
        };
        let Ok(exact) = self.responses(x, &here) else {
            return;
        };
        // lengths of which a part may be wrong in any window
        let usual = (exact.iter()).map(|column| {
            if is_small(column) {
                return f64::INFINITY;
            }
            USUAL * (squares(&column.parts) / self.len() as f64).sqrt()
        });
        let usual: Vec<f64> = usual.collect();
        let mut left = self.all();
        for &factor in possible {
            if left.is_empty() {
                break;
            }
            let mut some = self.only(&left);
            some.factors.fill(factor);
            let own: Vec<&Followed> = left.iter().map(|&w| &here[w]).collect();
            let Ok(found) = some.responses(x, &own) else {
                continue;
            };
            let mut rest = Vec::new();
            for (k, &w) in left.iter().enumerate() {
                let mut each = exact.iter().zip(&found).zip(&usual);
                let serves = each.all(|((a, b), usual)| {
                    let (own, wrong) = (a.parts[w].norm(), (&a.parts[w] - &b.parts[k]).norm());
                    wrong <= WRONG_ALONE * own.max(*usual)
                });
                if serves {
                    self.factors[w] = factor;
                } else {
                    rest.push(w);
                }
            }
            left = rest;
        }
    }

    /// Lets derivatives take half the steps at once, or single ones where windows differ: others may stick by now. Whether any took
    /// more than one.
    pub(super) fn shorten_steps(&mut self) -> bool {
        let any = self.factors.iter().any(|f| *f > 1);
        let differ = self.factors.windows(2).any(|two| two[0] != two[1]);
        for factor in &mut self.factors {
            *factor = if differ { 1 } else { (*factor / 2).max(1) };
        }
        any
    }

    /// What parameters and motors do to all rows, first states taken out; every window is followed `here`.
    fn responses<F: Borrow<Followed>>(
        &self,
        x: &[f64],
        here: &[F],
    ) -> Result<Vec<Column>, SysidError> {
        let linear = self.linearise_at(x, here)?;
        let mut out: Vec<Column> = (0..x.len())
            .map(|j| {
                let rows = linear.rows.iter();
                let parts: Vec<DVector<f64>> =
                    rows.map(|r| r.parameters.column(j).into_owned()).collect();
                let along = |r: &Row| r.along.column(j).norm_squared();
                let raw = squares(&parts) + linear.rows.iter().map(along).sum::<f64>();
                Column { parts, raw }
            })
            .collect();
        out.extend(linear.motors(self, x)?);
        Ok(out)
    }
}

/// Whether first states leave so little of a column that it says nothing on the step.
fn is_small(column: &Column) -> bool {
    squares(&column.parts) <= OWN * OWN * column.raw
}

/// Length of what is wrong of a column, of the exact one's `a`.
fn wrong(a: &Column, b: &Column) -> f64 {
    let each = a.parts.iter().zip(&b.parts);
    let wrong: f64 = each.map(|(a, b)| (a - b).norm_squared()).sum();
    (wrong / squares(&a.parts)).sqrt()
}

/// Whether a column is the exact one `a` as near as matters.
fn alike(a: &Column, b: &Column) -> bool {
    is_small(a) || wrong(a, b) <= WRONG
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{machine, searching};

    /// A mass that rests at times under dry friction: windows in which it moves on take long steps, and act as in short ones.
    #[test]
    fn a_few_windows_that_stick_do_not_spoil_all() {
        let base = machine(r#"damping=".2" frictionloss="1""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\n";
        searching(&base, &base, config, |search, _| {
            let windows = &mut search.windows;
            let (x, n) = (&search.x, windows.len());
            windows.factors.fill(1);
            windows.choose_each(x, &[4, 2]);
            let longest = windows.factors.iter().filter(|f| **f == 4).count();
            assert!(2 * longest > n && longest < n, "{longest} of {n}");
            let here = windows.followed(x).expect("followed");
            let found = windows.responses(x, &here).expect("linear");
            windows.factors.fill(4);
            let all_long = windows.responses(x, &here).expect("linear");
            windows.factors.fill(1);
            let exact_steps = windows.factors.clone();
            let exact = windows.responses(x, &here).expect("linear");
            let most = |of: &[Column]| {
                let each = exact.iter().zip(of).map(|(a, b)| wrong(a, b));
                each.fold(0.0, f64::max)
            };
            let (each, all) = (most(&found), most(&all_long));
            assert!(each < WRONG_ALONE && all > 2.0 * each, "{each} {all}");
            windows.factors.fill(4);
            assert!(windows.shorten_steps() && windows.factors == vec![2; n]);
            windows.factors[0] = 8;
            assert!(windows.shorten_steps() && windows.factors == exact_steps);
            assert!(!windows.shorten_steps());
        });
    }

    /// Where joints stick, the last steps of a fit are short ones; nothing after it needs them.
    #[test]
    fn a_fit_leaves_no_short_steps_behind() {
        let base = machine(r#"damping=".2" frictionloss=".05""#, "");
        let hidden = machine(r#"damping=".2" frictionloss=".5""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\n";
        searching(&base, &hidden, config, |search, watch| {
            let all_long = |windows: &Windows| windows.factors.iter().all(|f| *f > 1);
            assert!(all_long(&search.windows));
            search.windows.factors.fill(1);
            search.settle(watch).expect("settled");
            assert!(all_long(&search.windows));
        });
    }
}
