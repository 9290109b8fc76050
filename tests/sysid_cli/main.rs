//! `phantom sysid` as users meet it.

mod design;
mod machine;
mod mistakes;
mod results;
mod traces;
