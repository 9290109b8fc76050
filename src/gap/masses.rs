//! Two masses with motors, for tests of the search.

use super::cuts::Cuts;
use super::effect::{ModelFile, candidates};
use super::evidence::Evidence;
use super::model::Chosen;
use super::run::{self, Input, Options};
use super::search::{ITERATIONS, Search};
use super::stages::Nowhere;
use super::{Stage, Watch};
use crate::compare::Settings;
use crate::mujoco::Data;
use crate::recording::{Channel, Kind, Meta, Recording, Stream};
use crate::rng::{self, Purpose};

/// Two masses with motors, which begin at one place and do not touch; `a` and `b` are attributes of their joints.
pub(super) fn machine(a: &str, b: &str) -> ModelFile {
    let joint = |name: &str, axis: &str, more: &str| {
        format!(
            r#"<body><joint name="{name}" type="slide" axis="{axis}" {more}/><geom size=".01" mass=".5"/></body>"#
        )
    };
    let xml = format!(
        r#"<mujoco><option timestep="0.002" gravity="0 0 0"><flag contact="disable"/></option><worldbody>{}{}</worldbody>
        <actuator><motor name="ma" joint="a"/><motor name="mb" joint="b"/></actuator>
        <sensor><jointpos name="sa" joint="a"/><jointpos name="sb" joint="b"/></sensor></mujoco>"#,
        joint("a", "1 0 0", a),
        joint("b", "0 1 0", b)
    );
    ModelFile::of_text(xml, "masses.xml").expect("loads")
}

/// Four seconds of sines, read with a hundredth of a millimetre of noise.
pub(super) fn record(machine: &ModelFile) -> Recording {
    record_hammered(machine, 0.0)
}

/// The same with a force on mass `a` that is there in every third step, N, with none on average.
fn record_hammered(machine: &ModelFile, hammer: f64) -> Recording {
    const NOISE_M: f64 = 1e-5;
    let channel = |name: &str, kind, unit: &str, noise_sigma| Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma,
    };
    let reads = ["sa", "sb"].map(|n| channel(n, Kind::Sensor, "m", Some(NOISE_M)));
    let motors = ["ma", "mb"].map(|n| channel(n, Kind::Control, "N", None));
    let all = reads.into_iter().chain(motors).collect();
    let mut stream = Stream::new("all", Some(500.0), all);
    let mut data = Data::new(machine.model.clone()).expect("data");
    let mut rng = rng::stream(4, Purpose::SensorNoise, 0, 0);
    for k in 0..2000_i64 {
        let t = data.time();
        let turning = hammer * if k % 3 == 0 { 1.0 } else { -0.5 };
        let push = [
            (7.0 * t).sin() + (11.0 * t).cos() + turning,
            (9.0 * t).cos() + (4.0 * t).sin(),
        ];
        let mut row: Vec<f64> = (0..2)
            .map(|joint| data.encoder(joint)[0] + NOISE_M * rng::normal(&mut rng))
            .collect();
        row.extend(push);
        stream.push(k * 2_000_000, &row);
        data.ctrl_mut().copy_from_slice(&push);
        data.step().expect("step");
    }
    Recording {
        meta: Meta::default(),
        streams: vec![stream],
    }
}

/// An effect of the catalogue at a place.
pub(super) fn chosen(model: &ModelFile, name: &str, at: &str, values: &[f64]) -> Chosen {
    let all = candidates(&model.model).into_iter();
    let mut own = all.filter(|(e, p)| e.about().name == name && p.to_string() == at);
    let (effect, place) = own.next().expect("in the catalogue");
    Chosen {
        effect,
        place,
        values: values.to_vec(),
    }
}

/// A search that has fitted `base`, with the parameters that the text lists, to what `hidden` does.
pub(super) fn searching(
    base: &ModelFile,
    hidden: &ModelFile,
    parameters: &str,
    then: impl FnOnce(&mut Search<'_>, &mut Watch<'_>),
) {
    searching_hammered(base, (hidden, 0.0), parameters, then);
}

/// The same of a machine that is hammered in every third step, N.
pub(super) fn searching_hammered(
    base: &ModelFile,
    hidden: (&ModelFile, f64),
    parameters: &str,
    then: impl FnOnce(&mut Search<'_>, &mut Watch<'_>),
) {
    begun(base, hidden, parameters, |search, _, watch| {
        then(search, watch);
    });
}

/// As [`searching`], with what windows are cut from.
pub(super) fn searching_cut(
    base: &ModelFile,
    hidden: &ModelFile,
    parameters: &str,
    then: impl FnOnce(&mut Search<'_>, &Cuts, &mut Watch<'_>),
) {
    begun(base, (hidden, 0.0), parameters, then);
}

fn begun(
    base: &ModelFile,
    (hidden, hammer): (&ModelFile, f64),
    parameters: &str,
    then: impl FnOnce(&mut Search<'_>, &Cuts, &mut Watch<'_>),
) {
    let config = toml::from_str(&format!("command = \"held\"\n{parameters}"));
    let (config, protocol) = (config.expect("a configuration"), Settings::default());
    let train = [("sines".to_owned(), record_hammered(hidden, hammer))];
    let input = Input {
        model: base,
        config: &config,
        train: &train,
        holdout: &[],
        protocol: &protocol,
    };
    let mut report = |_: Stage, _: &str, _: Option<f64>| true;
    let mut watch = Watch::new(&mut report);
    let begun = run::begin(&input, &Options::default(), &mut Nowhere, &mut watch);
    let (cuts, mut search) = begun.expect("begun");
    then(&mut search, &cuts, &mut watch);
}

/// Makes a model with these effects, fitted, that of the search.
pub(super) fn found(search: &mut Search<'_>, effects: &[Chosen], watch: &mut Watch<'_>) {
    let fitted = search.fitted(effects, ITERATIONS, watch).expect("fitted");
    search.take(fitted.expect("follows"));
    let evidence = |_: &Chosen| Evidence {
        p_value: 0.0,
        gain: 0.5,
        size: None,
        alike: Vec::new(),
    };
    search.evidence = effects.iter().map(evidence).collect();
}
