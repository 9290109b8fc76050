//! Safe layer over `MuJoCo` 2.2.2; the only module with `unsafe`.
//!
//! Invariants that every unsafe block below rests on:
//!
//! 1. A [`Model`] owns one `mjModel` made by `MuJoCo`; nothing but this module writes to it, and only
//!    its doubles and its options. Indices stored inside it therefore stay as compiled.
//! 2. A [`Data`] owns one `mjData` allocated for a model of the same *structure* (every size, index
//!    and flag equal). It is only ever used with such models.
//! 3. Array lengths come from the table in `mjxmacro.h`, through the macros of `mujoco_sys`.
//! 4. A fatal `MuJoCo` error unwinds to the guard around the call. The mjData concerned is then
//!    poisoned: nothing is computed with it again.
//! 5. What reaches collision code is finite: edited model arrays and the inputs of the position
//!    stage are checked, because NaN there has no defined meaning in C.
//!
//! `MuJoCo` resets a state that diverges (NaN or beyond ±1e10) and goes on: [`Data::step`] then
//! returns `Ok`, and [`Data::warnings`] tells. Read it after every rollout.
#![allow(unsafe_code)]

mod actuators;
mod arrays;
mod data;
mod dynamics;
mod edit;
mod error;
mod extension;
mod fingerprint;
mod guard;
mod kinds;
mod measures;
mod model;
mod outcome;
mod sensor;
mod state;
mod swap;
mod touch;

pub use data::Data;
pub use edit::ModelEdit;
pub use error::{MujocoError, Result};
pub use extension::{Extension, Forces, Stage, Swing};
pub use guard::library_version;
pub use kinds::{Cone, Integrator, Jacobian, ObjectKind, Solver, SolverOptions};
pub use measures::Measures;
pub use model::Model;
pub use outcome::{Contact, Warnings};
pub use sensor::JointReading;
pub use state::State;

use mujoco_sys as ffi;

/// Numbers a row of `actuator_gainprm` and `actuator_biasprm`.
pub const N_PRM: usize = ffi::mjNGAIN as usize;
