//! Parts of a model that nothing connects are as if alone, and commands act when they do on machines.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::recording::{Channel, Kind, Recording, Stream};
use phantom::sysid::fit::{Fit, Start};
use phantom::sysid::joint::{JointSettings, solve};
use phantom::sysid::norm::Norm;
use phantom::sysid::parameter::ParameterRule;
use phantom::sysid::problem::{ChannelRule, CommandTiming, Problem, ProblemConfig};

const SIGMA: f64 = 1e-5; // rad

/// Pendulums `names`, each of its own length, and with `ball` a ball that lies on the floor.
fn model(names: &[&str], ball: bool, timestep: f64) -> Model {
    let mut bodies = String::new();
    let (mut motors, mut sensors) = (String::new(), String::new());
    for name in names {
        let length = if *name == "a" { 0.4 } else { 0.3 };
        let body = format!(
            r#"<body name="{name}" pos="0 {length} 1"><joint name="{name}" axis="0 1 0" damping="0.05"/>
            <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -{length}" mass="0.6"/></body>"#
        );
        bodies.push_str(&body);
        let motor = format!(r#"<motor name="m{name}" joint="{name}"/>"#);
        motors.push_str(&motor);
        let sensor = format!(r#"<jointpos name="s{name}" joint="{name}"/>"#);
        sensors.push_str(&sensor);
    }
    if ball {
        bodies += r#"<geom type="plane" size="1 1 .1"/><body pos="1 1 0.1"><freejoint/><geom size="0.1"/></body>"#;
    }
    let text = format!(
        r#"<mujoco><option timestep="{timestep}"/><worldbody>{bodies}</worldbody>
        <actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"#
    );
    Model::from_xml_str(&text).expect("loads")
}

/// 1 s of a model under sines, every `every`th step recorded; commands hold in between.
fn record(model: Model, every: usize) -> Recording {
    let nu = model.nu();
    let channels = |kind, unit: &str, names: Vec<String>| {
        let channel = |name| Channel {
            name,
            kind,
            unit: unit.into(),
            noise_sigma: None,
        };
        names.into_iter().map(channel).collect()
    };
    let named = |prefix: &str| -> Vec<String> {
        (0..nu)
            .map(|i| {
                let joint = (model.name(phantom::mujoco::ObjectKind::Joint, i)).expect("named");
                format!("{prefix}{joint}")
            })
            .collect()
    };
    let mut measured = Stream::new("s", None, channels(Kind::Sensor, "rad", named("s")));
    let mut commands = Stream::new("c", None, channels(Kind::Control, "N m", named("m")));
    let h = model.timestep();
    let mut data = Data::new(Arc::new(model)).expect("data");
    for step in 0..(1.0 / h).round() as usize {
        if step % every == 0 {
            let t = step as f64 * h;
            let stamp = (t * 1e9).round() as i64;
            let ctrl: Vec<f64> = (0..nu)
                .map(|i| 0.3 * (10.0 * t + i as f64).sin() + 0.2 * (23.0 * t).cos())
                .collect();
            measured.push(stamp, &data.qpos()[..nu]);
            commands.push(stamp, &ctrl);
            data.ctrl_mut().copy_from_slice(&ctrl);
        }
        data.step().expect("step");
    }
    Recording {
        streams: vec![measured, commands],
        ..Recording::default()
    }
}

fn fitted(model: Model, recording: &Recording, command: CommandTiming) -> (Problem, Fit) {
    let rule = |element, attribute| ParameterRule {
        start: Some(if attribute == "mass" { 0.5 } else { 0.03 }),
        ..ParameterRule::new(element, attribute)
    };
    let config = ProblemConfig {
        parameter: vec![rule("joint/?", "damping"), rule("body/?", "mass")],
        channel: vec![ChannelRule {
            name: "*".into(),
            noise_sigma: Some(SIGMA),
            norm: Norm::default(),
            ignore: false,
        }],
        command,
        ..ProblemConfig::default()
    };
    let recordings = [("r".to_owned(), recording.clone())];
    let problem = Problem::new(Arc::new(model), &config, &recordings).expect("fits");
    let settings = JointSettings {
        levels: vec![1.0, 1e-2],
        by_evidence: false,
        ..JointSettings::default()
    };
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    let fit = solve(&problem, &settings, &start, &mut |_| true).expect("solved");
    (problem, fit)
}

fn values(problem: &Problem, fit: &Fit) -> Vec<f64> {
    problem.parameters.values(&fit.x)
}

#[test]
fn parts_are_as_if_alone_and_what_rests_is_left_alone() {
    let h = 0.004;
    let recording = record(model(&["a", "b"], true, h), 1);
    let (problem, both) = fitted(model(&["a", "b"], true, h), &recording, CommandTiming::Held);
    let mut cost = 0.0;
    for (i, name) in ["a", "b"].into_iter().enumerate() {
        let mut own = recording.clone();
        for stream in &mut own.streams {
            stream.values = stream.values.chunks_exact(2).map(|row| row[i]).collect();
            stream.channels = vec![stream.channels[i].clone()];
        }
        let (alone, fit) = fitted(model(&[name], false, h), &own, CommandTiming::Held);
        cost += fit.negative_log_evidence;
        let (alone, both) = (values(&alone, &fit), values(&problem, &both));
        for (a, b) in alone.iter().zip([both[i], both[2 + i]]) {
            assert!((a / b - 1.0).abs() < 1e-6, "{name}: {a} {b}");
        }
        // and what was planted
        assert!((alone[0] / 0.05 - 1.0).abs() < 0.01, "{}", alone[0]);
        assert!((alone[1] / 0.6 - 1.0).abs() < 0.01, "{}", alone[1]);
    }
    let evidence = both.negative_log_evidence;
    assert!(
        (evidence - cost).abs() < 1e-3 * cost.abs(),
        "{evidence} {cost}"
    );
    // the ball: no force is asked of it, and it stays where it was
    assert!(both.force_sigma[..2].iter().all(|s| *s > 0.0));
    assert_eq!(both.force_sigma[2..], [0.0; 6]);
    let nq = problem.model.nq();
    let first = &both.trajectories[0][2..nq];
    for row in both.trajectories[0].chunks_exact(nq) {
        for (a, b) in row[2..].iter().zip(first) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }
}

/// A machine is no semi-implicit Euler step: its commands act in the middle of what the engine makes of them.
#[test]
fn commands_are_centred_for_machines() {
    let (h, finer) = (0.004, 20);
    let recording = record(model(&["a"], false, h / finer as f64), finer);
    let damping = |command| {
        let (problem, fit) = fitted(model(&["a"], false, h), &recording, command);
        (values(&problem, &fit)[0] / 0.05 - 1.0).abs()
    };
    let (centred, held) = (
        damping(CommandTiming::Centred),
        damping(CommandTiming::Held),
    );
    assert!(centred < 0.01, "{centred}");
    assert!(held > 0.05, "{held}");
}
