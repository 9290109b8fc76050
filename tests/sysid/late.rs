//! Encoders that are late: what windows know of the motion before them.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::recording::{Kind, Recording, Stream};
use phantom::rng::{self, Purpose};
use phantom::supplement;
use phantom::sysid::fit::Start;
use phantom::sysid::problem::{Problem, ProblemConfig};
use phantom::sysid::shooting::{self, ShootingSettings};

use crate::common::driven::channel;

/// s
const STEP: f64 = 0.001;
/// rad
const SIGMA: f64 = 5e-5;

/// A rotor whose encoder is `late_s` late.
fn rotor(late_s: f64) -> Arc<Model> {
    let text = format!(
        r#"<mujoco><option timestep="{STEP}" gravity="0 0 0"/>
        <worldbody><body name="link"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="j" axis="0 0 1" damping="0.02"/></body></worldbody>
        <actuator><motor name="m" joint="j"/></actuator><sensor><jointpos name="q" joint="j"/></sensor>
        <custom><numeric name="phantom:sensor_delay:encoders" data="{late_s}"/></custom></mujoco>"#
    );
    let model = Model::from_xml_str(&text).expect("it loads");
    Arc::new(supplement::attach(model).expect("a supplement"))
}

/// 2000 samples of a rotor's encoder under `torque` at each.
pub(crate) fn record(model: Arc<Model>, torque: impl Fn(i64, &Data) -> f64) -> Recording {
    let step = model.timestep();
    let mut data = Data::new(model).expect("data");
    let mut rng = rng::stream(1, Purpose::SensorNoise, 0, 0);
    let channels = vec![
        channel("q", Kind::Sensor, "rad", Some(SIGMA)),
        channel("m", Kind::Control, "N m", None),
    ];
    let mut stream = Stream::new("all", Some(1.0 / step), channels);
    for k in 0..2000 {
        let torque = torque(k, &data);
        data.ctrl_mut()[0] = torque;
        let reading = data.encoder(0)[0] + SIGMA * rng::normal(&mut rng);
        stream.push((k as f64 * step * 1e9).round() as i64, &[reading, torque]);
        data.step().expect("step");
    }
    Recording {
        streams: vec![stream],
        ..Recording::default()
    }
}

/// With windows begun as if at constant velocity it came out 0.2 ms too large, its interval twenty times as wide.
#[test]
fn lateness_is_estimated_from_windows_that_begin_in_motion() {
    const TRUE_S: f64 = 0.013;
    let config: ProblemConfig = toml::from_str(
        r#"
        command = "held"
        [[parameter]]
        element = "custom/phantom:sensor_delay:encoders"
        attribute = "data"
        components = [0]
        scale = "linear"
        lower = 0.0
        upper = 0.04
        "#,
    )
    .expect("a configuration");
    let torque = |k: i64, _: &Data| {
        let t = k as f64 * STEP;
        0.4 * (9.0 * t).sin() + 0.5 * (37.0 * t + 1.0).sin()
    };
    let recordings = [("late".to_owned(), record(rotor(TRUE_S), torque))];
    let problem = Problem::new(rotor(0.01), &config, &recordings).expect("a problem");
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
    let late_s = problem.free_values(&fit.x)[0];
    assert!((late_s - TRUE_S).abs() < 2e-5, "{late_s}");
}
