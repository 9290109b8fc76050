//! phantom: training, identification and gap finding on `MuJoCo` 2.2.2.

pub mod bench;
pub mod cli;
pub mod crosscheck;
pub mod evaluate;
pub mod exploration;
pub mod mujoco;
pub mod npg;
pub mod policy;
pub mod randomise;
pub mod rng;
pub mod rollout;
pub mod run_dir;
pub mod task;
pub mod train;
