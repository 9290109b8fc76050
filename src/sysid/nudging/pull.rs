//! Forces that pull a simulation along a recording's motion.
//!
//! Readings are turned into positions once, by the instruments as they then are. Where a bias or delay is estimated, the
//! motion moves with it, by the pseudo-inverse of the sensors' derivatives at the first knot; a gain counts when the motion
//! is next corrected ([`Pull::correct`]). Only what readings show is pulled: how an object turns that no sensor shows is left
//! to the model. M' is the inertia felt there with the rest free to follow,
//!
//! ```text
//! M' = M_ss − M_su M_uu⁻¹ M_us        M + ρ Jᵀ J in place of M, J the derivatives of loops
//! ```

use nalgebra::{DMatrix, DVector};

use crate::mujoco::{Data, Model};
use crate::sysid::pose::Pose;
use crate::sysid::problem::{Problem, Setting};
use crate::sysid::shooting::simulate::Simulated;
use crate::sysid::shooting::window::{Placed, State, Window};
use crate::sysid::smooth::smooth;
use crate::sysid::{SysidError, start};

/// Part of the largest derivative by a degree of freedom below which a channel does not show it.
const SHOWN: f64 = 1e-6;
/// Weight of loops against the largest inertia.
const RIGID: f64 = 1e6;

/// How a simulation of one recording is pulled.
#[derive(Clone)]
pub(super) struct Pull {
    /// (knots × nq) the recorded motion, smoothed
    qpos: Vec<f64>,
    /// (knots × nv)
    qvel: Vec<f64>,
    /// where simulations begin
    first: State,
    /// (nv × nv) what is felt at the degrees of freedom that readings show; 0 at others
    inertia: DMatrix<f64>,
    /// rad/s
    omega: f64,
    /// channels that show positions
    channels: Vec<usize>,
    /// (nv × those) change of the position by what they show, in their noise
    back: DMatrix<f64>,
    /// numbers of instruments with which the motion was read
    read_with: Vec<f64>,
    /// of estimated biases: change of the position (nv)
    biases: Vec<(usize, DVector<f64>)>,
    /// of estimated delays: change of the position (nv) over the velocity
    delays: Vec<(usize, DMatrix<f64>)>,
}

impl Pull {
    /// Along the motion of `window`, a whole trial, as instruments with the parameters `x` show it, at `hz`.
    pub(super) fn new(
        problem: &Problem,
        window: &Window,
        x: &[f64],
        hz: f64,
    ) -> Result<Self, SysidError> {
        let model = &problem.model;
        let (nq, nv) = (model.nq(), model.nv());
        let trial = &problem.trials[window.trial];
        let qpos = match &trial.path {
            Some(path) => path.rows().to_vec(),
            None => start::trajectory(problem, trial, x)?,
        };
        let channels = start::measured(problem, trial);
        let mut pose = Pose::new(problem, x)?;
        let derivatives = pose.derivatives(&qpos[..nq], &channels)?;
        let shown = derivatives.rows(0, channels.len()).into_owned();
        let loops = derivatives.rows_range(channels.len()..).into_owned();
        let is_shown: Vec<bool> = (shown.column_iter())
            .map(|column| column.amax() > SHOWN * shown.amax())
            .collect();
        let inertia = felt(&mut pose, &loops, &is_shown)?;
        let back = (shown.clone().pseudo_inverse(SHOWN * shown.amax()))
            .unwrap_or_else(|_| DMatrix::zeros(nv, channels.len()));
        let (mut biases, mut delays) = (Vec::new(), Vec::new());
        for (i, &c) in channels.iter().enumerate() {
            let channel = &problem.channels[c];
            if let Setting::Free(j) = channel.bias {
                let gain = channel.gain.value(&problem.free_values(x));
                biases.push((j, -back.column(i) / (channel.sigma * gain)));
            }
            if let Setting::Free(j) = channel.delay {
                delays.push((j, back.column(i) * shown.row(i)));
            }
        }
        Ok(Self {
            first: State::on(problem, window, &qpos)?,
            qvel: velocities(model, &qpos)?,
            qpos,
            back,
            channels,
            inertia,
            omega: std::f64::consts::TAU * hz,
            read_with: problem.free_values(x),
            biases,
            delays,
        })
    }

    /// From now on along what a simulation has made of the motion, corrected by what the readings still deviate: smoothing
    /// readings takes the edges off the motion, which deviations have less of.
    pub(super) fn correct(
        &mut self,
        problem: &Problem,
        (window, placed): (&Window, &[Placed]),
        simulated: &Simulated,
        x: &[f64],
    ) -> Result<(), SysidError> {
        let model = &problem.model;
        let (nq, nv, h) = (model.nq(), model.nv(), model.timestep());
        let free = problem.free_values(x);
        let mut series: Vec<Vec<(f64, f64)>> = vec![Vec::new(); problem.channels.len()];
        let samples = &problem.trials[window.trial].samples;
        for (p, (z, _)) in placed
            .iter()
            .zip(simulated.samples(problem, window, placed))
        {
            let sample = &samples[p.sample];
            let channel = &problem.channels[sample.channel];
            let time = (p.knot as f64 + p.part) * h;
            let short = (sample.value - channel.reading(&free, z)) / channel.gain.value(&free);
            series[sample.channel].push((time, short));
        }
        let mut shifts = DMatrix::zeros(nv, window.len());
        for (i, &c) in self.channels.iter().enumerate() {
            let sigma = problem.channels[c].sigma;
            let times = (0..window.len()).map(|k| k as f64 * h);
            let smoothed = DVector::from_vec(smooth(&series[c], sigma, times));
            shifts += self.back.column(i) / sigma * smoothed.transpose();
        }
        self.qpos.copy_from_slice(&simulated.qpos);
        for (row, shift) in self.qpos.chunks_exact_mut(nq).zip(shifts.column_iter()) {
            model.integrate_pos(row, shift.as_slice(), 1.0)?;
        }
        self.first = State::on(problem, window, &self.qpos)?;
        self.qvel = velocities(model, &self.qpos)?;
        self.read_with = free;
        Ok(())
    }

    /// Change of the motion's position (nv) where it has the velocity `qvel`, for instruments with the numbers `free`.
    fn shift(&self, free: &[f64], qvel: &[f64]) -> DVector<f64> {
        let mut shift = DVector::zeros(qvel.len());
        for (j, by) in &self.biases {
            shift += by * (free[*j] - self.read_with[*j]);
        }
        if !self.delays.is_empty() {
            let velocity = DVector::from_column_slice(qvel);
            for (j, by) in &self.delays {
                shift += by * &velocity * (free[*j] - self.read_with[*j]);
            }
        }
        shift
    }

    /// Where the simulation begins, by instruments with the numbers `free`.
    pub(super) fn first(&self, problem: &Problem, free: &[f64]) -> Result<State, SysidError> {
        let mut tangent = self.shift(free, &self.first.qvel).as_slice().to_vec();
        tangent.resize(2 * self.first.qvel.len(), 0.0);
        self.first.moved(problem, &tangent)
    }

    /// Sets the applied forces of a simulation that stands at `knot`.
    pub(super) fn apply(&self, knot: usize, free: &[f64], data: &mut Data) {
        let model = data.model();
        let (nq, nv) = (model.nq(), model.nv());
        let along = &self.qpos[knot * nq..(knot + 1) * nq];
        let velocity = &self.qvel[knot * nv..(knot + 1) * nv];
        let mut behind = vec![0.0; nv];
        // fails for wrong lengths alone, and these are the model's own
        let _ = model.differentiate_pos(&mut behind, 1.0, data.qpos(), along);
        let behind = DVector::from_vec(behind) + self.shift(free, velocity);
        let wanted = DVector::from_fn(nv, |i, _| {
            self.omega * (self.omega * behind[i] + 2.0 * (velocity[i] - data.qvel()[i]))
        });
        (data.qfrc_applied_mut()).copy_from_slice((&self.inertia * wanted).as_slice());
    }
}

/// Velocities (knots × nv) of positions (knots × nq) as the engine's step relates them: from the knot before. Those of the
/// middle would be half a step early, and the damper would add a part ω h of the inertia to what accelerates.
fn velocities(model: &Model, qpos: &[f64]) -> Result<Vec<f64>, SysidError> {
    let (nq, nv, h) = (model.nq(), model.nv(), model.timestep());
    let n = qpos.len() / nq;
    let knot = |k: usize| &qpos[k * nq..(k + 1) * nq];
    let mut qvel = vec![0.0; n * nv];
    for (k, out) in qvel.chunks_exact_mut(nv).enumerate() {
        let to = k.max(1).min(n - 1);
        model.differentiate_pos(out, h, knot(to - 1), knot(to))?;
    }
    Ok(qvel)
}

/// Inertia (nv × nv) felt at the degrees of freedom `shown` where the others follow freely, on the loops whose derivatives
/// are `loops`.
fn felt(
    pose: &mut Pose<'_>,
    loops: &DMatrix<f64>,
    shown: &[bool],
) -> Result<DMatrix<f64>, SysidError> {
    let nv = shown.len();
    let mut mass = vec![0.0; nv * nv];
    pose.data.position_stage()?;
    pose.data.full_mass_matrix(&mut mass)?;
    let mass = DMatrix::from_row_slice(nv, nv, &mass);
    let rigid = match loops.iter().fold(0.0_f64, |m, v| m.max(v.abs())) {
        0.0 => 0.0,
        most => RIGID * mass.amax() / most.powi(2),
    };
    let mass = mass + loops.tr_mul(loops) * rigid;
    let [own, others] =
        [true, false].map(|kind| -> Vec<usize> { (0..nv).filter(|&i| shown[i] == kind).collect() });
    let part = |rows: &[usize], columns: &[usize]| mass.select_rows(rows).select_columns(columns);
    let across = part(&own, &others);
    let mut seen = part(&own, &own);
    if let Some(factor) = part(&others, &others).cholesky() {
        seen -= &across * factor.solve(&across.transpose());
    }
    let mut out = DMatrix::zeros(nv, nv);
    for (i, &r) in own.iter().enumerate() {
        for (j, &c) in own.iter().enumerate() {
            out[(r, c)] = seen[(i, j)];
        }
    }
    Ok(out)
}
