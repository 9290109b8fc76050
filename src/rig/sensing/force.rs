//! Force and torque sensors: noise, bias, and a drift that is a random walk.

use super::{FORCE, TORQUE, components, of_type, stamp};
use crate::mujoco::Model;
use crate::recording::{Channel, Stream};
use crate::rig::RigError;
use crate::rig::config::{SensingConfig, setting};
use crate::rng::{self, Stream as Rng};

/// Channels of all components, forces and torques in the model's order.
pub(super) fn channels(model: &Model, force_sigma: f64, torque_sigma: f64) -> Vec<Channel> {
    of_type(model, [FORCE, TORQUE])
        .into_iter()
        .flat_map(|(sensor, at)| match model.sensor_type()[sensor] {
            FORCE => components(model, sensor, at.len(), "N", force_sigma),
            _ => components(model, sensor, at.len(), "N m", torque_sigma),
        })
        .collect()
}

/// One number a component: `force` for forces, `torque` for torques.
fn spread(model: &Model, force: f64, torque: f64) -> Vec<f64> {
    let units = channels(model, 0.0, 0.0).into_iter();
    units
        .map(|c| if c.unit == "N" { force } else { torque })
        .collect()
}

/// Calibration errors of all components.
pub(super) fn draw_bias(model: &Model, config: &SensingConfig, rng: &mut Rng) -> Vec<f64> {
    spread(
        model,
        config.force_bias_sigma_n,
        config.torque_bias_sigma_nm,
    )
    .iter()
    .map(|sigma| sigma * rng::normal(rng))
    .collect()
}

/// Add `amount` to the components of `sensors`, which are indices among all sensors.
pub(super) fn add_bias(model: &Model, sensors: &[usize], amount: f64, bias: &mut [f64]) {
    let mut column = 0;
    for (sensor, at) in of_type(model, [FORCE, TORQUE]) {
        for _ in at {
            if sensors.contains(&sensor) {
                bias[column] += amount;
            }
            column += 1;
        }
    }
}

/// All force and torque sensors.
#[derive(Debug)]
pub(super) struct ForceSensors {
    addresses: Vec<usize>,
    error: Vec<f64>,  // bias and drift
    sigma: Vec<f64>,  // of each sample
    wander: Vec<f64>, // of the drift from one sample to the next
    every: u64,
    stream: Stream,
    rng: Rng,
    row: Vec<f64>,
}

impl ForceSensors {
    /// # Errors
    /// When the rate is no whole part of `rate_hz`.
    pub(super) fn new(
        model: &Model,
        config: &SensingConfig,
        bias: &[f64],
        rate_hz: f64,
        rng: Rng,
    ) -> Result<Self, RigError> {
        let wanted = if config.force_hz > 0.0 {
            config.force_hz
        } else {
            rate_hz
        };
        let every = (rate_hz / wanted).round();
        if every < 1.0 || (every * wanted / rate_hz - 1.0).abs() > 1e-9 {
            return Err(setting(
                "sensing.force_hz",
                wanted,
                "a whole part of the control rate",
            ));
        }
        let (force, torque) = (config.force_sigma_n, config.torque_sigma_nm);
        let step = (1.0 / wanted).sqrt();
        Ok(Self {
            addresses: of_type(model, [FORCE, TORQUE])
                .into_iter()
                .flat_map(|(_, at)| at)
                .collect(),
            error: bias.to_vec(),
            sigma: spread(model, force, torque),
            wander: spread(
                model,
                config.force_drift_sigma_n * step,
                config.torque_drift_sigma_nm * step,
            ),
            every: every as u64,
            stream: Stream::new("force", Some(wanted), channels(model, force, torque)),
            rng,
            row: Vec::new(),
        })
    }

    pub(super) fn sample(&mut self, tick: u64, time_s: f64, sensordata: &[f64]) {
        if self.addresses.is_empty() || !tick.is_multiple_of(self.every) {
            return;
        }
        self.row.clear();
        for (i, &address) in self.addresses.iter().enumerate() {
            let error = noise(self.sigma[i], &mut self.rng);
            self.row.push(sensordata[address] + self.error[i] + error);
            self.error[i] += noise(self.wander[i], &mut self.rng);
        }
        self.stream.push(stamp(time_s), &self.row);
    }

    pub(super) fn into_stream(self) -> Stream {
        self.stream
    }
}

/// Gaussian noise; none drawn for an exact sensor.
fn noise(sigma: f64, rng: &mut Rng) -> f64 {
    if sigma > 0.0 {
        sigma * rng::normal(rng)
    } else {
        0.0
    }
}
