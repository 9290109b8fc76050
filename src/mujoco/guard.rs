//! Fatal errors and warnings of `MuJoCo`, turned into Rust values.
//!
//! The handlers are process-wide pointers, installed once. The error handler unwinds (the bindings
//! use the C-unwind ABI) to the nearest [`guarded`] call of its thread; outside one it prints a
//! line and ends the process with code 3.

use super::{MujocoError, Result, ffi};
use std::cell::{Cell, RefCell};
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Once;

/// Exit code after a fatal `MuJoCo` error that nobody could catch.
const EXIT_FATAL: i32 = 3;

/// What the error handler throws.
struct Thrown(String);

thread_local! {
    /// Whether this thread is inside [`guarded`].
    static GUARDED: Cell<bool> = const { Cell::new(false) };
    /// The last warning of this thread: the reason when a call returns null.
    static WARNING: RefCell<Option<String>> = const { RefCell::new(None) };
}

extern "C-unwind" fn on_error(message: *const c_char) {
    // SAFETY: MuJoCo passes a NUL-terminated buffer that lives during the call.
    let text = unsafe { CStr::from_ptr(message) };
    let text = text.to_string_lossy().into_owned();
    if GUARDED.get() {
        resume_unwind(Box::new(Thrown(text)));
    }
    end_process(&text);
}

#[allow(clippy::print_stderr, clippy::exit)]
fn end_process(text: &str) -> ! {
    eprintln!("error: MuJoCo stopped with a fatal error: {text}");
    std::process::exit(EXIT_FATAL);
}

/// Warnings of a simulation are counted in its mjData; without a handler they go to a log file.
extern "C-unwind" fn on_warning(message: *const c_char) {
    // SAFETY: MuJoCo passes a NUL-terminated buffer that lives during the call.
    let text = unsafe { CStr::from_ptr(message) };
    WARNING.set(Some(text.to_string_lossy().into_owned()));
}

/// The error for a call that returned null: the warning it raised, if any.
pub(super) fn null_error(otherwise: &str) -> MujocoError {
    let message = WARNING.take().unwrap_or_else(|| otherwise.into());
    MujocoError::Fatal { message }
}

/// Installs the handlers and checks the library's version, once.
pub(super) fn initialise() -> Result<()> {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: `Once` makes this the only write, before any call of MuJoCo that reads it.
        unsafe { ffi::mju_user_error = Some(on_error) };
        // SAFETY: as above.
        unsafe { ffi::mju_user_warning = Some(on_warning) };
    });
    let got = library_version();
    let expected = ffi::mjVERSION_HEADER as i32;
    if got == expected {
        Ok(())
    } else {
        Err(MujocoError::Version { expected, got })
    }
}

/// Version of the library loaded at run time, 222 for 2.2.2.
pub fn library_version() -> i32 {
    // SAFETY: takes nothing, reads a constant of the library.
    unsafe { ffi::mj_version() }
}

/// Runs `f`, which calls `MuJoCo`, and returns a fatal error as a value.
///
/// Whatever C structure `f` writes to is in an unknown state after an error and must be discarded.
#[inline]
pub(super) fn guarded<R>(f: impl FnOnce() -> R) -> std::result::Result<R, String> {
    let outer = GUARDED.replace(true);
    let result = catch_unwind(AssertUnwindSafe(f));
    GUARDED.set(outer);
    result.map_err(|payload| match payload.downcast::<Thrown>() {
        Ok(thrown) => thrown.0,
        Err(other) => resume_unwind(other),
    })
}

/// [`guarded`] where nothing is left behind to poison.
pub(super) fn guarded_once<R>(f: impl FnOnce() -> R) -> Result<R> {
    guarded(f).map_err(|message| MujocoError::Fatal { message })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    const CHILD: &str = "PHANTOM_TEST_FATAL";

    /// Runs itself as a child process that raises an error nobody guards.
    #[test]
    fn unguarded_error_ends_the_process_with_code_3() {
        if std::env::var_os(CHILD).is_some() {
            initialise().expect("right version");
            // SAFETY: the text ends in NUL.
            unsafe { ffi::mju_error(c"out of everything".as_ptr()) };
            return;
        }
        let this = std::env::current_exe().expect("test binary");
        let child = Command::new(this)
            .args(["--exact", "--nocapture"])
            .arg("mujoco::guard::tests::unguarded_error_ends_the_process_with_code_3")
            .env(CHILD, "1")
            .output()
            .expect("child runs");
        assert_eq!(child.status.code(), Some(EXIT_FATAL));
        let text = String::from_utf8_lossy(&child.stderr);
        let line = "error: MuJoCo stopped with a fatal error: out of everything\n";
        assert!(text.ends_with(line), "{text}");
    }

    #[test]
    fn guarded_error_is_a_value_and_panics_pass() {
        initialise().expect("right version");
        // SAFETY: the text ends in NUL.
        let result = guarded(|| unsafe { ffi::mju_error(c"boom".as_ptr()) });
        assert_eq!(result, Err("boom".into()));
        let panic = catch_unwind(|| guarded(|| panic!("other")));
        assert!(panic.is_err());
        assert!(!GUARDED.get());
    }
}
