//! A link behind a motor, read by an encoder, and fits to windows of its recordings.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::recording::{Kind, Recording, Stream};
use phantom::rng::{self, Purpose};
use phantom::supplement;
use phantom::sysid::fit::Start;
use phantom::sysid::problem::{Problem, ProblemConfig};
use phantom::sysid::shooting::{self, ShootingSettings};

use crate::common::driven::channel;

/// rad
const SIGMA: f64 = 5e-5;

/// A link of `inertia`, kg m², with attributes of its joint and custom elements, in steps of `step_s`.
pub(crate) fn rotor(step_s: f64, inertia: f64, joint: &str, custom: &str) -> Arc<Model> {
    let text = format!(
        r#"<mujoco><option timestep="{step_s}" gravity="0 0 0"/>
        <worldbody><body name="link"><inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>
        <joint name="j" axis="0 0 1" {joint}/></body></worldbody>
        <actuator><motor name="m" joint="j"/></actuator><sensor><jointpos name="q" joint="j"/></sensor>
        <custom>{custom}</custom></mujoco>"#
    );
    let model = Model::from_xml_str(&text).expect("it loads");
    Arc::new(supplement::attach(model).expect("a supplement"))
}

/// 2000 samples of its encoder under `torque` at each.
pub(crate) fn record(model: Arc<Model>, torque: impl Fn(i64, &Data) -> f64) -> Recording {
    let step_s = model.timestep();
    let mut data = Data::new(model).expect("data");
    let mut rng = rng::stream(1, Purpose::SensorNoise, 0, 0);
    let channels = vec![
        channel("q", Kind::Sensor, "rad", Some(SIGMA)),
        channel("m", Kind::Control, "N m", None),
    ];
    let mut stream = Stream::new("all", Some(1.0 / step_s), channels);
    for k in 0..2000 {
        let torque = torque(k, &data);
        data.ctrl_mut()[0] = torque;
        let reading = data.encoder(0)[0] + SIGMA * rng::normal(&mut rng);
        stream.push((k as f64 * step_s * 1e9).round() as i64, &[reading, torque]);
        data.step().expect("step");
    }
    Recording {
        streams: vec![stream],
        ..Recording::default()
    }
}

/// A fit of the parameters of a configuration to windows of 0.1 s; their values, and its cost.
pub(crate) fn fitted(model: Arc<Model>, config: &str, recording: &Recording) -> (Vec<f64>, f64) {
    let config: ProblemConfig = toml::from_str(config).expect("a configuration");
    let recordings = [("recorded".to_owned(), recording.clone())];
    let problem = Problem::new(model, &config, &recordings).expect("a problem");
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    let settings = ShootingSettings {
        window_s: 0.1,
        ..ShootingSettings::default()
    };
    let fit = shooting::solve(&problem, &settings, &start, &mut |_| true).expect("a fit");
    (problem.free_values(&fit.x), fit.cost)
}
