//! What the machine's sensors make of the true state.
//!
//! | stream | rate | channels |
//! | --- | --- | --- |
//! | `joints` | the control rate | encoder positions and velocities of the motorised joints |
//! | `commands` | the control rate | controls |
//! | `force` | `force_hz` | force and torque sensors |
//! | `mocap` | `mocap_hz`, on its own clock | `framepos` and `framequat` sensors |
//! | `goal` | a twentieth of the control rate | where the task wants the object |
//!
//! Channels are named after the model's sensors and actuators. The noise comes from streams of [`crate::rng`]:
//! the engine's own noise has no seed.

pub(super) mod encoder;
pub(super) mod force;
pub(super) mod mocap;

use encoder::Encoder;
use force::ForceSensors;
use mocap::Mocap;

use super::axes::Axis;
use super::config::SensingConfig;
use super::effects::drive::EARLY;
use super::effects::transmission::Transmission;
use super::effects::{Bound, Effect};
use super::truth::TrueParameter;
use super::{Rig, RigError, Trial};
use crate::mujoco::{Data, Model, ObjectKind};
use crate::recording::{Channel, Kind, Stream};
use crate::rng::{self, Purpose};

// `mjtSensor` of the engine's model format
const FORCE: i32 = 4;
const TORQUE: i32 = 5;
const JOINT_POSITION: i32 = 8;
const JOINT_VELOCITY: i32 = 9;
const FRAME_POSITION: i32 = 23;
const FRAME_QUATERNION: i32 = 24;

/// Control steps between two samples of the goal.
const GOAL_EVERY: u64 = 20;

/// Whether a sensor of this type is part of a force/torque sensor.
pub(super) fn is_force(sensor_type: i32) -> bool {
    matches!(sensor_type, FORCE | TORQUE)
}

/// The sensors of one type, as (id, address and length in `sensordata`).
fn of_type(model: &Model, types: [i32; 2]) -> Vec<(usize, std::ops::Range<usize>)> {
    (0..model.nsensor())
        .filter(|&s| types.contains(&model.sensor_type()[s]))
        .map(|s| {
            let start = model.sensor_adr()[s] as usize;
            (s, start..start + model.sensor_dim()[s] as usize)
        })
        .collect()
}

/// Channels of the components of a sensor.
fn components(
    model: &Model,
    sensor: usize,
    n: usize,
    unit: &str,
    sigma: f64,
) -> impl Iterator<Item = Channel> {
    let name = model
        .name(ObjectKind::Sensor, sensor)
        .map_or_else(|| format!("sensor{sensor}"), str::to_owned);
    let unit = unit.to_owned();
    (0..n).map(move |i| channel(&format!("{name}[{i}]"), Kind::Sensor, &unit, sigma))
}

/// A channel whose noise is known unless it is 0.
fn channel(name: &str, kind: Kind, unit: &str, sigma: f64) -> Channel {
    Channel {
        name: name.to_owned(),
        kind,
        unit: unit.to_owned(),
        noise_sigma: (sigma > 0.0).then_some(sigma),
    }
}

/// Stamp of a time, ns.
fn stamp(time_s: f64) -> i64 {
    (time_s * 1e9).round() as i64
}

/// All sensors of one machine in one trial.
#[derive(Debug)]
pub(super) struct Sensors {
    encoders: Vec<Encoder>,
    recorded: [Vec<usize>; 2], // encoders in columns of `joints`: positions, then velocities
    joints: Stream,
    commands: Stream,
    goal: Option<Stream>,
    mocap: Mocap,
    force: ForceSensors,
    command_step: f64,
    row: Vec<f64>,
}

/// Calibration errors of one machine, the same in all its trials.
#[derive(Debug, Clone)]
pub(super) struct Calibration {
    encoder_bias: Vec<f64>,  // rad, one an axis
    encoder_scale: Vec<f64>, // one an axis
    encoder_delay_s: f64,
    mocap: mocap::Calibration,
    force_bias: Vec<f64>, // N or N m, one a component
}

impl Calibration {
    /// Draw the errors of the machine `seed`, effects included.
    pub(super) fn draw(
        model: &Model,
        axes: &[Axis],
        config: &SensingConfig,
        effects: &[Bound],
        seed: u64,
    ) -> Self {
        let mut rng = rng::stream(seed, Purpose::Rig, 0, 1);
        let mut encoder_bias: Vec<f64> = axes
            .iter()
            .map(|_| config.encoder_bias_sigma_rad * rng::normal(&mut rng))
            .collect();
        let mocap = mocap::Calibration::draw(model, config, &mut rng);
        let mut force_bias = force::draw_bias(model, config, &mut rng);
        let mut encoder_scale = vec![1.0; axes.len()];
        let mut encoder_delay_s = 0.0;
        for bound in effects {
            let amount = bound.values[0];
            match bound.effect {
                Effect::SensorDelay => encoder_delay_s += amount,
                Effect::ForceSensorBias => {
                    force::add_bias(model, &bound.elements, amount, &mut force_bias);
                }
                Effect::EncoderOffset | Effect::EncoderScale => {
                    for (k, axis) in axes.iter().enumerate() {
                        if !bound.elements.contains(&axis.joint) {
                            continue;
                        }
                        match bound.effect {
                            Effect::EncoderOffset => encoder_bias[k] += amount,
                            _ => encoder_scale[k] *= 1.0 + amount,
                        }
                    }
                }
                _ => {}
            }
        }
        Self {
            encoder_bias,
            encoder_scale,
            encoder_delay_s,
            mocap,
            force_bias,
        }
    }

    /// The errors as rows of the truth.
    pub(super) fn rows(&self, model: &Model, axes: &[Axis]) -> Vec<TrueParameter> {
        let mut rows = Vec::new();
        let mut push = |element: String, attribute: &str, nominal: f64, value: f64, unit: &str| {
            if value != nominal {
                rows.push(TrueParameter {
                    element,
                    attribute: attribute.to_owned(),
                    nominal,
                    value,
                    unit: unit.to_owned(),
                });
            }
        };
        for (k, axis) in axes.iter().enumerate() {
            let joint = || super::truth::element(model, ObjectKind::Joint, axis.joint);
            push(joint(), "encoder_bias", 0.0, self.encoder_bias[k], "rad");
            push(joint(), "encoder_scale", 1.0, self.encoder_scale[k], "1");
        }
        push(
            "encoders".to_owned(),
            "delay",
            0.0,
            self.encoder_delay_s,
            "s",
        );
        for (component, bias) in force::channels(model, 0.0, 0.0)
            .iter()
            .zip(&self.force_bias)
        {
            push(
                format!("sensor/{}", component.name),
                "bias",
                0.0,
                *bias,
                &component.unit,
            );
        }
        for (component, bias) in mocap::channels(model, 0.0).iter().zip(&self.mocap.bias) {
            push(
                format!("sensor/{}", component.name),
                "bias",
                0.0,
                *bias,
                &component.unit,
            );
        }
        push(
            "mocap".to_owned(),
            "clock_offset",
            0.0,
            self.mocap.clock_offset_s,
            "s",
        );
        push(
            "mocap".to_owned(),
            "clock_rate",
            1.0,
            self.mocap.clock_rate,
            "1",
        );
        push("mocap".to_owned(), "phase", 0.0, self.mocap.phase, "1");
        rows
    }
}

impl Sensors {
    /// The sensors of `rig` in one trial.
    ///
    /// # Errors
    /// When a rate does not fit the control rate.
    pub(super) fn new(rig: &Rig, with_goal: bool, trial: &Trial) -> Result<Self, RigError> {
        let (model, axes, rate_hz) = (rig.model(), &rig.axes, rig.rate_hz);
        let (sensing, calibration) = (&rig.config.sensing, &rig.calibration);
        let noise = |index| rng::stream(rig.seed, Purpose::SensorNoise, trial.stream(), index);
        // what shows later shows what Euler's steps have early later too
        let early_s = match calibration.encoder_delay_s {
            0.0 => 0.0,
            _ => EARLY * rig.truth_model.timestep(),
        };
        let encoders: Vec<Encoder> = (0..axes.len())
            .map(|k| {
                Encoder::new(
                    sensing,
                    rate_hz,
                    calibration.encoder_bias[k],
                    calibration.encoder_scale[k],
                    calibration.encoder_delay_s + early_s,
                )
            })
            .collect();
        let mut recorded = [Vec::new(), Vec::new()];
        let mut channels = Vec::new();
        let sigmas = [
            encoder::position_sigma(sensing),
            encoder::velocity_sigma(sensing, rate_hz),
        ];
        for (i, sensor_type) in [JOINT_POSITION, JOINT_VELOCITY].into_iter().enumerate() {
            for (sensor, _) in of_type(model, [sensor_type; 2]) {
                let joint = model.sensor_objid()[sensor] as usize;
                let Some(k) = axes.iter().position(|axis| axis.joint == joint) else {
                    continue; // a joint without a motor has no encoder
                };
                let name = model.name(ObjectKind::Sensor, sensor).unwrap_or_default();
                let unit = ["rad", "rad/s"][i];
                channels.push(channel(name, Kind::Sensor, unit, sigmas[i]));
                recorded[i].push(k);
            }
        }
        let controls = (0..model.nu())
            .map(|u| {
                let name = model.name(ObjectKind::Actuator, u);
                let name = name.map_or_else(|| format!("actuator{u}"), str::to_owned);
                channel(&name, Kind::Control, "N m", 0.0)
            })
            .collect();
        let goal = (0..3)
            .map(|i| channel(&format!("goal[{i}]"), Kind::Goal, "m", 0.0))
            .collect();
        Ok(Self {
            encoders,
            recorded,
            joints: Stream::new("joints", Some(rate_hz), channels),
            commands: Stream::new("commands", Some(rate_hz), controls),
            goal: with_goal.then(|| Stream::new("goal", Some(rate_hz / GOAL_EVERY as f64), goal)),
            mocap: Mocap::new(model, sensing, &calibration.mocap, noise(0)),
            force: ForceSensors::new(model, sensing, &calibration.force_bias, rate_hz, noise(1))?,
            command_step: sensing.command_step,
            row: Vec::new(),
        })
    }

    /// Read the encoders: positions and velocities of the axes, as the controller gets them.
    pub(super) fn read_encoders(
        &mut self,
        axes: &[Axis],
        data: &Data,
        transmissions: &[Transmission],
        position: &mut [f64],
        velocity: &mut [f64],
    ) {
        for (k, (axis, encoder)) in axes.iter().zip(&mut self.encoders).enumerate() {
            // the encoder sits on the motor
            let motor = transmissions.iter().find(|t| t.dof == axis.dof);
            let [angle, speed] = motor.map_or_else(
                || data.encoder(axis.joint),
                |motor| [motor.angle, motor.speed],
            );
            (position[k], velocity[k]) = encoder.read(angle, speed);
        }
    }

    /// The control as the converter gives it.
    pub(super) fn quantise(&self, ctrl: &mut [f64]) {
        if self.command_step > 0.0 {
            for u in ctrl {
                *u = (*u / self.command_step).round() * self.command_step;
            }
        }
    }

    /// Record what control step `tick` measured and commanded.
    pub(super) fn record(
        &mut self,
        tick: u64,
        time_s: f64,
        [position, velocity, ctrl]: [&[f64]; 3],
        goal: Option<[f64; 3]>,
    ) {
        let at = stamp(time_s);
        self.row.clear();
        self.row
            .extend(self.recorded[0].iter().map(|&k| position[k]));
        self.row
            .extend(self.recorded[1].iter().map(|&k| velocity[k]));
        self.joints.push(at, &self.row);
        self.commands.push(at, ctrl);
        if let (Some(stream), Some(goal), true) =
            (&mut self.goal, goal, tick.is_multiple_of(GOAL_EVERY))
        {
            stream.push(at, &goal);
        }
    }

    /// Look at the engine's sensors after the inner step that began at `time_s`, the first of control step `tick` if
    /// there is a tick.
    pub(super) fn observe(&mut self, time_s: f64, data: &Data, tick: Option<u64>) {
        self.mocap.observe(time_s, data.sensordata());
        if let Some(tick) = tick {
            self.force.sample(tick, time_s, data.sensordata());
        }
    }

    /// The last place of the body that motion capture saw, m.
    pub(super) fn last_place(&self) -> Option<[f64; 3]> {
        self.mocap.last_place()
    }

    /// The streams, those without channels left out.
    pub(super) fn into_streams(self) -> Vec<Stream> {
        let mut streams = vec![
            self.joints,
            self.commands,
            self.force.into_stream(),
            self.mocap.into_stream(),
        ];
        streams.extend(self.goal);
        streams.retain(|stream| !stream.channels.is_empty());
        streams
    }
}
