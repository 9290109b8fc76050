//! System identification.
pub mod inverse;
