//! Teams: the same bits for every split, errors that reach everyone.

#[path = "../common/mod.rs"]
mod common;
mod exchange;
mod training;
