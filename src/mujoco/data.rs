//! One simulation: mjData and the model it was made for.

use super::guard::{guarded, initialise};
use super::{Model, ModelEdit, MujocoError, ObjectKind, Result, ffi};
use std::ptr::NonNull;
use std::sync::Arc;

/// Largest magnitude `MuJoCo` accepts in a state (`mjMAXVAL`).
const MAX_VALUE: f64 = 1e10;

/// A simulation. Moves between threads, is never shared; owns a share of its model.
pub struct Data {
    raw: NonNull<ffi::mjData>,
    model: Arc<Model>,
    /// Message of the fatal error after which nothing may be computed any more.
    poison: Option<String>,
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
        let fatal = |message| MujocoError::Fatal { message };
        // SAFETY: valid model.
        let raw = guarded(|| unsafe { ffi::mj_makeData(model.as_ptr()) }).map_err(fatal)?;
        let raw = NonNull::new(raw).ok_or_else(|| fatal("could not allocate mjData".into()))?;
        Ok(Self {
            raw,
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
    fn raw_mut(&mut self) -> &mut ffi::mjData {
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

    /// Changes numbers of this simulation's model. If the model is shared, it is copied first.
    ///
    /// Derived constants are recomputed if `f` asks with [`ModelEdit::recompute_constants`]; positions
    /// of bodies and everything else that follows from the state is then stale until the next
    /// step or forward, the state itself is kept.
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`]: the simulation then refuses to compute until the number is mended.
    pub fn edit_model<R>(&mut self, f: impl FnOnce(&mut ModelEdit<'_>) -> R) -> Result<R> {
        if Arc::get_mut(&mut self.model).is_none() {
            self.model = Arc::new(self.model.try_clone()?);
        }
        let model = Arc::get_mut(&mut self.model).ok_or_else(|| MujocoError::Fatal {
            message: "the model copy is shared".into(),
        })?;
        let mut edit = ModelEdit::new(model);
        let result = f(&mut edit);
        let recompute = edit.recompute;
        model.check_edits()?;
        if recompute {
            self.recompute_constants()?;
        }
        Ok(result)
    }

    /// `mj_setConst`, which leaves the reference position in qpos: put the state back.
    fn recompute_constants(&mut self) -> Result<()> {
        let qpos = self.qpos().to_vec();
        let model = Arc::get_mut(&mut self.model).map(Model::as_mut_ptr);
        let Some(model) = model else { return Ok(()) };
        // SAFETY: the model is this simulation's own and not shared; invariant 2.
        self.call(|_, data| unsafe { ffi::mj_setConst(model, data) })?;
        self.qpos_mut().copy_from_slice(&qpos);
        Ok(())
    }

    /// Uses another model of the same structure from now on.
    ///
    /// # Errors
    /// [`MujocoError::ModelMismatch`]; nothing is changed then.
    pub fn set_model(&mut self, model: Arc<Model>) -> Result<()> {
        self.model.check_same_structure(&model, "the new model")?;
        model.first_bad_edit()?;
        self.model = model;
        Ok(())
    }

    /// Gives the own model all numbers and settings of `nominal` again, in place. If the own model
    /// is shared, it is copied first.
    ///
    /// # Errors
    /// [`MujocoError::ModelMismatch`]; nothing is changed then.
    pub fn restore_model(&mut self, nominal: &Model) -> Result<()> {
        self.model
            .check_same_structure(nominal, "the nominal model")?;
        if let Some(model) = Arc::get_mut(&mut self.model) {
            model.copy_numbers(nominal);
        } else if !std::ptr::eq(Arc::as_ptr(&self.model), nominal) {
            let mut own = self.model.try_clone()?;
            own.copy_numbers(nominal);
            self.model = Arc::new(own);
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

    /// Back to the initial state. A poisoned simulation stays poisoned.
    pub fn reset(&mut self) {
        // SAFETY: invariant 2. A poisoned simulation is left alone.
        let _ = self.call(|m, d| unsafe { ffi::mj_resetData(m, d) });
    }

    /// Back to keyframe `id`.
    ///
    /// # Errors
    /// [`MujocoError::Index`].
    pub fn reset_to_keyframe(&mut self, id: usize) -> Result<()> {
        let id = self.model.check_id(ObjectKind::Keyframe, id)?;
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

/// Finds the first number `MuJoCo` would not accept.
#[inline]
pub(super) fn check(name: &'static str, values: &[f64]) -> Result<()> {
    // written so that NaN fails
    match values.iter().position(|v| !(v.abs() <= MAX_VALUE)) {
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
