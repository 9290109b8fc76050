//! Constants that force and torque sensors add to what they measure.

use super::law::{At, Built, Law};
use crate::mujoco::{Model, Stage};

#[derive(Debug)]
struct Bias {
    address: usize,
    n: usize,
}

pub(super) fn bias(model: &Model, sensor: usize) -> Built {
    let (address, n) = (
        model.sensor_adr()[sensor] as usize,
        model.sensor_dim()[sensor] as usize,
    );
    Ok(Box::new(Bias { address, n }))
}

impl Law for Bias {
    fn sense(&self, at: &At<'_>, stage: Stage, sensordata: &mut [f64]) {
        if stage != Stage::Acceleration {
            return;
        }
        for (reading, bias) in sensordata[self.address..]
            .iter_mut()
            .take(self.n)
            .zip(at.numbers)
        {
            if *bias != 0.0 {
                *reading += bias;
            }
        }
    }
}
