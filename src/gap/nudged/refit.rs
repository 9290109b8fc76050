//! A model with effects, its numbers fitted: Gauss-Newton, with slopes of the base model's parameters held.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::judge::{Judge, Machine, Point};
use crate::gap::GapError;
use crate::gap::model::Chosen;
use crate::sysid::interval::Posterior;
use crate::sysid::nudging::{Ensemble, Quadratic, Slopes};

/// Steps.
const STEPS: usize = 4;
/// Draws of simulations by which costs are compared.
const DRAWS: usize = 4;
/// Farthest that a number goes in one, in spreads.
const FAR: f64 = 3.0;

/// Where a fit ends.
pub(super) struct Fitted {
    pub point: Point,
    pub machine: Machine,
    pub ensemble: Ensemble,
    /// F with that of the priors
    pub cost: f64,
}

impl Fitted {
    /// Effects with their values.
    pub(super) fn chosen(&self) -> Vec<Chosen> {
        let (point, machine) = (&self.point, &self.machine);
        (machine.built).values(&machine.problem, &point.x, &point.written)
    }

    /// What whitens each bin of its deviations.
    pub(super) fn weights(&self, judge: &Judge<'_>) -> DVector<f64> {
        judge.course.weights(self.ensemble.mean.as_slice())
    }

    /// The problem of all its numbers, linearised.
    pub(super) fn quadratic(&self, judge: &Judge<'_>) -> Quadratic {
        let parameters = &self.machine.problem.parameters;
        Quadratic::new(
            &self.ensemble,
            &self.weights(judge),
            parameters,
            &self.point.x,
        )
    }

    /// Covariance of all numbers, by how deviations are correlated over time.
    pub(super) fn covariance(&self, judge: &Judge<'_>) -> DMatrix<f64> {
        let Ensemble { mean, slopes, .. } = &self.ensemble;
        let innovations = judge.course.innovations(mean, slopes);
        let problem = &self.machine.problem;
        let lengths: Vec<usize> = problem.trials.iter().map(|t| t.n_knots).collect();
        let x = &self.point.x;
        Posterior::new(&problem.parameters, x, &innovations, &lengths).covariance
    }
}

impl Judge<'_> {
    /// All numbers of a model fitted from a point on; `known` slopes of the first of them. Nothing where it cannot be
    /// simulated.
    ///
    /// # Errors
    /// The engine fails.
    pub(super) fn refit(
        &self,
        (machine, start): (Machine, Point),
        known: &Slopes,
    ) -> Result<Option<Fitted>, GapError> {
        let slopes = known.widened(start.x.len());
        let Some(mut best) = self.seen(machine, start, &slopes)? else {
            return Ok(None);
        };
        for _ in 0..STEPS {
            let x = self.step(&best);
            let point = Point {
                written: best.point.written.clone(),
                x,
            };
            match self.reached(point, &best.ensemble.slopes)? {
                Some(next) if next.cost < best.cost => best = next,
                _ => break,
            }
        }
        Ok(Some(best))
    }

    /// A point with what is seen there; nothing where it cannot be said or simulated.
    ///
    /// # Errors
    /// The engine fails.
    pub(super) fn reached(&self, point: Point, known: &Slopes) -> Result<Option<Fitted>, GapError> {
        match self.build(&point.written) {
            Some(machine) => self.seen(machine, point, known),
            None => Ok(None),
        }
    }

    fn seen(
        &self,
        machine: Machine,
        point: Point,
        known: &Slopes,
    ) -> Result<Option<Fitted>, GapError> {
        let ensemble = match self.look(&machine, &point, (known, 0)) {
            Ok(ensemble) => ensemble,
            Err(GapError::Sysid(_)) => return Ok(None),
            Err(error) => return Err(error),
        };
        Ok(Some(self.fitted(machine, point, ensemble)))
    }

    /// A point with what is seen there in a draw of simulations, slopes of the first numbers as known.
    ///
    /// # Errors
    /// The model cannot be said; simulations diverge.
    pub(super) fn at(&self, point: Point, known: (&Slopes, usize)) -> Result<Fitted, GapError> {
        let machine = self.build(&point.written).ok_or_else(super::broken)?;
        let ensemble = self.look(&machine, &point, known)?;
        Ok(self.fitted(machine, point, ensemble))
    }

    /// A point with what was seen there.
    pub(super) fn fitted(&self, machine: Machine, point: Point, ensemble: Ensemble) -> Fitted {
        let cost = self.course.misfit(ensemble.mean.as_slice());
        let cost = cost + machine.problem.parameters.prior_cost(&point.x);
        Fitted {
            point,
            machine,
            ensemble,
            cost,
        }
    }

    /// F of a fitted model in several draws of simulations, none of which it was fitted by.
    ///
    /// # Errors
    /// Simulations diverge.
    pub(super) fn costs(&self, fitted: &Fitted) -> Result<Vec<f64>, GapError> {
        let (machine, point) = (&fitted.machine, &fitted.point);
        let prior = machine.problem.parameters.prior_cost(&point.x);
        let one = |draw| {
            let ensemble = self.look(machine, point, (&fitted.ensemble.slopes, draw))?;
            Ok(self.course.misfit(ensemble.mean.as_slice()) + prior)
        };
        (1..=DRAWS).map(one).collect()
    }

    /// Where the linearised problem has its least cost.
    pub(super) fn step(&self, from: &Fitted) -> Vec<f64> {
        let spreads = self.spreads(&from.machine, &from.point);
        let parameters = &from.machine.problem.parameters;
        let dx = (from.quadratic(self)).step(parameters, &from.point.x, (&spreads, FAR));
        (from.point.x.iter().zip(&dx)).map(|(x, d)| x + d).collect()
    }

    /// Several points fitted, in their order.
    ///
    /// # Errors
    /// The engine fails.
    pub(super) fn refit_all(
        &self,
        points: Vec<(Machine, Point)>,
        known: &Slopes,
    ) -> Result<Vec<Option<Fitted>>, GapError> {
        let all: Vec<_> = (points.into_par_iter())
            .map(|point| self.refit(point, known))
            .collect();
        all.into_iter().collect()
    }
}
