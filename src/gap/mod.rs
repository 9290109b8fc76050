//! What the simulation is missing: where it and recorded data disagree, and which physics would mend it.
//!
//! ```text
//! effect     what may be missing, where, and how a model says it
//! ```

pub mod effect;
