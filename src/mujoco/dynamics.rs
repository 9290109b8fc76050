//! What `MuJoCo` computes: stepping, single stages, inverse dynamics, Jacobians.

use super::data::check;
use super::{Data, MujocoError, ObjectKind, Result, ffi};
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

    /// Potential and kinetic energy in J at the current stages, whatever the energy flag says.
    ///
    /// # Errors
    /// As [`Data::forward`].
    pub fn compute_energy(&mut self) -> Result<[f64; 2]> {
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_energyPos(m, d) })?;
        // SAFETY: invariant 2.
        self.call(|m, d| unsafe { ffi::mj_energyVel(m, d) })?;
        Ok(self.energy())
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
