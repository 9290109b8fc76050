//! What `MuJoCo` computes: stepping, single stages, inverse dynamics, Jacobians.

use super::data::check;
use super::{Data, Model, MujocoError, ObjectKind, Result, ffi};
use std::ptr;

impl Data {
    /// One time step. A diverged state is reset by `MuJoCo`, and counted in [`Data::warnings`].
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`] for NaN in the mocap pose, [`MujocoError::Fatal`],
    /// [`MujocoError::Poisoned`].
    #[inline]
    pub fn step(&mut self) -> Result<()> {
        self.check_mocap()?;
        // SAFETY: invariants 2 and 5; MuJoCo itself checks qpos, qvel, ctrl.
        self.call(|m, d| unsafe { ffi::mj_step(m, d) })
    }

    /// First half of a step, up to where controls are read.
    ///
    /// # Errors
    /// As [`Data::step`].
    pub fn step1(&mut self) -> Result<()> {
        self.check_mocap()?;
        // SAFETY: as in `step`.
        self.call(|m, d| unsafe { ffi::mj_step1(m, d) })
    }

    /// Second half of a step, from the controls on (never Runge-Kutta).
    ///
    /// # Errors
    /// As [`Data::step`].
    pub fn step2(&mut self) -> Result<()> {
        // SAFETY: invariant 2; what it reads was checked by the position stage before it.
        self.call(|m, d| unsafe { ffi::mj_step2(m, d) })
    }

    /// Everything that follows from state and inputs, up to qacc and sensors; no time passes.
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`] for NaN in positions or velocities; as [`Data::step`].
    pub fn forward(&mut self) -> Result<()> {
        self.check_position()?;
        check("qvel", self.qvel())?;
        // SAFETY: invariants 2 and 5.
        self.call(|m, d| unsafe { ffi::mj_forward(m, d) })
    }

    /// Inverse dynamics: `qfrc_inverse` from qpos, qvel, qacc.
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn inverse(&mut self) -> Result<()> {
        self.check_position()?;
        check("qvel", self.qvel())?;
        // SAFETY: invariants 2 and 5.
        self.call(|m, d| unsafe { ffi::mj_inverse(m, d) })
    }

    /// Inverse dynamics after [`Data::position_stage`] and [`Data::velocity_stage`]: `qfrc_inverse` from qacc, and with
    /// `sensors` the acceleration-dependent part of `sensordata`.
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`] for NaN in qacc; as [`Data::forward`].
    pub fn inverse_of_acceleration(&mut self, sensors: bool) -> Result<()> {
        check("qacc", self.qacc())?;
        let skip_stage = ffi::mjtStage_::mjSTAGE_VEL as i32;
        let skip_sensor = i32::from(!sensors);
        // SAFETY: invariants 2 and 5; the skipped stages were computed by the calls named above.
        self.call(|m, d| unsafe { ffi::mj_inverseSkip(m, d, skip_stage, skip_sensor) })
    }

    /// Forces of the actuators into `qfrc_actuator` from ctrl and act, and `act_dot`; after
    /// [`Data::velocity_stage`].
    ///
    /// # Errors
    /// [`MujocoError::NotFinite`] for NaN in ctrl or act; as [`Data::forward`].
    pub fn actuation(&mut self) -> Result<()> {
        check("ctrl", self.ctrl())?;
        check("act", self.act())?;
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_fwdActuation(m, d) })
    }

    /// Solves M x = y (nv each) with the inertia of the last position stage.
    ///
    /// # Errors
    /// [`MujocoError::Length`]; as [`Data::forward`].
    pub fn solve_mass_matrix(&mut self, x: &mut [f64], y: &[f64]) -> Result<()> {
        length("the solution", self.model().nv(), x)?;
        length("the right-hand side", self.model().nv(), y)?;
        let (x, y) = (x.as_mut_ptr(), y.as_ptr());
        // SAFETY: one vector of nv each, which do not overlap.
        self.call(|m, d| unsafe { ffi::mj_solveM(m, d, x, y, 1) })
    }

    /// Kinematics, inertia, collisions, constraint Jacobian: all that depends on position alone.
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn position_stage(&mut self) -> Result<()> {
        self.check_position()?;
        // SAFETY: invariants 2 and 5.
        self.call(|m, d| unsafe { ffi::mj_fwdPosition(m, d) })
    }

    /// All that depends on position and velocity; after [`Data::position_stage`].
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn velocity_stage(&mut self) -> Result<()> {
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_fwdVelocity(m, d) })
    }

    /// Position-dependent sensors into `sensordata`; after [`Data::position_stage`].
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn position_sensors(&mut self) -> Result<()> {
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_sensorPos(m, d) })
    }

    /// Velocity-dependent sensors into `sensordata`; after [`Data::velocity_stage`].
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn velocity_sensors(&mut self) -> Result<()> {
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_sensorVel(m, d) })
    }

    /// Dense joint-space inertia (nv × nv) of the last position stage.
    ///
    /// # Errors
    /// [`MujocoError::Length`].
    pub fn full_mass_matrix(&mut self, out: &mut [f64]) -> Result<()> {
        let nv = self.model().nv();
        length("the mass matrix", nv * nv, out)?;
        let (inertia, out) = (self.qM().as_ptr(), out.as_mut_ptr());
        // SAFETY: qM has nM entries, `out` nv × nv.
        self.call(|m, _| unsafe { ffi::mj_fullM(m, out, inertia) })
    }

    /// Jacobians of a site's position and rotation (3 × nv each), of the last position stage.
    ///
    /// # Errors
    /// [`MujocoError::Index`], [`MujocoError::Length`].
    pub fn jac_site(&mut self, site: usize, jacp: &mut [f64], jacr: &mut [f64]) -> Result<()> {
        let site = self.model().check_id(ObjectKind::Site, site)?;
        let nv = self.model().nv();
        length("the position Jacobian", 3 * nv, jacp)?;
        length("the rotation Jacobian", 3 * nv, jacr)?;
        let (p, r) = (jacp.as_mut_ptr(), jacr.as_mut_ptr());
        // SAFETY: site in range, both outputs are 3 × nv.
        self.call(|m, d| unsafe { ffi::mj_jacSite(m, d, p, r, site) })
    }

    /// Force and torque of contact `i` in its own frame, in N and N m.
    ///
    /// # Errors
    /// [`MujocoError::Index`].
    pub fn contact_force(&self, i: usize) -> Result<[f64; 6]> {
        self.usable()?;
        let count = self.contacts().len();
        if i >= count {
            return Err(MujocoError::Index {
                kind: "contact",
                count,
                got: i,
            });
        }
        let mut force = [0.0; 6];
        let data = ptr::from_ref(self.raw());
        // SAFETY: contact in range, six numbers of room; reads only.
        unsafe { ffi::mj_contactForce(self.model().as_ptr(), data, i as i32, force.as_mut_ptr()) };
        Ok(force)
    }

    /// Potential and kinetic energy in J after a velocity stage, whether or not the model enables
    /// their computation in each step.
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn compute_energy(&mut self) -> Result<[f64; 2]> {
        // MuJoCo returns zeros without the flag: pass it a header with the flag set
        let mut header = *self.model().raw();
        header.opt.enableflags |= ffi::mjtEnableBit_::mjENBL_ENERGY as i32;
        let model = ptr::from_ref(&header);
        // SAFETY: invariant 2; the arrays of `header` are those of the model, read only.
        self.call(|_, d| unsafe { ffi::mj_energyPos(model, d) })?;
        // SAFETY: as above.
        self.call(|_, d| unsafe { ffi::mj_energyVel(model, d) })?;
        Ok(self.energy())
    }
}

impl Model {
    /// Moves `qpos` (nq) along `qvel` (nv) for `dt` seconds, quaternions kept normalised.
    ///
    /// # Errors
    /// [`MujocoError::Length`].
    pub fn integrate_pos(&self, qpos: &mut [f64], qvel: &[f64], dt: f64) -> Result<()> {
        length("qpos", self.nq(), qpos)?;
        length("qvel", self.nv(), qvel)?;
        // SAFETY: valid model, lengths checked.
        unsafe { ffi::mj_integratePos(self.as_ptr(), qpos.as_mut_ptr(), qvel.as_ptr(), dt) };
        Ok(())
    }

    /// The velocity (nv) that leads from `from` to `to` (nq each) in `dt` seconds.
    ///
    /// # Errors
    /// [`MujocoError::Length`].
    pub fn differentiate_pos(
        &self,
        qvel: &mut [f64],
        dt: f64,
        from: &[f64],
        to: &[f64],
    ) -> Result<()> {
        length("qvel", self.nv(), qvel)?;
        length("qpos", self.nq(), from)?;
        length("qpos", self.nq(), to)?;
        let (q0, q1, out) = (from.as_ptr(), to.as_ptr(), qvel.as_mut_ptr());
        // SAFETY: valid model, lengths checked.
        unsafe { ffi::mj_differentiatePos(self.as_ptr(), out, dt, q0, q1) };
        Ok(())
    }
}

fn length(name: &'static str, expected: usize, slice: &[f64]) -> Result<()> {
    let got = slice.len();
    if got == expected {
        Ok(())
    } else {
        Err(MujocoError::Length {
            name,
            expected,
            got,
        })
    }
}
