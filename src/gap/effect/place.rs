//! Where effects act.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::mujoco::{Measures, Model, ObjectKind};
use crate::sysid::reach::Contacts;

/// What a place is a name of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum PlaceKind {
    /// everything
    World,
    /// a hinge or slide
    Joint,
    /// an actuator
    Actuator,
    /// a body
    Body,
    /// a geom
    Geom,
    /// a contact pair
    Pair,
    /// a force or torque sensor
    Sensor,
}

/// One place of a model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// what the name names
    pub kind: PlaceKind,
    /// empty for the world
    pub name: String,
    /// the other joint of a coupling, the other geom of a contact
    pub with: Option<String>,
}

impl Place {
    /// Everything.
    pub fn world() -> Self {
        Self {
            kind: PlaceKind::World,
            name: String::new(),
            with: None,
        }
    }

    /// An element by its name.
    pub fn at(kind: PlaceKind, name: &str) -> Self {
        Self {
            kind,
            name: name.to_owned(),
            with: None,
        }
    }

    /// Its joint: itself, the one an actuator drives.
    pub(super) fn joint(&self, model: &Model) -> Option<usize> {
        let name = match self.kind {
            PlaceKind::Joint => self.name.clone(),
            PlaceKind::Actuator => joint_of(model, self.id(model)?)?,
            _ => return None,
        };
        model.id(ObjectKind::Joint, &name).ok()
    }

    /// Name of its joint.
    pub(in crate::gap) fn joint_name<'a>(&self, model: &'a Model) -> Option<&'a str> {
        model.name(ObjectKind::Joint, self.joint(model)?)
    }

    /// Whether its joint has dry friction.
    pub(in crate::gap) fn is_dry(&self, model: &Model) -> bool {
        self.dry_level(model) > 0.0
    }

    /// Dry friction of its joint, N m or N; 0 of what has none.
    pub(in crate::gap) fn dry_level(&self, model: &Model) -> f64 {
        let friction = |joint: usize| model.dof_frictionloss()[model.jnt_dofadr()[joint] as usize];
        self.joint(model).map_or(0.0, friction)
    }

    /// Its body: itself, that of its joint or geom.
    pub(in crate::gap) fn body(&self, model: &Model) -> Option<usize> {
        match self.kind {
            PlaceKind::Body => self.id(model),
            PlaceKind::Geom => Some(model.geom_bodyid()[self.id(model)?] as usize),
            _ => Some(model.jnt_bodyid()[self.joint(model)?] as usize),
        }
    }

    /// Whether the geoms of a contact are among `touching`; `true` for what is no contact of two geoms.
    pub(in crate::gap) fn may_touch(&self, model: &Model, touching: &Contacts) -> bool {
        let (PlaceKind::Geom, Some(other)) = (self.kind, &self.with) else {
            return true;
        };
        let ids = [&self.name, other].map(|g| model.id(ObjectKind::Geom, g));
        let [Ok(a), Ok(b)] = ids else { return false };
        touching.contains(&[a, b]) || touching.contains(&[b, a])
    }

    /// The unit of a sensor.
    pub(super) fn unit(&self, model: &Model) -> Option<&'static str> {
        model.sensor_unit(self.id(model).filter(|_| self.kind == PlaceKind::Sensor)?)
    }

    fn id(&self, model: &Model) -> Option<usize> {
        model.id(self.kind.object()?, &self.name).ok()
    }
}

impl PlaceKind {
    fn object(self) -> Option<ObjectKind> {
        Some(match self {
            Self::World => return None,
            Self::Joint => ObjectKind::Joint,
            Self::Actuator => ObjectKind::Actuator,
            Self::Body => ObjectKind::Body,
            Self::Geom => ObjectKind::Geom,
            Self::Pair => ObjectKind::Pair,
            Self::Sensor => ObjectKind::Sensor,
        })
    }
}

/// `p0_turret`, `p0_upper+p0_crank` or `world`.
impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.with, self.kind) {
            (_, PlaceKind::World) => f.write_str("world"),
            (Some(other), _) => write!(f, "{}+{other}", self.name),
            (None, _) => f.write_str(&self.name),
        }
    }
}

/// A place of a given model.
#[derive(Debug, Clone, Copy)]
pub struct Site<'a> {
    /// the model without the effect
    pub model: &'a Model,
    /// where
    pub place: &'a Place,
    /// index of the element; 0 for the world
    pub id: usize,
}

impl<'a> Site<'a> {
    /// A place in a model.
    ///
    /// # Errors
    /// There is no such element; the message lists those there are.
    pub fn new(model: &'a Model, place: &'a Place) -> Result<Self, String> {
        let id = match place.kind.object() {
            None => 0,
            Some(kind) => model.id(kind, &place.name).map_err(|e| e.to_string())?,
        };
        Ok(Self { model, place, id })
    }

    /// Degree of freedom of the place's joint.
    pub(super) fn dof(&self) -> Result<usize, String> {
        let joint = self
            .place
            .joint(self.model)
            .ok_or("there is no hinge or slide")?;
        Ok(self.model.jnt_dofadr()[joint] as usize)
    }
}

/// Names of the elements of a kind that `keep` keeps.
fn named(model: &Model, kind: PlaceKind, keep: impl Fn(usize) -> bool) -> Vec<Place> {
    let Some(object) = kind.object() else {
        return Vec::new();
    };
    (0..model.count(object))
        .filter(|id| keep(*id))
        .filter_map(|id| Some(Place::at(kind, model.name(object, id)?)))
        .collect()
}

/// Hinges and slides.
pub(super) fn joints(model: &Model) -> Vec<Place> {
    named(model, PlaceKind::Joint, |j| model.is_slide(j).is_some())
}

/// Hinges and slides that have an encoder: a sensor of position or velocity; all if none has.
pub(super) fn encoders(model: &Model) -> Vec<Place> {
    let measured = |joint: usize| {
        (0..model.nsensor()).any(|s| match model.measures(s) {
            Measures::Position(at) => at == model.jnt_qposadr()[joint] as usize,
            Measures::Velocity(at) => at == model.jnt_dofadr()[joint] as usize,
            _ => false,
        })
    };
    let some = named(model, PlaceKind::Joint, |j| {
        model.is_slide(j).is_some() && measured(j)
    });
    if some.is_empty() { joints(model) } else { some }
}

/// Name of the hinge or slide that an actuator drives.
pub(super) fn joint_of(model: &Model, actuator: usize) -> Option<String> {
    const ON_JOINT: i32 = 0; // `mjTRN_JOINT` of the engine's model format
    if model.actuator_trntype()[actuator] != ON_JOINT {
        return None;
    }
    let joint = usize::try_from(model.actuator_trnid()[2 * actuator]).ok()?;
    model.is_slide(joint)?;
    model.name(ObjectKind::Joint, joint).map(str::to_owned)
}

/// Actuators whose force is proportional to their control, without activation.
pub(super) fn motors(model: &Model) -> Vec<Place> {
    named(model, PlaceKind::Actuator, |u| model.is_motor(u))
}

/// Motors that drive a hinge or slide.
pub(super) fn joint_motors(model: &Model) -> Vec<Place> {
    named(model, PlaceKind::Actuator, |u| {
        model.is_motor(u) && joint_of(model, u).is_some()
    })
}

/// Whether a body moves freely.
pub(super) fn is_free(model: &Model, body: usize) -> bool {
    let joint = usize::try_from(model.body_jntadr()[body]);
    joint.is_ok_and(|joint| model.is_free(joint))
}

/// Moving bodies with a mass, free ones or others.
pub(super) fn bodies(model: &Model, free: bool) -> Vec<Place> {
    named(model, PlaceKind::Body, |b| {
        b > 0
            && model.body_mass()[b] > 0.0
            && model.body_weldid()[b] != 0
            && is_free(model, b) == free
    })
}

/// Bodies that keep `keep`.
pub(super) fn bodies_that(model: &Model, keep: impl Fn(usize) -> bool) -> Vec<Place> {
    named(model, PlaceKind::Body, |b| b > 0 && keep(b))
}

/// Geoms that `keep` keeps.
pub(super) fn geoms(model: &Model, keep: impl Fn(usize) -> bool) -> Vec<Place> {
    named(model, PlaceKind::Geom, keep)
}

/// Whether a geom may touch another: in a pair, or by its masks.
pub(super) fn touches(model: &Model, geom: usize) -> bool {
    let paired = |geoms: &[i32]| geoms.iter().any(|g| *g as usize == geom);
    let masks = model.geom_contype()[geom] != 0 || model.geom_conaffinity()[geom] != 0;
    masks || paired(model.pair_geom1()) || paired(model.pair_geom2())
}

/// Whether a geom belongs to a body that moves.
pub(super) fn moves(model: &Model, geom: usize) -> bool {
    model.body_weldid()[model.geom_bodyid()[geom] as usize] != 0
}

/// Contacts that can be changed: pairs, and geoms that may touch without one.
pub(super) fn contacts(model: &Model) -> Vec<Place> {
    let mut out = named(model, PlaceKind::Pair, |_| true);
    out.extend(super::couple::couples(model));
    out
}

/// Force and torque sensors.
pub(super) fn wrenches(model: &Model) -> Vec<Place> {
    named(model, PlaceKind::Sensor, |s| {
        matches!(model.measures(s), Measures::Wrench(_))
    })
}
