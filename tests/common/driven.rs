//! Joints that motors drive by several sines, recorded, and searched for what a model of them lacks.

use std::sync::Arc;

use phantom::compare::Settings;
use phantom::gap::effect::ModelFile;
use phantom::gap::{self, Input, Options, Outcome};
use phantom::mujoco::{Data, Model};
use phantom::recording::{Channel, Kind, Meta, Recording, Stream};
use phantom::rng::{self, Purpose};
use phantom::sysid::problem::ProblemConfig;

/// Attributes of a joint with dry friction, N m.
pub(crate) const FRICTION: &str =
    r#"frictionloss="0.05" solreffriction="0.002 1" solimpfriction="0.99 0.99 0.001""#;

/// A channel of a recording.
pub(crate) fn channel(name: &str, kind: Kind, unit: &str, noise_sigma: Option<f64>) -> Channel {
    Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma,
    }
}

/// `steps` of 1 ms of the first positions, (name, unit, noise) each, as motors (name, phase) drive the machine.
pub(crate) fn record(
    model: &Arc<Model>,
    seed: u64,
    steps: i64,
    positions: &[(&str, &str, f64)],
    motors: &[(&str, f64)],
) -> (String, Recording) {
    let mut data = Data::new(Arc::clone(model)).expect("data");
    let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
    let sensors = (positions.iter())
        .map(|(name, unit, sigma)| channel(name, Kind::Sensor, unit, Some(*sigma)));
    let controls = motors
        .iter()
        .map(|(name, _)| channel(name, Kind::Control, "N m", None));
    let mut stream = Stream::new("all", Some(1000.0), sensors.chain(controls).collect());
    for k in 0..steps {
        let t = k as f64 * 1e-3;
        let torques: Vec<f64> = (motors.iter())
            .map(|(_, phase)| {
                0.4 * (3.1 * t + phase).sin()
                    + 0.3 * (7.3 * t + 2.0 * phase).sin()
                    + 0.1 * (23.0 * t + phase).sin()
            })
            .collect();
        let mut row: Vec<f64> = (data.qpos().iter().zip(positions))
            .map(|(q, (_, _, sigma))| q + sigma * rng::normal(&mut rng))
            .collect();
        row.extend(&torques);
        stream.push(k * 1_000_000, &row);
        data.ctrl_mut().copy_from_slice(&torques);
        data.step().expect("step");
    }
    let recording = Recording {
        meta: Meta::default(),
        streams: vec![stream],
    };
    (format!("{seed}"), recording)
}

/// Masses of `bodies` are fitted.
pub(crate) fn config(bodies: &str) -> ProblemConfig {
    toml::from_str(&format!(
        "[[parameter]]\nelement = \"body/{bodies}\"\nattribute = \"mass\"\nprior_sigma = 0.1\n"
    ))
    .expect("a configuration")
}

/// What `model` lacks, its masses of `bodies` fitted.
pub(crate) fn search(
    model: &ModelFile,
    bodies: &str,
    train: &[(String, Recording)],
    holdout: &[(String, Recording)],
) -> Outcome {
    let protocol = Settings {
        cutoff_hz: Some(30.0),
        ..Settings::default()
    };
    search_with(
        model,
        bodies,
        [train, holdout],
        (&Options::default(), &protocol),
    )
}

/// The same as told, `of` being recordings to train and to verify with.
pub(crate) fn search_with(
    model: &ModelFile,
    bodies: &str,
    of: [&[(String, Recording)]; 2],
    (options, protocol): (&Options, &Settings),
) -> Outcome {
    let input = Input {
        model,
        config: &config(bodies),
        train: of[0],
        holdout: of[1],
        protocol,
    };
    gap::run(&input, options, &mut |_, _, _| true).unwrap_or_else(|e| panic!("{e}"))
}
