//! Raw bindings to MuJoCo 2.2.2, and its array table as macros.
//!
//! `for_each_model_array!(callback, m)` and `for_each_data_array!(callback, m)` call
//! `callback! { m, ["doc"] element name (rows) (columns); … }` with every array field of `mjModel`
//! and `mjData`; rows and columns are expressions over `m`, a `&mjModel`. The `…_f64!` variants
//! list the arrays of doubles alone, `…_editable!` those of them that hold no indices, and
//! `for_each_model_size!(callback)` the sizes.
#![allow(
    missing_docs,
    unreachable_pub,
    unsafe_code,
    clippy::all,
    clippy::pedantic,
    clippy::undocumented_unsafe_blocks,
    clippy::multiple_unsafe_ops_per_block,
    non_camel_case_types,
    non_snake_case,
    non_upper_case_globals
)]
include!(concat!(env!("OUT_DIR"), "/bindings.rs"));
include!(concat!(env!("OUT_DIR"), "/arrays.rs"));
const _: () = assert!(
    mjVERSION_HEADER == 222,
    "these bindings are written for MuJoCo 2.2.2"
);
