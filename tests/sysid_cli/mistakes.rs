//! Files and settings that cannot be used.

use std::fs;

use crate::machine::{MODEL, PARAMETERS, folder, sysid, text};

#[test]
fn mistakes_are_named_with_exit_code_2() {
    let folder = folder();
    let write =
        |name: &str, content: &str| fs::write(folder.path().join(name), content).expect("written");
    let with = |old: &str, new: &str| PARAMETERS.replace(old, new);
    write("element.toml", &with("joint/hinge", "joint/hing"));
    write("attribute.toml", &with("\"damping\"", "\"dampening\""));
    write(
        "key.toml",
        &with("attribute = \"mass\"", "attribute = \"mass\"\nsigma = 1"),
    );
    write(
        "bound.toml",
        &with("attribute = \"mass\"", "attribute = \"mass\"\nlower = 0.5"),
    );
    write(
        "twice.toml",
        &with(
            "\"body/arm\"\nattribute = \"mass\"",
            "\"joint/*\"\nattribute = \"damping\"",
        ),
    );
    write("none.toml", "[[channel]]\nname = \"encoder\"\n");
    write(
        "rk4.xml",
        &MODEL.replace(
            "timestep=\"0.005\"",
            "timestep=\"0.005\" integrator=\"RK4\"",
        ),
    );
    write(
        "included.xml",
        &MODEL.replace(
            "<body name=\"arm\"",
            "<include file=\"arm.xml\"/><body name=\"other\"",
        ),
    );
    write("broken.xml", "<mujoco><worldbody>");
    write("no_control.csv", "time,encoder\n0,0\n0.005,0\n0.01,0\n");
    write(
        "short.csv",
        "time,encoder,motor\n0,0,0\n0.005,0,0\n0.01,0,0\n",
    );
    write(
        "unknown.csv",
        "time,voltage,motor\n0,0,0\n0.005,0,0\n0.01,0,0\n",
    );
    write("low.toml", "horizons_s = [-1.0]\n");
    for (arguments, message) in [
        (
            &["--parameters", "element.toml", "log1.mcap"][..],
            "no joint is named `hing`; there are: hinge",
        ),
        (
            &["--parameters", "attribute.toml", "log1.mcap"],
            "it has: damping, frictionloss",
        ),
        (
            &["--parameters", "key.toml", "log1.mcap"],
            "key.toml:10: unknown field `sigma`",
        ),
        (
            &["--parameters", "bound.toml", "log1.mcap"],
            "starts on its bound 0.5",
        ),
        (
            &["--parameters", "twice.toml", "log1.mcap"],
            "is already set by `joint/hinge damping`",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--pull", "5"],
            "--pull is for --method nudging",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--at-rest"],
            "--at-rest is for --method sequential",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--method",
                "sequential",
                "--chains",
                "5",
            ],
            "5 chains are too few",
        ),
        (
            &["--parameters", "none.toml", "log1.mcap"],
            "there is no [[parameter]] to estimate",
        ),
        (&["--parameters", "gone.toml", "log1.mcap"], "gone.toml"),
        (&["--parameters", "p.toml", "gone.mcap"], "gone.mcap"),
        (
            &["--parameters", "p.toml", "no_control.csv"],
            "actuator `motor` is not recorded",
        ),
        (&["--parameters", "p.toml", "short.csv"], "covers 3 steps"),
        (
            &["--parameters", "p.toml", "unknown.csv"],
            "no channel is a sensor",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--holdout",
                "short.csv",
            ],
            "covers 3 steps",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--protocol",
                "low.toml",
            ],
            "`horizons_s` is -1",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--ensemble", "0"],
            "1 to 1000000",
        ),
        (
            &["--parameters", "p.toml", "log1.mcap", "--model", "rk4.xml"],
            "its integrator is not Euler",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--model",
                "broken.xml",
            ],
            "broken.xml",
        ),
        (
            &[
                "--parameters",
                "p.toml",
                "log1.mcap",
                "--out",
                "model.xml/x",
            ],
            "model.xml/x",
        ),
        (&["--parameters", "p.toml"], "<FILE>"),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "dance"],
            "there is no behaviour `dance`",
        ),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "push"],
            "the model does not fit",
        ),
        (
            &["design", "--parameters", "p.toml", "--behaviours", "none"],
            "no --candidate to judge",
        ),
    ] {
        let mut all = arguments.to_vec();
        if !all.contains(&"--model") {
            all.extend(["--model", "model.xml"]);
        }
        let output = sysid(folder.path(), &all);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(message), "{arguments:?}: {error}");
    }
    assert!(
        !folder.path().join("sysid/model.xml").exists(),
        "nothing is written"
    );
}
