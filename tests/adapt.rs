//! The loop in small: recordings, posterior, training, test; found again when it goes on.

mod common;

use std::fs;
use std::path::Path;

use std::sync::Arc;

use common::program::phantom;
use phantom::adapt::{AdaptConfig, Adaptation, Found, Missing, Round, Watch};
use phantom::mujoco::Model;
use phantom::rig::Rig;
use phantom::run_dir;
use phantom::sysid::parameter::ParameterRule;
use phantom::sysid::problem::ProblemConfig;
use serde_json::Value;

/// The forearms of one finger are heavier than the model says.
const RIG: &str = "[physics]\nsubsteps = 1\n[sensing]\nencoder_steps_per_rad = 20000\n\
    [[effect]]\nname = \"link_mass\"\nwhere = \"p0_forearm\"\nshare = 0.5\n";
const PARAMETERS: &str =
    "[[parameter]]\nelement = \"body/p0_forearm\"\nattribute = \"mass\"\nprior_sigma = 1.0\n";
const SETTINGS: &str = "rounds = 1\nseconds = 0.1\nmodels = 4\nrollouts = 1\nmax_effects = 0\nidentify_method = \"joint\"\nidentify_timestep_s = 0.002\n\
    identify_iterations = 5\n[training.train]\niterations = 1\ntrajectories = 16\ntrajectory_s = 0.1\nevaluate_every = 0\n";

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, text) in [
        ("rig.toml", RIG),
        ("parameters.toml", PARAMETERS),
        ("adapt.toml", SETTINGS),
        (
            "small.toml",
            "[train]\niterations = 1\ntrajectories = 16\ntrajectory_s = 0.1\nevaluate_every = 0\n",
        ),
    ] {
        fs::write(folder.path().join(name), text).expect("writable");
    }
    let trained = phantom(
        folder.path(),
        &["train", "--config", "small.toml", "--out", "run"],
    );
    assert!(trained.status.success());
    folder
}

const COMMON: [&str; 11] = [
    "adapt",
    "--rig",
    "rig.toml",
    "--policy",
    "run/policy_last.json",
    "--parameters",
    "parameters.toml",
    "--config",
    "adapt.toml",
    "--out",
    "loop",
];

#[test]
fn settings_that_are_not_given_stay_those_of_the_loop() {
    let given =
        "rounds = 1\n[training.train]\niterations = 7\n[training.npg]\nfisher_damping = 0.2\n";
    let config: AdaptConfig = toml::from_str(given).expect("settings");
    let mut expected = AdaptConfig {
        rounds: 1,
        ..AdaptConfig::default()
    };
    expected.training.train.iterations = 7;
    expected.training.npg.fisher_damping = 0.2;
    assert_eq!(config, expected);
    let wrong = toml::from_str::<AdaptConfig>("[training.npg]\ndamping = 0.2\n");
    let message = wrong.expect_err("no such setting").to_string();
    assert!(
        message.contains("`damping`") && message.contains("fisher_damping"),
        "{message}"
    );
}

#[test]
fn a_round_finds_the_mass_and_leaves_what_is_needed() {
    let folder = folder();
    let run = |more: &[&str]| phantom(folder.path(), &[&COMMON[..], more].concat());
    let output = run(&[]);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    // whether one update of a policy that knows nothing helps is chance
    assert!(matches!(output.status.code(), Some(0 | 1)), "{error}");
    let path = folder.path().join("loop");
    let result: Value = run_dir::read_json(&path.join("result.json")).expect("a result");
    let mass = &result["rounds"][1]["identified"]["parameters"][0];
    let number = |key: &str| mass[key].as_f64().expect("a number");
    assert!((number("truth") / number("nominal") - 1.5).abs() < 1e-9);
    assert!(
        (number("value") / number("truth") - 1.0).abs() < 0.1,
        "{mass}"
    );
    assert_eq!(result["references"].as_array().expect("both").len(), 2);
    let page = fs::read_to_string(path.join("adapt.html")).expect("a page");
    assert!(page.contains("stands in for a machine") && path.join("tracking.svg").exists());

    // nothing is done twice
    let kept = |name: &str| {
        fs::metadata(path.join(name))
            .and_then(|m| m.modified())
            .expect("there")
    };
    let files = [
        "round-1/identified.json",
        "round-1/policy/checkpoint.json",
        "truth/round-1/tracking.json",
    ];
    let before = files.map(kept);
    run(&[]);
    assert_eq!(files.map(kept), before);

    // another machine is not taken for this one
    let rig = RIG.replace("0.5", "0.4");
    fs::write(folder.path().join("rig.toml"), rig).expect("writable");
    let other = run(&[]);
    let message = String::from_utf8_lossy(&other.stderr).into_owned();
    assert_eq!(other.status.code(), Some(2));
    assert!(message.contains("another rig"), "{message}");
}

/// Says nothing, and never stops.
struct Silent;

impl Watch for Silent {
    fn stage(&mut self, _text: &str) {}
    fn advanced(&mut self) -> bool {
        true
    }
}

#[test]
fn physics_found_missing_is_estimated_and_found_once() {
    let folder = folder();
    let model_path = Path::new(env!("CARGO_MANIFEST_DIR")).join("xml/phantom.xml");
    let model = Model::from_xml_path(&model_path).expect("loads");
    let mut config: AdaptConfig = toml::from_str(SETTINGS).expect("settings");
    config.max_effects = 1;
    let adaptation = |out: &str| Adaptation {
        out: folder.path().join(out),
        rig: Rig::new(
            model.try_clone().expect("a copy"),
            toml::from_str(RIG).expect("a rig"),
        )
        .expect("fits"),
        model_path: model_path.clone(),
        model: Arc::new(model.try_clone().expect("a copy")),
        policy: run_dir::read_json(&folder.path().join("run/policy_last.json")).expect("a policy"),
        parameters: toml::from_str(PARAMETERS).expect("parameters"),
        config: config.clone(),
        threads: 1,
    };
    // the search is another module's: here it names a spring that stiffens the model file
    let extended = folder.path().join("extended.xml");
    let text = fs::read_to_string(&model_path).expect("readable");
    let sprung = text.replacen(
        "<joint name=\"p0_turret\"",
        "<joint name=\"p0_turret\" stiffness=\"0.01\"",
        1,
    );
    assert_ne!(sprung, text);
    fs::write(&extended, sprung).expect("writable");
    let mut searches = 0;
    let mut run = |found: &dyn Fn() -> Found, out: &str| -> Option<Vec<Round>> {
        let rounds = adaptation(out).run(
            &mut |search, _| {
                assert_eq!((search.round, search.recordings.len()), (1, 1));
                searches += 1;
                Ok(found())
            },
            &mut Silent,
        );
        rounds.expect("a loop")
    };
    let spring = || {
        Found::Missing(Missing {
            model: extended.clone(),
            effects: vec!["joint_spring at p0_turret".to_owned()],
            parameters: {
                let own: ProblemConfig = toml::from_str(PARAMETERS).expect("parameters");
                let stiffness = ParameterRule {
                    prior_sigma: Some(1.0),
                    ..ParameterRule::new("joint/p0_turret", "stiffness")
                };
                [own.parameter, vec![stiffness]].concat()
            },
        })
    };
    assert!(run(&|| Found::Stopped, "stopped").is_none());
    for _ in 0..2 {
        let rounds = run(&spring, "found").expect("to its end");
        let identified = rounds[1].identified.as_ref().expect("identified");
        assert_eq!(identified.added, ["joint_spring at p0_turret"]);
        assert_eq!(identified.model, extended);
        let names: Vec<&str> = (identified.parameters.iter().map(|p| p.name.as_str())).collect();
        assert_eq!(names, ["body/p0_forearm mass", "joint/p0_turret stiffness"]);
        // killed before the identification was written
        fs::remove_file(folder.path().join("found/round-1/identified.json")).expect("was there");
    }
    assert_eq!(searches, 2);
}

#[test]
fn bad_settings_are_named() {
    let folder = folder();
    for (text, key) in [
        ("rounds = 0\n", "rounds"),
        ("objective = { epopt = 1.5 }\n", "objective.epopt"),
        ("behaviours = []\n", "behaviours"),
        ("seconds = -1.0\n", "seconds"),
        ("behaviours = [\"dance\"]\n", "dance"),
        (
            "[training.train]\niterations = 1\ntrajectories = 0\n",
            "train.trajectories",
        ),
    ] {
        fs::write(folder.path().join("adapt.toml"), text).expect("writable");
        let output = phantom(folder.path(), &COMMON);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}: {message}");
        assert!(message.contains(key), "{text}: {message}");
    }
}
