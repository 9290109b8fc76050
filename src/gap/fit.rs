//! Parameters and first states of all windows: Gauss-Newton with derivatives that serve for several steps.
//!
//! ```text
//! dx = −(Σ J̃ᵀJ̃ + P)⁻¹ (Σ J̃ᵀ r̃ + P (x − x̄))        ds = −(RᵀR + D)⁻¹ Rᵀ (Qᵀ r + Qᵀ J dx)
//! ```
//!
//! with P the precision of priors, bounds kept, D a trace that holds back what readings do not see, and Q, R, J̃, r̃ of
//! [`super::linear`]. r is simulated exactly after each step; J and Q, which cost a simulation an unknown, are only where
//! the cost does not fall as they foretell. Windows know nothing of each other: each takes the part of its ds that suits
//! it, and those that friction or stops bend go on by themselves ([`super::settle`]).

use nalgebra::{DMatrix, DVector};

use super::followed::Followed;
use super::linear::{LEAST_INFORMATION, Linear, Row, damped};
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::box_qp::solve_in_box;
use crate::sysid::fit::Iteration;
use crate::sysid::parameter::Parameters;
use crate::sysid::shooting::window::State;

/// Part of a direction's information that is added to it.
const RIDGE: f64 = 1e-9;
/// Fall of the cost that is not worth a step: a fraction of what a parameter's standard deviation makes.
const LEAST_FALL: f64 = 0.02;
/// The same as a part of the cost.
const LEAST_PART: f64 = 1e-6;
/// Squared length of a step of the parameters, in standard deviations, after which there is no other.
const NEAR: f64 = 0.1;
/// Part of the foretold fall from which derivatives go on serving.
const AS_FORETOLD: f64 = 0.6;
/// Part of the cost down to which a fall leads on: where joints stick, or swing through, derivatives do not reach the end, and the
/// next ones see further.
const LEADS_ON: f64 = 0.66;
/// Parts of a step that are tried.
const PARTS: [f64; 3] = [1.0, 0.3, 0.1];
/// Parts of the change of a window's state that are tried.
const STATE_PARTS: [f64; 3] = [1.0, 0.3, 0.0];

/// Where a fit ended.
#[derive(Debug, Clone)]
pub(super) struct Fitted {
    /// free parameters
    pub x: Vec<f64>,
    /// of residuals and priors
    pub cost: f64,
    /// of the residuals of each window
    pub each: Vec<f64>,
}

impl Windows {
    /// Estimates the parameters and first states from `x`. Derivatives that do not foretell what happens are made
    /// anew, then in shorter steps.
    ///
    /// # Errors
    /// Nothing can be simulated; the engine refuses a number.
    pub(super) fn fit(
        &mut self,
        x: &[f64],
        max_iterations: usize,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Fitted, SysidError> {
        self.fit_below(f64::INFINITY, x, max_iterations, watch)
    }

    /// The same, given up where derivatives foretell neither a cost below `bound` nor a fall by a third, or lead nowhere above it.
    ///
    /// # Errors
    /// As [`Windows::fit`].
    pub(super) fn fit_below(
        &mut self,
        bound: f64,
        x: &[f64],
        max_iterations: usize,
        watch: &mut dyn FnMut(&Iteration) -> bool,
    ) -> Result<Fitted, SysidError> {
        let mut here = self.followed(x)?;
        let mut x = x.to_vec();
        let mut cost = self.cost(&x, &here);
        let mut linear: Option<(Linear, DMatrix<f64>)> = None;
        let mut fresh = true; // whether derivatives are of the present point
        for _ in 0..max_iterations {
            fresh |= linear.is_none();
            let (derivatives, normal) = if let Some(known) = linear.take() {
                known
            } else {
                let found = self.linearise_at(&x, &here)?;
                let normal = information(&found.rows, x.len());
                (found, normal)
            };
            let step = self.step(&derivatives, &normal, &x, &here);
            let little = LEAST_FALL.max(LEAST_PART * cost);
            let foretold = step.fall(1.0);
            if foretold < little || cost - foretold > bound.max(LEADS_ON * cost) {
                if fresh {
                    break;
                }
                continue; // with new derivatives there may be more
            }
            let Some(taken) = self.along(&derivatives, &step, (&x, &here, cost))? else {
                // short steps are for what is in the lead: they cost several times as much
                if fresh && (cost > bound || !self.shorten_steps()) {
                    break;
                }
                continue;
            };
            let ends = fresh && cost - taken.cost < little;
            let same = (here.iter().zip(&taken.windows)).all(|(a, b)| a.samples == b.samples);
            if same && cost - taken.cost > AS_FORETOLD * step.fall(taken.part) {
                linear = Some((derivatives, normal));
            }
            fresh = false;
            (x, here, cost) = (taken.x, taken.windows, taken.cost);
            self.take(&here);
            let record = Iteration {
                level: 0.0,
                cost,
                damping: 0.0,
                horizon_s: None,
                step: taken.part * step.dx.iter().fold(0.0_f64, |m, d| m.max(d.abs())),
                x: x.clone(),
            };
            let near = taken.part == 1.0 && step.far < NEAR && !x.is_empty();
            if !watch(&record) || near || ends {
                break;
            }
        }
        let each = here.iter().map(|window| window.cost).collect();
        Ok(Fitted { x, cost, each })
    }

    /// The largest part of a step that the cost falls by; nothing if there is none.
    fn along(
        &self,
        linear: &Linear,
        step: &Step,
        (x, here, cost): (&[f64], &[Followed], f64),
    ) -> Result<Option<Taken>, SysidError> {
        for part in PARTS {
            let to: Vec<f64> = x.iter().zip(&step.dx).map(|(x, d)| x + part * d).collect();
            let Some(mut windows) = self.best(&to, here, &step.changes(linear, part))? else {
                continue;
            };
            self.settle(&to, &mut windows, linear, cost);
            let new = self.cost(&to, &windows);
            if new < cost {
                return Ok(Some(Taken {
                    x: to,
                    windows,
                    cost: new,
                    part,
                }));
            }
        }
        Ok(None)
    }

    /// Every window at `x`, without those that break down there.
    ///
    /// # Errors
    /// None can be simulated; the engine refuses a number.
    pub(super) fn followed(&mut self, x: &[f64]) -> Result<Vec<Followed>, SysidError> {
        let all = self.all();
        let found = self.simulate_some(x, &self.states, &all)?;
        let sound: Vec<usize> = all.into_iter().filter(|&i| found[i].is_some()).collect();
        if sound.is_empty() {
            let reason = "the simulation diverges from the measured motion everywhere: check units and signs".into();
            return Err(SysidError::Setting { reason });
        }
        if sound.len() < self.len() {
            *self = self.only(&sound);
        }
        let here: Vec<Followed> = found.into_iter().flatten().collect();
        self.take(&here);
        Ok(here)
    }

    fn take(&mut self, here: &[Followed]) {
        self.states = here.iter().map(|f| f.state.clone()).collect();
        self.trajectories = here.iter().map(|f| f.qpos.clone()).collect();
    }

    fn cost(&self, x: &[f64], here: &[Followed]) -> f64 {
        here.iter().map(|f| f.cost).sum::<f64>() + self.problem.parameters.prior_cost(x)
    }

    /// The windows at parameters `x`, each after the part of its change that suits it; nothing if one breaks down.
    fn best(
        &self,
        x: &[f64],
        here: &[Followed],
        changes: &[DVector<f64>],
    ) -> Result<Option<Vec<Followed>>, SysidError> {
        let mut best: Vec<Option<Followed>> = vec![None; self.len()];
        let mut left = self.all();
        for part in STATE_PARTS {
            let states = (here.iter().zip(changes))
                .map(|(f, ds)| f.state.moved(&self.problem, (ds * part).as_slice()))
                .collect::<Result<Vec<_>, _>>()?;
            // a step may leave what the engine accepts: then it is none
            if self.nearer(x, &states, &left, &mut best).is_err() {
                return Ok(None);
            }
            left.retain(|&w| best[w].as_ref().is_none_or(|b| b.cost > here[w].cost));
            if left.is_empty() {
                break;
            }
        }
        Ok(best.into_iter().collect())
    }

    /// Simulates the windows `some` from `states` and keeps of each what is nearer to its readings than the `best` yet.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn nearer(
        &self,
        x: &[f64],
        states: &[State],
        some: &[usize],
        best: &mut [Option<Followed>],
    ) -> Result<(), SysidError> {
        let found = self.simulate_some(x, states, some)?;
        for (&w, found) in some.iter().zip(found) {
            if let Some(found) = found
                && best[w].as_ref().is_none_or(|b| found.cost < b.cost)
            {
                best[w] = Some(found);
            }
        }
        Ok(())
    }

    /// Takes of every window the first state that its readings at `x` ask for by derivatives of another model, `linear`, where that is
    /// nearer. Nothing where windows are not those of `linear`.
    ///
    /// # Errors
    /// None can be simulated; the engine refuses a number.
    pub(super) fn move_states(&mut self, x: &[f64], linear: &Linear) -> Result<(), SysidError> {
        let here = self.followed(x)?;
        let mut each = here.iter().zip(&linear.rows);
        if here.len() != linear.rows.len() || !each.all(|(f, row)| f.is_like(row)) {
            return Ok(());
        }
        let changes: Vec<DVector<f64>> = (here.iter().zip(&linear.rows))
            .map(|(f, row)| row.change(damped(&row.triangle, &f.along(row), RIDGE)))
            .collect();
        if let Some(moved) = self.best(x, &here, &changes)? {
            self.take(&moved);
        }
        Ok(())
    }

    fn step(&self, linear: &Linear, normal: &DMatrix<f64>, x: &[f64], here: &[Followed]) -> Step {
        let np = x.len();
        let parameters = &self.problem.parameters;
        let mut right = DVector::zeros(np);
        let mut along = Vec::with_capacity(here.len());
        for (row, followed) in linear.rows.iter().zip(here) {
            let r = followed.weighted(row);
            along.push(row.basis.tr_mul(&r));
            right -= row.parameters.tr_mul(&r);
        }
        let gradient = -right.clone();
        let (dx, to) = solved(parameters, x, normal, right, &[]);
        let far = dx.dot(&(normal * &dx));
        let mut fall = parameters.prior_cost(x) - parameters.prior_cost(&to);
        fall -= gradient.dot(&dx) + 0.5 * far;
        for (row, along) in linear.rows.iter().zip(&along) {
            let rest = along + &row.triangle * damped(&row.triangle, along, RIDGE);
            fall += 0.5 * (along.norm_squared() - rest.norm_squared());
        }
        Step {
            dx,
            along,
            fall,
            far,
        }
    }
}

/// A step by the linearised problem.
struct Step {
    dx: DVector<f64>,
    /// Qᵀ r of every window
    along: Vec<DVector<f64>>,
    /// of the cost
    fall: f64,
    /// squared length of dx in standard deviations
    far: f64,
}

impl Step {
    /// Fall of the cost by a part of the step; first states take theirs whole.
    fn fall(&self, part: f64) -> f64 {
        self.fall * part * (2.0 - part)
    }

    /// ds of every window with a part of dx.
    fn changes(&self, linear: &Linear, part: f64) -> Vec<DVector<f64>> {
        let change = part * &self.dx;
        let each = linear.rows.iter().zip(&self.along);
        each.map(|(row, along)| {
            row.change(damped(
                &row.triangle,
                &(along + &row.along * &change),
                RIDGE,
            ))
        })
        .collect()
    }
}

/// Where a part of a step leads.
struct Taken {
    x: Vec<f64>,
    windows: Vec<Followed>,
    cost: f64,
    part: f64,
}

/// Σ J̃ᵀJ̃.
pub(super) fn information(rows: &[Row], np: usize) -> DMatrix<f64> {
    let mut normal = DMatrix::zeros(np, np);
    for row in rows {
        normal.gemm_tr(1.0, &row.parameters, &row.parameters, 1.0);
    }
    normal
}

/// Σ J̃ᵀ r of what each window has in `parts`.
pub(super) fn gradient<'a>(
    rows: &[Row],
    parts: impl IntoIterator<Item = &'a DVector<f64>>,
    np: usize,
) -> DVector<f64> {
    let mut gradient = DVector::zeros(np);
    for (row, part) in rows.iter().zip(parts) {
        gradient.gemv_tr(1.0, &row.parameters, part, 1.0);
    }
    gradient
}

/// dx of the parameters within their bounds, and where it leads; those `at_rest` stay. `normal` is Σ J̃ᵀJ̃, `right` −Σ J̃ᵀ r̃.
pub(super) fn solved(
    parameters: &Parameters,
    x: &[f64],
    normal: &DMatrix<f64>,
    mut right: DVector<f64>,
    at_rest: &[usize],
) -> (DVector<f64>, Vec<f64>) {
    let mut with_priors = normal.clone();
    add_priors(parameters, x, &mut with_priors, &mut right);
    let (mut low, mut high): (Vec<f64>, Vec<f64>) = parameters.reach(x).unzip();
    for &j in at_rest {
        (low[j], high[j]) = (0.0, 0.0);
    }
    let dx = DVector::from_vec(solve_in_box(&with_priors, &right, &low, &high));
    let to = x.iter().zip(&dx).map(|(x, d)| x + d).collect();
    (dx, to)
}

/// Adds priors and a ridge.
fn add_priors(
    parameters: &Parameters,
    x: &[f64],
    normal: &mut DMatrix<f64>,
    right: &mut DVector<f64>,
) {
    for (i, (precision, slope)) in parameters.prior_slopes(x).enumerate() {
        normal[(i, i)] += precision;
        right[i] -= slope;
        normal[(i, i)] += RIDGE * normal[(i, i)].max(LEAST_INFORMATION);
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::masses::{machine, searching};

    /// Windows that begin 0.3 m/s too fast.
    #[test]
    fn first_states_come_back_to_where_readings_ask_for_them() {
        let base = machine(r#"damping=".2""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &base, config, |search, _| {
            let (x, there) = (&search.x, &search.windows);
            let linear = there.linearise(x).expect("derivatives");
            let mut astray = there.clone();
            for state in &mut astray.states {
                state.qvel[0] += 0.3;
            }
            let mut back = astray.clone();
            back.move_states(x, &linear).expect("simulated");
            for (own, known) in back.states.iter().zip(&there.states) {
                let off = own.qvel[0] - known.qvel[0];
                // derivatives are taken in longer steps
                assert!(off.abs() < 3e-3, "{off}");
            }
            // derivatives of other windows say nothing of these
            let mut fewer = astray.only(&[0, 2]);
            fewer.move_states(x, &linear).expect("simulated");
            assert_eq!(fewer.states, astray.only(&[0, 2]).states);
        });
    }

    /// Damping of "a" that the model lacks leaves what no fit of the other's takes off.
    #[test]
    fn a_fit_that_will_not_come_below_its_bound_is_given_up() {
        let (base, hidden) = (machine("", ""), machine(r#"damping="2""#, ""));
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\nscale = \"linear\"\n\
                      lower = -5.0\n";
        searching(&base, &hidden, config, |search, _| {
            let below = |off: f64, bound: f64| {
                let away: Vec<f64> = search.x.iter().map(|x| x + off).collect();
                let (mut windows, mut n) = (search.windows.clone(), 0);
                let mut count = |_: &_| {
                    n += 1;
                    true
                };
                let fit = windows.fit_below(bound, &away, 12, &mut count);
                (fit.expect("fitted"), n)
            };
            let (whole, all) = below(0.01, f64::INFINITY);
            assert!(whole.cost < 1.01 * search.cost, "{}", whole.cost);
            assert_eq!(below(0.01, 2.0 * whole.cost).0.cost, whole.cost);
            let (given_up, steps) = below(0.01, 0.5 * whole.cost);
            assert!(
                steps < all && given_up.cost > whole.cost,
                "{steps} of {all}"
            );
            // from far off derivatives foretell a thousand times as much
            let (far, steps) = below(1.0, 2.0 * whole.cost);
            assert!(
                steps > 1 && far.cost < 1.01 * whole.cost,
                "{} {steps}",
                far.cost
            );
        });
    }

    /// A mass on a spring a quarter too soft: derivatives there foretell that a quarter of the cost stays, and after a step that
    /// most does of what is left; new ones that hardly any.
    #[test]
    fn a_fit_whose_derivatives_reach_part_of_the_way_goes_on() {
        let base = machine("", r#"stiffness="5000""#);
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"stiffness\"\n";
        searching(&base, &base, config, |search, _| {
            let away: Vec<f64> = search.x.iter().map(|x| x - 0.3).collect();
            let bound = 2.0 * search.cost;
            let fit = search.windows.fit_below(bound, &away, 12, &mut |_| true);
            let cost = fit.expect("fitted").cost;
            assert!(cost < 1.1 * search.cost, "{cost} for {}", search.cost);
        });
    }

    /// A mass on a spring that is fitted already, by derivatives in steps of a quarter of its period.
    #[test]
    fn what_is_stuck_above_its_bound_is_not_fitted_in_short_steps() {
        let base = machine(r#"damping=".2" stiffness="5000""#, "");
        let hidden = machine(r#"damping=".2" stiffness="5500""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"stiffness\"\n";
        searching(&base, &hidden, config, |search, _| {
            let begin = search.windows.problem.parameters.start();
            let mut there = search.windows.clone();
            let fit = there.fit(&begin, 100, &mut |_| true).expect("fitted");
            let below = |bound: f64| {
                let mut windows = there.clone();
                windows.factors.fill(8);
                let again = windows.fit_below(bound, &fit.x, 12, &mut |_| true);
                (again.expect("fitted").cost, windows.factors[0])
            };
            assert!(below(f64::INFINITY).1 < 8);
            let bound = 0.99 * fit.cost;
            let (cost, factor) = below(bound);
            assert!(cost > bound && factor == 8, "{cost} {factor}");
        });
    }
}
