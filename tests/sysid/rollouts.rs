//! A tumbling cube: single rollouts are chaotic, their mean is a cost that can be searched.

use std::sync::Arc;

use phantom::compare::Settings;
use phantom::mujoco::Model;
use phantom::recording::Recording;
use phantom::sysid::SysidError;
use phantom::sysid::fit::{Fit, Start};
use phantom::sysid::interval::Posterior;
use phantom::sysid::method::Method;
use phantom::sysid::parameter::ParameterRule;
use phantom::sysid::problem::{Problem, ProblemConfig};
use phantom::sysid::rollouts::RolloutSettings;

use crate::common::toss::Toss;

const FRICTION: f64 = 0.25;

fn cube() -> Arc<Model> {
    let xml = r#"<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
        <geom name="table" type="plane" size="1 1 .1"/>
        <body name="cube" pos="0 0 .05"><freejoint name="cube"/>
        <geom name="cube" type="box" size=".05 .05 .05" mass=".4"/></body></worldbody>
        <contact><pair name="on" geom1="cube" geom2="table" condim="3" friction=".4 .4 0 0 0"/></contact></mujoco>"#;
    Arc::new(Model::from_xml_str(xml).expect("loads"))
}

/// Tosses under the true friction, with a millimetre of noise.
fn tosses(n: u64, steps: i64) -> Vec<(String, Recording)> {
    let mut model = cube().try_clone().expect("copy");
    model.edit().pair_friction()[..2].fill(FRICTION);
    let model = Arc::new(model);
    let toss = Toss {
        height_m: 0.12,
        steps,
        every: 5,
        noise: 1e-3,
    };
    toss.record(&model, 0..n)
}

fn settings() -> RolloutSettings {
    RolloutSettings {
        protocol: Settings {
            horizons_s: vec![],
            to_end: true,
            every_s: Some(1e3),
            ..Settings::default()
        },
        generations: 12,
        ..RolloutSettings::default()
    }
}

fn identify(problem: &Problem, settings: RolloutSettings) -> Result<Fit, SysidError> {
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    Method::Rollout(settings).solve(problem, &start, &mut |_| true)
}

fn problem(n: u64, steps: i64) -> Problem {
    let rule = ParameterRule {
        lower: Some(0.05),
        upper: Some(1.0),
        ..ParameterRule::new("pair/on", "slide")
    };
    let config = ProblemConfig {
        parameter: vec![rule],
        ..ProblemConfig::default()
    };
    Problem::new(cube(), &config, &tosses(n, steps)).expect("fits")
}

#[test]
fn friction_of_a_tumbling_cube_is_found() {
    let problem = problem(24, 200);
    let fit = identify(&problem, settings()).expect("solved");
    let found = fit.x[0].exp();
    assert!((found / FRICTION - 1.0).abs() < 0.05, "{found}");
    let lengths: Vec<usize> = problem.trials.iter().map(|t| t.n_knots).collect();
    let posterior = Posterior::new(&problem.parameters, &fit.x, &fit.innovations, &lengths);
    let [low, high] = posterior.estimates[0].interval.expect("an interval");
    assert!(low < FRICTION && FRICTION < high, "{low} {high}");
    assert!(high / low < 1.3, "{low} {high}");
    // the motion of the result is the one of its rollouts
    let nq = problem.model.nq();
    assert!((fit.trajectories.iter().zip(&problem.trials)).all(|(t, p)| t.len() == p.n_knots * nq));
    let again = identify(&problem, settings()).expect("solved");
    assert_eq!(again, fit, "the same seed");
}

#[test]
fn rollouts_need_a_start() {
    let mut settings = settings();
    settings.protocol.drop = Some(phantom::compare::settings::Drop {
        joint: "cube".into(),
        below_m: -1.0,
        free_flight: false,
    });
    let error = identify(&problem(2, 50), settings).expect_err("never that low");
    assert!(error.to_string().contains("start"), "{error}");
}
