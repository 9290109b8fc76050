//! What leaves the pushing task unchanged: turns by 120°, where each finger takes the place of the one before it, and the
//! mirror image across the plane of finger 0, where the other two change places and all turrets turn the other way.
//!
//! Whether a model is the same machine after them is asked of the engine: random motions are simulated, and simulated again
//! turned, from turned states under turned torques. That covers whatever a file, a supplement or an identification has
//! changed, but for contacts of the fingers, which those motions seldom make: their properties are compared one by one.

use std::sync::Arc;

use nalgebra::DMatrix;

use super::push::{JOINTS, N_FINGER, N_JOINT, N_MOTOR, N_OBSERVATION, PushTask};
use super::symmetry::Symmetry;
use super::{Task, TaskError};
use crate::mujoco::{Data, Model};
use crate::rng::{self, Purpose};

/// Random motions.
const MOTIONS: u64 = 8;
/// Length of each, s; or less, until a fingertip touches something.
const DURATION_S: f64 = 0.008;
const MAX_STEPS: usize = 100;
/// Spread of their torques, N m.
const TORQUE_SIGMA: f64 = 0.3;
/// Difference of joint velocities, as a share of the largest, below which robots are equal: the shipped one is its own mirror
/// image but for a product of inertia, which makes 0.03 %; robots of one series differ by percents.
const ALIKE: f64 = 0.002;
/// The same for whatever else is seen, rad, m, m/s.
const PLACE: f64 = 1e-4;

impl PushTask {
    /// What `model` is the same machine after: all of turns and mirror images, one kind of them, or none.
    ///
    /// # Errors
    /// When the engine fails or no start is found.
    pub fn symmetries(&self, model: &Arc<Model>) -> Result<Vec<Symmetry>, TaskError> {
        let (turn, mirror) = (turn(), mirror());
        let mut all = Vec::new();
        if self.holds(&turn, model)? {
            all.extend([turn.clone(), turn.then(&turn)]);
        }
        if self.holds(&mirror, model)? {
            let mirrored: Vec<Symmetry> = all.iter().map(|turn| mirror.then(turn)).collect();
            all.extend(mirrored);
            all.push(mirror);
        }
        Ok(all)
    }

    /// Whether the task on `model` is unchanged by `turn`.
    fn holds(&self, turn: &Symmetry, model: &Arc<Model>) -> Result<bool, TaskError> {
        if !(self.starts_alike(turn) && self.fingers_touch_alike(turn, model)) {
            return Ok(false);
        }
        let [mut data, mut turned] = [Data::new(Arc::clone(model))?, Data::new(Arc::clone(model))?];
        let mut compared = 0;
        for index in 0..MOTIONS {
            match self.moves_alike(turn, index, &mut data, &mut turned)? {
                Some(steps) => compared += steps,
                None => return Ok(false),
            }
        }
        // a model of which nothing could be compared is not known to have it
        Ok(compared > 0)
    }

    /// Whether starts are drawn from the same range of motor coordinates.
    fn starts_alike(&self, turn: &Symmetry) -> bool {
        let ends = self.start_low.iter().zip(&self.start_high);
        let (middle, width): (Vec<f64>, Vec<f64>) = ends.map(|(a, b)| (a + b, b - a)).unzip();
        let same = |matrix: &DMatrix<f64>, x: &[f64]| {
            let mut turned = vec![0.0; x.len()];
            apply(matrix, x, &mut turned);
            turned.iter().zip(x).all(|(a, b)| (a - b).abs() < PLACE)
        };
        same(&turn.action, &middle) && same(&turn.action.abs(), &width)
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
        let steps = (DURATION_S / data.model().timestep()).ceil() as usize;
        let steps = steps.min(MAX_STEPS);
        for step in 0..steps {
            data.step()?;
            turned.step()?;
            if self.is_touching(data) {
                return Ok(Some(step));
            }
            if !self.looks_alike(turn, &place, data, turned) {
                return Ok(None);
            }
        }
        Ok(Some(steps))
    }

    /// Whether what is seen of `data` is, turned, what is seen of `turned`.
    fn looks_alike(
        &self,
        turn: &Symmetry,
        place: &DMatrix<f64>,
        data: &Data,
        turned: &Data,
    ) -> bool {
        let n = self.n_value_input();
        let (mut seen, mut expected, mut found) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        self.observe_value(data, &mut seen);
        self.observe_value(turned, &mut found);
        apply(&turn.value_input, &seen, &mut expected);
        let velocities = N_JOINT..2 * N_JOINT;
        let speeds = expected[velocities.clone()].iter().map(|v| v.abs());
        let fastest = speeds.fold(0.0, f64::max);
        let tolerance = |i: usize| {
            if velocities.contains(&i) {
                ALIKE * fastest
            } else {
                PLACE
            }
        };
        let mut pairs = expected.iter().zip(&found).enumerate();
        // joints do not tell where a robot stands
        let tip_alike = |finger: usize| {
            let found = self.tip(turned, next_finger(turn, finger));
            let mut expected = self.tip(data, finger);
            let [x, y, _] = expected;
            apply(place, &[x, y], &mut expected[..2]);
            let mut pairs = expected.iter().zip(&found);
            pairs.all(|(a, b)| (a - b).abs() <= PLACE)
        };
        pairs.all(|(i, (a, b))| (a - b).abs() <= tolerance(i)) && (0..N_FINGER).all(tip_alike)
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
        let mut heading = [0.0; 2];
        apply(place, &self.goal.heading(data), &mut heading);
        self.goal.set_heading(turned, heading);
        apply(place, &object[..2], &mut xy);
        self.object_mut(turned)[..2].copy_from_slice(&xy);
    }

    /// Whether the fingertips have the same size and touch everything in the same way.
    fn fingers_touch_alike(&self, turn: &Symmetry, model: &Model) -> bool {
        let next = |geom: usize| match self.tip_geoms.iter().position(|tip| *tip == geom) {
            Some(finger) => self.tip_geoms[next_finger(turn, finger)],
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

/// The finger whose place `finger` takes.
fn next_finger(turn: &Symmetry, finger: usize) -> usize {
    let turret = turn.action.column(finger * (N_MOTOR / N_FINGER));
    turret.iamax() / (N_MOTOR / N_FINGER)
}

/// The turn by 120°.
fn turn() -> Symmetry {
    let (sin, cos) = (std::f64::consts::TAU / N_FINGER as f64).sin_cos();
    symmetry([1, 2, 0], 1.0, [cos, sin, -sin, cos])
}

/// The mirror image across the plane of finger 0, x = 0.
fn mirror() -> Symmetry {
    symmetry([0, 2, 1], -1.0, [-1.0, 0.0, 0.0, 1.0])
}

/// Finger i takes the place of finger `to[i]`, its turret turning by `turret` times the angle, and what lies in the plane moves by
/// the matrix `plane`, column by column.
fn symmetry(to: [usize; N_FINGER], turret: f64, plane: [f64; 4]) -> Symmetry {
    let n = N_OBSERVATION + 4;
    let mut action = DMatrix::zeros(N_MOTOR, N_MOTOR);
    let mut value_input = DMatrix::zeros(n, n);
    let sign = |i: usize| if i == 0 { turret } else { 1.0 };
    for (from, to) in to.into_iter().enumerate() {
        let n_motor = N_MOTOR / N_FINGER;
        for i in 0..n_motor {
            action[(n_motor * to + i, n_motor * from + i)] = sign(i);
        }
        for first in [0, N_JOINT] {
            for i in 0..JOINTS.len() {
                let [to, from] = [to, from].map(|finger| first + JOINTS.len() * finger + i);
                value_input[(to, from)] = sign(i);
            }
        }
    }
    // places of object and goal, then their velocities
    let (object, goal) = (2 * N_JOINT, 2 * N_JOINT + 3);
    for at in [object, goal, N_OBSERVATION, N_OBSERVATION + 2] {
        value_input
            .view_mut((at, at), (2, 2))
            .copy_from_slice(&plane);
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
