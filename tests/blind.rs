//! Suites of blind tests: which machines they make, and what is refused. How often the search is right is a matter of
//! `phantom gap bench` (docs/gap.md).

use std::path::Path;

use phantom::blind::{Suite, SuiteConfig};
use phantom::rig::RigConfig;
use phantom::sysid::problem::ProblemConfig;

fn root(path: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn suite(arms: &str) -> Result<Suite, String> {
    let text = format!(
        "rig = \"r\"\nparameters = \"p\"\ntrain = [{{ behaviour = \"multi_sine\" }}]\nholdout = []\n{arms}"
    );
    let config: SuiteConfig = toml::from_str(&text).map_err(|e| e.message().to_owned())?;
    let rig = std::fs::read_to_string(root("rigs/arm.toml")).expect("shipped");
    let rig: RigConfig = toml::from_str(&rig).expect("shipped");
    Suite::new(config, rig, &root("xml/arm.xml"), ProblemConfig::default())
        .map_err(|e| e.to_string())
}

fn keys(suite: &Suite) -> Vec<String> {
    suite.cases.iter().map(|c| c.key(&suite.config)).collect()
}

#[test]
fn an_arm_makes_every_combination() {
    let all = suite(
        "[[arm]]\nname = \"none\"\nmachines = 2\n\
         [[arm]]\nname = \"one\"\neffects = [\"cogging\", \"object_mass\"]\nseverity = [0.5, 2.0]\nnoise = [1.0, 4.0]\n\
         machines = 1\n\
         [[arm]]\nname = \"two\"\neffects = [\"*\"]\ntogether = 2\nmachines = 1",
    )
    .expect("a suite");
    // an arm without a free body has no object: that effect makes no case
    let expected = [
        "none/-/1/1/0",
        "none/-/1/1/1",
        "one/cogging/0.5/1/0",
        "one/cogging/0.5/4/0",
        "one/cogging/2/1/0",
        "one/cogging/2/4/0",
        "two/-/1/1/0",
    ];
    assert_eq!(keys(&all), expected);
}

#[test]
fn what_makes_no_sense_is_named() {
    let refused = |arms: &str, what: &str| {
        let message = suite(arms).expect_err(what);
        assert!(message.contains(what), "{message}");
    };
    let none_fits = "[[arm]]\nname = \"a\"\neffects = [\"object_mass\"]\nmachines = 1";
    refused(none_fits, "arm `a` makes no case");
    let factor = "[[arm]]\nname = \"a\"\nmachines = 1\nnoise = [-1.0]";
    refused(factor, "factor -1");
    refused("[[arm]]\nname = \"a\"\nmachines = 1\nwat = 3", "wat");
    refused(
        "[[arm]]\nname = \"a\"\nmachines = 0",
        "arm `a` makes no case",
    );
}

/// A suite of `suites/`.
fn shipped(name: &str, change: impl Fn(&mut SuiteConfig)) -> Suite {
    let suites = root("suites");
    let read = |path: &Path| std::fs::read_to_string(suites.join(path)).expect("shipped");
    let file = format!("{name}.toml");
    let mut config: SuiteConfig = toml::from_str(&read(file.as_ref())).expect("a suite");
    change(&mut config);
    let rig: RigConfig = toml::from_str(&read(&config.rig)).expect("a rig");
    let parameters = toml::from_str(&read(&config.parameters)).expect("parameters");
    let model = Suite::model_of(&rig, &suites.join(&config.rig)).expect("named");
    Suite::new(config, rig, &model, parameters).expect("fits")
}

#[test]
fn shipped_suites_fit_their_rigs() {
    for name in ["arm", "contact", "finger"] {
        assert!(!shipped(name, |_| ()).cases.is_empty());
    }
}

/// The answer to one machine of the arm's suite, with an effect of four times the usual size.
fn found(effect: &str) -> phantom::blind::Scored {
    answer("one", effect, 4.0)
}

fn answer(arm: &str, effect: &str, severity: f64) -> phantom::blind::Scored {
    answer_of(arm, effect, severity, |_| ())
}

fn answer_of(
    arm: &str,
    effect: &str,
    severity: f64,
    change: impl Fn(&mut SuiteConfig),
) -> phantom::blind::Scored {
    let suite = shipped("arm", |config| {
        config.arm.retain(|own| own.name == arm);
        let arm = &mut config.arm[0];
        (arm.effects, arm.severity, arm.machines) = (vec![effect.to_owned()], vec![severity], 1);
        change(config);
    });
    first(&suite)
}

/// The answer to the suite's first machine.
fn first(suite: &Suite) -> phantom::blind::Scored {
    let watch: phantom::gap::Report<'_> = &mut |_, _, _| true;
    suite.run(&suite.cases[0], watch).expect("an answer")
}

/// A fitted mass stands for most of it, and joints that stick hide the rest from small changes of the model.
#[test]
fn an_offset_that_a_mass_made_up_for_is_found() {
    let scored = found("torque_offset");
    assert!(scored.exact, "{scored:?}");
    assert!(scored.covered.iter().all(phantom::blind::Covered::inside));
}

/// Few stretches of time are fast enough to tell.
#[test]
fn what_few_stretches_tell_plainly_is_found() {
    assert!(found("quadratic_drag").exact);
}

/// Readings at the beginning of a window are of before it.
#[test]
fn late_readings_are_found() {
    assert!(found("sensor_delay").exact);
}

/// Less recorded of machine 2000.
fn brief(config: &mut SuiteConfig) {
    config.first_seed = 2000;
    config.train.truncate(2);
    for trial in config.train.iter_mut().chain(&mut config.holdout) {
        trial.seconds = Some(2.5);
    }
}

/// Its period fitted together with its size went astray, and cogging was left.
#[test]
fn ripple_is_not_cogging() {
    let scored = answer_of("one", "torque_ripple", 4.0, brief);
    assert!(scored.exact, "{scored:?}");
}

/// Windows of 0.2 s lose a motion that a stop ends: they are cut shorter where nothing explains it.
#[test]
fn a_stop_in_the_middle_of_the_motion_is_found() {
    let scored = answer_of("one", "joint_stop", 4.0, brief);
    assert!(scored.exact, "{scored:?}");
}

/// A payload explains more than the spring or the length alone, and a motor's gain beside it most of the rest.
#[test]
fn two_effects_are_found_though_another_explains_more_than_either() {
    let suite = shipped("arm", |config| {
        config.arm.retain(|own| own.name == "two");
        config.arm[0].machines = 1;
        brief(config);
        config.first_seed = 32005;
    });
    let scored = first(&suite);
    assert!(scored.exact, "{scored:?}");
}

/// Damping is fitted in any case, so that nothing tells what was there before.
#[test]
fn what_fitted_parameters_absorb_is_untestable() {
    let scored = answer("absorbed by fitted parameters", "viscous_friction", 1.0);
    assert!(scored.found.is_empty() && scored.right, "{scored:?}");
}

/// No effect of the catalogue acts as a spring that stiffens: what is named, if anything, is not all.
#[test]
fn what_no_catalogue_has_is_unknown() {
    let verdict = found("cubic_spring").verdict;
    assert_eq!(verdict, phantom::gap::result::Verdict::Unknown);
}
