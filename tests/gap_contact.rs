//! What a model lacks of a machine that pushes: found by simulations that are pulled along its recordings.

mod common;

use std::sync::Arc;

use common::driven::channel;
use phantom::compare::Settings;
use phantom::gap::effect::ModelFile;
use phantom::gap::result::{Returned, Verdict};
use phantom::gap::{self, Input, Kept, Options};
use phantom::mujoco::{Data, Model, ObjectKind};
use phantom::recording::{Kind, Meta, Recording, Stream};
use phantom::rng::{self, Purpose};
use phantom::sysid::problem::ProblemConfig;

/// A driven finger pushes a block on a rail, again and again. `RAIL` stands for attributes of the block's joint, `WHERE` for
/// its place, `GRIP` for solref of the contact.
const PUSHER: &str = r#"<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body name="finger"><joint name="f" type="slide" axis="1 0 0" damping="3"/><geom name="tip" size=".01" mass=".1"/></body>
<body name="block" pos="WHERE 0 0"><joint name="b" type="slide" axis="1 0 0" damping=".5" RAIL/>
<geom name="block" type="box" size=".02 .02 .02" mass=".3"/></body></worldbody>
<contact><pair name="touch" geom1="tip" geom2="block" solref="GRIP -40"/></contact>
<actuator><motor name="m" joint="f"/></actuator>
<sensor><jointpos name="fs" joint="f"/><jointpos name="bs" joint="b"/></sensor></mujoco>"#;

/// Dry friction as the effect has it, N.
const FRICTION: &str =
    r#" frictionloss=".5" solreffriction="0.002 1" solimpfriction="0.99 0.99 0.001""#;

const NOISE_M: f64 = 5e-5;
/// m that the model has the block nearer
const OFF_M: f64 = 2e-3;

fn xml(rail: &str, place_m: f64, grip: f64) -> String {
    PUSHER
        .replace(" RAIL", rail)
        .replace("WHERE", &format!("{place_m}"))
        .replace("GRIP", &format!("{grip}"))
}

/// Three seconds of pushing, begun otherwise by each seed.
fn record(rail: &str, seed: u64) -> (String, Recording) {
    let model = Arc::new(Model::from_xml_str(&xml(rail, 0.05, -4000.0)).expect("loads"));
    let mut data = Data::new(Arc::clone(&model)).expect("data");
    let mut rng = rng::stream(seed, Purpose::SensorNoise, 0, 0);
    let sensors = ["fs", "bs"].map(|n| channel(n, Kind::Sensor, "m", Some(NOISE_M)));
    let control = [channel("m", Kind::Control, "N", None)];
    let mut stream = Stream::new(
        "all",
        Some(500.0),
        sensors.into_iter().chain(control).collect(),
    );
    for k in 0..1500_i64 {
        let t = data.time();
        let rate = 5.0 + seed as f64 % 3.0;
        let goal = 0.02 * t + 0.02 * (1.0 - (rate * t).cos());
        let push = 400.0 * (goal - data.qpos()[0]) - 10.0 * data.qvel()[0];
        let read = |q: f64, rng: &mut _| q + NOISE_M * rng::normal(rng);
        let row = [
            read(data.qpos()[0], &mut rng),
            read(data.qpos()[1], &mut rng),
            push,
        ];
        stream.push(k * 2_000_000, &row);
        data.ctrl_mut().copy_from_slice(&[push]);
        data.step().expect("step");
    }
    assert!(data.qpos()[1] > 0.02, "pushed to {}", data.qpos()[1]);
    let recording = Recording {
        meta: Meta::default(),
        streams: vec![stream],
    };
    (format!("push {seed}"), recording)
}

/// Recordings of a machine, and what is known of it.
struct Bench {
    model: ModelFile,
    config: ProblemConfig,
    train: Vec<(String, Recording)>,
    holdout: Vec<(String, Recording)>,
    protocol: Settings,
}

impl Bench {
    fn of(rail: &str) -> Self {
        Self {
            model: ModelFile::of_text(xml("", 0.05 - OFF_M, -4000.0), "pusher.xml").expect("loads"),
            config: toml::from_str(
                "command = \"held\"\n[[parameter]]\nelement = \"body/block\"\nattribute = \"pos\"\n\
                 components = [0]\nprior_sigma = 0.003\n",
            )
            .expect("a configuration"),
            train: vec![record(rail, 1), record(rail, 2)],
            holdout: vec![record(rail, 3)],
            protocol: Settings::default(),
        }
    }

    fn input(&self) -> Input<'_> {
        Input {
            model: &self.model,
            config: &self.config,
            train: &self.train,
            holdout: &self.holdout,
            protocol: &self.protocol,
        }
    }
}

fn pulled(hz: f64) -> Options {
    Options {
        pull_hz: Some(hz),
        ..Options::default()
    }
}

#[test]
fn friction_under_a_pushed_block_is_named() {
    let bench = Bench::of(FRICTION);
    let mut kept = Kept::default();
    let outcome = gap::resume(&bench.input(), &pulled(5.0), &mut kept, &mut |_, _, _| true);
    let outcome = outcome.expect("searched");
    let answer = &outcome.answer;
    let names: Vec<(&str, &str)> = (answer.effects.iter())
        .map(|e| (e.name.as_str(), e.at.as_str()))
        .collect();
    assert_eq!(names, [("coulomb_friction", "b")], "{answer:#?}");
    let level = &answer.effects[0].parameters[0];
    let [low, high] = level.ci95.expect("an interval");
    assert!((level.value / 0.5 - 1.0).abs() < 0.05, "{level:?}");
    assert!(low < 0.5 && 0.5 < high, "{level:?}");
    // as much of what is missing is gone as by the effect itself, which leaves little
    let found = answer.gap.holdout.as_ref().expect("held out");
    assert!(found.after < 0.5 * found.before, "{found:?}");
    let mut given = |name: &str, at: &str| {
        let effect = [(name.to_owned(), at.to_owned())];
        gap::with_effects(
            &bench.input(),
            &pulled(5.0),
            &effect,
            &mut kept,
            &mut |_, _, _| true,
        )
    };
    let oracle = given("coulomb_friction", "b")
        .expect("fitted")
        .expect("acts");
    let least = oracle.gap.holdout.expect("held out");
    assert_eq!(least.before, found.before, "fitted once");
    let closed = (found.before - found.after) / (found.before - least.after);
    assert!((closed - 1.0).abs() < 0.05, "{closed}");
    let d = oracle.detectability.expect("of one effect");
    assert!(d > 10.0, "{d}");
    assert!(
        given("coulomb_friction", "nowhere")
            .expect("looked for")
            .is_none()
    );
    let again = answer.round_trip.as_ref().expect("a round trip");
    assert!(again.found.is_empty(), "{again:?}");
    assert!(again.returned.iter().all(Returned::is_inside), "{again:?}");
    let repaired = Model::from_xml_str(&outcome.model).expect("loads");
    assert!((repaired.dof_frictionloss()[1] / level.value - 1.0).abs() < 1e-9);
    // and the block stands where it does, whatever made up for its friction before
    let block = repaired.id(ObjectKind::Body, "block").expect("a block");
    let at = repaired.body_pos()[3 * block];
    assert!((at - 0.05).abs() < 0.1 * OFF_M, "{at}");
}

#[test]
fn of_a_machine_like_its_model_nothing_is_found() {
    let options = Options {
        timestep_s: Some(0.001),
        ..pulled(5.0)
    };
    let outcome = gap::run(&Bench::of("").input(), &options, &mut |_, _, _| true);
    let outcome = outcome.expect("searched");
    assert_eq!(
        outcome.answer.verdict,
        Verdict::None,
        "{:#?}",
        outcome.answer.effects
    );
    // the file keeps its own steps
    let model = Model::from_xml_str(&outcome.model).expect("loads");
    assert_eq!(model.timestep(), 0.002);
}

#[test]
fn a_pull_that_steps_cannot_follow_is_refused() {
    let outcome = gap::run(&Bench::of("").input(), &pulled(400.0), &mut |_, _, _| true);
    let error = outcome.expect_err("refused");
    assert!(error.to_string().contains("pull"), "{error}");
}
