//! Raw bindings to MuJoCo 2.2.2, and its array table as macros.
//!
//! `for_each_model_array!(callback, m)` and `for_each_data_array!(callback, m)` call
//! `callback! { m, ["doc"] element name (rows) (columns); … }` with every array field of `mjModel`
//! and `mjData`; rows and columns are expressions over `m`, a `&mjModel`. The `…_f64!` variants
//! list the arrays of doubles alone, `…_editable!` those of them that hold no indices, and
//! `for_each_model_size!(callback)` the sizes.
//!
//! # Another build of the library
//!
//! Debian's library uses no AVX instruction. DeepMind's wheel of the same release does: measured on
//! `tests/models/arm.xml` and `push_box.xml`, interleaved on one core, a step takes 1.37 times as
//! long with Debian's, and both give the same bits. To build against the wheel's:
//!
//! ```text
//! python3.10 -m pip download --no-deps mujoco==2.2.2
//! mkdir -p mujoco-avx/lib
//! unzip -j mujoco-2.2.2-*.whl mujoco/libmujoco.so.2.2.2 -d mujoco-avx/lib
//! unzip mujoco-2.2.2-*.whl 'mujoco/include/*'
//! mv mujoco/include mujoco-avx/include
//! ln -s libmujoco.so.2.2.2 mujoco-avx/lib/libmujoco.so
//! MUJOCO_DIR=$PWD/mujoco-avx cargo build --release
//! ```
//!
//! `MUJOCO_DIR` must be an absolute path; its `lib` is also where the program looks at run time. The
//! two libraries share one name, so a program built against Debian's also takes the other through
//! `LD_LIBRARY_PATH`.
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
