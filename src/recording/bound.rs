//! Which number of the model each channel is, by name.
//!
//! | channel | number of the model |
//! | --- | --- |
//! | `NAME` | the sensor of that name, if it has one number; else the control of the actuator of that name |
//! | `NAME[i]` | component `i` of a sensor of several numbers |
//! | `goal[i]` | component `i` of the target |
//! | `qpos[JOINT]`, `qvel[JOINT]` | position or velocity of a hinge or slide joint |
//! | `qpos[JOINT][i]`, `qvel[JOINT][i]` | component `i` of that of a ball or free joint |
//!
//! A channel of kind `sensor` may be any of these, since tables carry no kinds; one of kind `control` is an actuator's
//! and one of kind `goal` the target's. Channels of kind `other` are left alone.

use super::{Channel, Kind, Recording, RecordingError};
use crate::mujoco::{Model, ObjectKind};

/// A channel and the number it stands for.
#[derive(Debug, Clone, PartialEq)]
pub struct BoundChannel {
    /// index in `Recording::streams`
    pub stream: usize,
    /// index in `Stream::channels`
    pub column: usize,
    /// index in `sensordata`, `ctrl`, the goal, `qpos` or `qvel`
    pub address: usize,
    /// index of the sensor, actuator or joint; 0 for the goal
    pub object: usize,
    /// known standard deviation of the noise
    pub noise_sigma: Option<f64>,
}

/// A channel that stands for nothing in the model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Unbound {
    /// its name
    pub name: String,
    /// what was looked for
    pub reason: String,
}

/// All channels of a recording, by their part in a model.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Bound {
    /// addresses in `sensordata`
    pub sensors: Vec<BoundChannel>,
    /// addresses in `ctrl`
    pub controls: Vec<BoundChannel>,
    /// components of the target
    pub goal: Vec<BoundChannel>,
    /// addresses in `qpos`
    pub qpos: Vec<BoundChannel>,
    /// addresses in `qvel`
    pub qvel: Vec<BoundChannel>,
    /// sensors and controls the model does not have
    pub unbound: Vec<Unbound>,
}

/// An array of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Array {
    Sensordata,
    Ctrl,
    Goal,
    Qpos,
    Qvel,
}

impl Bound {
    /// Look up every channel; each list is in the order of addresses.
    ///
    /// # Errors
    /// Two channels stand for one number.
    pub fn new(recording: &Recording, model: &Model) -> Result<Self, RecordingError> {
        let mut bound = Self::default();
        for (stream, content) in recording.streams.iter().enumerate() {
            for (column, channel) in content.channels.iter().enumerate() {
                if channel.kind == Kind::Other {
                    continue;
                }
                match find(channel, model) {
                    Ok((array, address, object)) => bound.list(array).push(BoundChannel {
                        stream,
                        column,
                        address,
                        object,
                        noise_sigma: channel.noise_sigma,
                    }),
                    Err(reason) => bound.unbound.push(Unbound {
                        name: channel.name.clone(),
                        reason,
                    }),
                }
            }
        }
        for array in [
            Array::Sensordata,
            Array::Ctrl,
            Array::Goal,
            Array::Qpos,
            Array::Qvel,
        ] {
            let list = bound.list(array);
            list.sort_by_key(|b| b.address);
            let twice = list
                .windows(2)
                .find(|pair| pair[0].address == pair[1].address);
            if let Some([a, b]) = twice {
                let name = |b: &BoundChannel| &recording.streams[b.stream].channels[b.column].name;
                return Err(RecordingError::Binding {
                    reason: format!(
                        "channels `{}` and `{}` are the same number of the model",
                        name(a),
                        name(b)
                    ),
                });
            }
        }
        Ok(bound)
    }

    fn list(&mut self, array: Array) -> &mut Vec<BoundChannel> {
        match array {
            Array::Sensordata => &mut self.sensors,
            Array::Ctrl => &mut self.controls,
            Array::Goal => &mut self.goal,
            Array::Qpos => &mut self.qpos,
            Array::Qvel => &mut self.qvel,
        }
    }

    /// Channels whose unit is not that of the number they stand for: stream, column, and the unit it should be. A channel
    /// that names no unit is taken for right.
    pub fn wrong_units(
        &self,
        recording: &Recording,
        model: &Model,
    ) -> Vec<(usize, usize, &'static str)> {
        let of_joint = |joint: usize, hinge, slide| {
            let slides = model.is_slide(joint)?;
            Some(if slides { slide } else { hinge })
        };
        let sensors = self
            .sensors
            .iter()
            .map(|b| (b, model.sensor_unit(b.object)));
        let qpos = self
            .qpos
            .iter()
            .map(|b| (b, of_joint(b.object, "rad", "m")));
        let qvel = (self.qvel.iter()).map(|b| (b, of_joint(b.object, "rad/s", "m/s")));
        (sensors.chain(qpos).chain(qvel))
            .filter_map(|(b, expected)| {
                let unit = &recording.streams[b.stream].channels[b.column].unit;
                let expected = expected?;
                let wrong = !unit.is_empty() && plain_unit(unit) != plain_unit(expected);
                wrong.then_some((b.stream, b.column, expected))
            })
            .collect()
    }

    /// Names of the model's sensors of which some number is not recorded.
    pub fn missing_sensors(&self, model: &Model) -> Vec<String> {
        let recorded = |sensor: &usize| {
            let n = self.sensors.iter().filter(|b| b.object == *sensor).count();
            n == model.sensor_dim()[*sensor] as usize
        };
        let sensors = (0..model.nsensor()).filter(|sensor| !recorded(sensor));
        sensors
            .map(|i| name(model, ObjectKind::Sensor, i))
            .collect()
    }

    /// Names of the model's actuators whose control is not recorded.
    pub fn missing_controls(&self, model: &Model) -> Vec<String> {
        let recorded = |actuator: &usize| self.controls.iter().any(|b| b.object == *actuator);
        let actuators = (0..model.nu()).filter(|actuator| !recorded(actuator));
        actuators
            .map(|i| name(model, ObjectKind::Actuator, i))
            .collect()
    }
}

/// One spelling of a unit: `N·m`, `N*m` and `Nm` are `N m`, `radians` are `rad`.
fn plain_unit(unit: &str) -> String {
    let mut plain: String = unit
        .chars()
        .filter(|c| !matches!(c, ' ' | '*' | '·' | '⋅' | '^'))
        .map(|c| match c {
            '²' => '2',
            '³' => '3',
            c => c,
        })
        .collect();
    if matches!(plain.as_str(), "-" | "") {
        return "1".to_owned();
    }
    for (long, short) in [
        ("radians", "rad"),
        ("radian", "rad"),
        ("meters", "m"),
        ("metres", "m"),
        ("meter", "m"),
        ("metre", "m"),
        ("seconds", "s"),
        ("second", "s"),
    ] {
        plain = plain.replace(long, short);
    }
    plain
}

/// The object's name, or its number.
fn name(model: &Model, kind: ObjectKind, id: usize) -> String {
    let unnamed = || format!("{} {id}", kind.text());
    model.name(kind, id).map_or_else(unnamed, str::to_owned)
}

/// Array, address and object of a channel, or what was looked for.
fn find(channel: &Channel, model: &Model) -> Result<(Array, usize, usize), String> {
    let text = channel.name.as_str();
    let actuator = || {
        let id = model.id(ObjectKind::Actuator, text).ok()?;
        Some((Array::Ctrl, id, id))
    };
    let goal = || match components(text) {
        Some(("goal", i)) => Some((Array::Goal, i, 0)),
        _ => None,
    };
    match channel.kind {
        Kind::Control => actuator().ok_or_else(|| "no actuator of this name".into()),
        Kind::Goal => goal().ok_or_else(|| "expected `goal[i]`".into()),
        Kind::Sensor => {
            if let Some(found) = sensor(text, model).or_else(|| joint(text, model)) {
                return found;
            }
            let found = actuator().or_else(goal);
            found.ok_or_else(|| "no sensor, actuator or joint of this name".into())
        }
        Kind::Other => Err("of kind `other`".into()),
    }
}

type Found = Result<(Array, usize, usize), String>;

/// `NAME` or `NAME[i]`; `None` if no sensor has this name.
fn sensor(text: &str, model: &Model) -> Option<Found> {
    let id = |name: &str| model.id(ObjectKind::Sensor, name).ok();
    let (id, component) = match (id(text), components(text)) {
        (Some(id), _) => (id, None),
        (None, Some((name, i))) => (id(name)?, Some(i)),
        (None, None) => return None,
    };
    let (address, n) = (
        model.sensor_adr()[id] as usize,
        model.sensor_dim()[id] as usize,
    );
    let found = component_of(component, n);
    Some(found.map(|i| (Array::Sensordata, address + i, id)))
}

/// `qpos[JOINT]`, `qvel[JOINT]`, either with `[i]`; `None` for any other name.
fn joint(text: &str, model: &Model) -> Option<Found> {
    let (array, rest) = if let Some(rest) = text.strip_prefix("qpos[") {
        (Array::Qpos, rest)
    } else {
        (Array::Qvel, text.strip_prefix("qvel[")?)
    };
    let (joint, component) = match rest.strip_suffix(']')?.split_once("][") {
        Some((joint, i)) => (joint, Some(i.parse().ok()?)),
        None => (rest.strip_suffix(']')?, None),
    };
    let Ok(id) = model.id(ObjectKind::Joint, joint) else {
        return Some(Err(format!("no joint `{joint}`")));
    };
    let (addresses, size) = if array == Array::Qpos {
        (model.jnt_qposadr(), model.nq())
    } else {
        (model.jnt_dofadr(), model.nv())
    };
    let next = addresses.get(id + 1).map_or(size, |a| *a as usize);
    let address = addresses[id] as usize;
    let found = component_of(component, next - address);
    Some(found.map(|i| (array, address + i, id)))
}

/// The component asked for, of `n`.
fn component_of(component: Option<usize>, n: usize) -> Result<usize, String> {
    match component {
        Some(i) if i < n => Ok(i),
        None if n == 1 => Ok(0),
        _ => Err(format!(
            "it has {n} numbers, [0] to [{}]",
            n.saturating_sub(1)
        )),
    }
}

/// `NAME[i]` in its parts.
fn components(text: &str) -> Option<(&str, usize)> {
    let (name, index) = text.strip_suffix(']')?.rsplit_once('[')?;
    Some((name, index.parse().ok()?))
}
