//! The guard through which the numbers of a model are changed.

use super::data::{allocate, check};
use super::guard::guarded_once;
use super::{Model, MujocoError, Result, SolverOptions, ffi};

/// Largest iteration count that a C int holds with room to spare.
const MAX_ITERATIONS: usize = 1_000_000_000;

/// Access to the doubles and settings of a model, and to nothing that could change its structure.
///
/// Lengths, indices and flags stay as compiled, so data made for the model stays valid. Quantities
/// that `MuJoCo` derives at compile time (`dof_invweight0`, `body_subtreemass`, …) follow only after
/// [`ModelEdit::finish`] or [`ModelEdit::recompute_constants`].
pub struct ModelEdit<'a> {
    pub(super) model: &'a mut Model,
    pub(super) recompute: bool,
}

impl<'a> ModelEdit<'a> {
    pub(super) fn new(model: &'a mut Model) -> Self {
        Self {
            model,
            recompute: false,
        }
    }

    /// Remembers that an array was handed out, to look for NaN in it later.
    pub(super) fn touch(&mut self, name: &'static str) {
        if !self.model.unchecked.contains(&name) {
            self.model.unchecked.push(name);
        }
    }

    /// The model as it is now.
    pub fn model(&self) -> &Model {
        self.model
    }

    /// Sets the time step in seconds.
    ///
    /// # Errors
    /// Unless it is finite and positive.
    pub fn set_timestep(&mut self, timestep: f64) -> Result<()> {
        require("timestep", "positive and finite", timestep, timestep > 0.0)?;
        self.model.raw_mut().opt.timestep = timestep;
        Ok(())
    }

    /// Sets the solver settings.
    ///
    /// # Errors
    /// If one is outside its range; nothing is changed then.
    pub fn set_option(&mut self, option: &SolverOptions) -> Result<()> {
        let o = option;
        require(
            "timestep",
            "positive and finite",
            o.timestep,
            o.timestep > 0.0,
        )?;
        require(
            "impratio",
            "positive and finite",
            o.impratio,
            o.impratio > 0.0,
        )?;
        for (name, value) in [
            ("tolerance", o.tolerance),
            ("noslip_tolerance", o.noslip_tolerance),
        ] {
            require(name, "at least 0 and finite", value, value >= 0.0)?;
        }
        for value in o.gravity {
            require("gravity", "finite", value, true)?;
        }
        for (name, n) in [
            ("iterations", o.iterations),
            ("noslip_iterations", o.noslip_iterations),
        ] {
            require(name, "at most 1e9", n as f64, n <= MAX_ITERATIONS)?;
        }
        for (name, bits, count) in [
            (
                "disable_flags",
                o.disable_flags,
                ffi::mjtDisableBit_::mjNDISABLE,
            ),
            (
                "enable_flags",
                o.enable_flags,
                ffi::mjtEnableBit_::mjNENABLE,
            ),
        ] {
            let known = (0..1 << count).contains(&bits);
            require(name, "a sum of MuJoCo's flags", f64::from(bits), known)?;
        }
        let opt = &mut self.model.raw_mut().opt;
        opt.timestep = o.timestep;
        opt.integrator = o.integrator.to_raw();
        opt.solver = o.solver.to_raw();
        opt.cone = o.cone.to_raw();
        opt.jacobian = o.jacobian.to_raw();
        opt.iterations = o.iterations as i32;
        opt.tolerance = o.tolerance;
        opt.noslip_iterations = o.noslip_iterations as i32;
        opt.noslip_tolerance = o.noslip_tolerance;
        opt.impratio = o.impratio;
        opt.gravity = o.gravity;
        opt.disableflags = o.disable_flags;
        opt.enableflags = o.enable_flags;
        Ok(())
    }

    /// Switches the computation of sensor values on or off; off, `sensordata` is stale and a step cheaper.
    pub fn set_sensors(&mut self, on: bool) {
        self.switch(ffi::mjtDisableBit_::mjDSBL_SENSOR as i32, on);
    }

    /// Switches the search for contacts on or off; off, nothing touches.
    pub fn set_contacts(&mut self, on: bool) {
        self.switch(ffi::mjtDisableBit_::mjDSBL_CONTACT as i32, on);
    }

    fn switch(&mut self, flag: i32, on: bool) {
        let flags = &mut self.model.raw_mut().opt.disableflags;
        *flags = if on { *flags & !flag } else { *flags | flag };
    }

    /// Asks [`Data::edit_model`](super::Data::edit_model) to recompute derived constants when the edit ends.
    pub fn recompute_constants(&mut self) {
        self.recompute = true;
    }

    /// Ends the edit: checks the arrays handed out and recomputes derived constants, with a
    /// temporary mjData. Dropping the guard instead leaves derived constants as they were.
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`], [`MujocoError::Fatal`](super::MujocoError::Fatal).
    pub fn finish(self) -> Result<()> {
        self.model.first_bad_edit()?;
        let data = allocate(self.model)?.as_ptr();
        let model = self.model.as_mut_ptr();
        // SAFETY: the data was made for this model, which is borrowed exclusively.
        let result = guarded_once(|| unsafe { ffi::mj_setConst(model, data) });
        // SAFETY: made above, used no more.
        unsafe { ffi::mj_deleteData(data) };
        result
    }
}

impl Drop for ModelEdit<'_> {
    /// Clears the list of arrays to look at if all numbers are usable; otherwise every [`super::Data`]
    /// with this model refuses to compute.
    fn drop(&mut self) {
        if self.model.first_bad_edit().is_ok() {
            self.model.unchecked.clear();
        }
    }
}

impl Model {
    /// Looks for NaN, infinite and huge (beyond ±1e10) numbers in the arrays that edits handed out.
    pub(super) fn first_bad_edit(&self) -> Result<()> {
        self.unchecked
            .iter()
            .try_for_each(|name| check(name, self.numeric_field(name).unwrap_or_default()))
    }
}

fn require(name: &'static str, expected: &'static str, got: f64, legal: bool) -> Result<()> {
    if got.is_finite() && legal {
        Ok(())
    } else {
        Err(MujocoError::Value {
            name,
            expected,
            got,
        })
    }
}
