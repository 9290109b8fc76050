//! Windows that meet the limits of the model's joints.
//!
//! What a limit throws back goes on from where it met it. Where the motor shakes besides, on a soft drive, readings do not say when
//! that is: the base model is lost in such a window, or another is, by hundreds of times what all others cost,
//!
//! ```text
//! c_w > 3 median c
//! ```
//!
//! and what these say of an effect is not heard. Windows that meet a limit are left out if the base model is lost in one of them and
//! they are few. Where they are many, limits are what the recordings are of.

use statrs::statistics::{Data, OrderStatistics};

use super::windows::Windows;
use crate::mujoco::Model;

/// Cost of a window, in median ones, from which on the model is lost in it.
const LOST: f64 = 3.0;
/// Part of the windows that are few.
const FEW: f64 = 0.1;

impl Windows {
    /// The windows that meet no limit, if some meet one and are to be left out; `each` is the cost of every window, at whose
    /// trajectories the model is.
    pub(super) fn off_limits(&self, each: &[f64]) -> Option<Vec<usize>> {
        let model = &self.problem.model;
        let limits = limits(model);
        let meets = |w: &usize| {
            let mut knots = self.trajectories[*w].chunks(model.nq());
            knots.any(|qpos| limits.iter().any(|limit| limit.is_met(qpos)))
        };
        let (met, others): (Vec<usize>, Vec<usize>) = self.all().into_iter().partition(meets);
        let much = LOST * Data::new(each.to_vec()).median();
        let is_lost = met.iter().any(|&w| each[w] > much);
        (is_lost && met.len() as f64 <= FEW * self.len() as f64).then_some(others)
    }
}

/// Of a hinge or slide.
struct Limit {
    /// address in `qpos`
    at: usize,
    low: f64,
    high: f64,
}

impl Limit {
    fn is_met(&self, qpos: &[f64]) -> bool {
        qpos[self.at] <= self.low || qpos[self.at] >= self.high
    }
}

/// Of all hinges and slides that have one.
fn limits(model: &Model) -> Vec<Limit> {
    let limited = |j: &usize| model.jnt_limited()[*j] != 0 && model.is_slide(*j).is_some();
    let range = model.jnt_range();
    (0..model.njnt())
        .filter(limited)
        .map(|j| Limit {
            at: model.jnt_qposadr()[j] as usize,
            low: range[2 * j],
            high: range[2 * j + 1],
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::masses::{machine, searching};

    /// Two masses, one of which has limits, met in some windows.
    #[test]
    fn windows_at_limits_are_left_out_where_few_and_lost() {
        let base = machine(r#"limited="true" range="-3 3""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &base, config, |search, _| {
            let off = |met: &[usize], lost: &[usize]| {
                let mut windows = search.windows.clone();
                let mut each = vec![1.0; windows.len()];
                for &w in met {
                    windows.trajectories[w][2] = 3.001;
                }
                for &w in lost {
                    each[w] = 10.0;
                }
                windows.off_limits(&each)
            };
            let n = search.windows.len();
            assert!(n >= 20, "{n}");
            let others: Vec<usize> = (0..n).filter(|w| ![2, 5].contains(w)).collect();
            // with one that the model follows
            assert_eq!(off(&[2, 5], &[5]), Some(others));
            // none is lost, or one that meets nothing
            assert_eq!(off(&[2, 5], &[]), None);
            assert_eq!(off(&[2], &[5]), None);
            let many: Vec<usize> = (0..n / 5).collect();
            assert_eq!(off(&many, &[1]), None);
        });
    }
}
