//! The learning core as numbers: policy, metric, step, value function. No simulation.

mod baseline;
mod fisher;
mod policy;
mod step;
mod symmetry;
mod synthetic;
