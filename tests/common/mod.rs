//! What the tests of simulated tasks share.
#![allow(dead_code)] // not every test uses everything

pub(crate) mod browser;
pub(crate) mod driven;
pub(crate) mod program;
pub(crate) mod team;
pub(crate) mod toss;

use phantom::mujoco::{Data, Model};
use phantom::rng::{self, Stream};
use phantom::task::{ObservationGroup, Task, TaskError};

pub(crate) fn phantom_model() -> Model {
    Model::from_xml_path("xml/phantom.xml").expect("the shipped model loads")
}

pub(crate) fn point_mass_model() -> Model {
    Model::from_xml_path("tests/models/point_mass.xml").expect("model loads")
}

/// The shipped model with a piece of its text replaced.
pub(crate) fn phantom_model_with(from: &str, to: &str) -> Model {
    let text = std::fs::read_to_string("xml/phantom.xml").expect("readable");
    assert!(text.contains(from), "{from}");
    let directory = tempfile::tempdir().expect("directory");
    let path = directory.path().join("changed.xml");
    std::fs::write(&path, text.replace(from, to)).expect("writable");
    Model::from_xml_path(&path).expect("the changed model loads")
}

/// The shipped model without torque limits: a huge torque is then no usable control.
pub(crate) fn unlimited_model() -> Model {
    phantom_model_with("ctrllimited=\"true\"", "ctrllimited=\"false\"")
}

/// Bring a mass to rest at a goal: observation = position, velocity, goal.
pub(crate) struct PointMass;

impl Task for PointMass {
    fn n_observation(&self) -> usize {
        6
    }

    fn n_action(&self) -> usize {
        2
    }

    fn observation_names(&self) -> Vec<String> {
        ["x", "y", "vx", "vy", "gx", "gy"]
            .map(String::from)
            .to_vec()
    }

    fn action_names(&self) -> Vec<String> {
        ["fx", "fy"].map(String::from).to_vec()
    }

    fn observation_groups(&self) -> Vec<ObservationGroup> {
        vec![ObservationGroup {
            name: "goal",
            columns: 4..6,
        }]
    }

    fn start(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError> {
        for q in data.qpos_mut() {
            *q = rng::uniform(rng, -0.5, 0.5);
        }
        self.new_goal(data, rng)
    }

    fn new_goal(&self, data: &mut Data, rng: &mut Stream) -> Result<(), TaskError> {
        for x in &mut data.mocap_pos_mut()[..2] {
            *x = rng::uniform(rng, -0.5, 0.5);
        }
        Ok(data.step1()?)
    }

    fn observe(&self, data: &Data, observation: &mut [f64]) {
        observation[..2].copy_from_slice(data.qpos());
        observation[2..4].copy_from_slice(data.qvel());
        observation[4..].copy_from_slice(&data.mocap_pos()[..2]);
    }

    fn reward(&self, data: &Data) -> f64 {
        let effort: f64 = data.ctrl().iter().map(|a| a * a).sum();
        1.0 - self.distance_m(data) - 0.001 * effort
    }

    fn distance_m(&self, data: &Data) -> f64 {
        let (q, goal) = (data.qpos(), data.mocap_pos());
        (q[0] - goal[0]).hypot(q[1] - goal[1])
    }
}
