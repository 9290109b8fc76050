//! System identification: planted truth comes back.

#![allow(
    clippy::print_stdout,
    reason = "the long suites print what docs/sysid.md quotes"
)]

mod apart;
#[path = "../common/mod.rs"]
mod common;
mod coverage;
mod inverse;
mod late;
mod mjcf;
mod nudging;
mod play;
mod push;
mod rollouts;
mod rotor;
mod sequential;
mod simulate;
