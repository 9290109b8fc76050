//! The turns by 120° and 240° of the pushing task: each finger takes the place of the one before it.
//!
//! Whether a model is the same machine after a turn is asked of the engine: random motions are simulated, and turned, from
//! turned states under turned torques. That covers whatever a file, a supplement or an identification has changed, but
//! for contacts of the fingers, which those motions seldom make: their properties are compared one by one.

use nalgebra::DMatrix;

use super::push::{JOINTS, N_FINGER, N_JOINT, N_MOTOR, N_OBSERVATION, PushTask};
use super::symmetry::Symmetry;
use super::{Task, TaskError};
use crate::mujoco::{Data, Model};
use crate::rng::{self, Purpose};

/// Random motions.
const MOTIONS: u64 = 8;
/// Physics steps of each, or fewer: until a fingertip touches something.
const STEPS: usize = 10;
/// Spread of their torques, N m.
const TORQUE_SIGMA: f64 = 0.3;
/// Difference of positions and velocities that the solver's rounding explains, rad, m, rad/s, m/s.
const TOLERANCE: f64 = 1e-6;

impl PushTask {
    /// The turns under which `model` is the same machine: two or none.
    ///
    /// # Errors
    /// When the engine fails or no start is found.
    pub fn symmetries(&self, model: &std::sync::Arc<Model>) -> Result<Vec<Symmetry>, TaskError> {
        let once = turn(1);
        let [mut data, mut turned] = [
            Data::new(std::sync::Arc::clone(model))?,
            Data::new(std::sync::Arc::clone(model))?,
        ];
        if !self.fingers_touch_alike(model) {
            return Ok(Vec::new());
        }
        let mut compared = 0;
        for index in 0..MOTIONS {
            match self.moves_alike(&once, index, &mut data, &mut turned)? {
                Some(steps) => compared += steps,
                None => return Ok(Vec::new()),
            }
        }
        // a model of which nothing could be compared is not known to have any
        let turns = if compared > 0 { 1..N_FINGER } else { 0..0 };
        Ok(turns.map(turn).collect())
    }

    /// In how many steps a random motion of `data` is, turned, that of `turned`; none if it is not in one of them.
    fn moves_alike(
        &self,
        turn: &Symmetry,
        index: u64,
        data: &mut Data,
        turned: &mut Data,
    ) -> Result<Option<usize>, TaskError> {
        let object = 2 * N_JOINT;
        let place = turn.observation.view((object, object), (2, 2)).into_owned();
        let mut rng = rng::stream(0, Purpose::Start, 0, index);
        data.reset();
        turned.reset();
        self.start(data, &mut rng)?;
        self.turn_state(turn, &place, data, turned);
        turned.step1()?;
        let action: Vec<f64> = (0..N_MOTOR)
            .map(|_| TORQUE_SIGMA * rng::normal(&mut rng))
            .collect();
        data.ctrl_mut().copy_from_slice(&action);
        apply(&turn.action, &action, turned.ctrl_mut());
        let n = self.n_value_input();
        let (mut seen, mut expected, mut found) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        for step in 0..STEPS {
            data.step()?;
            turned.step()?;
            if self.is_touching(data) {
                return Ok(Some(step));
            }
            self.observe_value(data, &mut seen);
            self.observe_value(turned, &mut found);
            apply(&turn.value_input, &seen, &mut expected);
            let differs = |(a, b): (&f64, &f64)| (a - b).abs() > TOLERANCE;
            if expected.iter().zip(&found).any(differs) {
                return Ok(None);
            }
            // joints do not tell where a robot stands
            for finger in 0..N_FINGER {
                let next = self.tip(turned, (finger + 1) % N_FINGER);
                let mut expected = self.tip(data, finger);
                let [x, y, _] = expected;
                apply(&place, &[x, y], &mut expected[..2]);
                if expected.iter().zip(&next).any(differs) {
                    return Ok(None);
                }
            }
        }
        Ok(Some(STEPS))
    }

    fn is_touching(&self, data: &Data) -> bool {
        let is_tip = |geom| self.tip_geoms.contains(&geom);
        data.contacts()
            .iter()
            .any(|c| c.geoms().into_iter().any(is_tip))
    }

    /// Put `turned` into the state of `data` after a turn: joints, the object's place, the goal. The object is round and
    /// stands upright and still.
    fn turn_state(&self, turn: &Symmetry, place: &DMatrix<f64>, data: &Data, turned: &mut Data) {
        let joints = turn.observation.view((0, 0), (N_JOINT, N_JOINT));
        apply(
            &joints.into_owned(),
            &data.qpos()[..N_JOINT],
            &mut turned.qpos_mut()[..N_JOINT],
        );
        let (object, goal) = (self.object(data).to_vec(), self.goal(data).to_vec());
        let mut xy = [0.0; 2];
        apply(place, &goal[..2], &mut xy);
        self.set_goal(turned, xy[0], xy[1]);
        apply(place, &object[..2], &mut xy);
        self.object_mut(turned)[..2].copy_from_slice(&xy);
    }

    /// Whether the fingertips have the same size and touch everything in the same way.
    fn fingers_touch_alike(&self, model: &Model) -> bool {
        let next = |geom: usize| match self.tip_geoms.iter().position(|tip| *tip == geom) {
            Some(finger) => self.tip_geoms[(finger + 1) % N_FINGER],
            None => geom,
        };
        let of_geom = |geom: usize| {
            let row = |all: &[f64], n: usize| all[n * geom..n * (geom + 1)].to_vec();
            [
                row(model.geom_size(), 3),
                row(model.geom_friction(), 3),
                row(model.geom_solref(), 2),
                row(model.geom_solimp(), 5),
                row(model.geom_margin(), 1),
                row(model.geom_gap(), 1),
            ]
            .concat()
        };
        let of_pair = |pair: usize| {
            let row = |all: &[f64], n: usize| all[n * pair..n * (pair + 1)].to_vec();
            [
                row(model.pair_friction(), 5),
                row(model.pair_solref(), 2),
                row(model.pair_solimp(), 5),
                row(model.pair_margin(), 1),
                row(model.pair_gap(), 1),
                vec![f64::from(model.pair_dim()[pair])],
            ]
            .concat()
        };
        let geoms = |pair: usize| {
            let of = |all: &[i32]| all[pair] as usize;
            [of(model.pair_geom1()), of(model.pair_geom2())]
        };
        let is_pair = |pair: usize, [a, b]: [usize; 2]| {
            let found = geoms(pair);
            found == [a, b] || found == [b, a]
        };
        let n_pair = model.npair();
        self.tip_geoms
            .iter()
            .all(|tip| of_geom(*tip) == of_geom(next(*tip)))
            && (0..n_pair).all(|pair| {
                let turned = geoms(pair).map(next);
                let mut others = (0..n_pair).filter(|other| is_pair(*other, turned));
                others.any(|other| of_pair(other) == of_pair(pair))
            })
    }
}

/// The turn by `k` times 120°.
fn turn(k: usize) -> Symmetry {
    let n = N_OBSERVATION + 2;
    let mut action = DMatrix::zeros(N_MOTOR, N_MOTOR);
    let mut value_input = DMatrix::zeros(n, n);
    // each finger's angles and torques become those of the finger k further on
    let further = |i: usize, per_finger: usize| (i + k * per_finger) % (N_FINGER * per_finger);
    for i in 0..N_MOTOR {
        action[(further(i, N_MOTOR / N_FINGER), i)] = 1.0;
    }
    for i in 0..N_JOINT {
        let to = further(i, JOINTS.len());
        value_input[(to, i)] = 1.0;
        value_input[(N_JOINT + to, N_JOINT + i)] = 1.0;
    }
    // object and goal turn about the vertical, and so does the object's velocity
    let (sin, cos) = (k as f64 * std::f64::consts::TAU / N_FINGER as f64).sin_cos();
    let (object, goal) = (2 * N_JOINT, 2 * N_JOINT + 3);
    for at in [object, goal, N_OBSERVATION] {
        value_input
            .view_mut((at, at), (2, 2))
            .copy_from_slice(&[cos, sin, -sin, cos]);
    }
    for at in [object, goal] {
        value_input[(at + 2, at + 2)] = 1.0;
    }
    let observation = value_input
        .view((0, 0), (N_OBSERVATION, N_OBSERVATION))
        .into_owned();
    Symmetry {
        action,
        observation,
        value_input,
    }
}

/// out = M x
fn apply(matrix: &DMatrix<f64>, x: &[f64], out: &mut [f64]) {
    for (out, row) in out.iter_mut().zip(matrix.row_iter()) {
        *out = row.iter().zip(x).map(|(m, x)| m * x).sum();
    }
}
