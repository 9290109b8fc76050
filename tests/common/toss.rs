//! Tosses of a cube, simulated and recorded.

use std::ops::Range;
use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::recording::{Channel, Kind, Recording, Stream};
use phantom::rng::{self, Purpose};

/// How a free body `cube` is tossed; the model's step is 2 ms.
pub(crate) struct Toss {
    /// height of the start, m
    pub height_m: f64,
    /// steps of the model, and of these a sample
    pub steps: i64,
    pub every: i64,
    /// of everything, m, rad, m/s or rad/s
    pub noise: f64,
}

impl Toss {
    /// Recordings of tosses by their numbers.
    pub(crate) fn record(
        &self,
        model: &Arc<Model>,
        numbers: Range<u64>,
    ) -> Vec<(String, Recording)> {
        numbers.map(|number| self.one(model, number)).collect()
    }

    fn one(&self, model: &Arc<Model>, number: u64) -> (String, Recording) {
        let mut rng = rng::stream(1, Purpose::Start, 0, number);
        let mut data = Data::new(model.clone()).expect("data");
        data.qpos_mut()[2] = self.height_m;
        for (i, v) in data.qvel_mut().iter_mut().enumerate() {
            *v = if i < 3 { 0.8 } else { 8.0 } * rng::normal(&mut rng);
        }
        let names =
            |kind: &'static str, n: usize| (0..n).map(move |i| format!("{kind}[cube][{i}]"));
        let channels = names("qpos", 7)
            .chain(names("qvel", 6))
            .map(|name| Channel {
                name,
                kind: Kind::Sensor,
                unit: "1".into(),
                noise_sigma: None,
            });
        let mut stream = Stream::new("cube", None, channels.collect());
        for k in 0..self.steps {
            if k % self.every == 0 {
                let state = data.qpos().iter().chain(data.qvel());
                let row: Vec<f64> = state
                    .map(|s| s + self.noise * rng::normal(&mut rng))
                    .collect();
                stream.push(2_000_000 * k, &row);
            }
            data.step().expect("step");
        }
        let mut recording = Recording {
            streams: vec![stream],
            ..Recording::default()
        };
        recording.meta.trial = number.to_string();
        (format!("toss {number}"), recording)
    }
}
