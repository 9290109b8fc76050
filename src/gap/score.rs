//! Score tests: how much of the residual a new column would explain, and how surely.
//!
//! With Φ the columns of what may be missing and J those of the parameters that are fitted anyway, first states taken
//! out of both ([`super::windows`]),
//!
//! ```text
//! β = −S⁻¹ Φᵀ (I − J J⁺) r      S = Φᵀ (I − J J⁺) Φ      gain = βᵀ S β / 2      visible = tr S / tr ΦᵀΦ
//! ```
//!
//! Residuals of a machine are not white: what is left is other physics, correlated over seconds. Nothing is therefore
//! taken from the size of the noise. Windows are gathered in stretches of time, and everything is estimated again with
//! each stretch left out (the delete-a-group jackknife, which is robust to any correlation within a stretch):
//!
//! ```text
//! Var β = (B − 1)/B Σ (β₋ᵦ − β̄)²      t = β/σ      dof = (Σ w)²/Σ w² − 1,  w: information of each stretch
//! ```
//!
//! What few stretches tell of has few degrees of freedom, however plainly they tell. What is left of all channels is
//! known much better, and with it the variance V₀ that weights ([`super::weigh`]) give: both are pooled,
//! V = (dof Var β + d₀ V₀)/(dof + d₀), with dof + d₀ degrees of freedom (Smyth 2004, "moderated t").
//!
//! The stretch left out is also predicted by the others: `held_gain` is how much better on average with Φ than
//! without. It falls with every needless parameter, and ranks candidates of different sizes.
//!
//! References: Rao 1948 (score test); Sörbom 1989 (modification index and expected change); Bell and `McCaffrey` 2002
//! (small numbers of groups).

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use statrs::distribution::{ContinuousCDF, FisherSnedecor, StudentsT};

use super::linear::{Column, Row};

/// Stretches that all windows are gathered in.
pub(super) const STRETCHES: usize = 40;
/// Ridge on every diagonal entry, relative to it: directions without information stay where they are.
const RIDGE: f64 = 1e-9;
/// Degrees of freedom that the weights of the residuals stand for.
const COMMON_DOF: f64 = 4.0;

/// Sums of products of all columns, stretch by stretch: parameters, then candidates, then the residual.
pub(super) struct Normal {
    stretches: Vec<DMatrix<f64>>,
    /// of parameters without candidates, each stretch left out in turn, then with all
    without: Vec<Solved>,
    /// (precision, gradient) of every parameter
    prior: Vec<(f64, f64)>,
    n_parameters: usize,
    n: usize,
}

/// The fit of parameters alone.
struct Solved {
    normal: DMatrix<f64>,
    factor: Option<Cholesky<f64, Dyn>>,
    step: DVector<f64>,
}

/// What one candidate would do.
#[derive(Debug, Clone)]
pub(super) struct Score {
    /// expected value of each of its columns' sizes
    pub expected: Vec<f64>,
    /// fall of the cost
    pub gain: f64,
    /// fall of the cost of what was left out, mean over stretches times their number, and of that of the priors
    pub held_gain: f64,
    /// its standard error
    pub held_sigma: f64,
    /// probability of as much by chance, for this candidate alone
    pub p_value: f64,
    /// part of the columns that nothing else can absorb
    pub visible: f64,
    /// standard error of each expected value, and the degrees of freedom behind it
    pub sigma: Vec<f64>,
    pub dof: f64,
}

/// Which stretch, of about `count`, each window belongs to: windows in order of recordings, `recording` of each.
pub(super) fn stretches(recording: &[usize], count: usize) -> Vec<usize> {
    let size = recording.len().div_ceil(count).max(1);
    let (mut out, mut stretch, mut filled) = (Vec::with_capacity(recording.len()), 0, 0);
    for (w, r) in recording.iter().enumerate() {
        if w > 0 && (filled == size || recording[w - 1] != *r) {
            stretch += 1;
            filled = 0;
        }
        filled += 1;
        out.push(stretch);
    }
    // recordings of one window each make many stretches
    let most = stretch + 1;
    if most > 2 * count {
        for s in &mut out {
            *s = *s * count / most;
        }
    }
    out
}

/// Sums of what each window has over its stretch.
pub(super) fn by_stretch(parts: impl Iterator<Item = f64>, stretch_of: &[usize]) -> Vec<f64> {
    let mut sums = vec![0.0; stretch_of.iter().max().map_or(0, |most| most + 1)];
    for (part, stretch) in parts.zip(stretch_of) {
        sums[*stretch] += part;
    }
    sums
}

impl Normal {
    /// Of all windows. `prior` is (precision, gradient) of every parameter.
    pub(super) fn new(
        rows: &[Row],
        columns: &[Column],
        stretch_of: &[usize],
        prior: &[(f64, f64)],
    ) -> Self {
        let np = rows.first().map_or(0, |r| r.parameters.ncols());
        let n = np + columns.len() + 1;
        let count = stretch_of.iter().max().map_or(0, |m| m + 1);
        let mut stretches = vec![DMatrix::zeros(n, n); count];
        for (w, row) in rows.iter().enumerate() {
            let mut all = DMatrix::zeros(row.residual.len(), n);
            all.columns_mut(0, np).copy_from(&row.parameters);
            for (k, column) in columns.iter().enumerate() {
                all.set_column(np + k, &column.parts[w]);
            }
            all.set_column(n - 1, &row.residual);
            stretches[stretch_of[w]].gemm_tr(1.0, &all, &all, 1.0);
        }
        Self::of(stretches, prior.to_vec())
    }

    /// Of the sums of every stretch.
    fn of(stretches: Vec<DMatrix<f64>>, prior: Vec<(f64, f64)>) -> Self {
        let (np, count) = (prior.len(), stretches.len());
        let n = stretches.first().map_or(np + 1, DMatrix::ncols);
        let mut total = DMatrix::zeros(n, n);
        for s in &stretches {
            total += s;
        }
        let mut solved = Vec::with_capacity(count + 1);
        for left_out in (0..count).map(Some).chain([None]) {
            let normal = match left_out {
                Some(b) => &total - &stretches[b],
                None => total.clone(),
            };
            solved.push(Solved::new(normal, np, &prior));
        }
        Self {
            stretches,
            without: solved,
            prior,
            n_parameters: np,
            n,
        }
    }

    /// The same with these parameters held where they are, in increasing order: those after them move up.
    pub(super) fn holding(&self, held: &[usize]) -> Self {
        let without = |s: &DMatrix<f64>| s.clone().remove_columns_at(held).remove_rows_at(held);
        let kept = (0..self.prior.len()).filter(|j| !held.contains(j));
        Self::of(
            self.stretches.iter().map(without).collect(),
            kept.map(|j| self.prior[j]).collect(),
        )
    }

    /// Cost of the residual as it is.
    pub(super) fn cost(&self) -> f64 {
        0.5 * self.all().normal[(self.n - 1, self.n - 1)]
    }

    /// Fall of the priors' cost where columns stand for what parameters had to.
    fn prior_gain(&self, with: &DVector<f64>) -> f64 {
        let cost = |step: &DVector<f64>| -> f64 {
            let each = self.prior.iter().zip(step.iter());
            each.map(|((precision, gradient), d)| d * (gradient + 0.5 * precision * d))
                .sum()
        };
        cost(&self.all().step) - cost(with)
    }

    fn all(&self) -> &Solved {
        &self.without[self.stretches.len()]
    }

    /// Of the candidate with these columns (index among the candidates).
    pub(super) fn score(&self, candidate: &[usize]) -> Option<Score> {
        self.score_of(&self.places(candidate))
    }

    /// Fall of the cost by a candidate, of all windows, and the expected value of each of its columns' sizes; none where
    /// others absorb it.
    pub(super) fn gain(&self, candidate: &[usize]) -> Option<(f64, Vec<f64>)> {
        let (_, beta, own) = self.all().with(&self.places(candidate))?;
        Some((0.5 * beta.dot(&(own * &beta)), beta.as_slice().to_vec()))
    }

    /// How far the fitted parameters move with a candidate; not at all where others absorb it.
    pub(super) fn step(&self, candidate: &[usize]) -> Vec<f64> {
        let with = self.all().with(&self.places(candidate));
        with.map_or_else(Vec::new, |(step, ..)| step.as_slice().to_vec())
    }

    /// Where the columns of a candidate stand among all.
    fn places(&self, candidate: &[usize]) -> Vec<usize> {
        candidate.iter().map(|c| self.n_parameters + c).collect()
    }

    /// Standard deviation of every parameter's x by the residuals' weights and priors alone.
    pub(super) fn spread(&self) -> Vec<f64> {
        let each = 0..self.n_parameters;
        each.map(|j| self.variance(j).sqrt()).collect()
    }

    /// Its square, of one.
    fn variance(&self, parameter: usize) -> f64 {
        let Some(factor) = &self.all().factor else {
            return f64::INFINITY;
        };
        let mut unit = DVector::zeros(self.n_parameters);
        unit[parameter] = 1.0;
        factor.solve(&unit)[parameter].max(0.0)
    }

    /// (J̃ᵀJ̃ + P)⁻¹ b of the parameters alone; none where they cannot be told apart.
    pub(super) fn solve(&self, b: &DVector<f64>) -> DVector<f64> {
        match &self.all().factor {
            Some(factor) => factor.solve(b),
            None => DVector::zeros(b.len()),
        }
    }

    /// Standard error of a fitted parameter's x, and the degrees of freedom behind it, moderated as the module says.
    pub(super) fn fitted(&self, parameter: usize) -> (f64, f64) {
        let count = self.stretches.len();
        let steps: Vec<f64> = self.without[..count]
            .iter()
            .map(|s| s.step[parameter])
            .collect();
        let entry = |b: usize| self.stretches[b][(parameter, parameter)];
        let (own, dof) = (jackknife(&steps), freedom((0..count).map(entry)));
        let common = self.variance(parameter);
        let variance = (dof * own * own + COMMON_DOF * common) / (dof + COMMON_DOF);
        (variance.sqrt(), dof + COMMON_DOF)
    }

    /// Squared cosine of the angle between a fitted parameter's column and a candidate's, all else fitted; and what of
    /// the candidate does most like one of the parameter.
    pub(super) fn likeness(&self, parameter: usize, candidate: &[usize]) -> (f64, Vec<f64>) {
        let np = self.n_parameters;
        let others: Vec<usize> = (0..np).filter(|j| *j != parameter).collect();
        let mut wanted = vec![parameter];
        wanted.extend(self.places(candidate));
        let total = &self.all().normal;
        let pick = |a: &[usize], b: &[usize]| {
            DMatrix::from_fn(a.len(), b.len(), |i, j| total[(a[i], b[j])])
        };
        let n = candidate.len();
        let nothing = (0.0, vec![0.0; n]);
        let mut left = pick(&wanted, &wanted);
        if !others.is_empty() {
            let Some(factor) = regular(pick(&others, &others)).cholesky() else {
                return nothing;
            };
            let cross = pick(&others, &wanted);
            left -= cross.tr_mul(&factor.solve(&cross));
        }
        let along = left.view((1, 0), (n, 1)).clone_owned();
        let own = regular(left.view((1, 1), (n, n)).clone_owned());
        let Some(factor) = own.cholesky() else {
            return nothing;
        };
        let instead = factor.solve(&along);
        let explained = along.tr_mul(&instead)[(0, 0)];
        let likeness = (explained / left[(0, 0)].max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        (likeness, instead.as_slice().to_vec())
    }

    fn score_of(&self, at: &[usize]) -> Option<Score> {
        let count = self.stretches.len();
        let (all_step, all_beta, own) = self.all().with(at)?;
        let gain = 0.5 * all_beta.dot(&(&own * &all_beta));
        let mut betas = Vec::with_capacity(count);
        let mut gains = Vec::with_capacity(count);
        for (b, solved) in self.without[..count].iter().enumerate() {
            // what shows in the stretch left out alone is not there for the others
            let Some((step, beta, _)) = solved.with(at) else {
                gains.push(0.0);
                betas.push(DVector::zeros(at.len()));
                continue;
            };
            let stretch = &self.stretches[b];
            let before = cost_at(stretch, &indices(self.n_parameters, &[]), &solved.step);
            let mut both = step.as_slice().to_vec();
            both.extend(beta.iter());
            let after = cost_at(
                stretch,
                &indices(self.n_parameters, at),
                &DVector::from_vec(both),
            );
            gains.push(before - after);
            betas.push(beta);
        }
        let n = at.len();
        let mean = betas.iter().sum::<DVector<f64>>() / count as f64;
        let mut covariance = DMatrix::zeros(n, n);
        for beta in &betas {
            let d = beta - &mean;
            covariance.ger((count as f64 - 1.0) / count as f64, &d, &d, 1.0);
        }
        let trace = |b: usize| at.iter().map(|j| self.stretches[b][(*j, *j)]).sum::<f64>();
        let dof = freedom((0..count).map(trace));
        let common = regular(own.clone()).cholesky()?.inverse();
        let pooled = (covariance * dof + common * COMMON_DOF) / (dof + COMMON_DOF);
        let p_value = wald(&all_beta, &pooled, dof + COMMON_DOF);
        let sum = gains.iter().sum::<f64>();
        let spread = gains
            .iter()
            .map(|g| (g - sum / count as f64).powi(2))
            .sum::<f64>();
        Some(Score {
            expected: all_beta.as_slice().to_vec(),
            gain,
            held_gain: sum + self.prior_gain(&all_step),
            held_sigma: (spread * count as f64 / (count as f64 - 1.0).max(1.0)).sqrt(),
            p_value,
            sigma: pooled
                .diagonal()
                .iter()
                .map(|v| v.max(0.0).sqrt())
                .collect(),
            dof: dof + COMMON_DOF,
            visible: own.trace() / at.iter().map(|j| self.all().normal[(*j, *j)]).sum::<f64>(),
        })
    }
}

impl Solved {
    fn new(mut normal: DMatrix<f64>, np: usize, prior: &[(f64, f64)]) -> Self {
        let last = normal.ncols() - 1;
        for (j, (precision, gradient)) in prior.iter().enumerate() {
            normal[(j, j)] += precision;
            normal[(j, last)] += gradient;
            normal[(last, j)] += gradient;
        }
        let factor = regular(normal.view((0, 0), (np, np)).clone_owned()).cholesky();
        let right = normal.view((0, last), (np, 1)).clone_owned();
        let step = match &factor {
            Some(f) if np > 0 => -f.solve(&right).column(0),
            _ => DVector::zeros(np),
        };
        Self {
            normal,
            factor,
            step,
        }
    }

    /// Steps of the parameters and sizes of the columns `at`, and what of these is their own.
    fn with(&self, at: &[usize]) -> Option<(DVector<f64>, DVector<f64>, DMatrix<f64>)> {
        let np = self.step.len();
        let last = self.normal.ncols() - 1;
        let cross = DMatrix::from_fn(np, at.len(), |i, j| self.normal[(i, at[j])]);
        let mut own = DMatrix::from_fn(at.len(), at.len(), |i, j| self.normal[(at[i], at[j])]);
        let mut right = DVector::from_fn(at.len(), |i, _| self.normal[(at[i], last)]);
        let mut solved = DMatrix::zeros(np, at.len());
        if np > 0 {
            solved = self.factor.as_ref()?.solve(&cross);
            own -= cross.tr_mul(&solved);
            right += cross.tr_mul(&self.step);
        }
        let scale = (0..at.len()).all(|i| own[(i, i)] > 1e-7 * self.normal[(at[i], at[i])]);
        if !scale {
            return None; // others absorb it
        }
        let beta = -regular(own.clone()).cholesky()?.solve(&right);
        let step = &self.step - solved * &beta;
        Some((step, beta, own))
    }
}

fn indices(np: usize, at: &[usize]) -> Vec<usize> {
    (0..np).chain(at.iter().copied()).collect()
}

/// Cost of a stretch after a step of the columns `at`.
fn cost_at(stretch: &DMatrix<f64>, at: &[usize], step: &DVector<f64>) -> f64 {
    let last = stretch.ncols() - 1;
    let mut sum = stretch[(last, last)];
    for (i, a) in at.iter().enumerate() {
        sum += 2.0 * step[i] * stretch[(*a, last)];
        for (j, b) in at.iter().enumerate() {
            sum += step[i] * step[j] * stretch[(*a, *b)];
        }
    }
    0.5 * sum
}

/// A matrix that can be factored whatever its directions without information.
fn regular(mut a: DMatrix<f64>) -> DMatrix<f64> {
    let most = (0..a.nrows()).map(|i| a[(i, i)]).fold(0.0, f64::max);
    for i in 0..a.nrows() {
        a[(i, i)] += RIDGE * a[(i, i)] + 1e-14 * most + f64::MIN_POSITIVE;
    }
    a
}

/// Standard error from estimates with each stretch left out.
fn jackknife(estimates: &[f64]) -> f64 {
    let n = estimates.len() as f64;
    let mean = estimates.iter().sum::<f64>() / n;
    let squares: f64 = estimates.iter().map(|e| (e - mean).powi(2)).sum();
    (squares * (n - 1.0) / n).sqrt()
}

/// Degrees of freedom of information in unequal parts.
fn freedom(parts: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut squares) = (0.0, 0.0);
    for p in parts {
        sum += p;
        squares += p * p;
    }
    (sum * sum / squares.max(f64::MIN_POSITIVE) - 1.0).max(0.0)
}

/// Probability of estimates this far from 0 by chance.
fn wald(beta: &DVector<f64>, covariance: &DMatrix<f64>, dof: f64) -> f64 {
    let n = beta.len() as f64;
    if beta.len() == 1 {
        let t = beta[0] / covariance[(0, 0)].sqrt();
        return two_sided(t, dof);
    }
    let left = dof + 1.0 - n;
    let Some(factor) = regular(covariance.clone()).cholesky() else {
        return 1.0;
    };
    if left < 1.0 {
        return 1.0;
    }
    // Hotelling's distribution
    let f = beta.dot(&factor.solve(beta)) * left / (n * dof);
    FisherSnedecor::new(n, left).map_or(1.0, |d| d.sf(f))
}

/// Mean of two or more independent values, and its standard error, above 0.
pub(super) fn mean(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt().max(f64::MIN_POSITIVE))
}

/// Root mean square.
pub(super) fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// Probability of a t this large in magnitude.
pub(super) fn two_sided(t: f64, dof: f64) -> f64 {
    if !t.is_finite() {
        return if t.is_nan() { 1.0 } else { 0.0 };
    }
    StudentsT::new(0.0, 1.0, dof.clamp(1.0, 1e5)).map_or(1.0, |d| 2.0 * d.sf(t.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{machine, searching};

    /// What shows in one window alone no other foretells, yet it can be asked for; and that window is looked at.
    #[test]
    fn what_shows_in_one_window_has_a_score() {
        const WINDOW: usize = 5;
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&machine("", ""), &machine("", ""), config, |search, _| {
            let mut linear = search.windows.linearise(&search.x).expect("linear");
            let mut parts: Vec<DVector<f64>> = (linear.rows.iter())
                .map(|row| DVector::zeros(row.residual.len()))
                .collect();
            parts[WINDOW].fill(1.0);
            linear.rows[WINDOW].residual -= &parts[WINDOW] * 3.0;
            let looked_at = linear.telling(4);
            assert!(
                looked_at.contains(&WINDOW) && looked_at.len() == linear.rows.len().div_ceil(4)
            );
            let raw = parts[WINDOW].norm_squared();
            let column = Column { parts, raw };
            let normal = Normal::new(&linear.rows, &[column], &search.stretch_of, &[(0.0, 0.0)]);
            let score = normal.score(&[0]).expect("a score");
            assert!((score.expected[0] - 3.0).abs() < 0.3, "{score:?}");
            assert!(
                score.gain > 4.0 * raw && score.held_gain < 1e-6 * score.gain,
                "{score:?}"
            );
        });
    }
}
