//! Play in a drive that rattles: windows put the motor where its readings show it.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::supplement;
use phantom::sysid::fit::Start;
use phantom::sysid::problem::{Problem, ProblemConfig};
use phantom::sysid::shooting::{self, ShootingSettings};

use crate::late::record;

/// s
const STEP: f64 = 5e-4;

/// A link behind a light motor with `play`, rad.
fn rotor(play: f64) -> Arc<Model> {
    let text = format!(
        r#"<mujoco><option timestep="{STEP}" gravity="0 0 0"/>
        <worldbody><body name="link"><inertial pos="0 0 0" mass="1" diaginertia="0.001 0.001 0.001"/>
        <joint name="j" axis="0 0 1" damping="0.002" armature="1e-5"/></body></worldbody>
        <actuator><motor name="m" joint="j"/></actuator><sensor><jointpos name="q" joint="j"/></sensor>
        <custom><numeric name="phantom:backlash:m" data="{play}"/></custom></mujoco>"#
    );
    let model = Model::from_xml_str(&text).expect("it loads");
    Arc::new(supplement::attach(model).expect("a supplement"))
}

/// What windows of fifty flights leave, under the commands of a loop that is late.
#[test]
fn play_is_seen_in_windows_of_a_motor_that_rattles() {
    const TRUE: f64 = 0.008;
    let config: ProblemConfig = toml::from_str(
        r#"
        command = "held"
        [[parameter]]
        element = "joint/j"
        attribute = "damping"
        prior_sigma = 0.1
        "#,
    )
    .expect("a configuration");
    let torque = |k: i64, data: &Data| {
        let (shown, own) = (data.encoder(0), data.joint_state(0));
        let before = shown[0] - own[0] - STEP * (shown[1] - own[1]);
        0.02 * (40.0 * k as f64 * STEP).sin() - 0.12_f64.copysign(before)
    };
    let recordings = [("rattling".to_owned(), record(rotor(TRUE), torque))];
    let left = |play: f64| {
        let problem = Problem::new(rotor(play), &config, &recordings).expect("a problem");
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
        fit.cost
    };
    let least = left(TRUE);
    let others = [0.0, 0.4, 0.8, 1.3].map(|part| left(part * TRUE));
    assert!(
        others.iter().all(|other| *other > 3.0 * least),
        "{least} {others:?}"
    );
}
