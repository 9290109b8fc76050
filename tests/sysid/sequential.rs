//! A swarm of simulations finds parameters of a small machine from what it sees of the recording.

use std::sync::Arc;

use phantom::mujoco::{Data, Model};
use phantom::sysid::fit::{Fit, Start};
use phantom::sysid::interval::Posterior;
use phantom::sysid::method::Method;
use phantom::sysid::norm::Norm;
use phantom::sysid::parameter::ParameterRule;
use phantom::sysid::problem::{ChannelRule, CommandTiming, Problem, ProblemConfig};
use phantom::sysid::sequential::SequentialSettings;
use phantom::sysid::shooting::ShootingSettings;

use crate::simulate::{recorded, simulate};

/// A slider that is pushed to and fro against a viscous friction, and leans on a stop part of the time.
const SLIDER: &str = r#"<mujoco><option timestep="0.01"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0" damping="2" limited="true" range="-1 0.3"/>
<geom size=".1" mass="1"/></body></worldbody>
<actuator><motor name="m" joint="x"/></actuator><sensor><jointpos name="xs" joint="x"/></sensor></mujoco>"#;

const NOISE_M: f64 = 1e-3;
const TRUTH: [f64; 2] = [2.0, 1.0];

/// One that begins with a velocity; `wrong_m` is added to its readings in the second half.
fn problem(velocity: f64, wrong_m: f64) -> Problem {
    let model = Arc::new(Model::from_xml_str(SLIDER).expect("loads"));
    let mut data = Data::new(model.clone()).expect("data");
    data.qvel_mut()[0] = velocity;
    let mut run = simulate(&mut data, 100, |data, ctrl| {
        ctrl[0] = 4.0 * (5.0 * data.time()).sin();
    });
    for reading in &mut run.sensordata[50..] {
        reading[0] += wrong_m;
    }
    let recording = recorded(&run, 100, (&["xs"], &["m"]), NOISE_M, 4);
    let rule = |element, attribute, start| ParameterRule {
        start: Some(start),
        lower: Some(0.05),
        upper: Some(20.0),
        ..ParameterRule::new(element, attribute)
    };
    let config = ProblemConfig {
        parameter: vec![
            rule("joint/x", "damping", 10.0),
            rule("body/cart", "mass", 0.2),
        ],
        channel: vec![ChannelRule {
            name: "*".into(),
            noise_sigma: Some(NOISE_M),
            norm: Norm::default(),
            ignore: false,
        }],
        command: CommandTiming::Held,
        ..ProblemConfig::default()
    };
    Problem::new(model, &config, &[("slider".into(), recording)]).expect("fits")
}

fn solve(problem: &Problem, method: &Method, start: Vec<f64>) -> Fit {
    let start = Start {
        x: start,
        trajectories: None,
        force_scale: None,
    };
    method
        .solve(problem, &start, &mut |_| true)
        .expect("solved")
}

fn settings(n_chains: usize, at_rest: bool, seed: u64) -> Method {
    Method::Sequential(SequentialSettings {
        n_chains,
        at_rest,
        seed,
        ..SequentialSettings::default()
    })
}

fn sigmas(problem: &Problem, fit: &Fit) -> Vec<f64> {
    let lengths = [problem.trials[0].n_knots];
    let posterior = Posterior::new(&problem.parameters, &fit.x, &fit.innovations, &lengths);
    let sigma = |e: &phantom::sysid::interval::Estimate| {
        // as white noise has it, which is what the swarm's own spread is of
        e.x_sigma.expect("free") / e.inflation.expect("free").sqrt()
    };
    posterior.estimates.iter().map(sigma).collect()
}

/// Where the posterior is a Gaussian, both have its mean and its covariance, though one uses no derivative.
#[test]
fn a_swarm_and_gauss_newton_agree_on_estimates_and_intervals() {
    let problem = problem(0.6, 0.0);
    let shooting = Method::Shooting(ShootingSettings {
        window_s: f64::INFINITY,
        ..ShootingSettings::default()
    });
    let by_slopes = solve(&problem, &shooting, problem.parameters.start());
    let a = sigmas(&problem, &by_slopes);
    // two seeds with which the swarm went no farther than to where it meets the stop, when chains were too short there
    for seed in [1, 4] {
        let swarm = solve(
            &problem,
            &settings(100, false, seed),
            problem.parameters.start(),
        );
        assert_eq!(swarm.horizon_s, None, "all of it is seen");
        let b = sigmas(&problem, &swarm);
        for j in 0..2 {
            let off = (swarm.x[j] - by_slopes.x[j]) / a[j];
            assert!(off.abs() < 0.4, "{j}: {off} standard deviations apart");
            assert!((0.8..1.25).contains(&(b[j] / a[j])), "{j}: {a:?}, {b:?}");
            assert!((swarm.x[j] - TRUTH[j].ln()).abs() < 4.0 * a[j]);
        }
    }
}

#[test]
fn a_recording_that_begins_at_rest_tells_more() {
    let problem = problem(0.0, 0.0);
    let of = |at_rest| {
        let fit = solve(
            &problem,
            &settings(30, at_rest, 0),
            problem.parameters.start(),
        );
        sigmas(&problem, &fit)
    };
    let (rest, moving) = (of(true), of(false));
    assert!(
        rest[0] < moving[0] && rest[1] < moving[1],
        "{rest:?} {moving:?}"
    );
}

#[test]
fn it_goes_no_farther_than_the_model_follows() {
    let problem = problem(0.0, 0.05);
    let fit = solve(&problem, &settings(20, true, 0), problem.parameters.start());
    let horizon = fit.horizon_s.expect("part of it");
    assert!((0.4..=0.52).contains(&horizon), "{horizon}");
    assert_eq!(fit.level, 0.0, "no force makes a reading jump by 5 cm");
    for (x, truth) in fit.x.iter().zip(TRUTH) {
        assert!((x - truth.ln()).abs() < 0.1, "{}, {truth}", x.exp());
    }
}

/// A swarm that stops where damping is hardly known finds it behind its horizon.
#[test]
fn what_lies_behind_the_horizon_tells_the_rest() {
    let problem = problem(0.0, 0.0);
    let of = |max_iterations| {
        let method = Method::Sequential(SequentialSettings {
            n_chains: 50,
            at_rest: true,
            max_iterations,
            ..SequentialSettings::default()
        });
        solve(&problem, &method, problem.parameters.start())
    };
    let sigma = sigmas(&problem, &of(300));
    let fit = of(14);
    assert!(fit.horizon_s.is_some_and(|s| s < 0.35));
    let at_horizon = sigmas(&problem, &fit);
    for j in 0..2 {
        assert!(at_horizon[j] > 5.0 * sigma[j], "{j}: known too well");
        let off = (fit.x[j] - TRUTH[j].ln()) / sigma[j];
        assert!(off.abs() < 4.0, "{j}: {off} standard deviations off");
    }
}

#[test]
fn the_same_seed_gives_the_same_swarm_on_any_number_of_threads_and_from_any_start() {
    let problem = problem(0.0, 0.0);
    let found = |seed, threads: usize, start: f64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().expect("threads");
        let start = vec![start.ln(); 2];
        pool.install(|| solve(&problem, &settings(20, true, seed), start))
            .x
    };
    assert_eq!(found(1, 1, 0.1), found(1, 3, 10.0));
    assert_ne!(found(1, 2, 0.1), found(2, 2, 0.1));
}

#[test]
fn too_few_simulations_are_refused() {
    let problem = problem(0.0, 0.0);
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    let fit = settings(3, true, 0).solve(&problem, &start, &mut |_| true);
    let text = fit.expect_err("refused").to_string();
    assert!(text.contains("3 chains") && text.contains("20"), "{text}");
}

#[test]
fn readings_that_no_simulation_follows_are_refused() {
    let mut problem = problem(0.0, 0.0);
    problem.channels[0].sigma = 1e-7;
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    let fit = settings(20, true, 0).solve(&problem, &start, &mut |_| true);
    let text = fit.expect_err("refused").to_string();
    assert!(
        text.contains("first samples") && text.contains("noise"),
        "{text}"
    );
}
