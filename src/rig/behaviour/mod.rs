//! What a machine is made to do while it is recorded.
//!
//! Behaviours see sensed state only ([`Estimate`]), through the nominal model, as on a real machine. Joint excitations
//! fit any model with motors; those with the object need fingertips and a free body, see `tips`.

mod contact;
mod joint;
mod policy;
pub(super) mod tips;

pub use policy::PolicyBehaviour;

use super::RigError;
use super::estimate::Estimate;
use crate::mujoco::MujocoError;
use crate::rng::Stream;

/// A closed-loop controller.
pub trait Behaviour {
    /// Write the controls (nu) of the control step at `time_s`.
    ///
    /// # Errors
    /// When the engine refuses.
    fn command(
        &mut self,
        time_s: f64,
        estimate: &mut Estimate,
        ctrl: &mut [f64],
    ) -> Result<(), MujocoError>;

    /// Where the object should be, m; none: there is no goal.
    fn goal(&self, _time_s: f64) -> Option<[f64; 3]> {
        None
    }
}

type Build = fn(&mut Estimate, f64, Stream) -> Result<Box<dyn Behaviour>, RigError>;

/// A named behaviour.
#[derive(Debug, Clone, Copy)]
pub struct Entry {
    /// on the command line
    pub name: &'static str,
    /// duration unless another is asked for, s
    pub seconds: f64,
    /// in words
    pub summary: &'static str,
    build: Build,
}

/// All behaviours.
pub const BEHAVIOURS: &[Entry] = &[
    Entry {
        name: "multi_sine",
        seconds: 10.0,
        summary: "all axes on sums of sines, free of contact",
        build: joint::multi_sine,
    },
    Entry {
        name: "chirp",
        seconds: 9.0,
        summary: "axes in turn from 0.2 to 15 Hz, free of contact",
        build: joint::chirp,
    },
    Entry {
        name: "reversals",
        seconds: 12.0,
        summary: "slow to and fro, one axis after the other the faster",
        build: joint::reversals,
    },
    Entry {
        name: "postures",
        seconds: 12.0,
        summary: "holds in postures over the range, for gravity",
        build: joint::postures,
    },
    Entry {
        name: "touch",
        seconds: 12.0,
        summary: "fingers in turn touch the resting object, low and high",
        build: contact::touch,
    },
    Entry {
        name: "press",
        seconds: 8.0,
        summary: "all fingers press, force by force, each held",
        build: contact::press,
    },
    Entry {
        name: "slide",
        seconds: 12.0,
        summary: "fingers in turn slide along the held object's surface",
        build: contact::slide,
    },
    Entry {
        name: "push",
        seconds: 16.0,
        summary: "the object out and back in eight directions",
        build: contact::push,
    },
];

/// The behaviour called `name`.
///
/// # Errors
/// [`RigError::Behaviour`], which lists those there are.
pub fn entry(name: &str) -> Result<&'static Entry, RigError> {
    BEHAVIOURS
        .iter()
        .find(|entry| entry.name == name)
        .ok_or_else(|| RigError::Behaviour {
            name: name.to_owned(),
            known: BEHAVIOURS
                .iter()
                .map(|e| e.name)
                .collect::<Vec<_>>()
                .join(", "),
        })
}

impl Entry {
    /// The behaviour on the machine of `estimate`, for `seconds`; `rng` draws what differs from trial to trial.
    ///
    /// # Errors
    /// [`RigError::Model`] when the model lacks what it acts on.
    pub fn build(
        &self,
        estimate: &mut Estimate,
        seconds: f64,
        rng: Stream,
    ) -> Result<Box<dyn Behaviour>, RigError> {
        (self.build)(estimate, seconds, rng)
    }
}

/// From 0 to 1 with zero speed at both ends.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}
