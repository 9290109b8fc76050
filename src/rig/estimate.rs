//! What a controller knows: sensed positions and velocities in the nominal model.
//!
//! Only motorised joints are sensed. Joints in closed loops follow from them by the equality constraints of the model,
//! whose Jacobian E is taken at the start:
//!
//! ```text
//! E q' = 0   →   q' = G a'        a: axes; G has the identity in their rows, -E_p⁺ E_a in those of other joints
//! M_a = Gᵀ M G,  b_a = Gᵀ b,  J_a = J G
//! ```
//!
//! Exact for linear loops (joint and tendon constraints), first order for others.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::axes::Axis;
use crate::mujoco::{Data, Model, MujocoError};

/// Singular values below this share of 1 are no constraint.
const RANK_TOLERANCE: f64 = 1e-9;

/// A controller's view of the machine.
#[derive(Debug)]
pub struct Estimate {
    axes: Vec<Axis>,
    data: Data,
    reduction: DMatrix<f64>, // G (nv × axes)
    start: Vec<f64>,         // (nq)
    object: Option<usize>,   // address in qpos of the body that motion capture sees
    position: DVector<f64>,  // (axes) as sensed
    velocity: DVector<f64>,  // (axes) as sensed
    inertia: DMatrix<f64>,   // M_a
    bias: DVector<f64>,      // b_a
}

impl Estimate {
    /// The view at the state `qpos`.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn new(model: &Model, axes: &[Axis], qpos: &[f64]) -> Result<Self, MujocoError> {
        let mut model = model.with_dense_jacobian()?;
        model.edit().set_sensors(false);
        let object = object_address(&model);
        let mut data = Data::new(Arc::new(model))?;
        data.qpos_mut().copy_from_slice(qpos);
        data.position_stage()?;
        let reduction = reduction(&data, axes);
        let n = axes.len();
        let position: Vec<f64> = axes.iter().map(|a| data.encoder(a.joint)[0]).collect();
        let mut estimate = Self {
            axes: axes.to_vec(),
            reduction,
            start: qpos.to_vec(),
            object,
            position: DVector::zeros(n),
            velocity: DVector::zeros(n),
            inertia: DMatrix::zeros(n, n),
            bias: DVector::zeros(n),
            data,
        };
        estimate.update(&position, &vec![0.0; n], None)?;
        Ok(estimate)
    }

    /// Take new samples of the axes, and of the object if there is one.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn update(
        &mut self,
        position: &[f64],
        velocity: &[f64],
        object: Option<[f64; 3]>,
    ) -> Result<(), MujocoError> {
        for (k, axis) in self.axes.iter().enumerate() {
            // what the model knows of its encoders is undone
            let reading = [position[k], velocity[k]];
            [self.position[k], self.velocity[k]] = self.data.decode(axis.joint, reading);
        }
        let moved = DVector::from_iterator(
            self.axes.len(),
            self.axes
                .iter()
                .zip(&self.position)
                .map(|(axis, q)| q - self.start[axis.qpos]),
        );
        let moved = &self.reduction * moved;
        let qvel = &self.reduction * &self.velocity;
        let mut qpos = self.start.clone();
        let model = self.data.model_arc().clone();
        model.integrate_pos(&mut qpos, moved.as_slice(), 1.0)?;
        if let (Some(address), Some(place)) = (self.object, object) {
            qpos[address..address + 3].copy_from_slice(&place);
        }
        self.data.qpos_mut().copy_from_slice(&qpos);
        self.data.qvel_mut().copy_from_slice(qvel.as_slice());
        self.data.position_stage()?;
        self.data.velocity_stage()?;
        let nv = model.nv();
        let mut mass = DMatrix::zeros(nv, nv);
        self.data.full_mass_matrix(mass.as_mut_slice())?;
        self.inertia = self.reduction.transpose() * mass * &self.reduction;
        let bias = DVector::from_column_slice(self.data.qfrc_bias());
        self.bias = self.reduction.transpose() * bias;
        Ok(())
    }

    /// The nominal model in the sensed state.
    pub fn data(&self) -> &Data {
        &self.data
    }

    /// The same, to move the goal in it.
    pub fn data_mut(&mut self) -> &mut Data {
        &mut self.data
    }

    /// The axes.
    pub fn axes(&self) -> &[Axis] {
        &self.axes
    }

    /// Sensed positions of the axes.
    pub fn position(&self) -> &DVector<f64> {
        &self.position
    }

    /// Sensed velocities of the axes.
    pub fn velocity(&self) -> &DVector<f64> {
        &self.velocity
    }

    /// Place of the object as last seen, m.
    pub fn object(&self) -> Option<[f64; 3]> {
        let at = self.object?;
        let qpos = self.data.qpos();
        Some([qpos[at], qpos[at + 1], qpos[at + 2]])
    }

    /// Torques of the axes that give them an acceleration: `M_a` a + `b_a`.
    pub fn torque(&self, acceleration: &DVector<f64>) -> DVector<f64> {
        &self.inertia * acceleration + &self.bias
    }

    /// Torques of the axes that hold them: `b_a`.
    pub fn holding_torque(&self) -> &DVector<f64> {
        &self.bias
    }

    /// Place of a site and its Jacobian `J_a` (3 × axes).
    ///
    /// # Errors
    /// When there is no such site.
    pub fn site(&mut self, site: usize) -> Result<([f64; 3], DMatrix<f64>), MujocoError> {
        let nv = self.data.model().nv();
        // the engine writes rows: columns of the transpose
        let (mut place, mut turn) = (DMatrix::zeros(nv, 3), DMatrix::zeros(nv, 3));
        self.data
            .jac_site(site, place.as_mut_slice(), turn.as_mut_slice())?;
        let xpos = &self.data.site_xpos()[3 * site..3 * site + 3];
        Ok((
            [xpos[0], xpos[1], xpos[2]],
            place.transpose() * &self.reduction,
        ))
    }

    /// Write the controls (nu) that make `torque` at the axes.
    pub fn command(&self, torque: &DVector<f64>, ctrl: &mut [f64]) {
        for (k, axis) in self.axes.iter().enumerate() {
            ctrl[axis.actuator] = axis.control(torque[k], self.position[k], self.velocity[k]);
        }
    }
}

/// Where the free body that the first `framepos` sensor looks at has its place in qpos.
fn object_address(model: &Model) -> Option<usize> {
    let body = super::behaviour::tips::object_body(model)?;
    let joint = model.body_jntadr()[body] as usize;
    Some(model.jnt_qposadr()[joint] as usize)
}

/// G at the state of `data`.
fn reduction(data: &Data, axes: &[Axis]) -> DMatrix<f64> {
    let nv = data.model().nv();
    let rows = data.equality_rows();
    let is_axis = |dof: usize| axes.iter().any(|axis| axis.dof == dof);
    let passive: Vec<usize> = (0..nv).filter(|&dof| !is_axis(dof)).collect();
    let entry = |i: usize, dof: usize| data.efc_J()[rows[i] * nv + dof];
    let mut reduction = DMatrix::zeros(nv, axes.len());
    for (k, axis) in axes.iter().enumerate() {
        reduction[(axis.dof, k)] = 1.0;
    }
    if rows.is_empty() || passive.is_empty() {
        return reduction;
    }
    let e_p = DMatrix::from_fn(rows.len(), passive.len(), |i, j| entry(i, passive[j]));
    let e_a = DMatrix::from_fn(rows.len(), axes.len(), |i, k| entry(i, axes[k].dof));
    // the tolerance is positive, so there is a pseudo-inverse
    if let Ok(inverse) = e_p.pseudo_inverse(RANK_TOLERANCE) {
        let follow = -(inverse * e_a);
        for (j, &dof) in passive.iter().enumerate() {
            for k in 0..axes.len() {
                reduction[(dof, k)] = follow[(j, k)];
            }
        }
    }
    reduction
}
