//! phantom trains robot policies in `MuJoCo` 2.2.2, and compares the simulation with recordings of machines, after Lowrey, Kolev, Dao, Rajeswaran, Todorov 2018,
//! "Reinforcement learning for non-prehensile manipulation: Transfer from simulation to physical system".
//!
//! Data flows one way; a module imports only what stands further right or below:
//!
//! ```text
//! main → cli → {train, bench} → {npg, rollout, evaluate, run_dir}
//!        cli → gap → {sysid, compare, supplement, mjcf}
//!        cli → {compare, rig} → {report, recording, rollout}
//!        cli → blind → {gap, rig}
//!        cli → {reproduce, adapt} → {train, sysid, compare, rig, report}
//!                  rollout → {task, policy, exploration, randomise, rng} → mujoco → mujoco_sys
//! ```
//!
//! | word | meaning |
//! | --- | --- |
//! | `qpos qvel ctrl qacc nq nv` | as in `MuJoCo` |
//! | control step | the time for which one action is held, some physics steps |
//! | trajectory, batch | a rollout of `horizon` control steps; the rollouts of one iteration |
//! | `step_size_delta` | δ of the normalised natural gradient: twice the KL divergence of a step |
//! | `*_sigma` | a standard deviation |
//!
//! Every random number comes from a stream addressed by seed, purpose, iteration and trajectory ([`rng`]), and every
//! sum over trajectories runs in a fixed order, so that results do not depend on the number of threads.

pub mod adapt;
pub mod bench;
pub mod blind;
pub mod cli;
pub mod compare;
pub mod crosscheck;
pub mod evaluate;
pub mod exploration;
pub mod gap;
pub mod mjcf;
pub mod mujoco;
pub mod npg;
pub mod policy;
pub mod randomise;
pub mod recording;
pub mod report;
pub mod reproduce;
pub mod rig;
pub mod rng;
pub mod rollout;
pub mod run_dir;
pub mod supplement;
pub mod sysid;
pub mod task;
pub mod team;
pub mod train;
