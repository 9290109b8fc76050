//! Passes on where `MuJoCo` was found: its library folder to the linker, its version to the program.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // set when MUJOCO_DIR is: the program must find that library again without LD_LIBRARY_PATH
    if let Ok(dir) = env::var("DEP_MUJOCO_LIB_DIR") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{dir}");
    }
    let version = env::var("DEP_MUJOCO_HEADER_VERSION").unwrap_or_default();
    println!("cargo::rustc-env=MUJOCO_HEADER_VERSION={version}");
}
