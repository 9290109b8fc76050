//! Short simulations of each policy from states recorded on the rig.

use super::super::{Case, ReproduceError, Study};
use super::forces::{recorded, settings};
use super::{STAND_IN, colour, figure};
use crate::compare::{Seeded, States, compare, seeded};
use crate::mujoco::ObjectKind;
use crate::policy::AffineGaussian;
use crate::report::{Curve, Panel, Panels, Section, Stroke, Table, number};

/// Steps of a simulation: the paper's, 0.1 s.
const STEPS: usize = 200;
/// Between two starts, s: the simulations do not overlap.
const EVERY_S: f64 = 0.2;
/// Every so many-th sample is drawn.
const DRAWN: usize = 4;
/// The joint that is drawn.
const JOINT: &str = "p0_turret";

/// What each of `policies` does in simulation from the states it came to on the rig.
///
/// # Errors
/// The machine breaks down, or its recording does not fit the model.
pub fn rollouts(
    study: &Study,
    policies: &[(Case, AffineGaussian)],
) -> Result<Section, ReproduceError> {
    let mut table = Table::new(
        "Deviation of simulation and rig after 200 steps (0.1 s) under the same policy, root mean square",
        &["policy", "starts", "object", "unit", JOINT, "unit"],
    );
    let (mut above, mut below) = (Vec::new(), Vec::new());
    for (case, policy) in policies {
        let recording = recorded(study, *case, policy)?;
        let settings = settings();
        let states = States::new(&recording, &study.model, &settings)?;
        let paths = seeded(&study.model, &states, policy, EVERY_S, STEPS)?;
        let [object, joint] = panels(study, *case, &states, &paths)?;
        above.push(object);
        below.push(joint);
        let all = compare(&study.model, &[recording], &settings, Some(policy), &|| ())?;
        let growth = all.policy_rollouts.map(|r| r.growth).unwrap_or_default();
        let end = |channel: &str| {
            let found = growth.iter().find(|g| g.channel == channel);
            found.map_or((String::new(), String::new()), |g| {
                (number(g.end_rms), g.unit.clone())
            })
        };
        let n = growth.first().map_or(0, |g| g.n);
        let ((a, a_unit), (b, b_unit)) = (end("object distance"), end(JOINT));
        let label = case.label().to_owned();
        table.push(vec![label, n.to_string(), a, a_unit, b, b_unit]);
    }
    above.extend(below);
    let caption = format!(
        "Coloured: the rig under each policy, as recorded and low-passed. Black: simulations of {STEPS} steps (0.1 s) of \
         the same policy by the nominal model, each from a recorded state. Above: the object from above; below: a \
         turret over time. {STAND_IN} Policies of seed {}, all on the same machine.",
        study.first_seed()
    );
    let panels = Panels {
        columns: policies.len().max(1),
        panel_size: (380, 340),
        panels: above,
    };
    let title = "Simulations from states of the virtual rig";
    Ok(Section::new("Rollouts from recorded states")
        .table(table)
        .figure(figure("rollouts", title, &caption, panels)))
}

/// The object from above, and a joint over time.
fn panels(
    study: &Study,
    case: Case,
    states: &States,
    paths: &[Seeded],
) -> Result<[Panel; 2], ReproduceError> {
    let model = &study.model;
    let nq = model.nq();
    let address = |joint: &str| -> Result<usize, ReproduceError> {
        let joint = model.id(ObjectKind::Joint, joint)?;
        Ok(model.jnt_qposadr()[joint] as usize)
    };
    let (object, turret) = (address("object")?, address(JOINT)?);
    let plane = |qpos: &[f64]| -> Vec<[f64; 2]> {
        let rows = qpos.chunks_exact(nq).step_by(DRAWN);
        rows.map(|q| [100.0 * q[object], 100.0 * q[object + 1]])
            .collect()
    };
    let angle = |time_s: &[f64], qpos: &[f64]| -> Vec<[f64; 2]> {
        let rows = time_s.iter().zip(qpos.chunks_exact(nq)).step_by(DRAWN);
        rows.map(|(t, q)| [*t, q[turret]]).collect()
    };
    let mut above = Panel::new(case.label(), "x (cm)", "y (cm)");
    above.equal = true;
    let mut below = Panel::new(case.label(), "time (s)", &format!("{JOINT} (rad)"));
    let c = colour(case);
    above.curves = vec![Curve::new("rig", c, Stroke::Thick, plane(&states.qpos))];
    below.curves = vec![Curve::new(
        "rig",
        c,
        Stroke::Thick,
        angle(&states.time_s, &states.qpos),
    )];
    for (i, path) in paths.iter().enumerate() {
        let label = if i == 0 { "simulation" } else { "" };
        let curve = |points| Curve::new(label, 0, Stroke::Thin, points);
        above.curves.push(curve(plane(&path.qpos)));
        below.curves.push(curve(angle(&path.time_s, &path.qpos)));
    }
    Ok([above, below])
}
