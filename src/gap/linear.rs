//! The windows, linearised: what first states, parameters and other models do to the readings.
//!
//! ```text
//! r(s₀ + ds, x + dx) ≈ r + Q R ds + J dx        r̃ = r − Q Qᵀ r        J̃ = J − Q Qᵀ J
//! ```
//!
//! | symbol | name |
//! | --- | --- |
//! | Q, R | [`Row::basis`], [`Row::triangle`] |
//! | r̃, J̃, Qᵀ J | [`Row::residual`], [`Row::parameters`], [`Row::along`] |

use std::borrow::Borrow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::coarse::{self, Paced};
use super::followed::Followed;
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::islands::{Partition, is_shown};
use crate::sysid::problem::Problem;
use crate::sysid::reach::Contacts;
use crate::sysid::shooting::columns::Point;
use crate::sysid::shooting::loops::Loops;
use crate::sysid::shooting::simulate::{Pool, Simulated};
use crate::sysid::shooting::window::{Placed, State, Window, place};

/// Part of a column's length that must be its own for it to count.
const OWN: f64 = 1e-6;
/// Information that an unknown is taken to have at least.
pub(super) const LEAST_INFORMATION: f64 = 1e-12;

/// Part of the information on the best known position or velocity below which another is not seen.
const UNSEEN: f64 = 1e-12;

/// A window's rows: whitened, what its first state explains taken out.
#[derive(Debug, Clone)]
pub(super) struct Row {
    /// (rows × rank) orthonormal
    pub basis: DMatrix<f64>,
    /// (2 nv × n) that the first state may change along, see [`crate::sysid::shooting::loops`]; none: everything
    directions: Option<DMatrix<f64>>,
    /// (rank × n) of the first state along the basis
    pub triangle: DMatrix<f64>,
    /// (rows) predictions in the steps of derivatives
    predicted: Vec<f64>,
    /// (rows) predictions in the model's own steps
    exact: Vec<f64>,
    /// (rows) of a prediction in its row
    pub factor: Vec<f64>,
    /// (rows) root of the norm's weight
    pub weight: Vec<f64>,
    /// (rows) index of its channel
    pub channel: Vec<usize>,
    /// (rows × free parameters)
    pub parameters: DMatrix<f64>,
    /// (rank × free parameters)
    pub along: DMatrix<f64>,
    /// (rows)
    pub residual: DVector<f64>,
}

/// The linearised problem.
pub(super) struct Linear {
    /// of each window: steps that were taken at once
    factors: Vec<usize>,
    pub windows: Vec<Window>,
    pub placed: Vec<Vec<Placed>>,
    states: Vec<State>,
    /// of each window
    pub rows: Vec<Row>,
    /// parts that nothing connects in any window
    pub partition: Partition,
    /// geoms that touch in some window
    pub contacts: Contacts,
}

/// What a change of the model does to the rows of every window, and its squared length before projection.
#[derive(Debug, Clone)]
pub(super) struct Column {
    /// per window (rows)
    pub parts: Vec<DVector<f64>>,
    /// Σ of squares with the first states held
    pub raw: f64,
}

/// Squared length of what is given of every window.
pub(super) fn squares(parts: &[DVector<f64>]) -> f64 {
    parts.iter().map(DVector::norm_squared).sum()
}

impl Windows {
    /// The linearised problem at parameters `x` and the present first states.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn linearise(&self, x: &[f64]) -> Result<Linear, SysidError> {
        let here = self.simulate(x, &self.states)?.ok_or_else(lost)?;
        self.linearise_at(x, &here)
    }

    /// The same where every window is followed already, `here` at `x`: a fifth of the work.
    ///
    /// # Errors
    /// As [`Windows::linearise`].
    pub(super) fn linearise_at<F: Borrow<Followed>>(
        &self,
        x: &[f64],
        here: &[F],
    ) -> Result<Linear, SysidError> {
        let is_longer = self.factors.iter().any(|f| *f > 1);
        match self.linearise_in(x, here, &self.factors) {
            // what breaks down in longer steps may not in short ones
            Err(SysidError::Setting { .. }) if is_longer => {
                self.linearise_in(x, here, &vec![1; self.len()])
            }
            result => result,
        }
    }

    fn linearise_in<F: Borrow<Followed>>(
        &self,
        x: &[f64],
        here: &[F],
        factors: &[usize],
    ) -> Result<Linear, SysidError> {
        let windows = self.windows();
        let placed = place(&self.problem, &windows, x);
        let states: Vec<State> = here.iter().map(|f| f.borrow().state.clone()).collect();
        let directions = self.directions(x, &states)?;
        let (mut contacts, mut found) = (Contacts::new(), BTreeMap::new());
        let free = self.problem.free_values(x);
        for (factor, some) in coarse::by_factor(factors, &self.all()) {
            let paced = Paced::new((&self.problem, &windows, &placed), &some, factor as f64)?;
            let of = |w: &usize| states[*w].clone();
            let own_states: Vec<State> = some.iter().map(of).collect();
            let own = |w: &usize| directions.get(*w).cloned();
            let own_directions: Vec<DMatrix<f64>> = some.iter().filter_map(own).collect();
            let pool = Pool::default();
            let point = paced.point(x, &own_states, &own_directions, &pool);
            let base: Option<Vec<Simulated>> = point.simulate()?.into_iter().collect();
            let base = base.ok_or_else(lost)?;
            let columns = point.columns(&base)?;
            contacts.extend(base.iter().flat_map(|s| &s.contacts).copied());
            for (k, (w, columns)) in some.into_iter().zip(&columns).enumerate() {
                let linear = point.rows(k, &base[k], columns, None)?;
                let at = |i: usize, j: usize| linear.values[i * linear.width + j];
                let n_state = point.n_state();
                let by_state = DMatrix::from_fn(placed[w].len(), n_state, at);
                let by_parameter = |i: usize, j: usize| at(i, 2 * n_state + j);
                let parameters = DMatrix::from_fn(placed[w].len(), x.len(), by_parameter);
                let row = self.row((w, here[w].borrow(), &free), by_state, parameters);
                found.insert(
                    w,
                    Row {
                        directions: directions.get(w).cloned(),
                        predicted: paced.samples(k, &base[k]).collect(),
                        ..row
                    },
                );
            }
        }
        Ok(Linear {
            partition: Partition::new(&self.problem, &contacts),
            contacts,
            factors: factors.to_vec(),
            windows,
            placed,
            states,
            rows: found.into_values().collect(),
        })
    }

    /// The row of window `w`, which is followed as it is `here`, of derivatives by its first state and parameters.
    fn row(
        &self,
        (w, here, free): (usize, &Followed, &[f64]),
        mut by_state: DMatrix<f64>,
        mut parameters: DMatrix<f64>,
    ) -> Row {
        let samples = &self.problem.trials[w].samples;
        let channel: Vec<usize> = here.samples.iter().map(|s| samples[*s].channel).collect();
        let weight: Vec<f64> = (channel.iter().zip(&here.residual))
            .map(|(c, r)| self.problem.channels[*c].norm.weight(*r).sqrt())
            .collect();
        for (i, weight) in weight.iter().enumerate() {
            by_state.row_mut(i).scale_mut(*weight);
            parameters.row_mut(i).scale_mut(*weight);
        }
        let basis = orthonormal(&by_state);
        let mut residual = DVector::from_fn(weight.len(), |i, _| weight[i] * here.residual[i]);
        let along = basis.tr_mul(&parameters);
        parameters -= &basis * &along;
        residual -= &basis * basis.tr_mul(&residual);
        let scale = here.samples.iter().zip(&weight).map(|(s, weight)| {
            let s = &samples[*s];
            let c = &self.problem.channels[s.channel];
            weight * c.gain.value(free) / c.sigma_of(s)
        });
        Row {
            factor: scale.collect(),
            directions: None,
            triangle: basis.tr_mul(&by_state),
            basis,
            predicted: Vec::new(),
            exact: here.predicted.clone(),
            weight,
            channel,
            parameters,
            along,
            residual,
        }
    }

    /// That first states may change along, see [`Point::directions`]; 0 for what lies still.
    fn directions(&self, x: &[f64], states: &[State]) -> Result<Vec<DMatrix<f64>>, SysidError> {
        let nv = self.problem.model.nv();
        let mut all = match Loops::new(&self.problem, x)? {
            Some(mut loops) => loops.directions(states)?,
            None if self.still.iter().all(Vec::is_empty) => return Ok(Vec::new()),
            None => vec![DMatrix::identity(2 * nv, 2 * nv); self.len()],
        };
        for (own, still) in all.iter_mut().zip(&self.still) {
            for dof in still {
                own.row_mut(*dof).fill(0.0);
                own.row_mut(nv + dof).fill(0.0);
            }
        }
        Ok(all)
    }
}

impl Row {
    /// (2 nv) a change `own` (n) of the unknowns as one of the first state.
    pub(super) fn change(&self, own: DVector<f64>) -> DVector<f64> {
        match &self.directions {
            Some(directions) => directions * own,
            None => own,
        }
    }
}

/// Least squares of R ds + b, each unknown held back in proportion to what is known of it and of the best: what readings do not
/// see, as the tilt of a body whose position is measured or the velocity of a joint that sticks, would go as far as rounding says,
/// and no part of such a step leads anywhere.
pub(super) fn damped(triangle: &DMatrix<f64>, b: &DVector<f64>, damping: f64) -> DVector<f64> {
    let mut normal = triangle.tr_mul(triangle);
    let n = normal.nrows();
    // positions, then velocities
    for kind in [0..n / 2, n / 2..n] {
        let best = kind.clone().map(|i| normal[(i, i)]).fold(0.0, f64::max);
        for i in kind {
            normal[(i, i)] +=
                damping * normal[(i, i)] + UNSEEN.max(damping) * best + LEAST_INFORMATION;
        }
    }
    let right = -triangle.tr_mul(b);
    match normal.cholesky() {
        Some(factor) => factor.solve(&right),
        None => DVector::zeros(right.len()),
    }
}

/// Per window (rows): change of the readings, whitened.
pub(super) type Moved = Vec<Option<DVector<f64>>>;

/// What makes the motion of windows.
type Simulate<'a> = &'a mut dyn FnMut(&Point<'_>) -> Result<Vec<Option<Simulated>>, SysidError>;

fn lost() -> SysidError {
    SysidError::Setting {
        reason: "the fitted model does not follow its own motion".into(),
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
    /// All windows.
    pub(super) fn all(&self) -> Vec<usize> {
        (0..self.rows.len()).collect()
    }

    /// One window of every `part` in a row, that of which most is left: what is missing shows there, and may nowhere else.
    pub(super) fn telling(&self, part: usize) -> Vec<usize> {
        let left: Vec<f64> = (self.rows.iter())
            .map(|row| row.residual.norm_squared())
            .collect();
        let groups = self.all();
        let most = groups.chunks(part).map(|some| {
            some.iter()
                .copied()
                .max_by(|a, b| left[*a].total_cmp(&left[*b]))
        });
        most.flatten().collect()
    }

    /// What another model, without free parameters, makes of the windows `some`, whose motion `simulate` makes, in the steps of
    /// derivatives or, `exactly`, in the model's own: change of each row. None for other windows, and where it diverges:
    /// nothing can be said there.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn moved(
        &self,
        held: &Problem,
        some: &[usize],
        exactly: bool,
        simulate: Simulate<'_>,
    ) -> Result<Moved, SysidError> {
        let mut out: Moved = vec![None; self.rows.len()];
        let groups = if exactly {
            BTreeMap::from([(1, some.to_vec())])
        } else {
            coarse::by_factor(&self.factors, some)
        };
        for (factor, own) in groups {
            let at = (held, &self.windows[..], &self.placed[..]);
            let paced = Paced::new(at, &own, factor as f64)?;
            let states: Vec<State> = own.iter().map(|w| self.states[*w].clone()).collect();
            let pool = Pool::default();
            let moved = simulate(&paced.point(&[], &states, &[], &pool))?;
            for (k, (&w, moved)) in own.iter().zip(&moved).enumerate() {
                let Some(moved) = moved else { continue };
                let row = &self.rows[w];
                let before = if exactly { &row.exact } else { &row.predicted };
                let each = paced.samples(k, moved).zip(before).zip(&row.factor);
                let change = each.map(|((z, before), factor)| factor * (z - before));
                out[w] = Some(DVector::from_iterator(row.residual.len(), change));
            }
        }
        Ok(out)
    }

    /// The column of what was moved, per unit of `size`; of rows of the parts `reached` if there are any.
    pub(super) fn part_of(
        &self,
        moved: &Moved,
        size: f64,
        reached: Option<&BTreeSet<usize>>,
    ) -> Column {
        let mut raw = 0.0;
        let shows = |channel: usize| is_shown(reached, self.partition.channels[channel]);
        let own = |(row, moved): (&Row, &Option<DVector<f64>>)| {
            let Some(moved) = moved else {
                return DVector::zeros(row.residual.len());
            };
            let value = |i: usize| {
                if shows(row.channel[i]) {
                    moved[i] / size
                } else {
                    0.0
                }
            };
            let mut part = DVector::from_fn(moved.len(), |i, _| value(i));
            raw += part.norm_squared();
            let along = row.basis.tr_mul(&part);
            part -= &row.basis * along;
            part
        };
        Column {
            parts: self.rows.iter().zip(moved).map(own).collect(),
            raw,
        }
    }

    /// Squared length of what happens to each channel, of rows per window.
    pub(super) fn by_channel<'a>(
        &self,
        parts: impl IntoIterator<Item = &'a DVector<f64>>,
    ) -> Vec<f64> {
        let channels = self.rows.iter().flat_map(|row| &row.channel);
        let n = channels.max().map_or(0, |most| most + 1);
        let mut squares = vec![0.0; n];
        for (row, part) in self.rows.iter().zip(parts) {
            for (c, value) in row.channel.iter().zip(part.iter()) {
                squares[*c] += value * value;
            }
        }
        squares
    }

    /// What the motors do to the readings, at parameters `x` of `windows`; none where there are none.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn motors(
        &self,
        windows: &Windows,
        x: &[f64],
    ) -> Result<Option<Column>, SysidError> {
        let problem = &windows.problem;
        if problem.model.nu() == 0 {
            return Ok(None);
        }
        let mut still = windows.held(problem, x);
        for trial in &mut still.trials {
            for control in Arc::make_mut(&mut trial.controls).iter_mut().flatten() {
                control.1 = 0.0;
            }
        }
        let moved = self.moved(&still, &self.all(), false, &mut |point| point.simulate())?;
        // elsewhere a solver's rounding would look like them
        Ok(Some(self.part_of(
            &moved,
            1.0,
            Some(&self.partition.driven),
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_readings_hardly_see_stays_where_it_is() {
        // a measured position, and a tilt that rounding alone seems to show
        let triangle = DMatrix::from_row_slice(2, 4, &[1e4, 0.0, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0]);
        let ds = damped(&triangle, &DVector::from_element(2, 1.0), 0.0);
        assert!((ds[0] + 1e-4).abs() < 1e-8, "{ds}");
        assert!(ds[1].abs() < 0.1, "{ds}");
    }

    /// A finger's joint that sticks for a window: its velocity would be 400 rad/s, where readings move by 10^-8 of them.
    #[test]
    fn the_velocity_of_a_joint_that_sticks_stays_where_it_is() {
        let seen = DVector::from_row_slice(&[2.1e4, 9.3e3, 2.5e3, 6e-5, 77.0, 34.0]);
        let along = DVector::from_row_slice(&[-0.15, 2.7, 0.72, 0.024, 0.024, -0.038]);
        let ds = damped(&DMatrix::from_diagonal(&seen), &along, 1e-6);
        for i in 0..6 {
            let whole = -along[i] / seen[i];
            if i == 3 {
                assert!(ds[i].abs() < 1e-3, "{ds}");
            } else {
                assert!((ds[i] / whole - 1.0).abs() < 1e-4, "{ds}");
            }
        }
    }
}
