//! Comparison of models with recordings: recordings made by the model itself, planted mistakes, unusable input.

#[path = "../common/mod.rs"]
mod common;
mod refused;

use std::sync::Arc;

use phantom::compare::rollouts::Growth;
use phantom::compare::settings::{Derivative, Drop};
use phantom::compare::{CompareError, Comparison, Settings, States, compare};
use phantom::mujoco::{Data, Model};
use phantom::policy::AffineGaussian;
use phantom::recording::{Channel, Kind, Meta, Recording, Stream};

/// Two carriages that do not touch, each with a motor.
const CARRIAGES: &str = r#"<mujoco><option timestep="0.001"/>
  <worldbody>
    <body name="a"><joint name="a" type="slide" axis="1 0 0" damping="2"/><geom size="0.1" mass="1"/></body>
    <body name="b" pos="0 0 1"><joint name="b" type="slide" axis="0 1 0" damping="3"/><geom size="0.1" mass="MASS"/></body>
  </worldbody>
  <actuator><motor name="ma" joint="a"/><motor name="mb" joint="b"/></actuator>
  <sensor><jointpos name="pa" joint="a"/><jointpos name="pb" joint="b"/><jointvel name="va" joint="a"/><jointvel name="vb" joint="b"/></sensor>
</mujoco>"#;

/// A finger over a table that is tilted by 30 degrees, with a force sensor in a turned frame.
const FINGER: &str = r#"<mujoco><option timestep="0.001"/>
  <worldbody>
    <geom type="plane" size="1 1 1" euler="0 30 0"/>
    <body name="finger" pos="0 0 0.1"><joint name="finger" type="slide" axis="0 0 1" damping="5"/><geom size="0.02" mass="0.5"/>
      <body name="tip" pos="0 0 -0.05"><geom size="0.02" mass="0.01"/><site name="tip" euler="90 0 20"/></body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="finger"/></actuator>
  <sensor><jointpos name="pos" joint="finger"/><jointvel name="vel" joint="finger"/><force name="force" site="tip"/></sensor>
</mujoco>"#;

const BALL: &str = r#"<mujoco><option timestep="0.001"/>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body name="ball" pos="0 0 0.5"><freejoint name="ball"/><geom type="box" size="0.05 0.04 0.03" mass="0.2"/></body>
  </worldbody>
</mujoco>"#;

fn model(xml: &str) -> Arc<Model> {
    Arc::new(Model::from_xml_str(xml).expect("model loads"))
}

fn carriages(mass: &str) -> Arc<Model> {
    model(&CARRIAGES.replace("MASS", mass))
}

/// What is recorded: a name, and where in the simulation it stands.
type Probe<'a> = (&'a str, Kind, Box<dyn Fn(&Data) -> f64 + 'a>);

fn probe<'a>(name: &'a str, value: impl Fn(&Data) -> f64 + 'a) -> Probe<'a> {
    (name, Kind::Sensor, Box::new(value))
}

/// Record a simulation at its own steps: state and sensors before the step, controls in force during it.
fn record(
    data: &mut Data,
    n: usize,
    control: impl Fn(f64) -> Vec<f64>,
    probes: &[Probe<'_>],
) -> Recording {
    let channels = probes.iter().map(|(name, kind, _)| Channel {
        name: (*name).to_owned(),
        kind: *kind,
        unit: String::new(),
        noise_sigma: None,
    });
    let mut stream = Stream::new("all", None, channels.collect());
    let step_ns = (data.model().timestep() * 1e9).round() as i64;
    for k in 0..n as i64 {
        let ctrl = control(data.time());
        data.ctrl_mut().copy_from_slice(&ctrl);
        data.forward().expect("computes");
        let row: Vec<f64> = probes.iter().map(|(_, _, value)| value(data)).collect();
        stream.push(k * step_ns, &row);
        data.step().expect("steps");
    }
    Recording {
        meta: Meta {
            source: "simulation".to_owned(),
            ..Meta::default()
        },
        streams: vec![stream],
    }
}

fn control(index: usize, name: &str) -> Probe<'_> {
    (name, Kind::Control, Box::new(move |d| d.ctrl()[index]))
}

fn carriage_log(mass: &str) -> Recording {
    let mut data = Data::new(carriages(mass)).expect("data");
    let probes = [
        probe("pa", |d| d.qpos()[0]),
        probe("pb", |d| d.qpos()[1]),
        probe("va", |d| d.qvel()[0]),
        probe("vb", |d| d.qvel()[1]),
        control(0, "ma"),
        control(1, "mb"),
    ];
    record(
        &mut data,
        1500,
        |t| vec![(7.0 * t).sin(), 2.0 * (5.0 * t).cos()],
        &probes,
    )
}

fn without(mut recording: Recording, name: &str) -> Recording {
    let stream = &mut recording.streams[0];
    let (n, column) = (
        stream.channels.len(),
        stream
            .channels
            .iter()
            .position(|c| c.name == name)
            .expect("the channel"),
    );
    stream.channels.remove(column);
    let values = std::mem::take(&mut stream.values);
    stream.values = values
        .into_iter()
        .enumerate()
        .filter(|(i, _)| i % n != column)
        .map(|(_, v)| v)
        .collect();
    recording
}

fn run(model: &Arc<Model>, recording: Recording, settings: &Settings) -> Comparison {
    compare(model, &[recording], settings, None, &|| ()).expect("comparable")
}

fn growth<'a>(comparison: &'a Comparison, channel: &str) -> Vec<&'a Growth> {
    let found: Vec<_> = comparison
        .rollouts
        .growth
        .iter()
        .filter(|g| g.channel == channel)
        .collect();
    assert!(!found.is_empty(), "no channel {channel}");
    found
}

#[test]
fn a_models_own_recording_has_no_error_at_any_horizon() {
    let comparison = run(&carriages("2"), carriage_log("2"), &Settings::default());
    assert_eq!(
        comparison.rollouts.growth.len(),
        4 * 5,
        "4 channels, 5 horizons"
    );
    for g in &comparison.rollouts.growth {
        assert!(g.end_rms < 1e-9 && g.window_rms < 1e-9, "{g:?}");
        assert!(g.n >= 30, "{g:?}");
    }
    for signal in &comparison.forces[0].signals {
        // velocities are divided by the step of 1 ms
        assert!(
            signal.rms < 1e-9 && signal.measured_rms > 0.5,
            "{} {}",
            signal.name,
            signal.rms
        );
    }
}

#[test]
fn explicit_differences_miss_the_implicit_damping() {
    let settings = Settings {
        derivative: Derivative::Central,
        ..Settings::default()
    };
    let comparison = run(&carriages("2"), carriage_log("2"), &settings);
    let rms = comparison.forces[0].signals[0].rms;
    // second order of the step, not rounding
    assert!(rms > 1e-6 && rms < 0.02, "{rms}");
}

#[test]
fn a_wrong_mass_shows_at_its_joint_alone() {
    let comparison = run(&carriages("2"), carriage_log("2.4"), &Settings::default());
    let signals = &comparison.forces[0].signals;
    assert_eq!(
        (signals[0].name.as_str(), signals[1].name.as_str()),
        ("a", "b")
    );
    assert!(
        signals[0].relative_percent < 1e-6,
        "{}",
        signals[0].relative_percent
    );
    assert!(
        signals[1].relative_percent > 5.0,
        "{}",
        signals[1].relative_percent
    );
    // the missing 0.4 kg times its acceleration
    let expected: Vec<f64> = {
        let log = carriage_log("2.4");
        let velocity: Vec<f64> = (0..1500).map(|i| log.streams[0].row(i)[3]).collect();
        velocity
            .windows(2)
            .map(|v| 0.4 * (v[1] - v[0]) / 1e-3)
            .collect()
    };
    for ((computed, measured), missing) in signals[1]
        .computed
        .iter()
        .zip(&signals[1].measured)
        .zip(&expected)
    {
        assert!(
            (measured - computed - missing).abs() < 1e-6,
            "{measured} {computed} {missing}"
        );
    }
    assert!(growth(&comparison, "a").iter().all(|g| g.end_rms < 1e-9));
    let b = growth(&comparison, "b");
    assert!(
        b.windows(2)
            .all(|pair| pair[1].end_rms > 1.5 * pair[0].end_rms),
        "{b:?}"
    );
}

#[test]
fn positions_alone_give_the_state() {
    let log = without(without(carriage_log("2"), "va"), "vb");
    let settings = Settings {
        cutoff_hz: Some(60.0),
        skip_s: 0.1,
        ..Settings::default()
    };
    let comparison = run(&carriages("2"), log, &settings);
    for signal in &comparison.forces[0].signals {
        assert!(
            signal.relative_percent < 1.0,
            "{} {}",
            signal.name,
            signal.relative_percent
        );
    }
}

#[test]
fn forces_are_compared_in_the_frame_of_the_contact() {
    let finger = model(FINGER);
    let mut data = Data::new(Arc::clone(&finger)).expect("data");
    let mut probes = vec![
        probe("pos", |d| d.qpos()[0]),
        probe("vel", |d| d.qvel()[0]),
        control(0, "push"),
    ];
    let names = ["force[0]", "force[1]", "force[2]"];
    for (i, name) in names.into_iter().enumerate() {
        probes.push(probe(name, move |d| d.sensordata()[2 + i]));
    }
    let log = record(
        &mut data,
        1000,
        |t| vec![4.0 - 3.0 * (6.0 * t).cos()],
        &probes,
    );
    let comparison = run(&finger, log, &Settings::default());
    let signals = &comparison.forces[0].signals;
    let of = |case: &str| {
        signals
            .iter()
            .filter(|s| s.samples == case)
            .collect::<Vec<_>>()
    };
    let (free, contact) = (of("no contact"), of("contact"));
    assert_eq!((free.len(), contact.len()), (3, 3));
    assert_eq!(
        free[0].n + contact[0].n,
        999,
        "every sample but the last, once"
    );
    for signal in free.iter().chain(&contact) {
        assert!(signal.rms < 1e-9, "{} {}", signal.name, signal.rms);
    }
    assert_eq!(contact[0].name, "force normal");
    // the tip touches the tilted table: mostly along its normal, and pushed away from it throughout
    let beside = contact[1].measured_rms.hypot(contact[2].measured_rms);
    assert!(
        contact[0].measured_rms > beside,
        "{} {beside}",
        contact[0].measured_rms
    );
    // turning keeps the length of the force
    let k = contact[0].n - 1;
    let turned: f64 = contact.iter().map(|s| s.measured[k].powi(2)).sum();
    let time = contact[0].time_s[k];
    let mut again = Data::new(finger).expect("data");
    while again.time() < time - 1e-6 {
        let push = 4.0 - 3.0 * (6.0 * again.time()).cos();
        again.ctrl_mut()[0] = push;
        again.step().expect("steps");
    }
    again.ctrl_mut()[0] = 4.0 - 3.0 * (6.0 * time).cos();
    again.forward().expect("computes");
    let raw: f64 = again.sensordata()[2..5].iter().map(|f| f * f).sum();
    assert!((turned - raw).abs() < 1e-9 * raw, "{turned} {raw}");
}

/// The shipped model, its motors' joints and the object recorded; the rods are not.
fn phantom_log() -> (Arc<Model>, Recording) {
    let phantom = Arc::new(common::phantom_model());
    let mut data = Data::new(Arc::clone(&phantom)).expect("data");
    let names: Vec<(String, usize)> = (0..3)
        .flat_map(|f| {
            ["turret", "upper", "crank"]
                .map(|j| format!("p{f}_{j}"))
                .into_iter()
                .enumerate()
                .map(move |(j, n)| (n, 5 * f + j))
        })
        .collect();
    let positions: Vec<String> = names.iter().map(|(n, _)| format!("{n}_pos")).collect();
    let velocities: Vec<String> = names.iter().map(|(n, _)| format!("{n}_vel")).collect();
    let motors: Vec<String> = (0..3)
        .flat_map(|f| (1..4).map(move |m| format!("p{f}_m{m}")))
        .collect();
    let object: Vec<String> = (0..3).map(|i| format!("object_pos[{i}]")).collect();
    let mut probes = Vec::new();
    for (i, (_, address)) in names.iter().enumerate() {
        let address = *address;
        probes.push(probe(&positions[i], move |d| d.qpos()[address]));
        probes.push(probe(&velocities[i], move |d| d.qvel()[address]));
        probes.push(control(i, &motors[i]));
    }
    for (i, name) in object.iter().enumerate() {
        probes.push(probe(name, move |d| d.qpos()[15 + i]));
    }
    probes.push(("goal[0]", Kind::Goal, Box::new(|_| 0.03)));
    probes.push(("goal[1]", Kind::Goal, Box::new(|_| -0.04)));
    let torque = |t: f64| {
        (0..9)
            .map(|i| 0.02 * (20.0 * t + f64::from(i)).sin() + [0.0, 0.16, 0.0][i as usize % 3])
            .collect()
    };
    let recording = record(&mut data, 400, torque, &probes);
    (phantom, recording)
}

#[test]
fn loops_are_closed_where_only_motors_are_measured() {
    let (phantom, recording) = phantom_log();
    let states = States::new(&recording, &phantom, &Settings::default()).expect("states");
    for row in states.qpos.chunks_exact(phantom.nq()) {
        for finger in row[..15].chunks_exact(5) {
            // the two tendons of each finger
            assert!(
                (finger[3] - finger[1] + finger[2]).abs() < 1e-9,
                "{finger:?}"
            );
            assert!(
                (finger[4] + finger[1] - finger[2]).abs() < 1e-9,
                "{finger:?}"
            );
        }
    }
    let comparison = run(&phantom, recording, &Settings::default());
    assert_eq!(comparison.forces[0].signals.len(), 9);
    for signal in &comparison.forces[0].signals {
        // loops of the engine are soft; docs/model.md measures up to 0.6 % of the acceleration
        assert!(
            signal.relative_percent < 1.0,
            "{} {}",
            signal.name,
            signal.relative_percent
        );
    }
    for g in growth(&comparison, "p1_crank") {
        assert!(g.end_rms < 1e-3, "{g:?}");
    }
    let tracking = &comparison.tracking[0];
    assert!((tracking.mean_m - 0.05).abs() < 1e-4, "{}", tracking.mean_m);
}

#[test]
fn a_policy_is_simulated_towards_the_recorded_target() {
    let (phantom, recording) = phantom_log();
    let with = |recording: &Recording, policy: &AffineGaussian| {
        let recordings = std::slice::from_ref(recording);
        let settings = Settings::default();
        compare(&phantom, recordings, &settings, Some(policy), &|| ())
    };
    // no torque at all: the object stays where it is, 5 cm from the target, and the fingers sink
    let idle = AffineGaussian::zeros(36, 9, -1.0);
    let comparison = with(&recording, &idle).expect("comparable");
    let [real, simulated] = &comparison.tracking[..] else {
        panic!("{} entries", comparison.tracking.len());
    };
    assert_eq!((real.origin, simulated.origin), ("recorded", "simulated"));
    assert_eq!(simulated.distance_m.len(), real.distance_m.len());
    assert!(
        (simulated.distance_m[0] - 0.05).abs() < 1e-4,
        "{}",
        simulated.distance_m[0]
    );
    let fell = |rollouts: &phantom::compare::rollouts::Rollouts| {
        let mut all = rollouts.growth.iter();
        all.find(|g| g.channel == "p0_upper" && g.horizon_s == Some(0.1))
            .expect("the channel")
            .end_rms
    };
    let under_policy = fell(
        &comparison
            .policy_rollouts
            .expect("rollouts under the policy"),
    );
    assert!(
        under_policy > 0.05 && fell(&comparison.rollouts) < 1e-3,
        "{under_policy}"
    );

    let error = with(&recording, &AffineGaussian::zeros(4, 9, -1.0)).expect_err("another size");
    assert!(matches!(error, CompareError::Policy(_)));
    let aimless = without(without(recording.clone(), "goal[0]"), "goal[1]");
    let error = with(&aimless, &idle).expect_err("no target");
    assert!(matches!(error, CompareError::NoGoal { .. }), "{error}");
}

#[test]
fn a_toss_starts_before_its_impact_with_the_velocity_of_its_flight() {
    let ball = model(BALL);
    let mut data = Data::new(Arc::clone(&ball)).expect("data");
    data.qvel_mut()
        .copy_from_slice(&[0.4, -0.2, 1.0, 3.0, -2.0, 1.0]);
    // principal inertias differ, so that the spin is not constant: keep it about one axis
    data.qvel_mut()[4..].fill(0.0);
    let names: Vec<String> = (0..7).map(|i| format!("qpos[ball][{i}]")).collect();
    let speeds: Vec<String> = (0..6).map(|i| format!("qvel[ball][{i}]")).collect();
    let mut probes = Vec::new();
    for (i, name) in names.iter().enumerate() {
        probes.push(probe(name, move |d| d.qpos()[i]));
    }
    for (i, name) in speeds.iter().enumerate() {
        // recorded velocities are useless here: the fit must not look at them
        probes.push(probe(name, move |d| if i < 3 { 99.0 } else { d.qvel()[i] }));
    }
    let toss = record(&mut data, 900, |_| Vec::new(), &probes);
    let settings = |free_flight, below_m| Settings {
        forces: false,
        horizons_s: Vec::new(),
        to_end: true,
        drop: Some(Drop {
            joint: "ball".to_owned(),
            below_m,
            free_flight,
        }),
        ..Settings::default()
    };
    let fitted = run(&ball, toss.clone(), &settings(true, 0.2));
    // the engine falls by Euler's rule, h g t / 2 faster than a parabola: 1e-3 * 9.81 / 2 m/s, for 0.4 s
    let distance = growth(&fitted, "ball distance")[0];
    assert!(distance.end_rms < 0.02, "{distance:?}");
    let raw = run(&ball, toss.clone(), &settings(false, 0.2));
    assert!(growth(&raw, "ball distance")[0].end_rms > 1.0);
    let never = run(&ball, toss, &settings(true, -1.0));
    assert_eq!((never.rollouts.skipped, never.rollouts.n), (1, 0));
}

#[test]
fn results_do_not_depend_on_threads() {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("pool");
        let result =
            pool.install(|| run(&carriages("2"), carriage_log("2.4"), &Settings::default()));
        serde_json::to_string(&result).expect("JSON")
    };
    assert_eq!(on(1), on(3));
}
