//! Forces that pull simulations along the recordings: where, and in which phase, the model lacks them.

use nalgebra::DMatrix;

use super::judge::{Judge, Machine, Point};
use crate::gap::GapError;
use crate::gap::locate::{Missing, driven, touched, unit};
use crate::gap::score::STRETCHES;
use crate::gap::windows;
use crate::mujoco::{Model, ObjectKind};
use crate::sysid::nudging::{Course, Pulled, trembling};
use crate::sysid::problem::Problem;

/// Simulations that forces are a mean of.
const SIMULATIONS: usize = 4;

/// A degree of freedom whose missing force is told.
struct Told {
    name: String,
    unit: &'static str,
    /// addresses in qpos and qvel
    at: (usize, usize),
}

/// Joints with motors, then where free bodies are along each axis.
fn told(model: &Model) -> Vec<Told> {
    let driven = driven(model);
    let mut out = Vec::new();
    for joint in 0..model.njnt() {
        let Some(name) = model.name(ObjectKind::Joint, joint) else {
            continue;
        };
        let at = (
            model.jnt_qposadr()[joint] as usize,
            model.jnt_dofadr()[joint] as usize,
        );
        if model.is_free(joint) {
            out.extend((0..3).map(|k| Told {
                name: format!("{name} {}", ["x", "y", "z"][k]),
                unit: "N",
                at: (at.0 + k, at.1 + k),
            }));
        } else if driven.iter().any(|d| d == name) {
            out.push(Told {
                name: name.to_owned(),
                unit: unit(model, name),
                at,
            });
        }
    }
    out
}

/// Forces missing at a point, means over stretches of `length_s`.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn missing(
    judge: &Judge<'_>,
    (machine, point): (&Machine, &Point),
    length_s: f64,
) -> Result<Option<Missing>, GapError> {
    let verifying = judge.verifying();
    let problem = machine.built.problem(verifying.problem)?;
    let held = verifying.beside(&problem, &point.x);
    of(judge, &held, (machine, point), length_s)
}

/// The same of the training recordings.
///
/// # Errors
/// The engine refuses a number.
pub(super) fn trained(
    judge: &Judge<'_>,
    (machine, point): (&Machine, &Point),
    length_s: f64,
) -> Result<Option<Missing>, GapError> {
    let course = judge.course.beside(&machine.problem, &point.x);
    of(judge, &course, (machine, point), length_s)
}

fn of(
    judge: &Judge<'_>,
    course: &Course<'_>,
    (machine, point): (&Machine, &Point),
    length_s: f64,
) -> Result<Option<Missing>, GapError> {
    let problem = course.problem;
    let model = &problem.model;
    let told = told(model);
    let spreads = judge.spreads(machine, point);
    let mut sums: Option<Cells> = None;
    for signs in trembling(point.x.len(), SIMULATIONS, 0) {
        let x: Vec<f64> = (0..point.x.len())
            .map(|j| point.x[j] + signs[j] * spreads[j])
            .collect();
        let Some(pulled) = course.pulled(&x)? else {
            continue;
        };
        let own = cells(problem, &told, &pulled, length_s);
        match &mut sums {
            None => sums = Some(own),
            Some(sum) => sum.add(&own),
        }
    }
    let Some(cells) = sums else { return Ok(None) };
    let n = cells.origin.len();
    let per = n.div_ceil(STRETCHES).max(1);
    Ok(Some(Missing {
        joints: told.iter().map(|t| t.name.clone()).collect(),
        units: told.iter().map(|t| t.unit).collect(),
        force: cells.force / cells.simulations,
        position: cells.position / cells.simulations,
        velocity: cells.velocity / cells.simulations,
        motor: cells.motor / cells.simulations,
        touching: cells.touching,
        names: (cells.origin.iter())
            .map(|(i, at_s)| windows::name(&problem.trials[*i], *at_s))
            .collect(),
        origin: cells.origin,
        stretch_of: (0..n).map(|w| w / per).collect(),
    }))
}

/// Means over stretches of time, of the first simulations.
struct Cells {
    simulations: f64,
    force: DMatrix<f64>,
    position: DMatrix<f64>,
    velocity: DMatrix<f64>,
    motor: DMatrix<f64>,
    touching: Vec<Vec<bool>>,
    origin: Vec<(usize, f64)>,
}

impl Cells {
    fn add(&mut self, other: &Self) {
        self.simulations += other.simulations;
        self.force += &other.force;
        self.position += &other.position;
        self.velocity += &other.velocity;
        self.motor += &other.motor;
    }
}

fn cells(problem: &Problem, told: &[Told], pulled: &[Pulled], length_s: f64) -> Cells {
    let model = &problem.model;
    let steps = ((length_s / model.timestep()).round() as usize).max(1);
    let (nq, nv) = (model.nq(), model.nv());
    let n: usize = pulled.iter().map(|p| p.touching.len() / steps).sum();
    let zeros = || DMatrix::zeros(n, told.len());
    let mut out = Cells {
        simulations: 1.0,
        force: zeros(),
        position: zeros(),
        velocity: zeros(),
        motor: zeros(),
        touching: Vec::with_capacity(n),
        origin: Vec::with_capacity(n),
    };
    for (i, trial) in pulled.iter().enumerate() {
        for first in (0..trial.touching.len() / steps).map(|i| i * steps) {
            let w = out.origin.len();
            for k in first..first + steps {
                let part = 1.0 / steps as f64;
                for (j, t) in told.iter().enumerate() {
                    let (q, v) = (k * nq + t.at.0, k * nv + t.at.1);
                    out.force[(w, j)] += part * trial.force[v];
                    out.motor[(w, j)] += part * trial.motor[v];
                    out.position[(w, j)] += part * trial.qpos[q];
                    out.velocity[(w, j)] += part * trial.qvel[v];
                }
            }
            let geoms = trial.touching[first..first + steps].iter().flatten();
            let dofs = told.iter().map(|t| t.at.1);
            out.touching.push(touched(model, geoms.copied(), dofs));
            let at_s = problem.trials[i].start_s + first as f64 * model.timestep();
            out.origin.push((i, at_s));
        }
    }
    out
}

/// Missing force as a part of that of the motors, over all joints that have any.
pub(super) fn share(missing: &Missing) -> Option<f64> {
    let square = |m: &DMatrix<f64>, j: usize| m.column(j).norm_squared();
    let driven = (0..missing.joints.len()).filter(|j| square(&missing.motor, *j) > 0.0);
    let (lacks, has) = driven.fold((0.0, 0.0), |(lacks, has), j| {
        (
            lacks + square(&missing.force, j),
            has + square(&missing.motor, j),
        )
    });
    (has > 0.0).then(|| (lacks / has).sqrt())
}
