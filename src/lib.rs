//! phantom: training, identification and gap finding on `MuJoCo` 2.2.2.
pub mod mujoco;
