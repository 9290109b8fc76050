//! Where the model and the recordings disagree.
//!
//! In each window the forces f at the joints that would bring the model onto the recording, constant over the window and
//! its first state free, follow by least squares. They are gathered in cells of joint × contact × direction × speed. A
//! cell's mean is tested over stretches of time (t test, times the number of cells), and how large it is by what the fitted
//! model, simulated, would show as missing ([`super::null`]). How fast what a joint misses changes says its band of
//! frequencies ([`super::band`]), up to one over two windows.
//!
//! ```text
//! r̃ + Φ f ≈ 0        Φ: what a constant torque at each joint does
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::DMatrix;

use super::GapError;
use super::band::band;
use super::effect::named;
use super::linear::{Row, squares};
use super::null::Null;
use super::result::Located;
use super::score::two_sided;
use super::screen::Screen;
use super::windows::Windows;
use crate::mujoco::{Contact, Data, Model, ObjectKind};

/// Speed below which a joint counts as at rest, as a part of its root mean square.
const REST: f64 = 0.05;
/// Windows of a cell, at least.
const LEAST: usize = 5;
/// Chance below which a cell is reported.
const LEVEL: f64 = 0.01;
/// Ridge of the forces of a window, relative.
const RIDGE: f64 = 1e-6;
/// Part of what a joint's force does to windows on average that it does to one where it is seen.
const STUCK: f64 = 1e-3;

/// Windows of a joint in one phase.
pub(super) struct Cell {
    pub joint: usize,
    phase: String,
    pub inside: Vec<usize>,
}

impl Cell {
    /// Root mean square of its part of forces (windows × joints).
    pub(super) fn rms(&self, force: &DMatrix<f64>) -> f64 {
        let squares = self.inside.iter().map(|&w| force[(w, self.joint)].powi(2));
        (squares.sum::<f64>() / self.inside.len() as f64).sqrt()
    }
}

/// Forces that the model misses, window by window.
pub(super) struct Missing {
    /// joints
    pub joints: Vec<String>,
    /// of the forces
    pub units: Vec<&'static str>,
    /// (windows × joints)
    pub force: DMatrix<f64>,
    /// (windows × joints) of the middle of each window
    pub position: DMatrix<f64>,
    /// the same of velocities
    pub velocity: DMatrix<f64>,
    /// (windows × joints) motor force
    pub motor: DMatrix<f64>,
    /// per window and joint: whether something touches what hangs together with the joint
    pub touching: Vec<Vec<bool>>,
    /// of each window: index of its recording, s from the start of that
    pub origin: Vec<(usize, f64)>,
    /// name of each
    pub names: Vec<String>,
    /// stretch of each window
    pub stretch_of: Vec<usize>,
}

impl Missing {
    /// From a screen, whose torque offsets are the columns Φ. Joints with motors where there are any.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn new(
        windows: &Windows,
        x: &[f64],
        screen: &Screen,
        stretch_of: &[usize],
    ) -> Result<Self, GapError> {
        let problem = &windows.problem;
        let model = &problem.model;
        let own = joints(model, screen);
        let (n, m) = (windows.len(), own.len());
        let mut force = DMatrix::zeros(n, m);
        let rows = screen.linear.rows.iter();
        for (w, (row, to)) in rows.zip(to_forces(model, screen)).enumerate() {
            force.set_row(w, &(to * &row.residual).transpose());
        }
        let mut data = Data::new(Arc::clone(model))?;
        problem.parameters.apply(model, x, &mut data)?;
        let index = |name: &str| model.id(ObjectKind::Joint, name).ok();
        let at: Vec<(usize, usize)> = (own.iter())
            .filter_map(|(name, _)| index(name))
            .map(|j| {
                (
                    model.jnt_qposadr()[j] as usize,
                    model.jnt_dofadr()[j] as usize,
                )
            })
            .collect();
        let (mut position, mut velocity) = (DMatrix::zeros(n, m), DMatrix::zeros(n, m));
        let mut motor = DMatrix::zeros(n, m);
        let mut touching = Vec::with_capacity(n);
        for (w, motion) in windows.trajectories.iter().enumerate() {
            let knots = motion.len() / model.nq();
            let (first, last) = (&motion[..model.nq()], &motion[(knots - 1) * model.nq()..]);
            let middle = (knots / 2) * model.nq();
            let span = (knots - 1) as f64 * model.timestep();
            let controls = problem.controls(&problem.trials[w], x);
            let nu = model.nu();
            let mut mean = vec![0.0; nu];
            for row in controls.chunks_exact(nu.max(1)) {
                for (m, u) in mean.iter_mut().zip(row) {
                    *m += u / knots as f64;
                }
            }
            data.qpos_mut()
                .copy_from_slice(&motion[middle..middle + model.nq()]);
            data.ctrl_mut().copy_from_slice(&mean);
            data.position_stage()?;
            data.velocity_stage()?;
            data.actuation()?;
            for (j, (address, dof)) in at.iter().enumerate() {
                position[(w, j)] = motion[middle + address];
                velocity[(w, j)] = (last[*address] - first[*address]) / span;
                motor[(w, j)] = data.qfrc_actuator()[*dof];
            }
            let geoms = data.contacts().iter().flat_map(Contact::geoms);
            let dofs = at.iter().map(|(_, dof)| *dof);
            touching.push(touched(model, geoms, dofs));
        }
        Ok(Self {
            units: own.iter().map(|(name, _)| unit(model, name)).collect(),
            joints: own.into_iter().map(|(name, _)| name).collect(),
            force,
            position,
            velocity,
            motor,
            touching,
            origin: windows.origin.clone(),
            names: problem.trials.iter().map(|t| t.name.clone()).collect(),
            stretch_of: stretch_of.to_vec(),
        })
    }

    /// Windows by joint and phase, where there are enough.
    pub(super) fn cells(&self) -> Vec<Cell> {
        let mut cells = Vec::new();
        for joint in 0..self.joints.len() {
            let speed = self.velocity.column(joint);
            let typical = (speed.norm_squared() / speed.len() as f64).sqrt();
            for touching in [false, true] {
                for (name, low, high) in [
                    ("at rest", 0.0, REST),
                    ("slow", REST, 0.7),
                    ("fast", 0.7, f64::INFINITY),
                ] {
                    for (way, sign) in [("forwards", 1.0), ("backwards", -1.0)] {
                        let inside: Vec<usize> = (0..speed.len())
                            .filter(|&w| {
                                let v = speed[w].abs() / typical.max(f64::MIN_POSITIVE);
                                let way = low == 0.0 || speed[w] * sign > 0.0;
                                self.touching[w][joint] == touching
                                    && (low..high).contains(&v)
                                    && way
                            })
                            .collect();
                        // at rest there is no direction
                        if inside.len() < LEAST || (low == 0.0 && sign < 0.0) {
                            continue;
                        }
                        let contact = if touching { "contact" } else { "free" };
                        let phase = if low == 0.0 {
                            format!("{contact}, {name}")
                        } else {
                            format!("{contact}, {way}, {name}")
                        };
                        cells.push(Cell {
                            joint,
                            phase,
                            inside,
                        });
                    }
                }
            }
        }
        cells
    }

    /// Cells in which the mean is not chance but for what the model's own steps leave, nor what is missing as little as in
    /// draws of `null`; largest first.
    pub(super) fn located(&self, null: Option<&Null>) -> Vec<Located> {
        let cells = self.cells();
        let tests = cells.len() as f64;
        let bands: Vec<Option<[f64; 2]>> = (0..self.joints.len())
            .map(|joint| band(&self.origin, self.force.column(joint).as_slice()))
            .collect();
        let (chances, steps) = match null {
            Some(null) => (null.chances(&self.force, &cells), Some(&null.steps)),
            None => (vec![0.0; cells.len()], None),
        };
        let mut out: Vec<Located> = (cells.iter().zip(chances))
            .map(|(cell, by_size)| {
                let own = self.cell(cell, steps, tests);
                Located {
                    band_hz: bands[cell.joint],
                    p_value: own.p_value.max(by_size),
                    ..own
                }
            })
            .filter(|l| l.p_value < LEVEL)
            .collect();
        out.sort_by(|a, b| b.effect_size.total_cmp(&a.effect_size));
        out
    }

    fn cell(&self, cell: &Cell, steps: Option<&DMatrix<f64>>, tests: f64) -> Located {
        let (joint, inside) = (cell.joint, &cell.inside);
        let force = |w: usize| self.force[(w, joint)];
        let by_steps = |w: usize| steps.map_or(0.0, |steps| steps[(w, joint)]);
        let size = |w: &&usize| force(**w).abs();
        let most = (inside.iter()).max_by(|a, b| size(a).total_cmp(&size(b)));
        let p = self.chance(inside, &|w| force(w) - by_steps(w));
        Located {
            channel: self.joints[joint].clone(),
            phase: cell.phase.clone(),
            effect_size: cell.rms(&self.force),
            mean: inside.iter().map(|&w| force(w)).sum::<f64>() / inside.len() as f64,
            unit: self.units[joint].to_owned(),
            p_value: (p * tests).min(1.0),
            n: inside.len(),
            band_hz: None,
            most_at: most.map(|&w| self.names[w].clone()),
        }
    }

    /// Probability that the mean of `value` over windows is that far from 0 by chance, by how it varies between stretches.
    fn chance(&self, inside: &[usize], value: &dyn Fn(usize) -> f64) -> f64 {
        let n = inside.len() as f64;
        let mean = inside.iter().map(|&w| value(w)).sum::<f64>() / n;
        let mut sums: BTreeMap<usize, f64> = BTreeMap::new();
        for &w in inside {
            *sums.entry(self.stretch_of[w]).or_default() += value(w) - mean;
        }
        let groups = sums.len() as f64;
        if groups < 3.0 {
            return 1.0;
        }
        let squares: f64 = sums.values().map(|sum| sum * sum).sum();
        let variance = squares * groups / (groups - 1.0) / (n * n);
        two_sided(mean / variance.sqrt(), groups - 1.0)
    }
}

/// Joints whose forces are told, with their columns: those with motors where there are any.
fn joints(model: &Model, screen: &Screen) -> Vec<(String, usize)> {
    let mut own: Vec<(String, usize)> = (screen.candidates.iter())
        .filter(|c| c.effect.about().name == "torque_offset")
        .map(|c| (c.place.name.clone(), c.columns[0]))
        .collect();
    let driven = driven(model);
    if own.iter().any(|(name, _)| driven.contains(name)) {
        own.retain(|(name, _)| driven.contains(name));
    }
    own
}

/// What makes forces (joints) of the residuals of each window (rows): −(ΦᵀΦ)⁻¹ Φᵀ.
pub(super) fn to_forces(model: &Model, screen: &Screen) -> Vec<DMatrix<f64>> {
    let own = joints(model, screen);
    let rows = &screen.linear.rows;
    // a joint that sticks all through a window shows no force in it
    let least: Vec<f64> = (own.iter())
        .map(|(_, c)| STUCK * squares(&screen.columns[*c].parts) / rows.len().max(1) as f64)
        .collect();
    let of = |(w, row): (usize, &Row)| {
        let (n, m) = (row.residual.len(), own.len());
        let phi = DMatrix::from_fn(n, m, |i, j| screen.columns[own[j].1].parts[w][i]);
        let mut normal = phi.tr_mul(&phi);
        for j in 0..m {
            normal[(j, j)] *= 1.0 + RIDGE;
            normal[(j, j)] += least[j].max(f64::MIN_POSITIVE);
        }
        match normal.cholesky() {
            Some(factor) => -factor.solve(&phi.transpose()),
            None => DMatrix::zeros(m, n),
        }
    };
    rows.iter().enumerate().map(of).collect()
}

/// Names of the joints that motors drive.
pub(super) fn driven(model: &Model) -> Vec<String> {
    (named("torque_ripple").into_iter())
        .flat_map(|e| e.places(model))
        .filter_map(|p| p.joint_name(model).map(str::to_owned))
        .collect()
}

/// Whether one of the geoms that touch hangs together with each degree of freedom.
pub(super) fn touched(
    model: &Model,
    geoms: impl Iterator<Item = usize>,
    dofs: impl Iterator<Item = usize>,
) -> Vec<bool> {
    let root = |body: i32| model.body_rootid()[body as usize];
    let roots: Vec<i32> = geoms.map(|g| root(model.geom_bodyid()[g])).collect();
    dofs.map(|d| roots.contains(&root(model.dof_bodyid()[d])))
        .collect()
}

/// Unit of forces at a joint.
pub(super) fn unit(model: &Model, joint: &str) -> &'static str {
    let slide = model
        .id(ObjectKind::Joint, joint)
        .is_ok_and(|j| model.is_slide(j) == Some(true));
    if slide { "N" } else { "N m" }
}

#[cfg(test)]
mod tests {
    use super::{joints, to_forces};
    use crate::gap::masses::{machine, searching};

    /// An elbow that friction held for all of a window missed 10¹² N m there.
    #[test]
    fn a_joint_that_sticks_misses_nothing_that_is_seen() {
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        let base = machine("", "");
        searching(&base, &base, config, |search, watch| {
            let mut screen = search.screen(watch).expect("screened").expect("whole");
            let forces = |screen: &_| -> Vec<f64> {
                let rows = search.windows.linearise(&search.x).expect("linear").rows;
                let to = to_forces(&base.model, screen);
                let each = to.iter().zip(&rows);
                each.map(|(to, row)| (to * &row.residual)[0].abs())
                    .collect()
            };
            let before = forces(&screen);
            let most = before.iter().copied().fold(0.0, f64::max);
            let (_, column) = joints(&base.model, &screen)[0];
            screen.columns[column].parts[1] *= 1e-12;
            let stuck = forces(&screen);
            assert!(stuck[1] < 1e-3 * most, "{} {most}", stuck[1]);
            for w in [0, 2] {
                assert!((stuck[w] / before[w] - 1.0).abs() < 0.01, "{stuck:?}");
            }
        });
    }
}
