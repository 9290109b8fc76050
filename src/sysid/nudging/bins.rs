//! Deviations of a pulled simulation from the readings, averaged over bins of time.

use std::ops::Range;

use crate::sysid::problem::Problem;
use crate::sysid::shooting::simulate::Simulated;
use crate::sysid::shooting::window::{Placed, Window};

/// Mean deviation of one channel over a short time.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bin {
    /// trial and knot of its middle
    pub place: (usize, usize),
    /// samples
    n: f64,
}

/// Bins of one channel in one trial.
pub(super) struct Series {
    pub bins: Range<usize>,
    /// variance of the readings' noise in a bin
    pub noise: f64,
}

/// All bins of a problem.
pub(super) struct Bins {
    pub all: Vec<Bin>,
    /// bin of every trial and sample
    of: Vec<Vec<usize>>,
    /// bins of each channel in each trial
    pub series: Vec<Series>,
}

impl Bins {
    /// Of `width_s` each.
    pub(super) fn new(problem: &Problem, width_s: f64) -> Self {
        let h = problem.model.timestep();
        let mut bins = Self {
            all: Vec::new(),
            of: Vec::new(),
            series: Vec::new(),
        };
        for (i, trial) in problem.trials.iter().enumerate() {
            let mut of = vec![0; trial.samples.len()];
            for channel in 0..problem.channels.len() {
                let first = bins.all.len();
                let mut present = None;
                for (s, sample) in trial.samples.iter().enumerate() {
                    if sample.channel != channel {
                        continue;
                    }
                    let at = (sample.time / width_s).floor();
                    if present != Some(at) {
                        present = Some(at);
                        let middle = ((at + 0.5) * width_s / h) as usize;
                        bins.all.push(Bin {
                            place: (i, middle.min(trial.n_knots - 1)),
                            n: 0.0,
                        });
                    }
                    let own = bins.all.len() - 1;
                    bins.all[own].n += 1.0;
                    of[s] = own;
                }
                let own = first..bins.all.len();
                if !own.is_empty() {
                    let n: f64 = bins.all[own.clone()].iter().map(|b| b.n).sum();
                    let sigma = problem.channels[channel].sigma;
                    bins.series.push(Series {
                        noise: sigma.powi(2) * own.len() as f64 / n,
                        bins: own,
                    });
                }
            }
            bins.of.push(of);
        }
        bins
    }

    /// Adds the mean deviations of a simulated trial to those of all bins.
    pub(super) fn add(
        &self,
        problem: &Problem,
        (window, placed): (&Window, &[Placed]),
        simulated: &Simulated,
        free: &[f64],
        out: &mut [f64],
    ) {
        let samples = &problem.trials[window.trial].samples;
        for (p, (z, _)) in placed
            .iter()
            .zip(simulated.samples(problem, window, placed))
        {
            let sample = &samples[p.sample];
            let bin = self.of[window.trial][p.sample];
            let reading = problem.channels[sample.channel].reading(free, z);
            out[bin] += (reading - sample.value) / self.all[bin].n;
        }
    }
}
