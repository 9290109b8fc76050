//! What the model says along an estimated motion: residuals of every channel and joint, and the motion as a recording.

use serde::Serialize;

use super::SysidError;
use super::fit::Fit;
use super::islands::Islands;
use super::newton::Solver;
use super::problem::Problem;
use crate::mujoco::{Model, ObjectKind};
use crate::recording::{Channel, Kind, Meta, Recording, Stream};

/// A channel of a trial: what was measured and what the model makes of the motion.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Predicted {
    /// s since the first knot
    pub time_s: Vec<f64>,
    /// as recorded
    pub measured: Vec<f64>,
    /// with bias, gain and delay
    pub predicted: Vec<f64>,
}

/// A trial as the fit explains it.
#[derive(Debug, Clone, PartialEq)]
pub struct Explained {
    /// one a channel of the problem
    pub channels: Vec<Predicted>,
    /// (knots × nv) force that nothing explains, N m or N; 0 at both ends
    pub force: Vec<f64>,
    /// (knots × nu)
    pub controls: Vec<f64>,
}

/// How well a channel is explained, over all trials.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelResidual {
    /// channel
    pub name: String,
    /// of the numbers
    pub unit: String,
    /// samples
    pub n: usize,
    /// standard deviation that the fit assumed
    pub sigma: f64,
    /// whether that was given, not guessed from the signal
    pub sigma_known: bool,
    /// root mean square of measured less predicted
    pub rms: f64,
}

/// How well the forces at a degree of freedom are explained, over all trials.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ForceResidual {
    /// joint, with the component where it has several
    pub name: String,
    /// standard deviation that the fit assumed, N m or N
    pub sigma: f64,
    /// root mean square of what nothing explains, N m or N
    pub rms: f64,
}

/// Every trial at free parameters `x` and `trajectories`.
///
/// # Errors
/// The engine refuses a number.
pub fn explain(
    problem: &Problem,
    x: &[f64],
    trajectories: &[Vec<f64>],
) -> Result<Vec<Explained>, SysidError> {
    let solver = Solver::new(problem, x.to_vec(), trajectories.to_vec());
    let free = problem.free_values(x);
    let n_channels = problem.channels.len();
    (problem.trials.iter().enumerate())
        .map(|(i, trial)| {
            let evaluated = solver.point(i, &trajectories[i], x).evaluate(true)?;
            let mut evaluated = evaluated.ok_or_else(|| SysidError::NoStep {
                recording: trial.name.clone(),
                time_s: 0.0,
            })?;
            // what is idle was measured, not estimated: its forces would be those of noise
            let idle = Islands::new(problem, std::mem::take(&mut evaluated.contacts)).idle;
            for row in evaluated.force.chunks_exact_mut(problem.model.nv().max(1)) {
                for d in &idle {
                    row[*d] = 0.0;
                }
            }
            let mut channels = vec![Predicted::default(); n_channels];
            let mut placed = solver.placed(i, x);
            placed.sort_by_key(|p| p.sample);
            for p in placed {
                let s = &trial.samples[p.sample];
                let channel = &problem.channels[s.channel];
                let mut z = evaluated.sensors[p.knot * n_channels + s.channel];
                if p.part > 0.0 {
                    z += p.part * (evaluated.sensors[(p.knot + 1) * n_channels + s.channel] - z);
                }
                let out = &mut channels[s.channel];
                out.time_s.push(s.time);
                out.measured.push(s.value);
                out.predicted.push(channel.reading(&free, z));
            }
            Ok(Explained {
                channels,
                force: evaluated.force,
                controls: problem.controls(trial, x),
            })
        })
        .collect()
}

/// Residuals of every channel.
pub fn channel_residuals(problem: &Problem, explained: &[Explained]) -> Vec<ChannelResidual> {
    (problem.channels.iter().enumerate())
        .map(|(c, channel)| {
            let trials = explained.iter().map(|e| &e.channels[c]);
            let errors =
                trials.flat_map(|p| p.measured.iter().zip(&p.predicted).map(|(m, p)| m - p));
            let (n, rms) = root_mean_square(errors);
            ChannelResidual {
                name: channel.name.clone(),
                unit: channel.unit.clone(),
                n,
                sigma: channel.sigma,
                sigma_known: channel.sigma_known,
                rms,
            }
        })
        .collect()
}

/// Residuals of the forces at every degree of freedom; `sigma` as in the fit, none where that allows no force.
pub fn force_residuals(
    problem: &Problem,
    explained: &[Explained],
    sigma: &[f64],
) -> Vec<ForceResidual> {
    let model = &problem.model;
    (0..model.nv())
        .filter(|dof| sigma[*dof] > 0.0)
        .map(|dof| {
            let inner = explained.iter().flat_map(|e| {
                let knots = e.force.len() / model.nv();
                (1..knots.saturating_sub(1)).map(move |k| e.force[k * model.nv() + dof])
            });
            ForceResidual {
                name: dof_name(model, dof),
                sigma: sigma[dof],
                rms: root_mean_square(inner).1,
            }
        })
        .collect()
}

fn root_mean_square(values: impl Iterator<Item = f64>) -> (usize, f64) {
    let (mut n, mut sum) = (0, 0.0);
    for v in values {
        n += 1;
        sum += v * v;
    }
    (n, (sum / f64::max(n as f64, 1.0)).sqrt())
}

/// Joint of a degree of freedom, `name[i]` where it has several.
pub fn dof_name(model: &Model, dof: usize) -> String {
    let joint = model.dof_jntid()[dof] as usize;
    component(
        model,
        joint,
        dof - model.jnt_dofadr()[joint] as usize,
        model.is_slide(joint).is_some(),
    )
}

fn component(model: &Model, joint: usize, i: usize, scalar: bool) -> String {
    let name = model
        .name(ObjectKind::Joint, joint)
        .map_or_else(|| joint.to_string(), str::to_owned);
    if scalar { name } else { format!("{name}[{i}]") }
}

/// An estimated trial as a recording: positions, velocities, controls, what the channels would read, and the forces
/// that nothing explains.
///
/// # Errors
/// The engine refuses a number.
pub fn recording(
    problem: &Problem,
    fit: &Fit,
    explained: &Explained,
    trial: usize,
) -> Result<Recording, SysidError> {
    let model = &problem.model;
    let (nq, nv, nu) = (model.nq(), model.nv(), model.nu());
    let h = model.timestep();
    let described = |name: String, kind: Kind, unit: &str| Channel {
        name,
        kind,
        unit: unit.to_owned(),
        noise_sigma: None,
    };
    let (mut positions, mut velocities) = (Vec::new(), Vec::new());
    for joint in 0..model.njnt() {
        let name = component(model, joint, 0, true);
        if let Some(slide) = model.is_slide(joint) {
            let (p, v) = if slide {
                ("m", "m/s")
            } else {
                ("rad", "rad/s")
            };
            positions.push(described(format!("qpos[{name}]"), Kind::Sensor, p));
            velocities.push(described(format!("qvel[{name}]"), Kind::Sensor, v));
        } else {
            let free = model.is_free(joint);
            for i in 0..if free { 7 } else { 4 } {
                let unit = if free && i < 3 { "m" } else { "1" };
                positions.push(described(format!("qpos[{name}][{i}]"), Kind::Sensor, unit));
            }
            for i in 0..if free { 6 } else { 3 } {
                let unit = if free && i < 3 { "m/s" } else { "rad/s" };
                velocities.push(described(format!("qvel[{name}][{i}]"), Kind::Sensor, unit));
            }
        }
    }
    let controls = (0..nu).map(|i| {
        let name = model.name(ObjectKind::Actuator, i).unwrap_or_default();
        described(name.to_owned(), Kind::Control, "")
    });
    let unexplained = (0..nv).map(|dof| {
        let joint = model.dof_jntid()[dof] as usize;
        let unit = if model.is_slide(joint) == Some(true) {
            "N"
        } else {
            "N m"
        };
        described(
            format!("unexplained {}", dof_name(model, dof)),
            Kind::Other,
            unit,
        )
    });
    let mut state = positions;
    state.extend(velocities);
    state.extend(controls);
    state.extend(unexplained);
    let mut motion = Stream::new("motion", Some(1.0 / h), state);
    let start = problem.trials[trial].start_s;
    let stamp = |time: f64| ((start + time) * 1e9).round() as i64;
    let trajectory = &fit.trajectories[trial];
    let knots: Vec<&[f64]> = trajectory.chunks_exact(nq).collect();
    let mut velocity = vec![0.0; nv];
    for (k, qpos) in knots.iter().enumerate() {
        // the velocity that the engine has at a knot is the difference to the one before
        let before = if k > 0 { knots[k - 1] } else { qpos };
        let (from, to) = if k > 0 {
            (before, *qpos)
        } else {
            (*qpos, knots[1])
        };
        model.differentiate_pos(&mut velocity, h, from, to)?;
        let mut row = qpos.to_vec();
        row.extend_from_slice(&velocity);
        row.extend_from_slice(&explained.controls[k * nu..(k + 1) * nu]);
        row.extend_from_slice(&explained.force[k * nv..(k + 1) * nv]);
        motion.push(stamp(k as f64 * h), &row);
    }
    let mut streams = vec![motion];
    for (channel, predicted) in problem.channels.iter().zip(&explained.channels) {
        if predicted.time_s.is_empty() {
            continue;
        }
        let name = format!("predicted {}", channel.name);
        let mut stream = Stream::new(
            &name,
            None,
            vec![described(name.clone(), Kind::Other, &channel.unit)],
        );
        for (time, value) in predicted.time_s.iter().zip(&predicted.predicted) {
            stream.push(stamp(*time), &[*value]);
        }
        streams.push(stream);
    }
    Ok(Recording {
        meta: Meta {
            source: "estimated motion".to_owned(),
            trial: problem.trials[trial].name.clone(),
            ..Meta::default()
        },
        streams,
    })
}
