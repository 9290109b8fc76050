//! The motion that rollouts make: simulated from starts one behind the other, as recorded before the first.

use super::objective::Objective;
use crate::compare::States;
use crate::mujoco::{Data, Model};
use crate::sysid::SysidError;

/// Positions at all knots of every trial (knots × nq) at free parameters `x`.
pub(super) fn of(objective: &Objective<'_>, x: &[f64]) -> Result<Vec<Vec<f64>>, SysidError> {
    let model = objective.model(x)?;
    let h = model.timestep();
    let mut data = Data::new(model.clone())?;
    let longest = if objective.protocol.to_end {
        f64::INFINITY
    } else {
        objective
            .protocol
            .horizons_s
            .iter()
            .copied()
            .fold(0.0, f64::max)
    };
    let mut all = Vec::new();
    for (i, trial) in objective.problem.trials.iter().enumerate() {
        let (states, starts) = match objective.begin(i, &model, x)? {
            Some(begun) => begun,
            None => (objective.states(i, &model, x)?, Vec::new()),
        };
        let mut starts = starts.iter().peekable();
        let mut until = f64::NEG_INFINITY; // end of the present rollout
        let mut qpos = Vec::with_capacity(trial.n_knots * model.nq());
        for k in 0..trial.n_knots {
            let time = trial.start_s + k as f64 * h;
            if time >= until - 0.5 * h {
                while let Some(start) =
                    starts.next_if(|s| states.time_s[s.sample] <= time + 0.5 * h)
                {
                    let begin = states.time_s[start.sample];
                    if begin >= until - 0.5 * h {
                        until = begin + longest;
                        data.reset();
                        data.set_memory(states.memory(start.sample))?;
                        data.set_time(begin);
                        let row = start.sample * model.nq()..(start.sample + 1) * model.nq();
                        data.qpos_mut().copy_from_slice(&states.qpos[row]);
                        data.qvel_mut().copy_from_slice(&start.qvel);
                    }
                }
            }
            if time < until - 0.5 * h {
                qpos.extend_from_slice(data.qpos());
                states.controls_at(time, data.ctrl_mut());
                data.step()?;
            } else {
                qpos.extend(recorded(&model, &states, time)?);
            }
        }
        all.push(qpos);
    }
    Ok(all)
}

/// Recorded position at a time, between samples by the shortest way.
fn recorded(model: &Model, states: &States, time: f64) -> Result<Vec<f64>, SysidError> {
    let nq = model.nq();
    let after = (states.time_s.partition_point(|t| *t < time)).clamp(1, states.len() - 1);
    let row = |k: usize| &states.qpos[k * nq..(k + 1) * nq];
    let (from, to) = (states.time_s[after - 1], states.time_s[after]);
    let part = ((time - from) / (to - from)).clamp(0.0, 1.0);
    let mut tangent = vec![0.0; model.nv()];
    model.differentiate_pos(&mut tangent, 1.0, row(after - 1), row(after))?;
    let mut qpos = row(after - 1).to_vec();
    model.integrate_pos(&mut qpos, &tangent, part)?;
    Ok(qpos)
}
