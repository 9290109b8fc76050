//! What an actuator is, and what it lets through.

use super::{Model, N_PRM};

/// `mjDSBL_CLAMPCTRL`, `mjGAIN_FIXED`, `mjDYN_NONE`, `mjBIAS_NONE` and `mjBIAS_AFFINE` of the engine's model format.
const CLAMP_DISABLED: i32 = 1 << 7;
const FIXED_GAIN: i32 = 0;
const NO_DYNAMICS: i32 = 0;
const NO_BIAS: i32 = 0;
const AFFINE_BIAS: i32 = 1;

impl Model {
    /// Whether an actuator's force is proportional to its control, but for a constant: a fixed gain, no activation.
    pub fn is_motor(&self, actuator: usize) -> bool {
        let bias = &self.actuator_biasprm()[N_PRM * actuator..N_PRM * actuator + 3];
        let constant = match self.actuator_biastype()[actuator] {
            NO_BIAS => true,
            AFFINE_BIAS => bias[1..] == [0.0; 2],
            _ => false,
        };
        self.actuator_gaintype()[actuator] == FIXED_GAIN
            && self.actuator_dyntype()[actuator] == NO_DYNAMICS
            && constant
    }

    /// Least and greatest control that an actuator takes; infinite where nothing limits it.
    pub fn ctrl_limits(&self, actuator: usize) -> [f64; 2] {
        let range = &self.actuator_ctrlrange()[2 * actuator..2 * actuator + 2];
        let clamps = self.option().disable_flags & CLAMP_DISABLED == 0;
        if clamps && self.actuator_ctrllimited()[actuator] != 0 {
            [range[0], range[1]]
        } else {
            [f64::NEG_INFINITY, f64::INFINITY]
        }
    }
}
