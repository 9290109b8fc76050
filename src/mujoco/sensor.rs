//! What sensors report, and in which units.

use super::{Model, ffi};
use ffi::{mjtJoint_, mjtSensor_};

impl Model {
    /// SI unit of sensor `id`, `1` for numbers without; `None` where it depends on the model, or there is no such
    /// sensor.
    pub fn sensor_unit(&self, id: usize) -> Option<&'static str> {
        let kind = *self.sensor_type().get(id)? as u32;
        let object = self.sensor_objid().get(id).copied();
        let joint = object.and_then(|i| self.jnt_type().get(usize::try_from(i).ok()?));
        let slides = joint.is_some_and(|j| *j as u32 == mjtJoint_::mjJNT_SLIDE);
        Some(match kind {
            mjtSensor_::mjSENS_TOUCH | mjtSensor_::mjSENS_FORCE => "N",
            mjtSensor_::mjSENS_TORQUE => "N m",
            mjtSensor_::mjSENS_ACCELEROMETER | mjtSensor_::mjSENS_FRAMELINACC => "m/s^2",
            mjtSensor_::mjSENS_VELOCIMETER
            | mjtSensor_::mjSENS_FRAMELINVEL
            | mjtSensor_::mjSENS_SUBTREELINVEL => "m/s",
            mjtSensor_::mjSENS_GYRO
            | mjtSensor_::mjSENS_BALLANGVEL
            | mjtSensor_::mjSENS_FRAMEANGVEL => "rad/s",
            mjtSensor_::mjSENS_FRAMEANGACC => "rad/s^2",
            mjtSensor_::mjSENS_RANGEFINDER
            | mjtSensor_::mjSENS_FRAMEPOS
            | mjtSensor_::mjSENS_SUBTREECOM => "m",
            mjtSensor_::mjSENS_JOINTPOS | mjtSensor_::mjSENS_JOINTLIMITPOS => {
                if slides {
                    "m"
                } else {
                    "rad"
                }
            }
            mjtSensor_::mjSENS_JOINTVEL | mjtSensor_::mjSENS_JOINTLIMITVEL => {
                if slides {
                    "m/s"
                } else {
                    "rad/s"
                }
            }
            mjtSensor_::mjSENS_JOINTLIMITFRC => {
                if slides {
                    "N"
                } else {
                    "N m"
                }
            }
            mjtSensor_::mjSENS_BALLQUAT
            | mjtSensor_::mjSENS_FRAMEQUAT
            | mjtSensor_::mjSENS_FRAMEXAXIS
            | mjtSensor_::mjSENS_FRAMEYAXIS
            | mjtSensor_::mjSENS_FRAMEZAXIS => "1",
            mjtSensor_::mjSENS_CLOCK => "s",
            _ => return None,
        })
    }

    /// The hinge or slide joint whose position or velocity sensor `id` reports as it is; `None` for other sensors.
    pub fn sensed_joint(&self, id: usize) -> Option<(usize, JointReading)> {
        let reading = match *self.sensor_type().get(id)? as u32 {
            mjtSensor_::mjSENS_JOINTPOS => JointReading::Position,
            mjtSensor_::mjSENS_JOINTVEL => JointReading::Velocity,
            _ => return None,
        };
        let joint = usize::try_from(*self.sensor_objid().get(id)?).ok()?;
        Some((joint, reading))
    }
}

/// What a sensor reports of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointReading {
    /// rad or m
    Position,
    /// rad/s or m/s
    Velocity,
}
