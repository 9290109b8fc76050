//! Supplements: each law against its equation, forwards, inversely, split, saved and restored.

mod commands;
#[path = "../common/mod.rs"]
mod common;
mod forces;
mod machine;
mod parse;
mod program;
mod readings;
mod step;
mod transmission;
