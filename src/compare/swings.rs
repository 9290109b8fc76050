//! Where recorded readings show motors in their play.
//!
//! Where the motion is filtered afterwards no rattling is left of it: a motor that rattles is in the middle of its play then, and how far it
//! goes is a property of the recording, the median over its samples, as a model that changes its mind where it begins or ends
//! jumps.

use super::samples::Samples;
use crate::mujoco::{Model, Swing};
use crate::supplement::swing;

/// At each sample (joint, swing).
pub(super) struct Swings(Vec<Vec<(usize, Swing)>>);

impl Swings {
    /// Of readings `qpos` (n × nq) at `time_s` of the joints in `measured` (addresses in `qpos`), which are `filtered` afterwards or not.
    pub(super) fn of(
        model: &Model,
        (time_s, qpos): (&[f64], &[f64]),
        measured: &[usize],
        filtered: bool,
    ) -> Self {
        let mut rows = vec![Vec::new(); time_s.len()];
        for joint in model.followed_joints() {
            let address = model.jnt_qposadr()[joint] as usize;
            if !measured.contains(&address) {
                continue;
            }
            let readings = Samples {
                time_s: time_s.to_vec(),
                values: qpos
                    .chunks_exact(model.nq())
                    .map(|row| row[address])
                    .collect(),
            };
            let (first, last) = (time_s[0], time_s[time_s.len() - 1]);
            let at = |now: &f64| swing(|off_s| readings.at((now + off_s).clamp(first, last)));
            let mut own: Vec<Swing> = time_s.iter().map(at).collect();
            if filtered {
                let mut ranges: Vec<f64> = own.iter().map(|s| s.range).collect();
                ranges.sort_by(f64::total_cmp);
                own.fill(Swing {
                    offset: None,
                    range: ranges[ranges.len() / 2],
                });
            }
            for (row, swing) in rows.iter_mut().zip(own) {
                row.push((joint, swing));
            }
        }
        Self(rows)
    }

    /// At a sample.
    pub(super) fn at(&self, sample: usize) -> impl Iterator<Item = (usize, Swing)> + '_ {
        self.0[sample].iter().copied()
    }
}
