//! Forces and torques of the instrumented finger at the states of a recording, with and without contact.

use std::path::Path;

use super::super::machine::machine;
use super::super::{Case, ReproduceError, Study};
use super::{STAND_IN, figure};
use crate::compare::forces::{Signal, instantaneous};
use crate::compare::{Settings, States};
use crate::mujoco::Model;
use crate::policy::AffineGaussian;
use crate::recording::{self, Recording};
use crate::report::{Curve, Panel, Panels, Section, Stroke, Table, number};
use crate::rig::tracking;

/// Zero-phase low-pass of the recorded state: above what arms do, below what encoders add, 1/s.
const CUTOFF_HZ: f64 = 30.0;

/// Every so many-th sample is compared and drawn: 500 a second.
const EVERY: usize = 4;

/// How recorded states are made from the rig's sensors.
pub(super) fn settings() -> Settings {
    Settings {
        cutoff_hz: Some(CUTOFF_HZ),
        decimate: EVERY,
        horizons_s: vec![0.1],
        every_s: Some(0.1),
        ..Settings::default()
    }
}

/// A recording of the first machine under `policy`, kept in the study's folder.
///
/// # Errors
/// The machine breaks down, or the recording cannot be written.
pub(super) fn recorded(
    study: &Study,
    case: Case,
    policy: &AffineGaussian,
) -> Result<Recording, ReproduceError> {
    let rig = machine(&study.model, &study.rig, 0)?;
    let outcome = tracking::follow(&rig, policy, 0)?;
    if let Some(reason) = outcome.diverged {
        let (case, seed) = (case.name(), study.first_seed());
        return Err(ReproduceError::Breakdown { case, seed, reason });
    }
    let folder = study.out.join("recordings");
    make(&folder)?;
    let name = format!("{}-seed{}.mcap", case.name(), study.first_seed());
    recording::write(&folder.join(name), &outcome.recording)?;
    Ok(outcome.recording)
}

fn make(folder: &Path) -> Result<(), ReproduceError> {
    std::fs::create_dir_all(folder).map_err(|reason| ReproduceError::File {
        file: folder.to_owned(),
        reason: reason.to_string(),
    })
}

/// What the model says of the finger's force and torque, against what the rig's sensor measured.
///
/// # Errors
/// The machine breaks down, or its recording does not fit the model.
pub fn forces(study: &Study, policy: &AffineGaussian) -> Result<Section, ReproduceError> {
    let recording = recorded(study, Case::Correct, policy)?;
    let settings = settings();
    let states = States::new(&recording, &study.model, &settings)?;
    let signals = instantaneous(&study.model, &states, &settings)?.signals;
    let of_sensor = |s: &&Signal| s.samples != "all";
    let mut table = Table::new(
        "Force and torque of finger 0: model at the recorded states, against the rig's sensor",
        &[
            "signal",
            "samples",
            "n",
            "rms difference",
            "rms measured",
            "unit",
            "relative",
        ],
    );
    let mut panels = Vec::new();
    for signal in signals.iter().filter(of_sensor) {
        table.push(vec![
            signal.name.clone(),
            signal.samples.to_owned(),
            signal.n.to_string(),
            number(signal.rms),
            number(signal.measured_rms),
            signal.unit.clone(),
            format!("{:.1} %", signal.relative_percent),
        ]);
        panels.push(panel(&study.model, signal));
    }
    let caption = format!(
        "Black: measured; colour: computed by the nominal model at the same state and controls. Samples in contact are \
         turned into the frame of the contact, normal first; without contact they stay in the frame of the fingertip. \
         Contact is what the model says: where it sees one that the machine does not, or the other way round, the \
         curves differ by the whole force. {STAND_IN} The correct policy of seed {} follows the spiral.",
        study.first_seed()
    );
    let panels = Panels {
        columns: 3,
        panel_size: (360, 240),
        panels,
    };
    let title = "Force and torque, simulation against the virtual rig";
    Ok(Section::new("Forces")
        .table(table)
        .figure(figure("forces", title, &caption, panels)))
}

fn panel(model: &Model, signal: &Signal) -> Panel {
    let title = format!("{}, {}", signal.name, signal.samples);
    let mut panel = Panel::new(&title, "time (s)", &signal.unit);
    // a line must not bridge the samples of the other case
    let gap = 2.5 * EVERY as f64 * model.timestep();
    let points = |values: &[f64]| {
        let mut points: Vec<[f64; 2]> = Vec::new();
        for (time, value) in signal.time_s.iter().zip(values) {
            if points.last().is_some_and(|last| time - last[0] > gap) {
                points.push([*time, f64::NAN]);
            }
            points.push([*time, *value]);
        }
        points
    };
    panel.curves = vec![
        Curve::new("measured", 0, Stroke::Thin, points(&signal.measured)),
        Curve::new("model", 1, Stroke::Thin, points(&signal.computed)),
    ];
    panel
}
