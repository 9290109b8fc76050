//! Simulations nudged along a recording in contact find what touches, and where.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::sysid::SysidError;
use phantom::sysid::fit::{Fit, Start, Status};
use phantom::sysid::interval::Posterior;
use phantom::sysid::norm::Norm;
use phantom::sysid::nudging::{NudgingSettings, solve};
use phantom::sysid::parameter::ParameterRule;
use phantom::sysid::problem::{ChannelRule, CommandTiming, Problem, ProblemConfig};

use crate::simulate::{recorded, simulate};

/// A driven finger pushes a block on rails with dry friction, again and again. No spring holds it to the finger.
const PUSHER: &str = r#"<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body name="finger"><joint name="f" type="slide" axis="1 0 0" damping="3"/><geom name="tip" size=".01" mass=".1"/></body>
<body name="block" pos=".05 0 0"><joint name="b" type="slide" axis="1 0 0" frictionloss=".5"/>
<geom name="block" type="box" size=".02 .02 .02" mass=".3"/></body></worldbody>
<contact><pair geom1="tip" geom2="block" solref="-4000 -40"/></contact>
<actuator><motor name="m" joint="f"/></actuator>
<sensor><jointpos name="fs" joint="f"/><jointpos name="bs" joint="b"/></sensor></mujoco>"#;

const NOISE_M: f64 = 5e-5;
/// mass, friction, and where the block stands at first
const TRUTH: [f64; 3] = [0.3, 0.5, 0.05];
/// m that the model has the block nearer
const OFF_M: f64 = 3e-3;

/// `beyond`: parameters besides mass, friction and place.
fn problem(norm: Norm, beyond: Option<ParameterRule>) -> Problem {
    let model = Arc::new(Model::from_xml_str(PUSHER).expect("loads"));
    let mut data = Data::new(model.clone()).expect("data");
    let run = simulate(&mut data, 1500, |data, ctrl| {
        let goal = 0.02 * data.time() + 0.02 * (1.0 - (6.0 * data.time()).cos());
        ctrl[0] = 400.0 * (goal - data.qpos()[0]) - 10.0 * data.qvel()[0];
    });
    assert!(run.qpos[1499][1] > 0.02, "pushed to {}", run.qpos[1499][1]);
    let names = (["fs", "bs"].as_slice(), ["m"].as_slice());
    let recording = recorded(&run, 500, names, NOISE_M, 5);
    let rule = |element, attribute, start: f64, prior_sigma| ParameterRule {
        start: Some(start),
        prior: Some(start),
        prior_sigma: Some(prior_sigma),
        ..ParameterRule::new(element, attribute)
    };
    let own = [
        rule("body/block", "mass", 0.5, 0.5),
        rule("joint/b", "frictionloss", 0.9, 0.5),
        ParameterRule {
            components: vec![0],
            ..rule("body/block", "pos", TRUTH[2] - OFF_M, 3e-3)
        },
    ];
    let config = ProblemConfig {
        parameter: own.into_iter().chain(beyond).collect(),
        channel: vec![ChannelRule {
            name: "*".into(),
            noise_sigma: Some(NOISE_M),
            norm,
            ignore: false,
        }],
        command: CommandTiming::Held,
        ..ProblemConfig::default()
    };
    Problem::new(model, &config, &[("push".into(), recording)]).expect("fits")
}

fn identify(problem: &Problem, settings: &NudgingSettings) -> Result<Fit, SysidError> {
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    solve(problem, settings, &start, &mut |_| true)
}

#[test]
fn mass_friction_and_place_of_what_is_pushed_come_back() {
    let problem = problem(Norm::Quadratic, None);
    let fit = identify(&problem, &NudgingSettings::default()).expect("solved");
    assert_eq!(fit.status, Status::Converged);
    let lengths = [problem.trials[0].n_knots];
    let posterior = Posterior::new(&problem.parameters, &fit.x, &fit.innovations, &lengths);
    // a damper that is half a step early is worth 10 % of the mass here
    for (estimate, truth) in posterior.estimates.iter().zip(TRUTH) {
        let off = estimate.value / truth - 1.0;
        assert!(off.abs() < 0.02, "{}: {off}", estimate.name);
        let [low, high] = estimate.interval.expect("determined");
        assert!(low < truth && truth < high, "{estimate:?}");
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let problem = problem(Norm::Quadratic, None);
    let settings = NudgingSettings {
        max_iterations: 3,
        ..NudgingSettings::default()
    };
    let of = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().expect("threads");
        pool.install(|| identify(&problem, &settings).expect("solved"))
    };
    let (one, three) = (of(1), of(3));
    assert_eq!(one.x, three.x);
    assert_eq!(one.innovations.rows, three.innovations.rows);
}

#[test]
fn what_it_cannot_use_is_refused() {
    let refused = |problem: &Problem, hz: f64, part: &str| {
        let settings = NudgingSettings {
            hz,
            ..NudgingSettings::default()
        };
        let error = identify(problem, &settings).expect_err("refused");
        assert!(error.to_string().contains(part), "{error}");
    };
    for hz in [0.0, f64::NAN, 50.0] {
        refused(&problem(Norm::Quadratic, None), hz, "below 50 Hz");
    }
    refused(
        &problem(Norm::Huber(2.0), None),
        5.0,
        "channel `fs` has a norm",
    );
}

/// An ensemble without simulations once passed for one without deviations.
#[test]
fn an_ensemble_that_diverges_is_no_estimate() {
    let gear = ParameterRule {
        components: vec![0],
        prior_sigma: Some(1e14),
        ..ParameterRule::new("actuator/m", "gear")
    };
    let problem = problem(Norm::Quadratic, Some(gear));
    let error = identify(&problem, &NudgingSettings::default()).expect_err("refused");
    assert!(error.to_string().contains("diverges"), "{error}");
}
