use crate::mujoco::MujocoError;
use crate::policy::PolicyError;
use crate::recording::RecordingError;
use crate::task::TaskError;

/// Why a comparison is impossible.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompareError {
    /// The engine refused.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The recording does not fit the model.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A setting is out of range.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// the key
        key: &'static str,
        /// found
        value: String,
        /// accepted range
        expected: &'static str,
    },
    /// No channel of the recording is a position of the model.
    #[error(
        "recording {recording}: no channel is a joint position or a pose of the model{unbound}"
    )]
    NoPosition {
        /// trial or source
        recording: String,
        /// what the channels were taken for
        unbound: String,
    },
    /// Some position that no constraint determines is not recorded.
    #[error("recording {recording}: the position of joint `{joint}` is not recorded")]
    MissingPosition {
        /// trial or source
        recording: String,
        /// joint
        joint: String,
    },
    /// Some control is not recorded.
    #[error("recording {recording}: no control of actuator {actuators}")]
    MissingControls {
        /// trial or source
        recording: String,
        /// names
        actuators: String,
    },
    /// Too few samples.
    #[error(
        "recording {recording}: {got} samples with a whole state, expected at least {expected}"
    )]
    TooShort {
        /// trial or source
        recording: String,
        /// needed
        expected: usize,
        /// found
        got: usize,
    },
    /// The loops of the model do not close at a recorded state.
    #[error(
        "recording {recording}: at {time_s} s the loops of the model stay open by {residual}; is it the right model?"
    )]
    OpenLoop {
        /// trial or source
        recording: String,
        /// time
        time_s: f64,
        /// residual of the equality constraints
        residual: f64,
    },
    /// The recording has no target.
    #[error("recording {recording}: no channels `goal[0]`, `goal[1]` to follow with the policy")]
    NoGoal {
        /// trial or source
        recording: String,
    },
    /// The policy does not fit.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The model does not fit the policy's task.
    #[error(transparent)]
    Task(#[from] TaskError),
}
