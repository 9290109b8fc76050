//! What sensors measure, in terms of the state.

use super::{Model, ffi};
use ffi::{mjtJoint_, mjtObj_, mjtSensor_};

/// What a sensor measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measures {
    /// a hinge or slide: its index in `qpos`
    Position(usize),
    /// its velocity: index in `qvel`
    Velocity(usize),
    /// the place of a free body: first of three in `qpos`
    FreePosition(usize),
    /// its quaternion: first of four in `qpos`
    FreeQuaternion(usize),
    /// its velocity in the world's frame: first of three in `qvel`
    FreeVelocity(usize),
    /// a force or torque in the frame of a site: the site
    Wrench(usize),
    /// anything else
    Other,
}

impl Model {
    /// What sensor `id` measures; [`Measures::Other`] if there is no such sensor.
    pub fn measures(&self, id: usize) -> Measures {
        let (Some(kind), Some(object)) = (self.sensor_type().get(id), self.sensor_objid().get(id))
        else {
            return Measures::Other;
        };
        let (kind, object) = (*kind as u32, *object as usize);
        match kind {
            mjtSensor_::mjSENS_JOINTPOS => Measures::Position(self.jnt_qposadr()[object] as usize),
            mjtSensor_::mjSENS_JOINTVEL => Measures::Velocity(self.jnt_dofadr()[object] as usize),
            mjtSensor_::mjSENS_FORCE | mjtSensor_::mjSENS_TORQUE => Measures::Wrench(object),
            mjtSensor_::mjSENS_FRAMEPOS
            | mjtSensor_::mjSENS_FRAMEQUAT
            | mjtSensor_::mjSENS_FRAMELINVEL => self.free_frame(id, kind, object),
            _ => Measures::Other,
        }
    }

    /// A frame that coincides with that of a free body.
    fn free_frame(&self, id: usize, kind: u32, object: usize) -> Measures {
        let (body, pos, quat) = match self.sensor_objtype()[id] as u32 {
            mjtObj_::mjOBJ_XBODY => (object, None, None),
            mjtObj_::mjOBJ_BODY => (object, Some(self.body_ipos()), Some(self.body_iquat())),
            mjtObj_::mjOBJ_GEOM => (
                self.geom_bodyid()[object] as usize,
                Some(self.geom_pos()),
                Some(self.geom_quat()),
            ),
            mjtObj_::mjOBJ_SITE => (
                self.site_bodyid()[object] as usize,
                Some(self.site_pos()),
                Some(self.site_quat()),
            ),
            _ => return Measures::Other,
        };
        let Some(joint) = self.free_joint(body) else {
            return Measures::Other;
        };
        let centred = pos.is_none_or(|p| p[3 * object..3 * object + 3] == [0.0; 3]);
        let aligned = quat.is_none_or(|q| q[4 * object..4 * object + 4] == [1.0, 0.0, 0.0, 0.0]);
        let relative = self.sensor_refid()[id] >= 0;
        let (qpos, dof) = (
            self.jnt_qposadr()[joint] as usize,
            self.jnt_dofadr()[joint] as usize,
        );
        match kind {
            _ if relative => Measures::Other,
            mjtSensor_::mjSENS_FRAMEPOS if centred => Measures::FreePosition(qpos),
            mjtSensor_::mjSENS_FRAMEQUAT if aligned => Measures::FreeQuaternion(qpos + 3),
            mjtSensor_::mjSENS_FRAMELINVEL if centred => Measures::FreeVelocity(dof),
            _ => Measures::Other,
        }
    }

    /// The free joint of a body.
    fn free_joint(&self, body: usize) -> Option<usize> {
        let joint = usize::try_from(self.body_jntadr()[body]).ok()?;
        self.is_free(joint).then_some(joint)
    }

    /// Whether joint `id` is a free one.
    pub fn is_free(&self, id: usize) -> bool {
        self.jnt_type()
            .get(id)
            .is_some_and(|t| *t as u32 == mjtJoint_::mjJNT_FREE)
    }

    /// Whether joint `id` has one coordinate, and is a slide rather than a hinge.
    pub fn is_slide(&self, id: usize) -> Option<bool> {
        match *self.jnt_type().get(id)? as u32 {
            mjtJoint_::mjJNT_SLIDE => Some(true),
            mjtJoint_::mjJNT_HINGE => Some(false),
            _ => None,
        }
    }

    /// Joints with one coordinate: hinges and slides.
    pub fn scalar_joints(&self) -> impl Iterator<Item = usize> {
        (0..self.njnt()).filter(|joint| self.is_slide(*joint).is_some())
    }
}
