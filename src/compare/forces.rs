//! Instantaneous forces: what the model says at each recorded state, against what was measured.
//!
//! Motor torques by inverse dynamics, in the independent directions N of motion (those that loops leave):
//!
//! ```text
//! computed  Nᵀ qfrc_inverse(q, v, a)          measured  Nᵀ qfrc_actuator(q, v, ctrl)
//! ```
//!
//! Euler integration treats joint damping D implicitly: a step of h with the forces of time t makes the velocity
//! difference `a_h` = (M + h D)⁻¹ M a. Recordings at the engine's own steps are therefore taken back to
//! a = M⁻¹ (M + h D) `a_h` first.
//!
//! Force and torque sensors are computed by forward dynamics at the recorded state and controls. In contact they are
//! turned into the frame of the contact, normal first; without contact they stay in the frame of their site. Contact
//! is what the model says: samples that the measurement sees otherwise come out as errors, as they should.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use super::butterworth::{Beyond, low_pass};
use super::closure::Closure;
use super::{CompareError, Settings, States};
use crate::mujoco::{Data, Integrator, Measures, Model, MujocoError, ObjectKind};

/// One signal, computed and measured.
#[derive(Debug, Clone, Serialize)]
pub struct Signal {
    /// actuated joint or sensor, with component
    pub name: String,
    /// of the values
    pub unit: String,
    /// `all`, `contact` or `no contact`
    pub samples: &'static str,
    /// number of samples compared
    pub n: usize,
    /// root mean square of computed less measured
    pub rms: f64,
    /// root mean square of measured
    pub measured_rms: f64,
    /// `rms / measured_rms` in percent
    pub relative_percent: f64,
    /// (n) s
    #[serde(skip)]
    pub time_s: Vec<f64>,
    /// (n) by the model
    #[serde(skip)]
    pub computed: Vec<f64>,
    /// (n) by the machine
    #[serde(skip)]
    pub measured: Vec<f64>,
    #[serde(skip)]
    torque: bool,
}

impl Signal {
    /// Whether it is the torque or force of a joint's motors, by inverse dynamics and as commanded.
    pub fn is_torque(&self) -> bool {
        self.torque
    }
}

/// All signals of a recording.
#[derive(Debug, Clone, Serialize)]
pub struct Forces {
    /// trial or source
    pub recording: String,
    /// torques first, then sensors
    pub signals: Vec<Signal>,
}

/// What was computed at one sample.
struct Row {
    /// (actuated, computed and measured)
    torques: Vec<[f64; 2]>,
    /// (sensors)
    sensors: Vec<f64>,
    /// rotation from the site to the contact for each sensor (3 × 3), if there is contact
    frames: Vec<Option<[f64; 9]>>,
}

/// Compare at every sample.
///
/// # Errors
/// The engine fails.
pub fn instantaneous(
    model: &Arc<Model>,
    states: &States,
    settings: &Settings,
) -> Result<Forces, CompareError> {
    let mut data = Data::new(Arc::clone(model))?;
    let mut closure = Closure::new(model)?;
    let actuated = actuated(&mut data)?;
    let last = if states.step_derivative {
        states.len() - 1
    } else {
        states.len()
    };
    let mut rows = Vec::with_capacity(last);
    for k in 0..last {
        rows.push(row(&mut data, &mut closure, states, k, &actuated)?);
    }
    let mut signals = torques(model, states, settings, &actuated, &rows);
    signals.extend(sensors(model, states, settings, &rows));
    Ok(Forces {
        recording: states.name.clone(),
        signals,
    })
}

/// Degrees of freedom that some actuator moves.
fn actuated(data: &mut Data) -> Result<Vec<usize>, MujocoError> {
    data.forward()?;
    let nv = data.model().nv();
    let moments = data.actuator_moment();
    let moved = |dof: &usize| moments.iter().skip(*dof).step_by(nv).any(|m| *m != 0.0);
    Ok((0..nv).filter(moved).collect())
}

fn row(
    data: &mut Data,
    closure: &mut Closure,
    states: &States,
    k: usize,
    actuated: &[usize],
) -> Result<Row, CompareError> {
    let (nq, nv, nu) = (data.model().nq(), data.model().nv(), data.model().nu());
    let qpos = &states.qpos[k * nq..(k + 1) * nq];
    data.set_memory(states.memory(k))?;
    data.set_time(states.time_s[k]);
    data.qpos_mut().copy_from_slice(qpos);
    data.qvel_mut()
        .copy_from_slice(&states.qvel[k * nv..(k + 1) * nv]);
    data.ctrl_mut()
        .copy_from_slice(&states.ctrl[k * nu..(k + 1) * nu]);
    data.forward()?;
    let sensors: Vec<f64> = states
        .sensors
        .iter()
        .map(|s| data.sensordata()[s.address])
        .collect();
    let frames = states
        .sensors
        .iter()
        .map(|s| contact_frame(data, s.sensor))
        .collect();
    let driven = DVector::from_column_slice(data.qfrc_actuator());

    let mut qacc = states.qacc[k * nv..(k + 1) * nv].to_vec();
    if states.step_derivative {
        undo_implicit_damping(data, &mut qacc)?;
    }
    data.qacc_mut().copy_from_slice(&qacc);
    data.inverse()?;
    let needed = DVector::from_column_slice(data.qfrc_inverse());
    let (n, independent) = closure.directions(qpos, &states.passive)?;
    let (needed, driven) = (n.tr_mul(&needed), n.tr_mul(&driven));
    let place = |dof: &usize| independent.iter().position(|i| i == dof);
    let torques = actuated
        .iter()
        .filter_map(place)
        .map(|i| [needed[i], driven[i]])
        .collect();
    Ok(Row {
        torques,
        sensors,
        frames,
    })
}

/// a = M⁻¹ (M + h D) `a_h`, for Euler's method.
fn undo_implicit_damping(data: &mut Data, qacc: &mut [f64]) -> Result<(), MujocoError> {
    let model = Arc::clone(data.model_arc());
    let (nv, h) = (model.nv(), model.timestep());
    if model.option().integrator != Integrator::Euler
        || model.dof_damping().iter().all(|d| *d == 0.0)
    {
        return Ok(());
    }
    let mut inertia = vec![0.0; nv * nv];
    data.full_mass_matrix(&mut inertia)?;
    let extra = DVector::from_fn(nv, |i, _| h * model.dof_damping()[i] * qacc[i]);
    if let Some(cholesky) = DMatrix::from_vec(nv, nv, inertia).cholesky() {
        let more = cholesky.solve(&extra);
        qacc.iter_mut().zip(more.iter()).for_each(|(a, m)| *a += m);
    }
    Ok(())
}

/// Rotation from the frame of a force sensor's site to that of the first contact of its body, normal first. Contact
/// frames point from the first geom to the second; a body's own side comes first here.
fn contact_frame(data: &Data, sensor: usize) -> Option<[f64; 9]> {
    let model = data.model();
    let Measures::Wrench(site) = model.measures(sensor) else {
        return None;
    };
    let body = model.site_bodyid()[site] as usize;
    let own = |geom: usize| model.geom_bodyid()[geom] as usize == body;
    let contact = data.contacts().iter().find(|c| {
        let [a, b] = c.geoms();
        (own(a) || own(b)) && c.efc_address().is_some()
    })?;
    let sign = if own(contact.geoms()[0]) { 1.0 } else { -1.0 };
    let (frame, site) = (contact.frame(), &data.site_xmat()[9 * site..9 * site + 9]);
    let entry = |r: usize, c: usize| {
        sign * (0..3)
            .map(|i| frame[3 * r + i] * site[3 * i + c])
            .sum::<f64>()
    };
    Some(std::array::from_fn(|i| entry(i / 3, i % 3)))
}

fn torques(
    model: &Model,
    states: &States,
    settings: &Settings,
    actuated: &[usize],
    rows: &[Row],
) -> Vec<Signal> {
    let interval = states.interval_s();
    let n = rows.first().map_or(0, |row| row.torques.len());
    let mut ends = (0..rows.len()).filter(|k| is_inner(states, settings, *k));
    let inner = (ends.next()).map_or(0..0, |first| first..ends.next_back().unwrap_or(first) + 1);
    let column = |i: usize| {
        let joint = model.dof_jntid()[actuated[i]] as usize;
        let name = model.name(ObjectKind::Joint, joint).unwrap_or("joint");
        let unit = if model.is_slide(joint) == Some(true) {
            "N"
        } else {
            "N m"
        };
        let pick = |which: usize| {
            rows.iter()
                .map(|row| row.torques[i][which])
                .collect::<Vec<_>>()
        };
        let (mut computed, mut measured) = (pick(0), pick(1));
        if let Some(cutoff) = settings.force_cutoff_hz {
            // ends, of which no motion says the force, would spread
            for signal in [&mut computed, &mut measured] {
                let inner = &mut signal[inner.clone()];
                low_pass(inner, 1, cutoff * interval, Beyond::Mirrored);
            }
        }
        let keep = |k: &usize| used(states, settings, *k);
        let kept: Vec<usize> = (0..rows.len()).filter(keep).collect();
        let choose = |from: &[f64]| kept.iter().map(|k| from[*k]).collect::<Vec<_>>();
        Signal {
            torque: true,
            ..signal(
                name.to_owned(),
                unit,
                "all",
                choose(&states.time_s),
                choose(&computed),
                choose(&measured),
            )
        }
    };
    (0..n).map(column).collect()
}

/// Whether sample `k` is neither at an end nor between those kept.
fn used(states: &States, settings: &Settings, k: usize) -> bool {
    is_inner(states, settings, k) && k.is_multiple_of(settings.decimate)
}

/// Whether sample `k` is not at an end.
fn is_inner(states: &States, settings: &Settings, k: usize) -> bool {
    let (time, n) = (&states.time_s, states.len());
    time[k] - time[0] >= settings.skip_s && time[n - 1] - time[k] >= settings.skip_s
}

/// Each sensor once without and once in contact; vectors of a site in the frame of the contact.
fn sensors(model: &Model, states: &States, settings: &Settings, rows: &[Row]) -> Vec<Signal> {
    let mut signals = Vec::new();
    for (i, measured) in states.sensors.iter().enumerate() {
        let unit = model.sensor_unit(measured.sensor).unwrap_or("");
        let first = model.sensor_adr()[measured.sensor] as usize;
        let component = measured.address - first;
        // the components of this sensor, if all were measured
        let vector: Vec<usize> = (0..states.sensors.len())
            .filter(|j| states.sensors[*j].sensor == measured.sensor)
            .collect();
        let wrench =
            matches!(model.measures(measured.sensor), Measures::Wrench(_)) && vector.len() == 3;
        let cases: &[&str] = if wrench {
            &["no contact", "contact"]
        } else {
            &["all"]
        };
        for case in cases {
            let keep = |k: &usize| {
                let contact = rows[*k].frames[i].is_some();
                used(states, settings, *k)
                    && vector
                        .iter()
                        .all(|j| states.sensors[*j].values[*k].is_finite())
                    && (*case == "all" || (*case == "contact") == contact)
            };
            let kept: Vec<usize> = (0..rows.len()).filter(keep).collect();
            if kept.is_empty() {
                continue;
            }
            let turned = |k: usize, value: &dyn Fn(usize) -> f64| match rows[k].frames[i] {
                Some(frame) if *case == "contact" => (0..3)
                    .map(|c| frame[3 * component + c] * value(vector[c]))
                    .sum(),
                _ => value(i),
            };
            let computed = kept
                .iter()
                .map(|k| turned(*k, &|j| rows[*k].sensors[j]))
                .collect();
            let real = kept
                .iter()
                .map(|k| turned(*k, &|j| states.sensors[j].values[*k]))
                .collect();
            let name = match (wrench, *case) {
                (true, "contact") => {
                    let sensor = model
                        .name(ObjectKind::Sensor, measured.sensor)
                        .unwrap_or("sensor");
                    format!(
                        "{sensor} {}",
                        ["normal", "tangent 1", "tangent 2"][component]
                    )
                }
                _ => measured.name.clone(),
            };
            let time = kept.iter().map(|k| states.time_s[*k]).collect();
            signals.push(signal(name, unit, case, time, computed, real));
        }
    }
    signals
}

fn signal(
    name: String,
    unit: &str,
    samples: &'static str,
    time_s: Vec<f64>,
    computed: Vec<f64>,
    measured: Vec<f64>,
) -> Signal {
    let n = computed.len();
    let mean = |sum: f64| (sum / n.max(1) as f64).sqrt();
    let rms = mean(
        computed
            .iter()
            .zip(&measured)
            .map(|(c, m)| (c - m).powi(2))
            .sum(),
    );
    let measured_rms = mean(measured.iter().map(|m| m * m).sum());
    Signal {
        name,
        unit: unit.to_owned(),
        samples,
        n,
        rms,
        measured_rms,
        relative_percent: 100.0 * rms / measured_rms,
        time_s,
        computed,
        measured,
        torque: false,
    }
}
