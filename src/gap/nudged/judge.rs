//! Models with effects, simulated under the pulls of the base model.

use std::sync::Arc;

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::refit::Fitted;
use crate::gap::GapError;
use crate::gap::effect::{ModelFile, Place};
use crate::gap::inputs::{judged, same_channels};
use crate::gap::model::{Built, Chosen, Measured};
use crate::gap::run::Input;
use crate::recording::Recording;
use crate::rng::{self, Purpose};
use crate::sysid::nudging::{Course, Ensemble, Slopes, trembling};
use crate::sysid::parameter::ParameterRule;
use crate::sysid::path::Path;
use crate::sysid::problem::Problem;
use crate::sysid::start;

/// Times that pulls are led along what simulations have made of the motion.
const CORRECTIONS: usize = 3;
/// Simulations of a mean.
const STILL: usize = 16;
/// Part of its value by which an effect's number is moved to see what it does, or of a third of the usual size.
const MOVED: f64 = 0.3;
/// The same once it is nearly fitted: so many standard deviations, between these parts. Friction under which all sticks does
/// no more than it has to, and what moves reach beyond that is not linear; slopes by moves much smaller than a number's
/// standard deviation are chaos, which damps steps until the fit seems to have ended.
const SIGMAS: f64 = 4.0;
const LEAST_MOVED: f64 = 0.1;
const MOST_MOVED: f64 = 1.0;

/// s of the stretches of a motion that its speeds are means over.
const STRETCH_S: f64 = 0.2;

/// Training and held-out recordings with the base model's parameters.
pub(super) struct Problems {
    pub train: Problem,
    pub held: Option<Problem>,
}

impl Problems {
    /// # Errors
    /// Input that does not fit together.
    pub(super) fn new(input: &Input<'_>) -> Result<Self, GapError> {
        let config = judged(input)?;
        let of = |all: &[(String, Recording)]| -> Result<Problem, GapError> {
            let mut problem = Problem::new(Arc::clone(&input.model.model), &config, all)?;
            let x = problem.parameters.start();
            for i in 0..problem.trials.len() {
                let qpos = start::trajectory(&problem, &problem.trials[i], &x)?;
                let model = &problem.model;
                problem.trials[i].path = Some(Path::new(qpos, model.nq(), model.timestep()));
            }
            Ok(problem)
        };
        let train = of(input.train)?;
        same_channels(&train, &config, input)?;
        let held = (!input.holdout.is_empty()).then(|| of(input.holdout));
        Ok(Self {
            train,
            held: held.transpose()?,
        })
    }
}

/// Effects as they were written into the model, and all its free numbers.
#[derive(Debug, Clone)]
pub(super) struct Point {
    pub written: Vec<Chosen>,
    pub x: Vec<f64>,
}

/// A model and what is estimated of it.
pub(super) struct Machine {
    pub built: Built,
    pub problem: Problem,
}

/// An effect's number that is nearly fitted.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Known {
    name: String,
    place: Place,
    /// which of the effect's
    parameter: usize,
    /// by which it is moved
    spread: f64,
}

/// The motions (knots × nq) of recordings in stretches of equal length: speeds and travels are those within a stretch and from
/// one to another, while a recording as a whole may end where it begins.
fn in_stretches(problem: &Problem) -> Vec<Vec<f64>> {
    let model = &problem.model;
    let size = ((STRETCH_S / model.timestep()).round() as usize).max(2) * model.nq();
    let paths = problem.trials.iter().filter_map(|t| t.path.as_ref());
    paths
        .flat_map(|path| path.rows().chunks_exact(size).map(<[f64]>::to_vec))
        .collect()
}

impl Known {
    fn is(&self, chosen: &Chosen, parameter: usize) -> bool {
        self.name == chosen.effect.about().name
            && self.place == chosen.place
            && self.parameter == parameter
    }
}

/// Judges models by simulations of the training recordings.
pub(super) struct Judge<'a> {
    pub base: &'a ModelFile,
    pub rules: &'a [ParameterRule],
    pub measured: Measured,
    /// spreads of the base model's parameters
    pub spreads: Vec<f64>,
    /// effects' numbers that are nearly fitted
    pub known: Vec<Known>,
    hz: f64,
    pub course: Course<'a>,
    held: Option<Course<'a>>,
}

impl<'a> Judge<'a> {
    /// With pulls along the recordings as the base model's numbers `x` have them.
    ///
    /// # Errors
    /// A model that cannot be simulated.
    pub(super) fn new(
        input: &Input<'a>,
        problems: &'a Problems,
        hz: f64,
        (x, spreads): (&[f64], &[f64]),
    ) -> Result<Self, GapError> {
        let motions = in_stretches(&problems.train);
        let course = |problem: &'a Problem| Course::new(problem, hz, x);
        Ok(Self {
            base: input.model,
            rules: &input.config.parameter,
            measured: Measured::new(&problems.train, x, &motions)?,
            spreads: spreads.to_vec(),
            known: Vec::new(),
            hz,
            course: course(&problems.train)?,
            held: problems.held.as_ref().map(course).transpose()?,
        })
    }

    /// Leads pulls along what simulations of a model make of the recorded motion: smoothing has taken the edges off that. They
    /// then supply what the model lacks, which one that lacks less would have twice: each model that is kept wants its own.
    ///
    /// # Errors
    /// A simulation diverges.
    pub(super) fn lead(&mut self, machine: &Machine, x: &[f64]) -> Result<(), GapError> {
        let base = &x[..self.spreads.len()];
        let led = |of: &Course<'a>| -> Result<Course<'a>, GapError> {
            let problem = machine.built.problem(of.problem)?;
            let mut own = Course::new(&problem, self.hz, x)?;
            for _ in 0..CORRECTIONS {
                let here = own.at(x)?.ok_or_else(super::broken)?;
                own.correct(x, &here)?;
            }
            Ok(own.beside(of.problem, base))
        };
        let (course, held) = (led(&self.course)?, self.held.as_ref().map(led).transpose()?);
        (self.course, self.held) = (course, held);
        Ok(())
    }

    /// The base model with effects; nothing where it cannot be said.
    pub(super) fn build(&self, written: &[Chosen]) -> Option<Machine> {
        let built = Built::new(self.base, self.rules, written, &self.measured).ok()?;
        let problem = built.problem(self.course.problem).ok()?;
        Some(Machine { built, problem })
    }

    /// The model and the numbers of `present` with more effects; nothing where that cannot be said.
    pub(super) fn with(&self, present: &Point, more: &[Chosen]) -> Option<(Machine, Point)> {
        let written = [&present.written, more].concat();
        let machine = self.build(&written)?;
        let mut x = machine.problem.parameters.start();
        x[..present.x.len()].copy_from_slice(&present.x);
        Some((machine, Point { written, x }))
    }

    /// Spreads of all numbers of a model: those of effects that are not known yet from their values.
    pub(super) fn spreads(&self, machine: &Machine, point: &Point) -> Vec<f64> {
        let mut spreads = self.moves(machine, point, MOVED);
        for (j, i, p, _) in machine.built.free(&machine.problem) {
            if let Some(known) = self.known.iter().find(|k| k.is(&point.written[i], p)) {
                spreads[j] = known.spread;
            }
        }
        spreads
    }

    /// The effects' numbers at a fitted point, with spreads by how well they are known there.
    pub(super) fn known(&self, fitted: &Fitted) -> Vec<Known> {
        let (machine, point) = (&fitted.machine, &fitted.point);
        let [low, high] = [LEAST_MOVED, MOST_MOVED].map(|part| self.moves(machine, point, part));
        let Some(factor) = fitted.quadratic(self).normal.cholesky() else {
            return Vec::new();
        };
        let covariance = factor.inverse();
        let free = machine.built.free(&machine.problem).into_iter();
        let known = free.map(|(j, i, parameter, _)| Known {
            name: point.written[i].effect.about().name.to_owned(),
            place: point.written[i].place.clone(),
            parameter,
            spread: (SIGMAS * covariance[(j, j)].sqrt()).clamp(low[j], high[j]),
        });
        known.collect()
    }

    /// Spreads of all numbers of a model, those of effects the part `moved` of their values.
    fn moves(&self, machine: &Machine, point: &Point, moved: f64) -> Vec<f64> {
        let values = (machine.built).values(&machine.problem, &point.x, &point.written);
        let mut spreads = self.spreads.clone();
        spreads.resize(point.x.len(), 0.0);
        for (j, i, p, slope) in machine.built.free(&machine.problem) {
            let chosen = &values[i];
            let scales = self.measured.scales(&self.base.model, &chosen.place);
            let parameter = &chosen.effect.about().parameters[p];
            let usual = match parameter.typical(&scales).abs() {
                0.0 => parameter.high * parameter.scale(&scales),
                typical => typical,
            };
            let size = moved * chosen.values[p].abs().max(usual / 3.0);
            spreads[j] = size / slope.abs();
        }
        spreads
    }

    /// All slopes at a point, and the mean in its midst.
    ///
    /// # Errors
    /// Simulations diverge.
    pub(super) fn linearise(&self, machine: &Machine, point: &Point) -> Result<Ensemble, GapError> {
        let course = self.course.beside(&machine.problem, &point.x);
        let spreads = self.spreads(machine, point);
        let wide = Ensemble::new(&course, &point.x, &spreads)?;
        Ok(Ensemble::still(
            &course,
            &point.x,
            &spreads,
            &wide.slopes,
            STILL,
        )?)
    }

    /// Slopes of the effects' numbers at a point, the others as known, in a draw of simulations.
    ///
    /// # Errors
    /// Simulations diverge.
    pub(super) fn look(
        &self,
        machine: &Machine,
        point: &Point,
        known: (&Slopes, usize),
    ) -> Result<Ensemble, GapError> {
        let course = self.course.beside(&machine.problem, &point.x);
        let spreads = self.spreads(machine, point);
        let open: Vec<usize> = (self.spreads.len()..point.x.len()).collect();
        Ok(Ensemble::few(&course, &point.x, &spreads, &open, known)?)
    }

    /// Mean deviations of the held-out recordings at a point, and what they cost; nothing without any, or where simulations
    /// diverge.
    ///
    /// # Errors
    /// The model cannot carry the parameters.
    pub(super) fn held(&self, machine: &Machine, point: &Point) -> Result<Option<f64>, GapError> {
        let Some(held) = &self.held else {
            return Ok(None);
        };
        let problem = machine.built.problem(held.problem)?;
        let course = held.beside(&problem, &point.x);
        let spreads = self.spreads(machine, point);
        // slopes there are not known, and trembling is little
        let known = Slopes::zeros(course.n_bins(), point.x.len());
        let found = Ensemble::still(&course, &point.x, &spreads, &known, STILL);
        Ok(Some(found.map_or(f64::INFINITY, |e| {
            course.misfit(e.mean.as_slice())
        })))
    }

    /// By how much deviations would be more, had the model at `fitted` made the recordings, with the noise of the sensors, in
    /// so many draws; nothing where one diverges.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn recorded(
        &self,
        fitted: &Fitted,
        draws: usize,
        seed: u64,
    ) -> Result<Option<Vec<DVector<f64>>>, GapError> {
        let (machine, point) = (&fitted.machine, &fitted.point);
        let course = self.course.beside(&machine.problem, &point.x);
        let spreads = self.spreads(machine, point);
        let trembling = trembling(point.x.len(), STILL + draws, 0);
        let mut out = Vec::new();
        for (draw, signs) in trembling.iter().skip(STILL).enumerate() {
            let moved = DVector::from_fn(point.x.len(), |j, _| signs[j] * spreads[j]);
            let x: Vec<f64> = point.x.iter().zip(&moved).map(|(x, m)| x + m).collect();
            let Some(own) = course.at(&x)? else {
                return Ok(None);
            };
            // its chaos, without what its parameters are moved by
            let own = DVector::from_vec(own.bins) - &fitted.ensemble.slopes.by * moved;
            let mut rng = rng::stream(seed, Purpose::SensorNoise, u64::MAX, draw as u64);
            let noise = (course.noise_sigma()).map(|sigma| sigma * rng::normal(&mut rng));
            out.push(noise - own);
        }
        Ok(Some(out))
    }

    /// The same judge where training recordings are others, so that deviations are `more`; without held-out ones.
    pub(super) fn retold(&self, more: DVector<f64>) -> Self {
        Self {
            measured: self.measured.clone(),
            spreads: self.spreads.clone(),
            known: self.known.clone(),
            course: self.course.retold(more),
            held: None,
            ..*self
        }
    }

    /// Independent numbers that the recordings' deviations are worth.
    pub(super) fn worth(&self) -> f64 {
        self.course.worth()
    }

    /// The same of the held-out ones.
    pub(super) fn worth_held(&self) -> f64 {
        self.held.as_ref().map_or(0.0, Course::worth)
    }

    /// The course of the held-out recordings, else of the training ones.
    pub(super) fn verifying(&self) -> &Course<'a> {
        self.held.as_ref().unwrap_or(&self.course)
    }
}

#[cfg(test)]
mod tests {
    use super::{Problems, in_stretches};
    use crate::compare::Settings;
    use crate::gap::masses::{chosen, machine, record};
    use crate::gap::model::Measured;
    use crate::gap::run::Input;
    use crate::sysid::problem::ProblemConfig;

    /// Sines that end anywhere.
    #[test]
    fn a_recording_goes_farther_than_from_its_begin_to_its_end() {
        let base = machine("", "");
        let (config, protocol) = (ProblemConfig::default(), Settings::default());
        let train = [("sines".to_owned(), record(&base))];
        let input = Input {
            model: &base,
            config: &config,
            train: &train,
            holdout: &[],
            protocol: &protocol,
        };
        let problem = Problems::new(&input).expect("a problem").train;
        let path = problem.trials[0].path.as_ref().expect("a path");
        let q: Vec<f64> = path.rows().iter().step_by(2).copied().collect();
        let h = base.model.timestep();
        let speeds: Vec<f64> = q.windows(2).map(|q| (q[1] - q[0]) / h).collect();
        let rms = (speeds.iter().map(|v| v * v).sum::<f64>() / speeds.len() as f64).sqrt();
        let span = q.iter().copied().fold(f64::NEG_INFINITY, f64::max)
            - q.iter().copied().fold(f64::INFINITY, f64::min);
        let measured = Measured::new(&problem, &[], &in_stretches(&problem)).expect("sizes");
        let place = chosen(&base, "joint_spring", "a", &[1.0, 0.0]).place;
        let scales = measured.scales(&base.model, &place);
        assert!(
            (scales.travel / span - 1.0).abs() < 0.1,
            "{}",
            scales.travel
        );
        assert!((scales.speed / rms - 1.0).abs() < 0.3, "{}", scales.speed);
    }
}
