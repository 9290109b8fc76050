//! Noise-free trajectories made by the engine itself.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::recording::{Channel, Kind, Recording, Stream};
use phantom::rng::{self, Purpose};

/// States and controls of consecutive steps; sensors as the step saw them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Run {
    pub qpos: Vec<Vec<f64>>,
    pub qvel: Vec<Vec<f64>>,
    pub ctrl: Vec<Vec<f64>>,
    pub sensordata: Vec<Vec<f64>>,
    /// steps in which constraint rows were active
    pub n_constrained: usize,
}

/// The solver at the limit of what doubles allow.
pub(crate) fn tighten(model: &mut Model) {
    let mut option = model.option();
    option.tolerance = 0.0;
    option.iterations = 100;
    model.edit().set_option(&option).expect("legal");
}

/// Simulates `n` steps under `control(data, time)`.
pub(crate) fn simulate(
    data: &mut Data,
    n: usize,
    mut control: impl FnMut(&Data, &mut [f64]),
) -> Run {
    let mut run = Run::default();
    let mut ctrl = vec![0.0; data.model().nu()];
    for _ in 0..n {
        control(data, &mut ctrl);
        data.ctrl_mut().copy_from_slice(&ctrl);
        run.qpos.push(data.qpos().to_vec());
        run.qvel.push(data.qvel().to_vec());
        run.ctrl.push(ctrl.clone());
        data.step().expect("step");
        run.sensordata.push(data.sensordata().to_vec());
        run.n_constrained += usize::from(data.nefc() > 6);
    }
    assert!(!data.warnings().any(), "{}", data.warnings());
    run
}

/// Fingers under a stiff joint controller around targets that move by `swing` (rad).
pub(crate) fn swing_fingers(model: Model, n: usize, close: f64, swing: f64) -> Run {
    let mut data = Data::new(Arc::new(model)).expect("data");
    data.reset_to_keyframe(0).expect("home");
    simulate(&mut data, n, |data, ctrl| {
        let t = data.time();
        for finger in 0..3 {
            let phase = 2.0 * finger as f64;
            let goal = [
                0.3 * swing * (7.0 * t + phase).sin(),
                0.2 * swing * (11.0 * t + phase).sin(),
                close * (4.0 * t).min(1.0) + swing * (9.0 * t + phase).sin(),
            ];
            for (motor, goal) in goal.iter().enumerate() {
                let (q, v) = (
                    data.qpos()[5 * finger + motor],
                    data.qvel()[5 * finger + motor],
                );
                ctrl[3 * finger + motor] = (4.0 * (goal - q) - 0.1 * v).clamp(-1.5, 1.5);
            }
        }
    })
}

pub(crate) fn rms<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for v in values {
        sum += v * v;
        n += 1;
    }
    (sum / f64::from(n)).sqrt()
}

pub(crate) fn channel(name: &str, kind: Kind, unit: &str) -> Channel {
    Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma: None,
    }
}

/// A run of linear sensors (m) and motors (N), by their names, with noise on every reading.
pub(crate) fn recorded(
    run: &Run,
    rate_hz: u32,
    (sensors, motors): (&[&str], &[&str]),
    noise_m: f64,
    seed: u64,
) -> Recording {
    let stream = |name: &str, names: &[&str], kind: Kind, unit| {
        let channels = names.iter().map(|n| channel(n, kind, unit)).collect();
        Stream::new(name, Some(f64::from(rate_hz)), channels)
    };
    let mut sensors = stream("sensors", sensors, Kind::Sensor, "m");
    let mut controls = stream("controls", motors, Kind::Control, "N");
    let mut rng = rng::stream(seed, Purpose::Model, 0, 0);
    for (k, (s, u)) in run.sensordata.iter().zip(&run.ctrl).enumerate() {
        let stamp = 1_000_000_000 / i64::from(rate_hz) * k as i64;
        let noisy: Vec<f64> = s
            .iter()
            .map(|s| s + noise_m * rng::normal(&mut rng))
            .collect();
        sensors.push(stamp, &noisy);
        controls.push(stamp, u);
    }
    Recording {
        streams: vec![sensors, controls],
        ..Recording::default()
    }
}
