//! Changing the model under a running simulation.

use super::{Data, Model, ModelEdit, Result, ffi};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;

impl Data {
    /// Changes numbers of this simulation's model. If the model is shared, it is copied first.
    ///
    /// Derived constants are recomputed if `f` asks with [`ModelEdit::recompute_constants`]. The state
    /// is kept, but what follows from it (body positions, …) is stale until the next step or forward.
    ///
    /// # Errors
    /// [`NotFinite`](super::MujocoError::NotFinite): the simulation then refuses to compute until the
    /// number is mended or the model restored.
    pub fn edit_model<R>(&mut self, f: impl FnOnce(&mut ModelEdit<'_>) -> R) -> Result<R> {
        let before = self.model().raw().opt;
        let mut edit = ModelEdit::new(self.own_model()?);
        // the settings must be looked at even if `f` panics after changing them
        let result = catch_unwind(AssertUnwindSafe(|| f(&mut edit)));
        let recompute = edit.recompute;
        drop(edit);
        self.forget_constraints_unless_solved_as(&before);
        self.fit_extension();
        let result = result.unwrap_or_else(|panic| resume_unwind(panic));
        self.model().first_bad_edit()?;
        if recompute {
            self.recompute_constants()?;
        }
        Ok(result)
    }

    /// Uses another model of the same structure from now on.
    ///
    /// # Errors
    /// [`ModelMismatch`](super::MujocoError::ModelMismatch); nothing is changed then.
    pub fn set_model(&mut self, model: Arc<Model>) -> Result<()> {
        self.model().check_same_structure(&model, "the new model")?;
        model.first_bad_edit()?;
        let before = self.model().raw().opt;
        self.model = model;
        self.forget_constraints_unless_solved_as(&before);
        self.fit_extension();
        Ok(())
    }

    /// Gives the own model all doubles and settings of `nominal` again, in place. If the own model is
    /// shared, it is copied first.
    ///
    /// # Errors
    /// [`ModelMismatch`](super::MujocoError::ModelMismatch); nothing is changed then.
    pub fn restore_model(&mut self, nominal: &Model) -> Result<()> {
        let same = std::ptr::eq(Arc::as_ptr(&self.model), nominal);
        if same {
            return Ok(());
        }
        self.model()
            .check_same_structure(nominal, "the nominal model")?;
        let before = self.model().raw().opt;
        self.own_model()?.copy_numbers(nominal);
        self.forget_constraints_unless_solved_as(&before);
        self.fit_extension();
        Ok(())
    }

    /// The model for writing: a copy of its own, unless it is not shared anyway.
    fn own_model(&mut self) -> Result<&mut Model> {
        if Arc::get_mut(&mut self.model).is_none() {
            self.model = Arc::new(self.model.try_clone()?);
        }
        // not shared, so this never copies
        Ok(Arc::make_mut(&mut self.model))
    }

    /// `mj_setConst`, which leaves a reference position in qpos: put the state back.
    fn recompute_constants(&mut self) -> Result<()> {
        let qpos = self.qpos().to_vec();
        let model = self.own_model()?.as_mut_ptr();
        // SAFETY: the model is this simulation's own and not shared; invariant 2.
        self.call(|_, data| unsafe { ffi::mj_setConst(model, data) })?;
        self.qpos_mut().copy_from_slice(&qpos);
        Ok(())
    }

    /// Drops contacts and constraint rows that were laid out for other settings: how many rows a
    /// contact has, and whether they are sparse, depends on them.
    fn forget_constraints_unless_solved_as(&mut self, before: &ffi::mjOption) {
        let layout = |o: &ffi::mjOption| {
            let flags = (o.disableflags, o.enableflags);
            (o.cone, o.jacobian, o.solver, o.noslip_iterations, flags)
        };
        if layout(before) == layout(&self.model().raw().opt) {
            return;
        }
        let data = self.raw_mut();
        (data.ne, data.nf, data.nefc, data.ncon) = (0, 0, 0, 0);
    }
}
