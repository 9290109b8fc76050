//! Physics that `MuJoCo` 2.2.2 cannot express, written in the model file as custom elements:
//!
//! ```xml
//! <custom>
//!   <numeric name="phantom:stribeck_friction:p0_turret" data="0.02 0.1"/>   <!-- excess N m, speed rad/s -->
//! </custom>
//! ```
//!
//! The name is `phantom:` *kind* `:` *element*; the numbers are those of the kind, in its order ([`KINDS`]). Any `MuJoCo`
//! loads such a file and ignores them. [`load`] makes a model that obeys them: a [`Supplement`] is the model's
//! [`Extension`], so that steps, forward and inverse dynamics and sensors contain it wherever the model is used. The
//! numbers are read from `numeric_data` of the model in use; a parameter of a supplement is changed like any other
//! number of a model (`custom/phantom:stribeck_friction:p0_turret data[0]`, see [`crate::mjcf`]).
//!
//! | part of a step | laws |
//! | --- | --- |
//! | commands | `command`: delay, lag, ripple |
//! | forces | `transmission`, `friction`, `joint`, `contact` |
//! | readings | `encoder`, `sensor`, and the motor side of a `transmission` |
//!
//! A law of size 0 changes no bit. `scripts/phantom_supplement.py` does the same with the Python package.

#![allow(clippy::unnecessary_wraps)] // laws that fit everywhere are built like those that do not

mod command;
mod contact;
mod encoder;
mod friction;
mod joint;
mod law;
mod parse;
mod sensor;
mod swing;
mod transmission;

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use thiserror::Error;

use crate::mujoco::{Data, Extension, Forces, Model, MujocoError, Stage};
use law::{At, Law};
pub use parse::{Element, KINDS, Kind, Number, PREFIX, name_of};
pub(crate) use swing::swing;

/// Longest delay of a command or reading, s.
pub const MAX_DELAY_S: f64 = 0.05;
/// What was commanded longer ago is forgotten: seven times a lag of 30 ms.
pub(crate) const MEMORY_S: f64 = 0.2;

/// What can be wrong with the custom elements of a model.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SupplementError {
    /// The model itself does not load.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// An element cannot be used.
    #[error("custom element `{name}`: {reason}")]
    Element {
        /// its name
        name: String,
        /// what is wrong, and what there is instead
        reason: String,
    },
}

/// One custom element bound to the model.
#[derive(Debug)]
struct Term {
    kind: &'static Kind,
    element: String,
    first: usize, // of its numbers in numeric_data
    law: Box<dyn Law>,
}

/// All supplements of a model.
#[derive(Debug)]
pub struct Supplement {
    terms: Vec<Term>, // in the order of `KINDS`
    /// per hinge or slide whose encoder does not show the joint itself: (joint, address in sensordata, which of both)
    read: Vec<(usize, usize, usize)>,
}

/// Loads a model file with its supplements.
///
/// # Errors
/// A model that does not load, a custom element that cannot be used.
pub fn load(path: impl AsRef<Path>) -> Result<Model, SupplementError> {
    attach(Model::from_xml_path(path)?)
}

/// Compiles a model text as if it were the file `path`, with its supplements.
///
/// # Errors
/// As [`load`].
pub fn load_text(xml: &str, path: impl AsRef<Path>) -> Result<Model, SupplementError> {
    attach(Model::from_xml_text(xml, path)?)
}

/// The model with the supplements that it names.
///
/// # Errors
/// A custom element that cannot be used.
pub fn attach(model: Model) -> Result<Model, SupplementError> {
    Ok(match Supplement::of(&model)? {
        None => model,
        Some(supplement) => model.with_extension(Arc::new(supplement)),
    })
}

impl Supplement {
    /// The supplements that a model names; none if there are none.
    ///
    /// # Errors
    /// A custom element that cannot be used.
    pub fn of(model: &Model) -> Result<Option<Self>, SupplementError> {
        let terms = parse::terms(model)?;
        if terms.is_empty() {
            return Ok(None);
        }
        let read = encoder::sensors(model)
            .filter(|(joint, ..)| terms.iter().any(|t| t.law.reads(*joint)))
            .collect();
        Ok(Some(Self { terms, read }))
    }

    /// Kind and element of each.
    pub fn list(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.terms.iter().map(|t| (t.kind.name, t.element.as_str()))
    }

    /// Whether motors stand apart from their joints, so that encoders show where motors are.
    pub fn has_transmission(&self) -> bool {
        self.terms.iter().any(|t| t.kind.element == Element::Motor)
    }

    /// Terms with what they see, and where their parts of the memory are.
    fn each<'a>(
        &'a self,
        data: &'a Data,
        memory: &'a [f64],
    ) -> impl Iterator<Item = (&'a Term, At<'a>, Range<usize>)> {
        let timestep = data.model().timestep();
        let mut first = 0;
        self.terms.iter().map(move |term| {
            let part = first..first + term.law.memory_len(timestep);
            first = part.end;
            let at = At {
                data,
                numbers: term.numbers(data.model()),
                memory: &memory[part.clone()],
                timestep,
            };
            (term, at, part)
        })
    }

    /// What an encoder would show without delay, by the first `n` terms.
    fn instantaneous(&self, data: &Data, memory: &[f64], joint: usize, n: usize) -> [f64; 2] {
        let mut reading = data.joint_state(joint);
        for (term, at, _) in self.each(data, memory).take(n) {
            term.law.encode(&at, joint, &mut reading);
        }
        reading
    }
}

impl Term {
    fn numbers<'a>(&self, model: &'a Model) -> &'a [f64] {
        &model.numeric_data()[self.first..self.first + self.kind.numbers.len()]
    }
}

impl Extension for Supplement {
    fn encoder_delay_s(&self, model: &Model) -> Option<f64> {
        let mut terms = self.terms.iter();
        let late = terms.find(|t| t.kind.name == encoder::DELAY)?;
        Some(late.numbers(model)[0])
    }

    fn is_loaded(&self) -> bool {
        self.has_transmission()
    }

    fn load(
        &self,
        data: &Data,
        memory: &[f64],
        acceleration: &dyn Fn(usize) -> f64,
        since_s: Option<f64>,
        next: &mut [f64],
    ) {
        for (term, at, part) in self.each(data, memory) {
            let next = &mut next[part];
            term.law.load(&at, acceleration, since_s, next);
        }
    }

    fn follows(&self, joint: usize) -> bool {
        self.terms.iter().any(|term| term.law.follows(joint))
    }

    /// Every law acts on one joint, by one actuator, in contacts or on readings.
    fn is_local(&self) -> bool {
        true
    }

    fn memory_len(&self, model: &Model) -> usize {
        let timestep = model.timestep();
        self.terms.iter().map(|t| t.law.memory_len(timestep)).sum()
    }

    fn command(&self, data: &Data, memory: &[f64], ctrl: &mut [f64], next: &mut [f64]) {
        for (term, at, part) in self.each(data, memory) {
            term.law.command(&at, ctrl, &mut next[part]);
        }
    }

    fn changes_command(&self, actuator: usize) -> bool {
        self.terms.iter().any(|t| t.law.changes_command(actuator))
    }

    fn force(&self, data: &Data, memory: &[f64], forces: &mut Forces, next: &mut [f64]) {
        for (term, at, part) in self.each(data, memory) {
            term.law.force(&at, forces, &mut next[part]);
        }
        self.record(data, memory, next);
    }

    fn record(&self, data: &Data, memory: &[f64], next: &mut [f64]) {
        for (n, (term, at, part)) in self.each(data, memory).enumerate() {
            let encoder = |joint| self.instantaneous(data, memory, joint, n);
            term.law.record(&at, &encoder, &mut next[part]);
        }
    }

    fn settle(&self, data: &Data, next: &mut [f64]) {
        let timestep = data.model().timestep();
        let mut first = 0;
        for term in &self.terms {
            let part = first..first + term.law.memory_len(timestep);
            first = part.end;
            term.law.settle(data, &mut next[part]);
        }
    }

    fn sense(&self, data: &Data, memory: &[f64], stage: Stage, sensordata: &mut [f64]) {
        for (term, at, _) in self.each(data, memory) {
            term.law.sense(&at, stage, sensordata);
        }
        for &(joint, address, which) in &self.read {
            if stage == [Stage::Position, Stage::Velocity][which] {
                sensordata[address] = self.encoder(data, memory, joint)[which];
            }
        }
    }

    fn encoder(&self, data: &Data, memory: &[f64], joint: usize) -> [f64; 2] {
        self.instantaneous(data, memory, joint, self.terms.len())
    }

    fn decode(&self, data: &Data, memory: &[f64], joint: usize, reading: [f64; 2]) -> [f64; 2] {
        let terms: Vec<_> = self.each(data, memory).collect();
        let mut state = reading;
        for (term, at, _) in terms.iter().rev() {
            term.law.decode(at, joint, &mut state);
        }
        state
    }
}
