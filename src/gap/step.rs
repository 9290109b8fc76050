//! What the model's own step makes of the numbers that are estimated in it.
//!
//! A machine moves on in no steps; a model in steps of h is off by about a constant times h, and its numbers are fitted
//! so as to make up for that. No residual tells: the error is the same in every window. It is measured by simulating the
//! windows once more in half the step,
//!
//! ```text
//! dx = −2 (J̃ᵀJ̃ + P)⁻¹ J̃ᵀ (r(h/2) − r(h))
//! ```
//!
//! twice, as half the error is gone in half the step (Richardson 1911). Without steps numbers would be about x + dx, give or take |dx|:
//! intervals span that and x. With r + 2 (r(h/2) − r(h)) for r, and dx fitted to it, the cost is what it would be without steps.

use nalgebra::DVector;

use super::coarse::Paced;
use super::fit::{gradient, information, solved};
use super::linear::Linear;
use super::score::Normal;
use super::windows::Windows;
use crate::sysid::SysidError;
use crate::sysid::parameter::Parameters;
use crate::sysid::shooting::simulate::Pool;

/// 2 (r(h/2) − r(h)) of every window of a linearisation, weighed as its rows.
pub(super) struct WithoutSteps<'l> {
    linear: &'l Linear,
    pub changes: Vec<DVector<f64>>,
}

impl Windows {
    /// The windows of `linear`, which is at `x`, without steps. `None` where half the step breaks down.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn without_steps<'l>(
        &self,
        x: &[f64],
        linear: &'l Linear,
    ) -> Result<Option<WithoutSteps<'l>>, SysidError> {
        let held = self.held(&self.problem, x);
        let at = (&held, &linear.windows[..], &linear.placed[..]);
        let whole = Paced::new(at, &linear.all(), 1.0)?;
        let fine = Paced::new(at, &linear.all(), 0.5)?;
        let simulate = |paced: &Paced| {
            let pool = Pool::default();
            let point = paced.point(&[], &self.states, &[], &pool);
            point.simulate()
        };
        let (before, after) = (simulate(&whole)?, simulate(&fine)?);
        let mut changes = Vec::with_capacity(linear.rows.len());
        for (w, row) in linear.rows.iter().enumerate() {
            let (Some(before), Some(after)) = (&before[w], &after[w]) else {
                return Ok(None);
            };
            let each = whole.samples(w, before).zip(fine.samples(w, after));
            let change = (each.zip(&row.factor)).map(|((z, half), f)| 2.0 * f * (half - z));
            changes.push(DVector::from_iterator(row.residual.len(), change));
        }
        Ok(Some(WithoutSteps { linear, changes }))
    }
}

impl WithoutSteps<'_> {
    /// dx of every free parameter from the step of the model; `normal` is of the same linearisation.
    pub(super) fn error(&self, normal: &Normal) -> DVector<f64> {
        let rows = &self.linear.rows;
        let np = rows.first().map_or(0, |row| row.parameters.ncols());
        // J̃ has nothing of what first states do
        normal.solve(&-gradient(rows, &self.changes, np))
    }

    /// What the cost is more than with steps, `parameters` at `x` but those `at_rest` and first states fitted to that: two
    /// models are told apart by it where steps of h do what one of them is about, as a drive that is late.
    pub(super) fn cost(&self, parameters: &Parameters, x: &[f64], at_rest: &[usize]) -> f64 {
        let normal = information(&self.linear.rows, x.len());
        let rows = || self.linear.rows.iter();
        let with = rows().map(|row| row.residual.clone());
        let without = (rows().zip(&self.changes))
            .map(|(row, change)| &row.residual + change - &row.basis * row.basis.tr_mul(change));
        // a fit that could go on would otherwise go on for one of them
        let least = |residuals: Vec<DVector<f64>>| {
            let right = -gradient(&self.linear.rows, &residuals, x.len());
            let (dx, to) = solved(parameters, x, &normal, right, at_rest);
            let squares = (rows().zip(residuals))
                .map(|(row, residual)| (residual + &row.parameters * &dx).norm_squared());
            0.5 * squares.sum::<f64>() + parameters.prior_cost(&to)
        };
        least(without.collect()) - least(with.collect())
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mujoco::{Data, Model};
    use crate::recording::{Channel, Kind, Meta, Recording, Stream};
    use crate::sysid::problem::{Problem, ProblemConfig};

    /// A driven pendulum; `STEP` stands for its step, s.
    const MACHINE: &str = r#"<mujoco>
      <compiler angle="radian"/>
      <option timestep="STEP"/>
      <worldbody>
        <body>
          <inertial pos="0 0 -0.3" mass="0.4" diaginertia="0.004 0.004 0.004"/>
          <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.01"/>
        </body>
      </worldbody>
      <actuator><motor name="drive" joint="hinge"/></actuator>
      <sensor><jointpos name="angle" joint="hinge"/></sensor>
    </mujoco>"#;

    pub(in crate::gap) fn model(step_s: &str) -> Arc<Model> {
        let xml = MACHINE.replace("STEP", step_s);
        Arc::new(Model::from_xml_text(&xml, "machine.xml").expect("a model"))
    }

    const STEP_S: f64 = 0.004;

    /// What a machine does that moves in `inner` steps to 4 ms.
    pub(in crate::gap) fn driven(machine: &Arc<Model>, inner: usize) -> Recording {
        let mut data = Data::new(Arc::clone(machine)).expect("data");
        let channel = |name: &str, kind, unit: &str, noise_sigma| Channel {
            name: name.into(),
            kind,
            unit: unit.into(),
            noise_sigma,
        };
        let channels = vec![
            channel("angle", Kind::Sensor, "rad", Some(1e-5)),
            channel("drive", Kind::Control, "N m", None),
        ];
        let mut stream = Stream::new("all", Some(STEP_S.recip()), channels);
        for k in 0..500 {
            let t = f64::from(k) * STEP_S;
            let torque = 0.6 * (4.0 * t).sin() + 0.3 * (11.0 * t).sin();
            stream.push((t * 1e9) as i64, &[data.qpos()[0], torque]);
            data.ctrl_mut()[0] = torque;
            for _ in 0..inner {
                data.step().expect("a step");
            }
        }
        Recording {
            meta: Meta::default(),
            streams: vec![stream],
        }
    }

    /// Cost without steps of 4 ms less that with them, of a machine that moves in `inner` of them.
    fn cost_of_steps(machine: &Arc<Model>, inner: usize, command: &str) -> f64 {
        let recording = driven(machine, inner);
        let config: ProblemConfig =
            toml::from_str(&format!("command = \"{command}\"")).expect("a configuration");
        let all = [("one".to_owned(), recording)];
        let problem = Problem::new(model("0.004"), &config, &all).expect("a problem");
        let mut windows = Windows::cut(&problem, &[], 0.4, 100).expect("windows");
        windows.fit(&[], 20, &mut |_| true).expect("a fit");
        let linear = windows.linearise(&[]).expect("simulations");
        let without = windows.without_steps(&[], &linear).expect("simulations");
        let without = without.expect("that half the step does not break");
        without.cost(&windows.problem.parameters, &[], &[])
    }

    #[test]
    fn steps_cost_a_machine_that_moves_in_none() {
        assert!(cost_of_steps(&model("0.0001"), 40, "centred") < 0.0);
    }

    #[test]
    fn none_cost_a_machine_that_moves_in_steps() {
        assert!(cost_of_steps(&model("0.004"), 1, "held") > 0.0);
    }
}
