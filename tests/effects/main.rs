//! The catalogue of effects: what it says, what it writes, and what that does.

mod catalogue;
#[path = "../common/mod.rs"]
mod common;
mod contact;
mod force;
mod machine;
mod phantom_model;
