//! Tasks, rollouts, randomised models and training on simulated models.

#[path = "../common/mod.rs"]
mod common;
mod evaluate;
mod point_mass;
mod push_task;
mod randomise;
mod rollout;
mod training;
mod turns;
