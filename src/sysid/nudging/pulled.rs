//! What pulls do along a simulation: the forces that its model lacks.

use super::course::Course;
use crate::mujoco::{Contact, Data};
use crate::sysid::SysidError;
use crate::sysid::shooting::simulate::Simulator;

/// One trial, knot by knot.
#[derive(Debug, Clone, Default)]
pub(crate) struct Pulled {
    /// (knots × nv) of the pulls
    pub force: Vec<f64>,
    /// (knots × nv) of the motors, in the step before
    pub motor: Vec<f64>,
    /// (knots × nq)
    pub qpos: Vec<f64>,
    /// (knots × nv)
    pub qvel: Vec<f64>,
    /// geoms that touched in the step before
    pub touching: Vec<Vec<usize>>,
}

impl Course<'_> {
    /// All trials at parameters `x`; `None` where one diverges.
    ///
    /// # Errors
    /// A number the engine refuses.
    pub(crate) fn pulled(&self, x: &[f64]) -> Result<Option<Vec<Pulled>>, SysidError> {
        let problem = self.problem;
        let free = problem.free_values(x);
        let timing = self.timings.at(problem, &self.windows, x);
        let mut out = Vec::new();
        for ((window, pull), controls) in
            (self.windows.iter().zip(self.pulls.iter())).zip(&timing.controls)
        {
            let first = pull.first(problem, &free)?;
            let mut pulled = Pulled::default();
            let simulated = Simulator::with(problem, &self.pool, x, |simulator| {
                let push = &mut |knot: usize, data: &mut Data| {
                    pull.apply(knot, &free, data);
                    pulled.force.extend_from_slice(data.qfrc_applied());
                    pulled.motor.extend_from_slice(data.qfrc_actuator());
                    pulled.qpos.extend_from_slice(data.qpos());
                    pulled.qvel.extend_from_slice(data.qvel());
                    let geoms = data.contacts().iter().flat_map(Contact::geoms);
                    pulled.touching.push(geoms.collect());
                };
                simulator.run_with(window, &first, controls, push)
            })?;
            if simulated.is_none() {
                return Ok(None);
            }
            out.push(pulled);
        }
        Ok(Some(out))
    }
}
