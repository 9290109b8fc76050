//! What a supplement is to the step.

use crate::mujoco::{Data, Forces, Stage};

/// What a law sees.
#[derive(Debug, Clone, Copy)]
pub(super) struct At<'a> {
    pub data: &'a Data,
    /// of the custom element, as they are in the model in use
    pub numbers: &'a [f64],
    /// its own part, at the beginning of the step
    pub memory: &'a [f64],
    /// s
    pub timestep: f64,
}

/// A law bound to an element, or the reason why it does not fit there.
pub(super) type Built = Result<Box<dyn Law>, String>;

/// A law of the machine. `next` is its own part of the memory at the end of the step.
///
/// All methods are functions of their arguments alone: numbers and memory live in the simulation.
pub(super) trait Law: std::fmt::Debug + Send + Sync {
    /// Numbers of memory.
    fn memory_len(&self, _timestep: f64) -> usize {
        0
    }

    /// Changes controls on their way to the actuators.
    fn command(&self, _at: &At<'_>, _ctrl: &mut [f64], _next: &mut [f64]) {}

    /// Whether it changes the control of this actuator.
    fn changes_command(&self, _actuator: usize) -> bool {
        false
    }

    /// Adds forces.
    fn force(&self, _at: &At<'_>, _forces: &mut Forces, _next: &mut [f64]) {}

    /// What [`crate::mujoco::Extension::load`] does, for its own part.
    fn load(
        &self,
        _at: &At<'_>,
        _acceleration: &dyn Fn(usize) -> f64,
        _since_s: Option<f64>,
        _next: &mut [f64],
    ) {
    }

    /// Remembers what encoders, up to this law, show at the beginning of the step.
    fn record(&self, _at: &At<'_>, _encoder: &dyn Fn(usize) -> [f64; 2], _next: &mut [f64]) {}

    /// Remembers forces of contacts.
    fn settle(&self, _data: &Data, _next: &mut [f64]) {}

    /// Changes readings of sensors other than encoders.
    fn sense(&self, _at: &At<'_>, _stage: Stage, _sensordata: &mut [f64]) {}

    /// Whether it changes what the encoder of a joint shows.
    fn reads(&self, _joint: usize) -> bool {
        false
    }

    /// Whether its motor is put where the readings of a joint show it.
    fn follows(&self, _joint: usize) -> bool {
        false
    }

    /// Changes position and velocity as an encoder shows them.
    fn encode(&self, _at: &At<'_>, _joint: usize, _reading: &mut [f64; 2]) {}

    /// The other way round; a delay, which mixes times, is left to the caller.
    fn decode(&self, _at: &At<'_>, _joint: usize, _reading: &mut [f64; 2]) {}
}
