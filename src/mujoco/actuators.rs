//! What an actuator is, and what it lets through.

use super::ffi::{mjtBias_, mjtDisableBit_, mjtDyn_, mjtGain_};
use super::{Model, N_PRM};

impl Model {
    /// Whether an actuator's force is proportional to its control, but for a constant: a fixed gain, no activation.
    pub fn is_motor(&self, actuator: usize) -> bool {
        let bias = &self.actuator_biasprm()[N_PRM * actuator..N_PRM * actuator + 3];
        let constant = match self.actuator_biastype()[actuator] as _ {
            mjtBias_::mjBIAS_NONE => true,
            mjtBias_::mjBIAS_AFFINE => bias[1..] == [0.0; 2],
            _ => false,
        };
        self.actuator_gaintype()[actuator] == mjtGain_::mjGAIN_FIXED as i32
            && self.actuator_dyntype()[actuator] == mjtDyn_::mjDYN_NONE as i32
            && constant
    }

    /// Least and greatest control that an actuator takes; infinite where nothing limits it.
    pub fn ctrl_limits(&self, actuator: usize) -> [f64; 2] {
        let range = &self.actuator_ctrlrange()[2 * actuator..2 * actuator + 2];
        let clamps = self.option().disable_flags & mjtDisableBit_::mjDSBL_CLAMPCTRL as i32 == 0;
        if clamps && self.actuator_ctrllimited()[actuator] != 0 {
            [range[0], range[1]]
        } else {
            [f64::NEG_INFINITY, f64::INFINITY]
        }
    }
}
