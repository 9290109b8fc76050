//! What leaves the pushing task unchanged: turns by 120°, where each finger takes the place of the one before it, and the
//! mirror image across the plane of finger 0, where the other two change places and all turrets turn the other way.
//!
//! Whether a model is the same machine after them is asked of the engine: random motions are simulated, and simulated again
//! turned, from turned states under turned torques. That covers whatever a file, a supplement or an identification has
//! changed, but for contacts of the fingers, which those motions seldom make: their properties are compared one by one.

use std::sync::Arc;

use nalgebra::{DMatrix, Matrix2, Vector2};

use super::push::{JOINTS, N_FINGER, N_JOINT, N_MOTOR, N_OBSERVATION, N_VALUE_INPUT, PushTask};
use super::symmetry::{Symmetry, apply};
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

/// What of the machine takes the place of what.
struct Image {
    /// finger i takes the place of finger `to[i]`
    to: [usize; N_FINGER],
    /// what becomes of x and y
    plane: Matrix2<f64>,
    symmetry: Symmetry,
}

impl PushTask {
    /// What `model` is the same machine after: all of turns and mirror images, one kind of them, or none.
    ///
    /// # Errors
    /// When the engine fails or no start is found.
    pub fn symmetries(&self, model: &Arc<Model>) -> Result<Vec<Symmetry>, TaskError> {
        let (turn, mirror) = (Image::turn(), Image::mirror());
        let mut all = Vec::new();
        if self.holds(&turn, model)? {
            let once = turn.symmetry;
            let twice = once.then(&once);
            all.extend([once, twice]);
        }
        if self.holds(&mirror, model)? {
            let mirror = mirror.symmetry;
            let mirrored: Vec<Symmetry> = all.iter().map(|turn| mirror.then(turn)).collect();
            all.extend(mirrored);
            all.push(mirror);
        }
        Ok(all)
    }

    /// Whether the task on `model` is its own `image`.
    fn holds(&self, image: &Image, model: &Arc<Model>) -> Result<bool, TaskError> {
        if !(self.starts_alike(image) && self.fingers_touch_alike(image, model)) {
            return Ok(false);
        }
        let [mut data, mut turned] = [Data::new(Arc::clone(model))?, Data::new(Arc::clone(model))?];
        let mut compared = 0;
        for index in 0..MOTIONS {
            match self.moves_alike(image, index, &mut data, &mut turned)? {
                Some(steps) => compared += steps,
                None => return Ok(false),
            }
        }
        // a model of which nothing could be compared is not known to have it
        Ok(compared > 0)
    }

    /// Whether starts are drawn from the same range of motor coordinates.
    fn starts_alike(&self, image: &Image) -> bool {
        let ends = self.start_low.iter().zip(&self.start_high);
        let (middle, width): (Vec<f64>, Vec<f64>) = ends.map(|(a, b)| (a + b, b - a)).unzip();
        let action = &image.symmetry.action;
        let same = |matrix: &DMatrix<f64>, x: &[f64]| {
            let turned = apply(matrix, x);
            turned.iter().zip(x).all(|(a, b)| (a - b).abs() < PLACE)
        };
        same(action, &middle) && same(&action.abs(), &width)
    }

    /// In how many steps a random motion of `data` is, turned, that of `turned`; none if it is not in one of them.
    fn moves_alike(
        &self,
        image: &Image,
        index: u64,
        data: &mut Data,
        turned: &mut Data,
    ) -> Result<Option<usize>, TaskError> {
        let mut rng = rng::stream(0, Purpose::Start, 0, index);
        data.reset();
        turned.reset();
        self.start(data, &mut rng)?;
        self.turn_state(image, data, turned);
        turned.step1()?;
        let action: Vec<f64> = (0..N_MOTOR)
            .map(|_| TORQUE_SIGMA * rng::normal(&mut rng))
            .collect();
        data.ctrl_mut().copy_from_slice(&action);
        let action = apply(&image.symmetry.action, &action);
        turned.ctrl_mut().copy_from_slice(action.as_slice());
        let steps = (DURATION_S / data.model().timestep()).ceil() as usize;
        let steps = steps.min(MAX_STEPS);
        for step in 0..steps {
            data.step()?;
            turned.step()?;
            if self.is_touching(data, |_| true) {
                return Ok(Some(step));
            }
            if !self.looks_alike(image, data, turned) {
                return Ok(None);
            }
        }
        Ok(Some(steps))
    }

    /// Whether what is seen of `data` is, turned, what is seen of `turned`.
    fn looks_alike(&self, image: &Image, data: &Data, turned: &Data) -> bool {
        let [mut seen, mut found] = [vec![0.0; N_VALUE_INPUT], vec![0.0; N_VALUE_INPUT]];
        self.observe_value(data, &mut seen);
        self.observe_value(turned, &mut found);
        let expected = apply(&image.symmetry.value_input, &seen);
        let velocities = N_JOINT..2 * N_JOINT;
        let fastest = expected.rows_range(velocities.clone()).amax();
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
            let [x, y, z] = self.tip(data, finger);
            let [x, y] = image.in_plane([x, y]);
            let found = self.tip(turned, image.to[finger]);
            let mut pairs = [x, y, z].into_iter().zip(found);
            pairs.all(|(a, b)| (a - b).abs() <= PLACE)
        };
        pairs.all(|(i, (a, b))| (a - b).abs() <= tolerance(i)) && (0..N_FINGER).all(tip_alike)
    }

    /// Put `turned` into the state of `data` after a turn: joints, the object's place, the goal. The object is round and
    /// stands upright and still.
    fn turn_state(&self, image: &Image, data: &Data, turned: &mut Data) {
        let joints = image.symmetry.observation.view((0, 0), (N_JOINT, N_JOINT));
        let joints = apply(&joints.into_owned(), &data.qpos()[..N_JOINT]);
        turned.qpos_mut()[..N_JOINT].copy_from_slice(joints.as_slice());
        let at = |place: &[f64]| image.in_plane([place[0], place[1]]);
        let [x, y] = at(self.goal(data));
        self.set_goal(turned, x, y);
        let heading = image.in_plane(self.goal.heading(data));
        self.goal.set_heading(turned, heading);
        self.object_mut(turned)[..2].copy_from_slice(&at(self.object(data)));
    }

    /// Whether the fingertips have the same size and touch everything in the same way.
    fn fingers_touch_alike(&self, image: &Image, model: &Model) -> bool {
        let next = |geom: usize| match self.tip_geoms.iter().position(|tip| *tip == geom) {
            Some(finger) => self.tip_geoms[image.to[finger]],
            None => geom,
        };
        let of_geom = |geom: usize| {
            [
                row(model.geom_size(), 3, geom),
                row(model.geom_friction(), 3, geom),
                row(model.geom_solref(), 2, geom),
                row(model.geom_solimp(), 5, geom),
                row(model.geom_margin(), 1, geom),
                row(model.geom_gap(), 1, geom),
            ]
            .concat()
        };
        let of_pair = |pair: usize| {
            let dim = f64::from(model.pair_dim()[pair]);
            [
                row(model.pair_friction(), 5, pair),
                row(model.pair_solref(), 2, pair),
                row(model.pair_solimp(), 5, pair),
                row(model.pair_margin(), 1, pair),
                row(model.pair_gap(), 1, pair),
                &[dim],
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

/// The `n` numbers of element `at`.
fn row(all: &[f64], n: usize, at: usize) -> &[f64] {
    &all[n * at..n * (at + 1)]
}

impl Image {
    /// The turn by 120°.
    fn turn() -> Self {
        let (sin, cos) = (std::f64::consts::TAU / N_FINGER as f64).sin_cos();
        Self::new([1, 2, 0], 1.0, Matrix2::new(cos, -sin, sin, cos))
    }

    /// The mirror image across the plane of finger 0, x = 0.
    fn mirror() -> Self {
        Self::new([0, 2, 1], -1.0, Matrix2::new(-1.0, 0.0, 0.0, 1.0))
    }

    /// Turrets turn by `turret` times the angle.
    fn new(to: [usize; N_FINGER], turret: f64, plane: Matrix2<f64>) -> Self {
        let mut action = DMatrix::zeros(N_MOTOR, N_MOTOR);
        let mut value_input = DMatrix::zeros(N_VALUE_INPUT, N_VALUE_INPUT);
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
            value_input.view_mut((at, at), (2, 2)).copy_from(&plane);
        }
        for at in [object, goal] {
            value_input[(at + 2, at + 2)] = 1.0;
        }
        let n = N_OBSERVATION;
        let symmetry = Symmetry {
            action,
            observation: value_input.view((0, 0), (n, n)).into_owned(),
            value_input,
        };
        Self {
            to,
            plane,
            symmetry,
        }
    }

    /// A place or direction in the plane, turned.
    fn in_plane(&self, xy: [f64; 2]) -> [f64; 2] {
        (self.plane * Vector2::from(xy)).into()
    }
}
