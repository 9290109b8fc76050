//! How much the residuals weigh.
//!
//! What missing physics leaves is neither as small as the sensors' noise nor white: its samples say the same thing many
//! times over. Taken for noise, it would pull parameters away from anything that their priors allow. Channels are
//! therefore weighed by what is left of them, and all together by how much more the gradient of the cost varies from
//! stretch to stretch than samples by themselves let expect:
//!
//! ```text
//! sigma = max(noise, rms √max(κ, 1))        κ = tr(H⁻¹ G)/n        H = Σ J̃ᵀJ̃        G = Σ (g − ḡ)(g − ḡ)ᵀ,  g = J̃ᵀ r̃
//! ```
//!
//! with n parameters, one g a stretch. Where nothing is missing, κ is 1.
//!
//! What is left depends on the fit, and the fit on the weights: a fit from afar leaves much, and channels that weigh little
//! leave parameters where their priors have them. Both are made again while weights are far from what is left. Where more than
//! noise is left and a parameter is far off its prior all the same, that stands for missing physics: all sigma are then taken
//! to be larger until no parameter is.
//!
//! Reference: Ribatet, Cooley and Davison 2012, "Bayesian inference from composite likelihoods" (magnitude adjustment).

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use super::fit::Fitted;
use super::windows::Windows;
use crate::sysid::SysidError;

/// Part of the largest information below which a direction says nothing.
const LEAST: f64 = 1e-8;
/// Iterations of a fit where weights are far from what they will be.
pub(super) const ROUGH_ITERATIONS: usize = 5;
/// Times that channels are weighed anew, at most.
const WEIGHINGS: usize = 8;
/// Factor by which a weight changes, from which on it is far from what it will be.
pub(super) const FAR: f64 = 2.0;
/// Standard deviations that a parameter is hardly ever from its prior.
const HARDLY: f64 = 4.0;
/// And that it may well be.
const WELL: f64 = 2.0;
/// Factor by which channels are taken to be coarser at a time.
const LESS: f64 = 3.0;

/// How much channels weigh by what is left.
pub(super) struct Weights {
    /// standard deviation of each
    sigma: Vec<f64>,
    /// of the residuals by these
    pub cost: f64,
}

impl Windows {
    /// Fits from `x` on until weights are near what is left, before and after a fit of so many iterations; `fit` is told from where,
    /// and how many.
    ///
    /// # Errors
    /// The engine refuses a number; of `fit`.
    pub(super) fn fit_weighed(
        &mut self,
        (x, noise): (&[f64], &[f64]),
        iterations: usize,
        mut fit: impl FnMut(&mut Self, &[f64], usize) -> Result<Fitted, SysidError>,
    ) -> Result<Fitted, SysidError> {
        let mut fitted = fit(self, x, ROUGH_ITERATIONS)?;
        let mut weights = self.weights(&fitted.x, noise)?;
        for _ in 0..WEIGHINGS {
            let near = self.take_weights(&weights) < FAR;
            let most = if near { iterations } else { ROUGH_ITERATIONS };
            fitted = fit(self, &fitted.x, most)?;
            weights = self.weights(&fitted.x, noise)?;
            if near && self.change(&weights) < FAR {
                break;
            }
        }
        Ok(fitted)
    }

    /// `fitted`, unless a parameter is where its prior has it hardly ever while more than noise is left: then that stands for
    /// missing physics, and channels weigh less until parameters are where they may well be.
    ///
    /// # Errors
    /// Of `fit`.
    pub(super) fn within_priors(
        &mut self,
        mut fitted: Fitted,
        noise: &[f64],
        mut fit: impl FnMut(&mut Self, &[f64]) -> Result<Fitted, SysidError>,
    ) -> Result<Fitted, SysidError> {
        let farthest = |windows: &Self, x: &[f64]| windows.problem.parameters.farthest(x);
        if !self.misfit(noise) || farthest(self, &fitted.x) <= HARDLY {
            return Ok(fitted);
        }
        for _ in 0..WEIGHINGS {
            if farthest(self, &fitted.x) <= WELL {
                break;
            }
            for channel in &mut self.problem.channels {
                channel.sigma *= LESS;
            }
            fitted = fit(self, &fitted.x)?;
        }
        Ok(fitted)
    }

    /// Whether more than `noise` is left of a channel.
    pub(super) fn misfit(&self, noise: &[f64]) -> bool {
        let mut each = self.problem.channels.iter().zip(noise);
        each.any(|(c, noise)| c.sigma > FAR * noise)
    }

    /// Sets the standard deviations of channels at parameters `x`, where their sensors have `noise`. The largest factor by
    /// which one changes.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn weigh(&mut self, x: &[f64], noise: &[f64]) -> Result<f64, SysidError> {
        let weights = self.weights(x, noise)?;
        Ok(self.take_weights(&weights))
    }

    /// Gives the channels these weights; how they change.
    fn take_weights(&mut self, weights: &Weights) -> f64 {
        let change = self.change(weights);
        self.problem.take_sigma(&weights.sigma);
        change
    }

    /// The largest factor by which these weights are not those of the channels.
    fn change(&self, weights: &Weights) -> f64 {
        let each = self.problem.channels.iter().zip(&weights.sigma);
        each.fold(1.0, |change, (channel, sigma)| {
            change.max(sigma / channel.sigma).max(channel.sigma / sigma)
        })
    }

    /// The weights of channels at parameters `x`, where their sensors have `noise`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn weights(&self, x: &[f64], noise: &[f64]) -> Result<Weights, SysidError> {
        let linear = self.linearise(x)?;
        let mut squares = vec![(0.0, 0.0_f64); self.problem.channels.len()];
        for row in &linear.rows {
            for (c, r) in row.channel.iter().zip(row.residual.iter()) {
                squares[*c] = (squares[*c].0 + r * r, squares[*c].1 + 1.0);
            }
        }
        let rms: Vec<f64> = (squares.iter())
            .map(|(sum, n)| if *n > 0.0 { (sum / n).sqrt() } else { 1.0 })
            .collect();
        let stretch_of = self.stretches();
        let n_stretches = stretch_of.iter().max().map_or(0, |m| m + 1);
        let np = x.len();
        let mut information = DMatrix::zeros(np, np);
        let mut gradients = vec![DVector::zeros(np); n_stretches];
        for (row, stretch) in linear.rows.iter().zip(&stretch_of) {
            let weight = |i: usize| rms[row.channel[i]].max(f64::MIN_POSITIVE).recip();
            let n = row.residual.len();
            let slopes = DMatrix::from_fn(n, np, |i, j| row.parameters[(i, j)] * weight(i));
            let residual = DVector::from_fn(n, |i, _| row.residual[i] * weight(i));
            information.gemm_tr(1.0, &slopes, &slopes, 1.0);
            gradients[*stretch].gemv_tr(1.0, &slopes, &residual, 1.0);
        }
        let spread = repetition(information, &gradients).max(1.0).sqrt();
        let channels = &self.problem.channels;
        let each = channels.iter().zip(rms).zip(noise);
        let sigma: Vec<f64> = each
            .map(|((channel, rms), noise)| noise.max(channel.sigma * rms * spread))
            .collect();
        let each = channels.iter().zip(&sigma).zip(squares);
        let cost = each
            .map(|((channel, sigma), (square, _))| 0.5 * square * (channel.sigma / sigma).powi(2))
            .sum();
        Ok(Weights { sigma, cost })
    }
}

/// κ of the module.
fn repetition(mut information: DMatrix<f64>, gradients: &[DVector<f64>]) -> f64 {
    let (np, count) = (information.nrows(), gradients.len() as f64);
    if np == 0 || gradients.len() < 2 {
        return 1.0;
    }
    let scale = DVector::from_fn(np, |i, _| {
        information[(i, i)].max(f64::MIN_POSITIVE).sqrt().recip()
    });
    for i in 0..np {
        for j in 0..np {
            information[(i, j)] *= scale[i] * scale[j];
        }
    }
    let mean = gradients.iter().sum::<DVector<f64>>() / count;
    let eigen = SymmetricEigen::new(information);
    let most = eigen.eigenvalues.max();
    let (mut sum, mut n) = (0.0, 0.0_f64);
    for (value, vector) in eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter())
    {
        if *value > LEAST * most {
            let along = |g: &DVector<f64>| (g - &mean).component_mul(&scale).dot(&vector);
            sum += gradients.iter().map(|g| along(g).powi(2)).sum::<f64>() / value;
            n += 1.0;
        }
    }
    sum / n.max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::base;
    use crate::gap::masses::{machine, searching, searching_cut};
    use crate::gap::step::tests::{driven, model};
    use crate::sysid::problem::{Problem, ProblemConfig};

    /// An armature 10 % off, as its prior allows, and channels that are taken to be a thousand times too coarse.
    #[test]
    fn weights_do_not_stay_where_a_fit_from_afar_has_them() {
        let machine = model("0.004");
        let config = "command = \"held\"
            [[parameter]]
            element = \"joint/hinge\"
            attribute = \"armature\"
            start = 0.011
            prior = 0.011
            prior_sigma = 0.1";
        let config: ProblemConfig = toml::from_str(config).expect("a configuration");
        let all = [("one".to_owned(), driven(&machine, 1))];
        let problem = Problem::new(machine, &config, &all).expect("a problem");
        let mut windows = Windows::cut(&problem, &[], 0.4, 100).expect("windows");
        let noise = [windows.problem.channels[0].sigma];
        windows.problem.channels[0].sigma *= 1000.0;
        let start = windows.problem.parameters.start();
        let fitted = windows.fit_weighed((&start, &noise), 20, |windows, x, _| {
            windows.fit(x, 20, &mut |_| true)
        });
        let x = fitted.expect("a fit").x;
        let armature = windows.problem.parameters.values(&x)[0];
        assert!((armature / 0.01 - 1.0).abs() < 1e-3, "{armature}");
        assert!(windows.weigh(&x, &noise).expect("weights") < FAR);
    }

    /// A rotor that no prior allows stays where it is if it is all that was missing, not if friction is missing beside it, which
    /// a base fit then leaves, however far off the rotor is.
    #[test]
    fn what_hardly_can_be_is_not_while_something_is_missing() {
        let farthest = |windows: &Windows, x: &[f64]| windows.problem.parameters.farthest(x);
        let base = machine(r#"damping=".2""#, "");
        for (friction, sigma, most) in [
            ("", 0.1, f64::INFINITY),
            (r#"frictionloss=".1""#, 0.09, WELL),
        ] {
            let hidden = machine(&format!(r#"damping=".2" armature=".45" {friction}"#), "");
            let config = format!(
                "[[parameter]]\nelement = \"joint/a\"\nattribute = \"armature\"\nscale = \"linear\"\n\
                 prior_sigma = {sigma}\n"
            );
            searching(&base, &hidden, &config, |search, _| {
                // the base model's
                let of_base = farthest(&search.windows, &search.x);
                assert!((of_base > HARDLY) == friction.is_empty(), "{of_base}");
                // and one that explains all by the rotor
                let (mut windows, noise) = (search.windows.clone(), search.noise.clone());
                windows.problem.take_sigma(&noise);
                let fit = |windows: &mut Windows, x: &[f64]| windows.fit(x, 20, &mut |_| true);
                let explained = windows.fit_weighed((&search.x, &noise), 20, |w, x, _| fit(w, x));
                let explained = explained.expect("a fit");
                assert!(farthest(&windows, &explained.x) > HARDLY);
                let within = windows.within_priors(explained, &noise, |w, x| fit(w, x));
                let within = farthest(&windows, &within.expect("a fit").x);
                assert!(
                    within <= most && (within > HARDLY) == friction.is_empty(),
                    "{within}"
                );
            });
        }
        let hidden = machine(r#"damping=".2" armature="2" frictionloss=".1""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"armature\"\nscale = \"linear\"\nprior_sigma = 0.09\n";
        searching_cut(&base, &hidden, config, |search, cuts, watch| {
            // in windows that it does not follow, too
            for length_s in [0.2, 0.4, 0.8] {
                let long = cuts.train(length_s).expect("windows");
                let (long, _, fit) = base::fit(long, watch).expect("a fit");
                let farthest = farthest(&long, &fit.x);
                assert!(farthest <= WELL, "{length_s} {farthest}");
            }
            let farthest = farthest(&search.windows, &search.x);
            assert!(farthest <= HARDLY, "{farthest}");
        });
    }

    #[test]
    fn samples_that_say_the_same_count_once() {
        // four stretches of a signed unit gradient; then every sample of them nine times, which is no news
        let gradients = |factor: f64| -> Vec<DVector<f64>> {
            [1.0, -1.0, 1.0, -1.0]
                .iter()
                .map(|g| DVector::from_element(1, g * factor))
                .collect()
        };
        let once = repetition(DMatrix::from_element(1, 1, 4.0), &gradients(1.0));
        let often = repetition(DMatrix::from_element(1, 1, 36.0), &gradients(9.0));
        assert!(
            (once - 1.0).abs() < 1e-12 && (often - 9.0).abs() < 1e-12,
            "{once} {often}"
        );
    }
}
