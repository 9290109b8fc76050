//! System identification: planted truth comes back.

#[path = "../common/mod.rs"]
mod common;
mod coverage;
mod inverse;
mod mjcf;
mod push;
mod simulate;
