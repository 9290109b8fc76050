//! Motion capture: places and orientations at its own rate and on its own clock.
//!
//! ```text
//! frame n is exposed at t_n = (n + φ)/rate and stamped r t_n + o
//! ```
//!
//! Exposures fall between inner steps and are interpolated.

use super::{FRAME_POSITION, FRAME_QUATERNION, components, of_type, stamp};
use crate::mujoco::Model;
use crate::recording::{Channel, Stream};
use crate::rig::config::SensingConfig;
use crate::rng::{self, Stream as Rng};

/// Noise of a component of an orientation beside that of a place: markers 0.05 m from the centre, half angles.
const QUATERNION_PER_M: f64 = 10.0;

/// What is wrong with the system of one machine, for good.
#[derive(Debug, Clone)]
pub(in crate::rig) struct Calibration {
    /// m, or 1 for orientations; one a component
    pub(super) bias: Vec<f64>,
    pub(super) clock_offset_s: f64,
    pub(super) clock_rate: f64,
    /// φ
    pub(super) phase: f64,
}

impl Calibration {
    pub(super) fn draw(model: &Model, config: &SensingConfig, rng: &mut Rng) -> Self {
        let error = config.mocap_error_m;
        let bias = channels(model, 0.0)
            .iter()
            .map(|c| {
                let drawn = rng::uniform(rng, -error, error);
                if c.unit == "m" { drawn } else { 0.0 }
            })
            .collect();
        let clock_offset_s = rng::uniform(rng, 0.0, config.mocap_clock_s);
        let clock_rate = 1.0 + config.mocap_clock_drift_sigma * rng::normal(rng);
        // exposures in step with the control are as unlikely as an exact clock
        let phase = if config.mocap_clock_s > 0.0 {
            rng::uniform(rng, 0.0, 1.0)
        } else {
            0.0
        };
        Self {
            bias,
            clock_offset_s,
            clock_rate,
            phase,
        }
    }
}

/// Channels of all components.
pub(super) fn channels(model: &Model, sigma_m: f64) -> Vec<Channel> {
    of_type(model, [FRAME_POSITION, FRAME_QUATERNION])
        .into_iter()
        .flat_map(|(sensor, at)| match model.sensor_type()[sensor] {
            FRAME_POSITION => components(model, sensor, at.len(), "m", sigma_m),
            _ => components(model, sensor, at.len(), "1", QUATERNION_PER_M * sigma_m),
        })
        .collect()
}

/// The motion capture of one trial.
#[derive(Debug)]
pub(super) struct Mocap {
    addresses: Vec<usize>,
    place: Option<usize>, // column of the first place
    bias: Vec<f64>,
    sigma: Vec<f64>,
    rate_hz: f64,
    calibration: Calibration,
    frame: u64,
    before: (f64, Vec<f64>), // time and components of the step before
    stream: Stream,
    rng: Rng,
    row: Vec<f64>,
}

impl Mocap {
    pub(super) fn new(
        model: &Model,
        config: &SensingConfig,
        calibration: &Calibration,
        rng: Rng,
    ) -> Self {
        let channels = channels(model, config.mocap_sigma_m);
        let addresses: Vec<usize> = of_type(model, [FRAME_POSITION, FRAME_QUATERNION])
            .into_iter()
            .flat_map(|(_, at)| at)
            .collect();
        Self {
            before: (0.0, vec![0.0; addresses.len()]),
            addresses,
            place: channels.iter().position(|c| c.unit == "m"),
            bias: calibration.bias.clone(),
            sigma: channels
                .iter()
                .map(|c| c.noise_sigma.unwrap_or(0.0))
                .collect(),
            rate_hz: config.mocap_hz,
            calibration: calibration.clone(),
            frame: 0,
            stream: Stream::new("mocap", Some(config.mocap_hz), channels),
            rng,
            row: Vec::new(),
        }
    }

    /// Take the frames exposed since the last call; `sensordata` is that of `time_s`.
    pub(super) fn observe(&mut self, time_s: f64, sensordata: &[f64]) {
        if self.addresses.is_empty() {
            return;
        }
        loop {
            let exposed = (self.frame as f64 + self.calibration.phase) / self.rate_hz;
            // a billionth of a second of rounding in the sum of steps is no reason to be one step late
            if exposed > time_s + 1e-9 {
                break;
            }
            self.expose(exposed, time_s, sensordata);
            self.frame += 1;
        }
        self.before.0 = time_s;
        for (value, &address) in self.before.1.iter_mut().zip(&self.addresses) {
            *value = sensordata[address];
        }
    }

    fn expose(&mut self, exposed: f64, time_s: f64, sensordata: &[f64]) {
        let span = time_s - self.before.0;
        let share = if span > 0.0 {
            ((exposed - self.before.0) / span).min(1.0)
        } else {
            1.0
        };
        self.row.clear();
        for (i, &address) in self.addresses.iter().enumerate() {
            let before = self.before.1[i];
            let mut value = before + share * (sensordata[address] - before);
            if share == 1.0 {
                value = sensordata[address];
            }
            value += self.bias[i];
            if self.sigma[i] > 0.0 {
                value += self.sigma[i] * rng::normal(&mut self.rng);
            }
            self.row.push(value);
        }
        let clock = &self.calibration;
        let stamped = clock.clock_rate * exposed + clock.clock_offset_s;
        self.stream.push(stamp(stamped), &self.row);
    }

    pub(super) fn last_place(&self) -> Option<[f64; 3]> {
        let column = self.place?;
        let last = self.stream.len().checked_sub(1)?;
        let row = self.stream.row(last);
        Some([row[column], row[column + 1], row[column + 2]])
    }

    pub(super) fn into_stream(self) -> Stream {
        self.stream
    }
}
