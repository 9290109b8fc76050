//! One simulation: mjData and the model it was made for.

use super::extension::{Extended, Swing};
use super::guard::{guarded, guarded_once, initialise, null_error};
use super::{Model, MujocoError, ObjectKind, Result, ffi};
use std::ptr::NonNull;
use std::sync::Arc;

/// Largest magnitude `MuJoCo` accepts in a state (`mjMAXVAL`).
const MAX_VALUE: f64 = 1e10;

/// A simulation. Moves between threads, is never shared; owns a share of its model.
///
/// Views borrow the simulation, so none survives a step:
///
/// ```compile_fail,E0502
/// fn stale(data: &mut phantom::mujoco::Data) -> f64 {
///     let qpos = data.qpos();
///     data.step().ok();
///     qpos[0]
/// }
/// ```
///
/// nor do two writable ones exist at a time:
///
/// ```compile_fail,E0499
/// fn aliased(data: &mut phantom::mujoco::Data) {
///     let (a, b) = (data.ctrl_mut(), data.ctrl_mut());
///     a[0] = b[0];
/// }
/// ```
///
/// and threads cannot share one:
///
/// ```compile_fail,E0277
/// fn shared<T: Sync>() {}
/// shared::<phantom::mujoco::Data>();
/// ```
pub struct Data {
    raw: NonNull<ffi::mjData>,
    pub(super) model: Arc<Model>,
    /// Message of the fatal error after which nothing may be computed any more.
    poison: Option<String>,
    /// The model's extension at work here.
    pub(super) extended: Option<Box<Extended>>,
    /// (nu) see [`Data::hold`]; empty: 0
    pub(super) late: Vec<f64>,
    /// see [`Data::show`]
    pub(super) shown: Vec<(usize, Swing)>,
}

// SAFETY: mjData holds no thread-bound resource, and this type owns it. It is not `Sync` because
// `NonNull` is not.
unsafe impl Send for Data {}

impl Data {
    /// Allocates a simulation of `model`, at its initial state.
    ///
    /// # Errors
    /// [`MujocoError::Fatal`] when out of memory, [`MujocoError::NotFinite`] when the model was edited
    /// to NaN.
    pub fn new(model: Arc<Model>) -> Result<Self> {
        initialise()?;
        model.first_bad_edit()?;
        let raw = allocate(&model)?;
        Ok(Self {
            raw,
            extended: Extended::of(&model),
            late: Vec::new(),
            shown: Vec::new(),
            model,
            poison: None,
        })
    }

    /// The model.
    #[inline]
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The model, to share.
    pub fn model_arc(&self) -> &Arc<Model> {
        &self.model
    }

    #[inline]
    pub(super) fn raw(&self) -> &ffi::mjData {
        // SAFETY: owned and valid; MuJoCo writes to it only through `&mut self`.
        unsafe { self.raw.as_ref() }
    }

    #[inline]
    pub(super) fn raw_mut(&mut self) -> &mut ffi::mjData {
        // SAFETY: as above, and `&mut self` is exclusive.
        unsafe { self.raw.as_mut() }
    }

    /// Runs one `MuJoCo` call on this simulation; a fatal error poisons it.
    #[inline]
    pub(super) fn call<R>(
        &mut self,
        f: impl FnOnce(*const ffi::mjModel, *mut ffi::mjData) -> R,
    ) -> Result<R> {
        self.usable()?;
        let (model, data) = (self.model.as_ptr(), self.raw.as_ptr());
        guarded(|| f(model, data)).map_err(|message| {
            self.poison = Some(message.clone());
            MujocoError::Fatal { message }
        })
    }

    /// Refuses a poisoned simulation and a model edited to NaN.
    #[inline]
    pub(super) fn usable(&self) -> Result<()> {
        if let Some(message) = &self.poison {
            return Err(MujocoError::Poisoned {
                message: message.clone(),
            });
        }
        if !self.model.unchecked.is_empty() {
            self.model.first_bad_edit()?;
        }
        Ok(())
    }

    /// Simulated time in seconds.
    pub fn time(&self) -> f64 {
        self.raw().time
    }

    /// Sets the simulated time in seconds.
    pub fn set_time(&mut self, time: f64) {
        self.raw_mut().time = time;
    }

    /// Number of contacts.
    pub fn ncon(&self) -> usize {
        self.raw().ncon.max(0) as usize
    }

    /// Number of scalar constraints: the meaningful rows of `efc_*`.
    pub fn nefc(&self) -> usize {
        self.raw().nefc.max(0) as usize
    }

    /// Rows of `efc_*` that are equality constraints.
    pub fn equality_rows(&self) -> Vec<usize> {
        const EQUALITY: i32 = 0; // mjCNSTR_EQUALITY
        (0..self.nefc())
            .filter(|&row| self.efc_type()[row] == EQUALITY)
            .collect()
    }

    /// Iterations of the last constraint solve.
    pub fn solver_iterations(&self) -> usize {
        self.raw().solver_iter.max(0) as usize
    }

    /// Largest numbers of contacts, of constraint rows and of stack doubles used since the reset.
    pub fn buffer_use(&self) -> (usize, usize, usize) {
        let d = self.raw();
        (
            d.maxuse_con as usize,
            d.maxuse_efc as usize,
            d.maxuse_stack as usize,
        )
    }

    /// Potential and kinetic energy in J, of the last stages that computed them.
    pub fn energy(&self) -> [f64; 2] {
        self.raw().energy
    }

    pub(super) fn warning_total(&self, kind: usize) -> u64 {
        self.raw()
            .warning
            .get(kind)
            .map_or(0, |w| w.number.max(0) as u64)
    }

    /// Sets all warning counts to 0.
    pub fn clear_warnings(&mut self) {
        for warning in &mut self.raw_mut().warning {
            warning.number = 0;
            warning.lastinfo = 0;
        }
    }

    /// Back to the initial state of the model, all inputs and warning counts cleared. A simulation
    /// that refuses to compute (poisoned, or model edited to NaN) stays as it is.
    pub fn reset(&mut self) {
        // SAFETY: invariant 2.
        let _ = self.call(|m, d| unsafe { ffi::mj_resetData(m, d) });
        self.forget();
    }

    /// Back to keyframe `id`.
    ///
    /// # Errors
    /// [`MujocoError::Index`].
    pub fn reset_to_keyframe(&mut self, id: usize) -> Result<()> {
        let id = self.model.check_id(ObjectKind::Keyframe, id)?;
        self.forget();
        // SAFETY: invariant 2, keyframe in range.
        self.call(|m, d| unsafe { ffi::mj_resetDataKeyframe(m, d, id) })
    }

    /// Looks for NaN, infinite and huge (beyond ±1e10) numbers in all inputs.
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`] with the first.
    pub fn check_finite(&self) -> Result<()> {
        self.check_position()?;
        check("qvel", self.qvel())?;
        check("act", self.act())?;
        check("ctrl", self.ctrl())?;
        check("qacc_warmstart", self.qacc_warmstart())?;
        check("qfrc_applied", self.qfrc_applied())?;
        check("xfrc_applied", self.xfrc_applied())?;
        check("time", &[self.time()])
    }

    /// The inputs of the position stage.
    #[inline]
    pub(super) fn check_position(&self) -> Result<()> {
        check("qpos", self.qpos())?;
        self.check_mocap()
    }

    /// The inputs that `MuJoCo` does not check itself in a step.
    #[inline]
    pub(super) fn check_mocap(&self) -> Result<()> {
        check("mocap_pos", self.mocap_pos())?;
        check("mocap_quat", self.mocap_quat())
    }
}

/// An mjData for `model`, which the caller frees.
pub(super) fn allocate(model: &Model) -> Result<NonNull<ffi::mjData>> {
    // SAFETY: valid model.
    let raw = guarded_once(|| unsafe { ffi::mj_makeData(model.as_ptr()) })?;
    NonNull::new(raw).ok_or_else(|| null_error("could not allocate mjData"))
}

/// Finds the first number `MuJoCo` would not accept.
#[inline]
pub(super) fn check(name: &'static str, values: &[f64]) -> Result<()> {
    let unusable = |v: &f64| v.is_nan() || v.abs() > MAX_VALUE;
    match values.iter().position(unusable) {
        None => Ok(()),
        Some(index) => Err(MujocoError::NotFinite {
            name,
            index,
            got: values[index],
        }),
    }
}

impl Drop for Data {
    fn drop(&mut self) {
        // SAFETY: owned, and not used after this.
        unsafe { ffi::mj_deleteData(self.raw.as_ptr()) };
    }
}

impl std::fmt::Debug for Data {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Data")
            .field("time", &self.time())
            .field("model", &self.model)
            .field("poison", &self.poison)
            .finish_non_exhaustive()
    }
}
