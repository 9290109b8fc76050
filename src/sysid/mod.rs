//! Joint identification of model parameters and estimation of the motion, through contact.
//!
//! Over parameters P of the model and its sensors, and the whole trajectory Q = (q₀ … qₜ) of every recording,
//!
//! ```text
//! min  Σ ρ((τ̂ₖ − uₖ)/σ)  +  Σ ρ((ŝₖ − sₖ)/σₛ)  +  Σ ((x − x̄)/σₓ)²/2
//! P,Q
//! ```
//!
//! where τ̂ are the forces that inverse dynamics needs for three consecutive positions and ŝ the sensors there. Taking
//! the motion as an unknown keeps contact tractable: nothing is integrated, so nothing diverges, and a wrong parameter
//! shows as a force where it acts.
//!
//! | symbol | name |
//! | --- | --- |
//! | h, q, v, a, τ̂ − u | timestep, qpos, qvel, acceleration, `residual`: [`inverse`] |
//! | P, x, σₓ | [`parameter`]: value, its number in the estimator, `prior_sigma` |
//! | s, σₛ, σ | [`problem`]: samples, `Channel::sigma`, `force_sigma` |
//! | ρ | [`norm`] |
//!
//! Reference: Kolev and Todorov 2015, "Physically consistent state estimation and system identification for contacts".

mod arrow;
mod backward;
pub(crate) mod box_qp;
pub mod check;
pub mod commands;
mod conclude;
pub mod design;
pub mod ensemble;
mod evolution;
mod expansion;
pub mod figures;
pub mod fit;
pub mod holdout;
pub(crate) mod instrument;
pub mod interval;
pub mod inverse;
pub(crate) mod islands;
pub mod joint;
pub mod leave_out;
mod likelihood;
mod linearise;
mod long_run;
mod manifold;
pub mod method;
mod newton;
pub mod norm;
pub mod nudging;
pub mod parameter;
pub mod path;
mod point;
mod pose;
pub mod predict;
mod prior;
pub mod problem;
pub(crate) mod reach;
pub mod rollouts;
mod rows;
mod rule;
mod separate;
pub mod sequential;
pub mod shooting;
mod smooth;
pub(crate) mod start;
mod step;
pub(crate) mod student;
pub mod summary;
mod surface;
mod timing;
mod track;
pub(crate) mod trial;

use thiserror::Error;

use crate::mjcf::MjcfError;
use crate::mujoco::MujocoError;
use crate::recording::RecordingError;

/// Why a problem cannot be set up or solved.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SysidError {
    /// The engine failed.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// An address means nothing.
    #[error("parameter {0}")]
    Mjcf(#[from] MjcfError),
    /// A recording does not fit the model.
    #[error(transparent)]
    Binding(#[from] RecordingError),
    /// A rule cannot be used.
    #[error("parameter `{element} {attribute}`: {reason}")]
    Parameter {
        /// as configured
        element: String,
        /// as configured
        attribute: String,
        /// what is wrong, and what to do
        reason: String,
    },
    /// The method cannot handle the model.
    #[error("this model cannot be identified: {reason}")]
    Model {
        /// why
        reason: String,
    },
    /// A recording cannot be used.
    #[error("recording `{recording}`: {reason}")]
    Recording {
        /// its name
        recording: String,
        /// what is wrong
        reason: String,
    },
    /// The engine takes no step from where the estimate is.
    #[error(
        "recording `{recording}`: the engine takes no step at {time_s} s, its numbers become too large; check units, \
         and where parameters start"
    )]
    NoStep {
        /// its name
        recording: String,
        /// s since the first knot
        time_s: f64,
    },
    /// A channel cannot be used.
    #[error("channel `{channel}`: {reason}")]
    Channel {
        /// its name
        channel: String,
        /// what is wrong, and what to do
        reason: String,
    },
    /// Something that is to be estimated leaves no trace.
    #[error("the recordings do not show {what}; {remedy}")]
    Unseen {
        /// joints or parameters
        what: String,
        /// what to do
        remedy: String,
    },
    /// A setting is out of range.
    #[error("{reason}")]
    Setting {
        /// the setting and its range
        reason: String,
    },
}
