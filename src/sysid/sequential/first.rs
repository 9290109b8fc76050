//! Where simulations begin: the first state of a trial, and how well it is known.
//!
//! With J the whitened derivatives of the position sensors along the directions that loops leave open, one reading
//! tells positions to s = 1/√λ along the eigenvectors of `JᵀJ`. A first state is what the first readings say, moved by
//! Σ 5 s u along them, u ~ N(0, 1), and brought back onto the loops: so wide that the first samples, which are counted
//! like all others, are hardly counted twice.
//!
//! - **At rest**, velocities are 0, and what no sensor shows is where the model has it.
//! - Otherwise velocities are known by no less than their size in the recording: a motion that is smoothed begins
//!   gently, one that is commanded begins at once.

use nalgebra::{DMatrix, SymmetricEigen};

use crate::sysid::SysidError;
use crate::sysid::pose::{Pose, UNKNOWN_SIGMA};
use crate::sysid::problem::{Problem, Trial};
use crate::sysid::shooting::loops::Loops;
use crate::sysid::shooting::window::{State, Window};
use crate::sysid::start::{self, RATE};

/// Spread of first positions, in errors of a reading.
const WIDE: f64 = 5.0;

/// The first state of a trial.
pub(super) struct First {
    state: State,
    /// (2 nv × unknowns) tangent vectors, each a standard deviation long
    root: DMatrix<f64>,
}

impl First {
    /// Of a trial that begins at rest.
    pub(super) fn at_rest(problem: &Problem, trial: &Trial, x: &[f64]) -> Result<Self, SysidError> {
        let free = problem.free_values(x);
        let goals: Vec<(usize, f64)> = (start::measured(problem, trial).into_iter())
            .filter_map(|c| {
                let channel = &problem.channels[c];
                let first = trial.samples.iter().find(|s| s.channel == c)?;
                let value = (first.value - channel.bias.value(&free)) / channel.gain.value(&free);
                Some((c, value))
            })
            .collect();
        let mut pose = Pose::new(problem, x)?;
        pose.fit(&goals, 30)?;
        let state = State {
            qpos: pose.data.qpos().to_vec(),
            qvel: vec![0.0; problem.model.nv()],
        };
        let channels: Vec<usize> = goals.iter().map(|g| g.0).collect();
        Self::around(problem, x, state, &channels, None)
    }

    /// Of a trial whose motion is about `qpos` (knots × nq).
    pub(super) fn moving(
        problem: &Problem,
        (window, trial): (&Window, &Trial),
        x: &[f64],
        qpos: &[f64],
    ) -> Result<Self, SysidError> {
        let model = &problem.model;
        let (nq, h) = (model.nq(), model.timestep());
        let state = State::on(problem, window, qpos)?;
        let mut square = vec![0.0; model.nv()];
        let mut qvel = vec![0.0; model.nv()];
        let knots: Vec<&[f64]> = qpos.chunks_exact(nq).collect();
        for pair in knots.windows(2) {
            model.differentiate_pos(&mut qvel, h, pair[0], pair[1])?;
            for (s, v) in square.iter_mut().zip(&qvel) {
                *s += v * v / knots.len() as f64;
            }
        }
        let speed: Vec<f64> = square.iter().map(|s| s.sqrt()).collect();
        Self::around(
            problem,
            x,
            state,
            &start::measured(problem, trial),
            Some(&speed),
        )
    }

    /// `speed`: size of velocities (nv); none: at rest.
    fn around(
        problem: &Problem,
        x: &[f64],
        state: State,
        channels: &[usize],
        speed: Option<&[f64]>,
    ) -> Result<Self, SysidError> {
        let nv = problem.model.nv();
        let (state, open) = match Loops::new(problem, x)? {
            None => (state, DMatrix::identity(nv, nv)),
            Some(mut loops) => {
                let state = loops.close(&state)?;
                let all = loops.directions(std::slice::from_ref(&state))?;
                let n = all[0].ncols() / 2;
                (state, all[0].view((0, 0), (nv, n)).into_owned())
            }
        };
        let jacobian = Pose::new(problem, x)?.sensitivity(&state.qpos, channels)? * &open;
        let eigen = SymmetricEigen::new(jacobian.tr_mul(&jacobian));
        let mut columns = Vec::new();
        for (i, information) in eigen.eigenvalues.iter().enumerate() {
            let along = &open * eigen.eigenvectors.column(i);
            let is_seen = *information > UNKNOWN_SIGMA.powi(-2);
            let sigma = if is_seen {
                WIDE / information.sqrt()
            } else {
                UNKNOWN_SIGMA
            };
            let mut column = |position: f64, velocity: f64| {
                let mut tangent = vec![0.0; 2 * nv];
                for (d, a) in along.iter().enumerate() {
                    (tangent[d], tangent[nv + d]) = (position * a, velocity * a);
                }
                columns.extend(tangent);
            };
            if speed.is_none() && !is_seen {
                continue;
            }
            column(sigma, 0.0);
            if let Some(speed) = speed {
                let squares = along.iter().zip(speed).map(|(a, s)| (a * s).powi(2));
                column(0.0, (RATE * sigma).hypot(squares.sum::<f64>().sqrt()));
            }
        }
        let n = columns.len() / (2 * nv);
        Ok(Self {
            state,
            root: DMatrix::from_vec(2 * nv, n, columns),
        })
    }

    /// Number of unknowns.
    pub(super) fn len(&self) -> usize {
        self.root.ncols()
    }

    /// The state at unknowns `u`, on the loops of the model with parameters `x`.
    pub(super) fn at(&self, problem: &Problem, x: &[f64], u: &[f64]) -> Result<State, SysidError> {
        let mut tangent = vec![0.0; self.root.nrows()];
        for (column, u) in self.root.column_iter().zip(u) {
            for (t, c) in tangent.iter_mut().zip(column.iter()) {
                *t += u * c;
            }
        }
        let state = self.state.moved(problem, &tangent)?;
        match Loops::new(problem, x)? {
            None => Ok(state),
            Some(mut loops) => loops.close(&state),
        }
    }
}
