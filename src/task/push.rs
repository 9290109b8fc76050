//! The pushing task of Lowrey et al. 2018, sections V.A and V.B.
//!
//! ```text
//! observation (36) = 15 joint positions (rad), 15 joint velocities (rad/s), object xyz (m), goal xyz (m)
//! action (9)       = motor torques (N m)
//! reward           = 1 - 3 ‖O - G‖_xy - Σ_i ‖f_i - O‖ - 0.1 ‖a‖²
//! ```
//!
//! The squared torque is that of the torques the motors give, which are limited. Charging for what the policy asks for
//! instead makes the cost of one trajectory that runs away, a thousand times that of all others, decide the update.
//!
//! The paper writes the fingertip term as `‖f_i − O_xy‖`. It is read here as the distance in space to the object's
//! centre ([`TipDistance::Space`]): taken in the plane only ([`TipDistance::Plane`], selectable), a finger is paid for
//! hovering above the cylinder, and policies learn to.
//!
//! Start: joints uniform in the model's range (`start_low`, `start_high`, in motor coordinates), redrawn until no
//! fingertip touches the object; object at the origin; goal uniform in a disc.

use serde::{Deserialize, Serialize};

use super::goal::Goal;
use super::{ObservationGroup, Task, TaskError};
use crate::mujoco::{Contact, Data, Model, ObjectKind};
use crate::rng::{self, Stream};

/// Number of fingers.
pub const N_FINGER: usize = 3;
pub(super) const JOINTS: [&str; 5] = ["turret", "upper", "crank", "rod", "forearm"];
pub(super) const N_JOINT: usize = N_FINGER * JOINTS.len();
pub(super) const N_MOTOR: usize = 3 * N_FINGER;
pub(super) const N_OBSERVATION: usize = 2 * N_JOINT + 6;
/// The observation and the velocities of object and goal in the plane.
pub(super) const N_VALUE_INPUT: usize = N_OBSERVATION + 4;
const START_TRIES: usize = 100;

/// How the distance of a fingertip to the object is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TipDistance {
    /// to the object's centre, in three dimensions
    Space,
    /// horizontally only
    Plane,
}

/// Settings of the task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PushConfig {
    /// diameter of the disc of goals, m (paper: 0.12)
    pub goal_diameter_m: f64,
    /// speed of the goal within the disc, m/s; 0: it stands still (paper)
    pub goal_speed_m_s: f64,
    /// how far from the object a new goal may be, m; anywhere in the disc when absent (paper)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub goal_jump_m: Option<f64>,
    /// weight of the distance between object and goal, 1/m (paper: 3)
    pub goal_weight: f64,
    /// weight of the distance between each fingertip and the object, 1/m (paper: 1)
    pub tip_weight: f64,
    /// weight of the squared torque, 1/(N m)² (paper: 0.1)
    pub torque_weight: f64,
    /// `space` or `plane`
    pub tip_distance: TipDistance,
}

impl Default for PushConfig {
    fn default() -> Self {
        Self {
            goal_diameter_m: 0.12,
            goal_speed_m_s: 0.0,
            goal_jump_m: None,
            goal_weight: 3.0,
            tip_weight: 1.0,
            torque_weight: 0.1,
            tip_distance: TipDistance::Space,
        }
    }
}

impl PushConfig {
    fn validate(&self) -> Result<(), TaskError> {
        let named = [
            ("task.goal_diameter_m", self.goal_diameter_m),
            ("task.goal_speed_m_s", self.goal_speed_m_s),
            ("task.goal_jump_m", self.goal_jump_m.unwrap_or(0.0)),
            ("task.goal_weight", self.goal_weight),
            ("task.tip_weight", self.tip_weight),
            ("task.torque_weight", self.torque_weight),
        ];
        for (key, value) in named {
            if !(value.is_finite() && value >= 0.0) {
                return Err(TaskError::Setting {
                    key,
                    value: value.to_string(),
                    expected: "a finite number of at least 0",
                });
            }
        }
        Ok(())
    }
}

/// The pushing task bound to one model (and to every model of the same layout).
#[derive(Debug, Clone)]
pub struct PushTask {
    config: PushConfig,
    tips: [usize; N_FINGER],                 // site ids
    pub(super) tip_geoms: [usize; N_FINGER], // geom ids
    object_geom: usize,                      // geom id
    object_qpos: usize,                      // address of the free joint in qpos
    object_dof: usize,                       // address of the free joint in qvel
    pub(super) goal: Goal,
    pub(super) start_low: Vec<f64>,  // (9) motor coordinates, rad
    pub(super) start_high: Vec<f64>, // (9)
    loop_rod: [f64; 3],              // rod = a upper + b crank + c
    loop_forearm: [f64; 3],          // forearm likewise
}

impl PushTask {
    /// Bind the task to `model` by the names of its elements.
    ///
    /// # Errors
    /// When an element is missing, the joints are not in the documented order, or a setting is out of range.
    pub fn new(model: &Model, config: PushConfig) -> Result<Self, TaskError> {
        config.validate()?;
        let fail = |reason: String| Err(TaskError::Model { reason });
        for (index, name) in joint_names().enumerate() {
            let id = model.id(ObjectKind::Joint, &name)?;
            let (qpos, dof) = (
                model.jnt_qposadr()[id] as usize,
                model.jnt_dofadr()[id] as usize,
            );
            if qpos != index || dof != index || id != index {
                return fail(format!(
                    "joint `{name}` is at qpos[{qpos}], qvel[{dof}], expected {index} in both"
                ));
            }
        }
        if model.nu() != N_MOTOR {
            return fail(format!("{} actuators, expected {N_MOTOR}", model.nu()));
        }
        let object_joint = model.id(ObjectKind::Joint, "object")?;
        let object_qpos = model.jnt_qposadr()[object_joint] as usize;
        // the last joint; a free one has seven coordinates
        if object_joint + 1 != model.njnt() || model.nq() - object_qpos != 7 {
            return fail("joint `object` is not a free joint after all others".to_owned());
        }
        let goal = Goal::new(model, &config)?;
        let mut tips = [0; N_FINGER];
        let mut tip_geoms = [0; N_FINGER];
        for finger in 0..N_FINGER {
            let name = format!("p{finger}_tip");
            tips[finger] = model.id(ObjectKind::Site, &name)?;
            tip_geoms[finger] = model.id(ObjectKind::Geom, &name)?;
        }
        let triple = |name: &str| -> Result<[f64; 3], TaskError> {
            let data = numeric(model, name, 3)?;
            Ok([data[0], data[1], data[2]])
        };
        Ok(Self {
            config,
            tips,
            tip_geoms,
            object_geom: model.id(ObjectKind::Geom, "object")?,
            object_qpos,
            object_dof: model.jnt_dofadr()[object_joint] as usize,
            goal,
            start_low: numeric(model, "start_low", N_MOTOR)?,
            start_high: numeric(model, "start_high", N_MOTOR)?,
            loop_rod: triple("loop_rod")?,
            loop_forearm: triple("loop_forearm")?,
        })
    }

    /// The object's position, m.
    pub fn object<'a>(&self, data: &'a Data) -> &'a [f64] {
        &data.qpos()[self.object_qpos..self.object_qpos + 3]
    }

    pub(super) fn object_mut<'a>(&self, data: &'a mut Data) -> &'a mut [f64] {
        &mut data.qpos_mut()[self.object_qpos..self.object_qpos + 3]
    }

    /// The position of a fingertip, m.
    pub(super) fn tip(&self, data: &Data, finger: usize) -> [f64; 3] {
        let at = 3 * self.tips[finger];
        std::array::from_fn(|k| data.site_xpos()[at + k])
    }

    /// The goal's position, m.
    pub fn goal<'a>(&self, data: &'a Data) -> &'a [f64] {
        self.goal.position(data)
    }

    /// Move the goal to (`x`, `y`), at its height.
    pub fn set_goal(&self, data: &mut Data, x: f64, y: f64) {
        self.goal.set_position(data, [x, y]);
    }

    /// Joint positions of one draw of the start range, loops closed.
    fn draw_joints(&self, data: &mut Data, rng: &mut Stream) {
        let qpos = data.qpos_mut();
        for finger in 0..N_FINGER {
            let motor: [f64; 3] = std::array::from_fn(|i| {
                let k = 3 * finger + i;
                rng::uniform(rng, self.start_low[k], self.start_high[k])
            });
            let [turret, upper, crank] = motor;
            let close = |[a, b, c]: [f64; 3]| a * upper + b * crank + c;
            let joints = [
                turret,
                upper,
                crank,
                close(self.loop_rod),
                close(self.loop_forearm),
            ];
            qpos[finger * JOINTS.len()..][..JOINTS.len()].copy_from_slice(&joints);
        }
    }

    /// Whether a fingertip touches a geom of which `what` is true.
    pub(super) fn is_touching(&self, data: &Data, what: impl Fn(usize) -> bool) -> bool {
        let tip = |geom| self.tip_geoms.contains(&geom);
        let mut contacts = data.contacts().iter().map(Contact::geoms);
        contacts.any(|[a, b]| (tip(a) && what(b)) || (tip(b) && what(a)))
    }
}

/// The 15 joint names in the order of `qpos`.
fn joint_names() -> impl Iterator<Item = String> {
    (0..N_FINGER).flat_map(|finger| JOINTS.iter().map(move |joint| format!("p{finger}_{joint}")))
}

/// A `<numeric>` of the model that must have `length` values.
fn numeric(model: &Model, name: &str, length: usize) -> Result<Vec<f64>, TaskError> {
    let id = model.id(ObjectKind::Numeric, name)?;
    let (start, size) = (
        model.numeric_adr()[id] as usize,
        model.numeric_size()[id] as usize,
    );
    if size != length {
        return Err(TaskError::Model {
            reason: format!("numeric `{name}` has {size} values, expected {length}"),
        });
    }
    Ok(model.numeric_data()[start..start + size].to_vec())
}

impl Task for PushTask {
    fn n_observation(&self) -> usize {
        N_OBSERVATION
    }

    fn n_action(&self) -> usize {
        N_MOTOR
    }

    fn observation_names(&self) -> Vec<String> {
        let axes = |body: &'static str| {
            ["x", "y", "z"]
                .into_iter()
                .map(move |axis| format!("{body}_{axis}"))
        };
        joint_names()
            .map(|name| format!("{name}_pos"))
            .chain(joint_names().map(|name| format!("{name}_vel")))
            .chain(axes("object"))
            .chain(axes("goal"))
            .collect()
    }

    fn action_names(&self) -> Vec<String> {
        (0..N_FINGER)
            .flat_map(|finger| (1..=3).map(move |motor| format!("p{finger}_m{motor}")))
            .collect()
    }

    fn observation_groups(&self) -> Vec<ObservationGroup> {
        let group = |name, start, length| ObservationGroup {
            name,
            columns: start..start + length,
        };
        vec![
            group("joint_position", 0, N_JOINT),
            group("joint_velocity", N_JOINT, N_JOINT),
            group("object", 2 * N_JOINT, 3),
            group("goal", 2 * N_JOINT + 3, 3),
        ]
    }

    fn start(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError> {
        for _ in 0..START_TRIES {
            // a rejected state may have overfilled a buffer; that says nothing about the next one
            data.clear_warnings();
            self.draw_joints(data, rng);
            self.new_goal(data, rng)?;
            if !self.is_touching(data, |geom| geom == self.object_geom) {
                return Ok(());
            }
        }
        Err(TaskError::Start { tries: START_TRIES })
    }

    fn new_goal(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError> {
        let [x, y] = [0, 1].map(|axis| self.object(data)[axis]);
        self.goal.draw(data, [x, y], rng);
        data.step1()?;
        Ok(())
    }

    fn pass(&self, data: &mut Data, seconds: f64) {
        self.goal.pass(data, seconds);
    }

    fn observe(&self, data: &Data, observation: &mut [f64]) {
        // as on the machine, joints are seen through their encoders; joint numbers are addresses, see `new`
        for joint in 0..N_JOINT {
            [observation[joint], observation[N_JOINT + joint]] = data.encoder(joint);
        }
        observation[2 * N_JOINT..2 * N_JOINT + 3].copy_from_slice(self.object(data));
        observation[2 * N_JOINT + 3..].copy_from_slice(self.goal(data));
    }

    /// The observation and the velocities of object and goal in the plane, m/s. The policy must do without them, since
    /// measuring them takes a state estimator; the value function need not, and most of the reward to come hangs on where
    /// the object is about to slide.
    fn n_value_input(&self) -> usize {
        N_VALUE_INPUT
    }

    fn observe_value(&self, data: &Data, input: &mut [f64]) {
        let (observation, velocity) = input.split_at_mut(N_OBSERVATION);
        self.observe(data, observation);
        let (object, goal) = velocity.split_at_mut(2);
        object.copy_from_slice(&data.qvel()[self.object_dof..self.object_dof + 2]);
        goal.copy_from_slice(&self.goal.velocity(data));
    }

    fn reward(&self, data: &Data) -> f64 {
        let object = self.object(data);
        let tips: f64 = (0..N_FINGER)
            .map(|finger| {
                let tip = self.tip(data, finger);
                let height = match self.config.tip_distance {
                    TipDistance::Space => tip[2] - object[2],
                    TipDistance::Plane => 0.0,
                };
                (tip[0] - object[0]).hypot(tip[1] - object[1]).hypot(height)
            })
            .sum();
        let torque: f64 = data.actuator_force().iter().map(|a| a * a).sum();
        1.0 - self.config.goal_weight * self.distance_m(data)
            - self.config.tip_weight * tips
            - self.config.torque_weight * torque
    }

    fn distance_m(&self, data: &Data) -> f64 {
        let (object, goal) = (self.object(data), self.goal(data));
        (object[0] - goal[0]).hypot(object[1] - goal[1])
    }
}
