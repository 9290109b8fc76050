//! The weights of a policy as a map of colours.

use super::super::ReproduceError;
use crate::mujoco::Model;
use crate::policy::AffineGaussian;
use crate::report::{Drawing, Figure, HeatBlock, HeatMap, Section};
use crate::task::Task;
use crate::task::push::{PushConfig, PushTask};

/// One row a motor, one block of columns a group of observations, the bias last.
///
/// # Errors
/// Policy or model do not fit the task.
pub fn weights(model: &Model, policy: &AffineGaussian) -> Result<Section, ReproduceError> {
    let task = PushTask::new(model, PushConfig::default())?;
    policy
        .check(task.n_observation(), task.n_action())
        .map_err(crate::train::TrainError::from)?;
    let names = ["pos", "vel", "object", "goal"];
    let units = ["N m/rad", "N m s/rad", "N m/m", "N m/m"];
    let groups = task.observation_groups();
    let mut blocks: Vec<HeatBlock> = groups
        .iter()
        .zip(names.into_iter().zip(units))
        .map(|(group, (name, unit))| HeatBlock {
            name: name.to_owned(),
            unit: unit.to_owned(),
            columns: group.columns.len(),
        })
        .collect();
    blocks.push(HeatBlock {
        name: "bias".to_owned(),
        unit: "N m".to_owned(),
        columns: 1,
    });
    let map = HeatMap {
        rows: task.action_names(),
        blocks,
        values: policy.weights().to_vec(),
    };
    let caption = "Each row is a motor (turret, shoulder, elbow of the fingers 0 to 2), each column an observation: 15 \
                   joint positions and 15 velocities (turret, upper arm, crank, rod, forearm of each finger), place of \
                   object and goal (x, y, z). Each block has its own scale, red above 0, blue below.";
    let figure = Figure {
        name: "heatmap".to_owned(),
        title: "Weights of the correct policy".to_owned(),
        caption: caption.to_owned(),
        drawing: Drawing::HeatMap(map),
    };
    Ok(Section::new("Policy weights").figure(figure))
}
