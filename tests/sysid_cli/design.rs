//! What to record next.

use phantom::recording;

use crate::machine::{folder, record, sysid, text};

/// Of a sine and of standing still, the sine tells more; both are judged from files and from the library.
#[test]
fn design_prefers_motion() {
    let folder = folder();
    let mut still = record(1, 1.0);
    for stream in &mut still.streams {
        stream.values.fill(0.0);
    }
    recording::write(&folder.path().join("still.mcap"), &still).expect("written");
    let arguments = [
        "design",
        "--model",
        "model.xml",
        "--parameters",
        "p.toml",
        "--behaviours",
        "multi_sine",
        "--seconds",
        "1",
        "--candidate",
        "still.mcap",
        "--next",
        "2",
        "--json",
    ];
    let output = sysid(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(json["scores"][0]["name"], "multi_sine");
    assert_eq!(json["scores"][1]["name"], "still.mcap");
    assert_eq!(json["next"][1]["name"], "multi_sine");
    let sigma = |s: &serde_json::Value| s["sigma"][0].as_f64().expect("a number");
    let (once, twice) = (sigma(&json["next"][0]), sigma(&json["next"][1]));
    assert!(
        (twice / once * 2_f64.sqrt() - 1.0).abs() < 0.01,
        "{once} {twice}"
    );
    // of the weight of a hanging pendulum nothing is seen
    assert!(sigma(&json["scores"][1]) > 1.0 && once < 0.1, "{json}");
}
