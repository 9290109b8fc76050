//! Raw bindings to MuJoCo 2.2.2.
#![allow(missing_docs, unreachable_pub, unsafe_code, clippy::pedantic, non_camel_case_types, non_snake_case, non_upper_case_globals)]
include!(concat!(env!("OUT_DIR"), "/bindings.rs"));
const _: () = assert!(mjVERSION_HEADER == 222, "these bindings are written for MuJoCo 2.2.2");
