//! Fingertips and the object, found in a model: sites whose names end in `tip` on mechanisms with axes, and the free
//! body that a `framepos` sensor looks at.

use nalgebra::{DMatrix, DVector, Vector3};

use crate::mujoco::{Model, MujocoError, ObjectKind};
use crate::rig::RigError;
use crate::rig::estimate::Estimate;

// `mjtSensor`, `mjtJoint`, `mjtObj` of the engine's model format
const FRAME_POSITION: i32 = 23;
const FREE: i32 = 0;
const BODY: i32 = 1;
const FRAME_BODY: i32 = 2;
const SITE: i32 = 6;

/// The free body that the first `framepos` sensor looks at.
pub(in crate::rig) fn object_body(model: &Model) -> Option<usize> {
    (0..model.nsensor())
        .filter(|&s| model.sensor_type()[s] == FRAME_POSITION)
        .filter_map(|s| {
            let id = model.sensor_objid()[s] as usize;
            match model.sensor_objtype()[s] {
                BODY | FRAME_BODY => Some(id),
                SITE => Some(model.site_bodyid()[id] as usize),
                _ => None,
            }
        })
        .find(|&body| {
            model.body_jntnum()[body] == 1
                && model.jnt_type()[model.body_jntadr()[body] as usize] == FREE
        })
}

/// One fingertip in the sensed state.
#[derive(Debug)]
pub(super) struct Tip {
    pub(super) place: Vector3<f64>,
    pub(super) velocity: Vector3<f64>,
    jacobian: DMatrix<f64>, // (3 × axes)
}

impl Tip {
    /// Torques of the axes that make a force at the tip.
    pub(super) fn torque(&self, force: Vector3<f64>) -> DVector<f64> {
        self.jacobian.transpose() * DVector::from_column_slice(force.as_slice())
    }
}

/// The fingertips of a machine and how they lie to the object at the start.
#[derive(Debug, Clone)]
pub(super) struct Hand {
    sites: Vec<usize>,
    /// one a finger: from the object's axis to the tip, in the plane
    pub(super) outwards: Vec<Vector3<f64>>,
    /// distance of a touching tip's centre from the object's axis, m
    pub(super) touching: f64,
    /// where the object starts
    pub(super) object: Vector3<f64>,
    /// half the height of the object, m
    pub(super) half_height: f64,
}

impl Hand {
    /// Find the hand of the machine of `estimate`.
    ///
    /// # Errors
    /// [`RigError::Model`] when tips or object are missing.
    pub(super) fn find(estimate: &mut Estimate) -> Result<Self, RigError> {
        let missing = |what: &str| RigError::Model {
            reason: format!("behaviours with an object need {what}"),
        };
        let model = estimate.data().model_arc().clone();
        let body =
            object_body(&model).ok_or_else(|| missing("a free body with a `framepos` sensor"))?;
        let geom = |body: usize| {
            (model.body_geomnum()[body] > 0).then(|| model.body_geomadr()[body] as usize)
        };
        let size = |geom: usize| &model.geom_size()[3 * geom..3 * geom + 3];
        let object_size = geom(body)
            .map(size)
            .ok_or_else(|| missing("a body with a geom"))?;
        let object = estimate
            .object()
            .ok_or_else(|| missing("a free body with a `framepos` sensor"))?;
        let mut hand = Self {
            sites: Vec::new(),
            outwards: Vec::new(),
            touching: 0.0,
            object: Vector3::from(object),
            half_height: object_size[1],
        };
        for site in 0..model.nsite() {
            let owner = model.site_bodyid()[site] as usize;
            let root = model.body_rootid()[owner];
            let is_tip = model
                .name(ObjectKind::Site, site)
                .is_some_and(|name| name.ends_with("tip"));
            let has_axis = estimate
                .axes()
                .iter()
                .any(|axis| model.body_rootid()[model.jnt_bodyid()[axis.joint] as usize] == root);
            if !(is_tip && has_axis) {
                continue;
            }
            let (place, _) = estimate.site(site)?;
            let mut outwards = Vector3::from(place) - hand.object;
            outwards.z = 0.0;
            hand.sites.push(site);
            hand.outwards.push(outwards.normalize());
            let tip_radius = geom(owner).map_or(0.0, |g| size(g)[0]);
            hand.touching = object_size[0] + tip_radius;
        }
        if hand.sites.is_empty() {
            return Err(missing("sites whose names end in `tip`"));
        }
        Ok(hand)
    }

    /// Number of fingers.
    pub(super) fn len(&self) -> usize {
        self.sites.len()
    }

    /// Finger `i` as sensed.
    pub(super) fn tip(&self, i: usize, estimate: &mut Estimate) -> Result<Tip, MujocoError> {
        let (place, jacobian) = estimate.site(self.sites[i])?;
        let velocity = &jacobian * estimate.velocity();
        Ok(Tip {
            place: Vector3::from(place),
            velocity: Vector3::new(velocity[0], velocity[1], velocity[2]),
            jacobian,
        })
    }
}
