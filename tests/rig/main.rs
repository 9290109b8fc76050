//! The virtual rig: what it simulates, senses, hides, and refuses.

mod truth;

use std::path::{Path, PathBuf};

use phantom::mujoco::{Data, Integrator, Model};
use phantom::policy::AffineGaussian;
use phantom::recording::Recording;
use phantom::rig::behaviour::{self, BEHAVIOURS, PolicyBehaviour};
use phantom::rig::{Outcome, Rig, RigConfig, Scheme, Trial};
use std::sync::Arc;

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

fn phantom_model() -> Model {
    Model::from_xml_path(path("xml/phantom.xml")).expect("the shipped model")
}

fn config(text: &str) -> RigConfig {
    toml::from_str(text).expect("a rig file")
}

fn shipped(name: &str) -> RigConfig {
    config(&std::fs::read_to_string(path(name)).expect("a shipped rig"))
}

fn rig(config: RigConfig) -> Rig {
    Rig::new(phantom_model(), config).expect("a rig")
}

fn run(rig: &Rig, name: &str, seconds: f64, number: u64) -> Outcome {
    let trial = Trial {
        number,
        label: name.to_owned(),
        seconds,
    };
    let entry = behaviour::entry(name).expect("a behaviour");
    let mut behaviour = rig.behaviour(entry, &trial).expect("it fits the model");
    let outcome = rig
        .record(behaviour.as_mut(), &trial, |_| {})
        .expect("the engine runs");
    assert_eq!(outcome.diverged, None, "{name}");
    outcome
}

/// Control at 500 Hz and steps of 0.5 ms, to be quick.
fn coarse(config: &mut RigConfig) {
    config.physics.rate_hz = Some(500.0);
    config.physics.substeps = 4;
    config.physics.integrator = None;
    config.sensing.force_hz = 0.0;
}

/// Bits of all samples; NaN compares equal to itself.
fn bits(recording: &Recording) -> Vec<(Vec<i64>, Vec<u64>)> {
    let of = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect();
    recording
        .streams
        .iter()
        .map(|s| (s.stamps_ns.clone(), of(&s.values)))
        .collect()
}

#[test]
fn ideal_rig_at_the_models_step_is_the_model() {
    let rig = rig(config("[physics]\nsubsteps = 1\n"));
    let recording = run(&rig, "multi_sine", 0.5, 0).recording;
    let model = Arc::new(phantom_model());
    assert_eq!(
        recording.meta.model_hash,
        model.fingerprint().expect("saved")
    );
    let mut data = Data::new(Arc::clone(&model)).expect("data");
    data.reset_to_keyframe(0).expect("home");
    let commands = recording.streams.iter().find(|s| s.name == "commands");
    let commands = commands.expect("commands");
    let (joints, _) = recording.channel("p0_turret_pos").expect("a stream");
    assert_eq!((joints.len(), joints.channels.len()), (1000, 18));
    for k in 0..joints.len() {
        assert_eq!(joints.stamps_ns[k], 500_000 * k as i64);
        for (column, channel) in joints.channels.iter().enumerate() {
            let sensor = model
                .id(phantom::mujoco::ObjectKind::Sensor, &channel.name)
                .expect("named after a sensor");
            let joint = model.sensor_objid()[sensor] as usize;
            let truth = if channel.name.ends_with("_pos") {
                data.qpos()[model.jnt_qposadr()[joint] as usize]
            } else {
                data.qvel()[model.jnt_dofadr()[joint] as usize]
            };
            assert_eq!(joints.row(k)[column].to_bits(), truth.to_bits());
        }
        data.ctrl_mut().copy_from_slice(commands.row(k));
        data.step().expect("a step");
    }
}

#[test]
fn finer_steps_and_schemes_tend_to_one_motion() {
    let last = |scheme: Option<Scheme>, substeps| {
        let mut config = RigConfig::default();
        config.physics.integrator = scheme;
        config.physics.substeps = substeps;
        let recording = run(&rig(config), "multi_sine", 0.5, 0).recording;
        let (stream, column) = recording.channel("p1_crank_pos").expect("a channel");
        stream.row(stream.len() - 1)[column]
    };
    let fine = last(Some(Scheme::Rk4), 10);
    for scheme in [Scheme::Euler, Scheme::Implicit] {
        let difference = (last(Some(scheme), 10) - fine).abs();
        assert!(difference < 1e-3, "{scheme:?} {difference}");
        // the truth is not the model
        assert!(difference > 0.0);
    }
    assert_eq!(phantom_model().option().integrator, Integrator::Euler);
}

#[test]
fn one_seed_gives_the_same_bits_another_machine_or_trial_does_not() {
    let recording = |seed, trial| {
        let mut config = shipped("rigs/paper.toml");
        config.seed = seed;
        config.physics.substeps = 2;
        bits(&run(&rig(config), "multi_sine", 0.1, trial).recording)
    };
    let base = recording(3, 0);
    assert!(base == recording(3, 0));
    assert!(base != recording(4, 0), "another machine");
    assert!(base != recording(3, 1), "another trial");
}

/// Runs all behaviours and looks at joints and motors.
fn stays_within_limits(config: RigConfig, duration: impl Fn(f64) -> f64) {
    let rig = rig(config);
    let ranges = rig.model().actuator_ctrlrange();
    for entry in BEHAVIOURS {
        let outcome = run(&rig, entry.name, duration(entry.seconds), 0);
        let overrun = outcome.limit_overrun;
        assert!(overrun < 0.0, "{}: {overrun} beyond a limit", entry.name);
        let mut streams = outcome.recording.streams.iter();
        let commands = streams.find(|s| s.name == "commands").expect("commands");
        assert!(commands.len() > 100);
        for k in 0..commands.len() {
            for (u, range) in commands.row(k).iter().zip(ranges.chunks(2)) {
                assert!(range[0] <= *u && *u <= range[1], "{} {u}", entry.name);
            }
        }
    }
}

#[test]
fn behaviours_stay_within_the_limits_of_joints_and_motors() {
    let mut config = shipped("rigs/paper.toml");
    coarse(&mut config);
    stays_within_limits(config, |_| 2.5);
}

/// `cargo test --release --test rig -- --ignored whole_behaviours`
#[test]
#[ignore = "minutes"]
fn whole_behaviours_stay_within_the_limits_of_joints_and_motors() {
    for file in ["rigs/nominal.toml", "rigs/paper.toml"] {
        let mut config = shipped(file);
        config.physics.substeps = 1;
        stays_within_limits(config, |seconds| seconds);
    }
}

#[test]
fn contact_behaviours_do_what_they_say() {
    let mut config = shipped("rigs/paper.toml");
    coarse(&mut config);
    let rig = rig(config);
    let column = |recording: &Recording, name: &str| -> Vec<f64> {
        let (stream, column) = recording.channel(name).expect("a channel");
        (0..stream.len()).map(|k| stream.row(k)[column]).collect()
    };
    let range = |values: &[f64]| {
        let high = values.iter().copied().fold(f64::MIN, f64::max);
        high - values.iter().copied().fold(f64::MAX, f64::min)
    };
    // the object rests while touched, and moves some centimetres both ways when pushed
    let touch = run(&rig, "touch", 9.0, 0).recording;
    let push = run(&rig, "push", 7.0, 0).recording;
    for axis in ["object_pos[0]", "object_pos[1]"] {
        let (rest, moved) = (range(&column(&touch, axis)), range(&column(&push, axis)));
        assert!(rest < 0.006, "{axis}: {rest} m while touched");
        assert!(moved > 0.03, "{axis}: {moved} m while pushed");
    }
    assert!(push.channel("goal[0]").is_some() && touch.channel("goal[0]").is_none());
    // finger 0 feels the ladder's 4 N
    let size = |recording: &Recording| {
        (0..3)
            .map(|i| range(&column(recording, &format!("p0_force[{i}]"))))
            .fold(0.0, f64::max)
    };
    let press = size(&run(&rig, "press", 4.0, 0).recording);
    assert!((2.5..15.0).contains(&press), "{press} N");
    assert!(size(&touch) > 0.2, "{} N", size(&touch));
}

#[test]
fn a_policy_sees_sensed_state_and_its_goal_is_recorded() {
    let rig = rig(shipped("rigs/nominal.toml"));
    let mut policy = AffineGaussian::zeros(36, 9, -1.0);
    let mut theta = policy.parameters();
    theta[0] = 2.0; // first motor against its own joint, the first observation
    theta[36] = 0.1; // and a constant
    policy.set_parameters(&theta).expect("finite");
    let mut behaviour = PolicyBehaviour::new(policy, rig.model()).expect("it fits");
    let trial = Trial {
        number: 0,
        label: "policy".to_owned(),
        seconds: 0.05,
    };
    let outcome = rig.record(&mut behaviour, &trial, |_| {}).expect("runs");
    let (joints, position) = outcome.recording.channel("p0_turret_pos").expect("a joint");
    let (commands, control) = outcome.recording.channel("p0_m1").expect("a motor");
    for k in 0..joints.len() {
        let expected = 2.0 * joints.row(k)[position] + 0.1;
        assert!((commands.row(k)[control] - expected).abs() < 1e-12);
    }
    assert!(outcome.recording.channel("goal[2]").is_some());
    assert!(PolicyBehaviour::new(AffineGaussian::zeros(3, 9, 0.0), rig.model()).is_err());
}

#[test]
fn motion_capture_has_its_own_rate_and_clock() {
    let stamps = |offset: f64| {
        let mut config = RigConfig::default();
        config.sensing.mocap_clock_s = offset;
        let recording = run(&rig(config), "multi_sine", 0.1, 0).recording;
        let (stream, _) = recording.channel("object_pos[0]").expect("motion capture");
        stream.stamps_ns.clone()
    };
    let exact = stamps(0.0);
    assert_eq!(exact.len(), 24);
    for (n, stamp) in exact.iter().enumerate() {
        assert_eq!(*stamp, (n as f64 / 240.0 * 1e9).round() as i64);
    }
    let shifted = stamps(0.5);
    assert!(shifted[0] > exact[0] + 1_000_000, "{shifted:?}");
    assert!(
        shifted
            .windows(2)
            .all(|w| (w[1] - w[0] - 4_166_667).abs() <= 1)
    );
}

#[test]
fn joint_excitations_fit_another_model() {
    let model = Model::from_xml_path(path("tests/models/arm.xml")).expect("the arm");
    let rig = Rig::new(model, RigConfig::default()).expect("a rig");
    let recording = run(&rig, "multi_sine", 1.0, 0).recording;
    assert!(recording.channel("q1").is_some() && recording.channel("tip[2]").is_some());
    let trial = Trial {
        number: 0,
        label: String::new(),
        seconds: 1.0,
    };
    let entry = behaviour::entry("push").expect("a behaviour");
    let error = rig.behaviour(entry, &trial).err().expect("no object");
    assert!(error.to_string().contains("framepos"), "{error}");
}

#[test]
fn bad_rigs_are_refused_by_name() {
    for (text, parts) in [
        (
            "[[effect]]\nname = \"cogging\"\nwhere = \"p9*\"\namplitude_nm = 1\n",
            vec!["cogging", "p9*", "p0_turret"],
        ),
        (
            "[[effect]]\nname = \"cogging\"\nwhere = \"*\"\namplitude = 1\n",
            vec!["no parameter `amplitude`", "amplitude_nm"],
        ),
        (
            "[[effect]]\nname = \"cogging\"\nwhere = \"*\"\n",
            vec!["`amplitude_nm` is missing"],
        ),
        (
            "[[effect]]\nname = \"gravity_tilt\"\nwhere = \"x\"\ntilt_rad = 0.1\n",
            vec!["no `where`"],
        ),
        (
            "[[effect]]\nname = \"viscous_friction\"\nwhere = \"p0_upper\"\ndamping_nms = -1\n",
            vec!["damping_nms", "-1"],
        ),
        ("[sensing]\nmocap_hz = 0\n", vec!["sensing.mocap_hz", "0"]),
        (
            "[sensing]\nforce_hz = 1500\n",
            vec!["sensing.force_hz", "1500"],
        ),
        ("[physics]\nsubsteps = 0\n", vec!["physics.substeps"]),
        ("[family]\neffects = [\"magic\"]\n", vec!["magic"]),
        ("keyframe = \"away\"\n", vec!["away", "home"]),
    ] {
        let built = Rig::new(phantom_model(), config(text));
        let error = built.and_then(|rig| {
            let trial = Trial {
                number: 0,
                label: String::new(),
                seconds: 0.01,
            };
            let mut behaviour = rig.behaviour(behaviour::entry("chirp")?, &trial)?;
            rig.record(behaviour.as_mut(), &trial, |_| {})
        });
        let message = error.expect_err(text).to_string();
        for part in parts {
            assert!(
                message.contains(part),
                "{text}: `{part}` is not in: {message}"
            );
        }
    }
    let error = toml::from_str::<RigConfig>("[[effect]]\nname = \"magic\"\n").expect_err("unknown");
    assert!(error.to_string().contains("expected one of"), "{error}");
    assert!(toml::from_str::<RigConfig>("subtseps = 3\n").is_err());
}

/// `cargo test --release --test rig -- --ignored --nocapture cost`
#[test]
#[ignore = "timing"]
#[expect(clippy::print_stderr, reason = "the figure is the point")]
fn recording_costs_at_most_a_fifth_of_the_simulation() {
    let rig = rig(shipped("rigs/paper.toml"));
    // the fastest of some runs of the same trial: other work on the machine only ever slows a run down
    let (mut with, mut bare) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..5 {
        let outcome = run(&rig, "push", 2.0, 0);
        let streams = outcome.recording.streams.iter();
        let commands: Vec<f64> = streams
            .filter(|s| s.name == "commands")
            .flat_map(|s| s.values.iter().copied())
            .collect();
        bare = bare.min(rig.replay(&commands).expect("a replay").as_secs_f64());
        with = with.min((outcome.cost.simulation + outcome.cost.recording).as_secs_f64());
    }
    assert!(with < 1.2 * bare, "recorded {with} s, bare {bare} s");
    // shown when the test is run with --nocapture
    eprintln!("recorded / bare simulation: {:.3}", with / bare);
}
