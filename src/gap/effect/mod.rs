//! The catalogue of effects that a model may lack.
//!
//! An [`Effect`] knows its law, its parameters, where on a model it can act, how a model file says it, and what it may be
//! mistaken for. [`write()`] puts one into a model file: by attributes and elements where `MuJoCo` 2.2.2 has them, else as a
//! [`crate::supplement`]. What comes back, [`Written`], is a model to simulate and identify, with one rule of
//! [`crate::sysid`] a parameter.
//!
//! ```text
//! base file ── Expression: structural changes, then numbers ──> file, model, rules
//! number of the model = origin + slope × value of the parameter
//! ```
//!
//! An effect of size 0 is absent: nothing is written.

mod body;
mod contact;
mod couple;
mod drag;
mod drive;
mod friction;
mod geometry;
mod joint;
mod parameter;
mod place;
mod sensing;
mod spring;
mod touch;
mod transmission;
mod write;

pub(super) use joint::TWO_PERIODS;
pub use parameter::{Dimension, Parameter, Role, Scales, Sign};
pub use place::{Place, PlaceKind, Site};
pub use write::{EffectError, Estimated, Expression, Form, ModelFile, Number, Written, write};

use crate::mujoco::Model;

/// Name of the dry friction whose varieties other effects are.
pub(crate) const DRY: &str = "coulomb_friction";

/// What an effect does to the quantities that are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shows {
    /// in the force that the motion needs and nothing explains
    Force,
    /// in readings, with the motion as it should be
    Reading,
    /// in forces, where bodies touch
    Contact,
}

/// Another effect that looks alike, and what tells them apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Neighbour {
    /// name of the other
    pub name: &'static str,
    /// the experiment that splits them
    pub split: &'static str,
}

/// Whether one of two effects is said to look like the other.
pub(crate) fn are_neighbours(a: &dyn Effect, b: &dyn Effect) -> bool {
    let knows = |a: &dyn Effect, b: &dyn Effect| {
        let name = b.about().name;
        a.about().neighbours.iter().any(|n| n.name == name)
    };
    knows(a, b) || knows(b, a)
}

/// What is known of an effect without a model.
#[derive(Debug)]
pub struct About {
    /// its name
    pub name: &'static str,
    /// its law
    pub law: &'static str,
    /// where it shows
    pub shows: Shows,
    /// how: residual as a function of position q, velocity v, acceleration a, control u
    pub signature: &'static str,
    /// its parameters
    pub parameters: &'static [Parameter],
    /// what it is mistaken for
    pub neighbours: &'static [Neighbour],
    /// what a machine has to do for it to show, by names of [`crate::rig::behaviour`]
    pub behaviours: &'static [&'static str],
}

impl About {
    /// Whether it says how dry friction varies, which must be there for it.
    pub fn is_variety(&self) -> bool {
        self.parameters.iter().any(|p| p.role == Role::Companion)
    }

    /// Which of its parameters is how late it makes encoders, if one is.
    pub fn lateness(&self) -> Option<usize> {
        let is_time = |p: &Parameter| p.dimension == Dimension::Time;
        let at = self.parameters.iter().position(is_time);
        at.filter(|_| self.shows == Shows::Reading)
    }

    /// Shapes that are tried before one is fitted: all at their first values, and each at its others.
    pub fn shapes(&self) -> usize {
        let others = self.parameters.iter().map(|p| match p.role {
            Role::Shape(grid) => grid.len() - 1,
            _ => 0,
        });
        1 + others.sum::<usize>()
    }
}

/// Physics that a model may lack.
pub trait Effect: std::fmt::Debug + Sync {
    /// What is known of it without a model.
    fn about(&self) -> &'static About;

    /// Where it can act.
    fn places(&self, model: &Model) -> Vec<Place>;

    /// How a model file says it, with one value a parameter, in order.
    ///
    /// # Errors
    /// The reason why it cannot be said there.
    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String>;

    /// Whether steps longer than the model's own do not show it.
    fn is_quick(&self) -> bool {
        false
    }

    /// Name of another effect that is the same law where a joint has dry friction, and its size per size of this one.
    fn in_dry_joints(&self) -> Option<(&'static str, f64)> {
        None
    }

    /// Of the bodies that are fixed to the one where it is, that which it is nearest to, and its values there; nothing if it is
    /// there, or if where on a link it is said to be makes a difference.
    fn nearest(&self, _: &Model, _: &Place, _: &[f64]) -> Option<(Place, Vec<f64>)> {
        None
    }

    /// What it is proportional to, if it is a sine and a cosine of the joint's angle whose period is its last parameter:
    /// then the best period is found without a simulation for each.
    fn periodic(&self) -> Option<Periodic> {
        None
    }
}

/// What a periodic torque is proportional to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Periodic {
    /// nothing
    Torque,
    /// the command of the motor
    Command,
}

/// Every effect; a new one is a type in a file of this folder and a line here.
pub const CATALOGUE: &[&dyn Effect] = &[
    &drag::Viscous,
    &friction::Coulomb,
    &friction::Asymmetric,
    &friction::Stribeck,
    &friction::LoadDependent,
    &drag::QuadraticDrag,
    &spring::Spring,
    &joint::TorqueOffset,
    &joint::RotorInertia,
    &body::LinkMass,
    &body::Payload,
    &body::GravityTilt,
    &drive::TorqueGain,
    &drive::TorqueSaturation,
    &drive::ActuatorLag,
    &drive::ActuatorDelay,
    &drive::TorqueRipple,
    &joint::Cogging,
    &transmission::Backlash,
    &transmission::Compliance,
    &spring::Coupling,
    &spring::Stop,
    &sensing::EncoderOffset,
    &sensing::EncoderScale,
    &sensing::SensorDelay,
    &sensing::ForceSensorBias,
    &geometry::BasePose,
    &body::ObjectMass,
    &contact::ContactFriction,
    &contact::TorsionalFriction,
    &contact::FrictionCone,
    &touch::ContactStiffness,
    &touch::ContactDamping,
    &contact::AnisotropicFriction,
    &touch::FingertipRadius,
    &geometry::LengthScale,
];

/// The effect of a name.
pub fn named(name: &str) -> Option<&'static dyn Effect> {
    CATALOGUE.iter().copied().find(|e| e.about().name == name)
}

/// Every effect at every place of a model where it can act.
pub fn candidates(model: &Model) -> Vec<(&'static dyn Effect, Place)> {
    let at = |effect: &&'static dyn Effect| {
        let effect = *effect;
        effect
            .places(model)
            .into_iter()
            .map(move |place| (effect, place))
    };
    CATALOGUE.iter().flat_map(at).collect()
}
