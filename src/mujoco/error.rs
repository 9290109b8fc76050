//! What can go wrong between Rust and `MuJoCo`.

use std::path::PathBuf;

/// Result of this module's fallible calls.
pub type Result<T> = std::result::Result<T, MujocoError>;

/// Every error of the `MuJoCo` layer.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MujocoError {
    /// The library found at run time is another release than the headers.
    #[error("libmujoco is version {got}, this program needs {expected}")]
    Version {
        /// Version of the headers this was built with, 222 for 2.2.2.
        expected: i32,
        /// What the loaded library says.
        got: i32,
    },
    /// A model file cannot be read.
    #[error("cannot read model {}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: String,
    },
    /// `MuJoCo` refused the model.
    #[error("model {} does not load: {message}", file.display())]
    Load {
        /// The file, `<string>` for a model given as text.
        file: PathBuf,
        /// `MuJoCo`'s own message.
        message: String,
    },
    /// No object of that kind and name.
    #[error("the model has no {kind} named '{name}'; it has: {}", list(known))]
    UnknownName {
        /// Kind of object.
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// The names that exist.
        known: Vec<String>,
    },
    /// An index is out of range.
    #[error("{kind} {got} does not exist, the model has {count}")]
    Index {
        /// Kind of object.
        kind: &'static str,
        /// How many there are.
        count: usize,
        /// The index asked for.
        got: usize,
    },
    /// A slice has the wrong length.
    #[error("{name} needs {expected} numbers, got {got}")]
    Length {
        /// The array.
        name: &'static str,
        /// Its length.
        expected: usize,
        /// Length of what was given.
        got: usize,
    },
    /// A setting is outside its range.
    #[error("{name} must be {expected}, got {got}")]
    Value {
        /// The setting.
        name: &'static str,
        /// The legal range in words.
        expected: &'static str,
        /// The value given.
        got: f64,
    },
    /// NaN, infinite or too large input.
    #[error("{name}[{index}] is {got}, not a usable number")]
    NotFinite {
        /// The array.
        name: &'static str,
        /// Where in it.
        index: usize,
        /// The number.
        got: f64,
    },
    /// Data or a state was used with a model of another structure.
    #[error("{what} belongs to a model of another structure ({detail})")]
    ModelMismatch {
        /// What was given.
        what: &'static str,
        /// The first difference.
        detail: String,
    },
    /// `MuJoCo` raised a fatal error; the data concerned is unusable from here on.
    #[error("MuJoCo stopped with a fatal error: {message}")]
    Fatal {
        /// `MuJoCo`'s own message.
        message: String,
    },
    /// A step of this integrator cannot be cut where an extension acts.
    #[error(
        "the integrator is RK4, whose steps cannot hold what the model's supplement adds; use Euler or implicit"
    )]
    RungeKutta,
    /// The data had a fatal error before.
    #[error("this simulation had a fatal error before and cannot be used: {message}")]
    Poisoned {
        /// The first error's message.
        message: String,
    },
}

impl MujocoError {
    /// Whether the engine itself gave up, as opposed to refusing an input.
    pub fn is_fatal(&self) -> bool {
        matches!(self, Self::Fatal { .. } | Self::Poisoned { .. })
    }
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        return "none".into();
    }
    names.join(", ")
}
