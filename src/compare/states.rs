//! The states of a model at the samples of a recording.
//!
//! The samples are those of the stream with most positions; other streams are interpolated to them, controls are held.
//! With a low-pass, samples at uneven intervals are first interpolated to even ones. Velocities that are not recorded
//! follow by central differences, passive joints from the loops they close. Where the model says that encoders show
//! something else than its joints, states are those of the joints.

use crate::mujoco::{Measures, Model, ObjectKind};
use crate::recording::{Bound, BoundChannel, Recording};

use super::butterworth::{Beyond, low_pass};
use super::closure::Closure;
use super::differences::{accelerations, align, differences, free_quaternions, normalise};
use super::memory::Memory;
use super::samples::{Samples, median_interval};
use super::settings::Derivative;
use super::swings::Swings;
use super::{CompareError, Settings};

const MIN_SAMPLES: usize = 3;
/// m or rad that loops may stay open
const MAX_OPEN: f64 = 1e-6;
/// intervals within this part of the median count as even
const EVEN: f64 = 0.01;

/// A measured number that is no state.
#[derive(Debug, Clone)]
pub struct Measured {
    /// index in `sensordata`
    pub address: usize,
    /// index of the sensor
    pub sensor: usize,
    /// name of the channel
    pub name: String,
    /// (n)
    pub values: Vec<f64>,
}

/// States and measurements at common times.
#[derive(Debug, Clone)]
pub struct States {
    /// trial or source
    pub name: String,
    /// (n) s
    pub time_s: Vec<f64>,
    /// (n × nq)
    pub qpos: Vec<f64>,
    /// (n × nv)
    pub qvel: Vec<f64>,
    /// (n × nv)
    pub qacc: Vec<f64>,
    /// (n × nu) in force from each time on
    pub ctrl: Vec<f64>,
    /// measured sensors that are no states
    pub sensors: Vec<Measured>,
    /// (n × 2) x and y of the target, if recorded
    pub goal: Option<Vec<f64>>,
    /// addresses in `qpos` that were measured
    pub measured_qpos: Vec<usize>,
    /// passive degrees of freedom
    pub passive: Vec<usize>,
    /// whether accelerations are those of the engine's own steps
    pub step_derivative: bool,
    /// first of three coordinates in `qpos` of the free body that is recorded
    pub free_body: Option<usize>,
    /// controls as recorded: times in s and values, one list an actuator
    controls: Vec<Control>,
    /// (n × memory) what the model's supplement remembers
    memory: Vec<f64>,
}

/// Times in s and values.
type Control = (Vec<f64>, Vec<f64>);

/// Where each recorded number of the state goes.
#[derive(Default)]
struct Sources<'a> {
    qpos: Vec<(usize, &'a BoundChannel)>,
    qvel: Vec<(usize, &'a BoundChannel)>,
    sensors: Vec<&'a BoundChannel>,
}

impl<'a> Sources<'a> {
    fn new(bound: &'a Bound, model: &Model) -> Self {
        let mut sources = Self {
            qpos: bound.qpos.iter().map(|b| (b.address, b)).collect(),
            qvel: bound.qvel.iter().map(|b| (b.address, b)).collect(),
            sensors: Vec::new(),
        };
        for b in &bound.sensors {
            let component = b.address - model.sensor_adr()[b.object] as usize;
            match model.measures(b.object) {
                Measures::Position(a) | Measures::FreePosition(a) | Measures::FreeQuaternion(a) => {
                    sources.qpos.push((a + component, b));
                }
                Measures::Velocity(a) | Measures::FreeVelocity(a) => {
                    sources.qvel.push((a + component, b));
                }
                Measures::Wrench(_) | Measures::Other => sources.sensors.push(b),
            }
        }
        // a state that two channels measure comes from the first of them
        for list in [&mut sources.qpos, &mut sources.qvel] {
            list.sort_by_key(|(address, _)| *address);
            list.dedup_by_key(|(address, _)| *address);
        }
        sources
    }
}

impl States {
    /// The states of a recording.
    ///
    /// # Errors
    /// Positions or controls are missing, loops stay open, or too little is left.
    pub fn new(
        recording: &Recording,
        model: &Model,
        settings: &Settings,
    ) -> Result<Self, CompareError> {
        let name = label(recording);
        let bound = Bound::new(recording, model)?;
        let missing = bound.missing_controls(model);
        if !missing.is_empty() {
            return Err(CompareError::MissingControls {
                recording: name,
                actuators: missing.join(", "),
            });
        }
        let sources = Sources::new(&bound, model);
        if sources.qpos.is_empty() {
            let unbound = bound.unbound.first();
            return Err(CompareError::NoPosition {
                recording: name,
                unbound: unbound.map_or(String::new(), |u| format!("; `{}`: {}", u.name, u.reason)),
            });
        }
        let mut closure = Closure::new(model)?;
        let measured_qpos: Vec<usize> = sources.qpos.iter().map(|(a, _)| *a).collect();
        let unknown = check_positions(model, &measured_qpos, &closure.passive, &name)?;

        let mut memory = Memory::new(model)?;
        let encoded = |stream: &BoundChannel, scalar: bool| {
            let mut own = samples(recording, stream);
            if scalar && memory.delay_s > 0.0 {
                own.time_s.iter_mut().for_each(|t| *t -= memory.delay_s);
            }
            own
        };
        let positions: Vec<Samples> = sources
            .qpos
            .iter()
            .map(|(address, b)| encoded(b, is_scalar(model, model.jnt_qposadr(), *address)))
            .collect();
        let velocities: Vec<(usize, Samples)> = sources
            .qvel
            .iter()
            .map(|(dof, b)| (*dof, encoded(b, is_scalar(model, model.jnt_dofadr(), *dof))))
            .collect();
        let controls: Vec<Control> = bound
            .controls
            .iter()
            .map(|b| {
                let own = samples(recording, b);
                (own.time_s, own.values)
            })
            .collect();
        let held = |time: f64, ctrl: &mut [f64]| controls_at(&controls, time, ctrl);
        let mut time_s = common_times(&positions);
        if time_s.len() < MIN_SAMPLES {
            return Err(CompareError::TooShort {
                recording: name,
                expected: MIN_SAMPLES,
                got: time_s.len(),
            });
        }
        let interval = median_interval(&time_s);
        if settings.cutoff_hz.is_some() || settings.force_cutoff_hz.is_some() {
            even(&mut time_s, interval);
        }
        let mut qpos = fill(model.qpos0(), &time_s, &measured_qpos, &positions);
        let quaternions = free_quaternions(model);
        align(&mut qpos, model.nq(), &quaternions);
        let filtered = settings.cutoff_hz.is_some();
        let swings = Swings::of(model, (&time_s, &qpos), &measured_qpos, filtered);
        if let Some(cutoff) = settings.cutoff_hz {
            low_pass(&mut qpos, model.nq(), cutoff * interval, Beyond::Reflected);
        }
        normalise(&mut qpos, model.nq(), &quaternions);
        let shown = differences(model, &time_s, &qpos)?;
        let drives = (settings.cutoff_hz).and_then(|cutoff| {
            memory.drives((&time_s, interval), &shown, cutoff * interval, &held)
        });
        let loaded = drives.as_ref().map(|own| (own, &own.qacc[..]));
        let rows = memory.follow(&time_s, (&qpos, &shown), &held, loaded, &swings)?;
        memory.decode(&rows, &mut qpos, &measured_qpos)?;
        for (row, time) in qpos.chunks_exact_mut(model.nq()).zip(&time_s) {
            if unknown.is_empty() {
                break;
            }
            let residual = closure.close(row, &unknown)?;
            if residual > MAX_OPEN {
                return Err(CompareError::OpenLoop {
                    recording: name,
                    time_s: *time,
                    residual,
                });
            }
        }

        let recorded_velocities = if settings.differences {
            &[]
        } else {
            velocities.as_slice()
        };
        let mut qvel = differences(model, &time_s, &qpos)?;
        for (dof, channel) in recorded_velocities {
            let mut values = channel.all_at(&time_s);
            if let Some(cutoff) = settings.cutoff_hz {
                low_pass(&mut values, 1, cutoff * interval, Beyond::Reflected);
            }
            for (k, value) in values.into_iter().enumerate() {
                // a sample before the first of this channel keeps its difference
                if value.is_finite() {
                    qvel[k * model.nv() + dof] = memory.velocity(&rows, k, *dof, value)?;
                }
            }
        }
        let whole = recorded_velocities.len() + unknown.len() >= model.nv();
        let guessed: Vec<usize> = unknown
            .iter()
            .copied()
            .filter(|dof| recorded_velocities.iter().all(|(d, _)| d != dof))
            .collect();
        if !guessed.is_empty() {
            for (q, v) in qpos
                .chunks_exact(model.nq())
                .zip(qvel.chunks_exact_mut(model.nv()))
            {
                closure.close_velocity(q, v, &guessed)?;
            }
        }
        let at_steps = (interval / model.timestep() - 1.0).abs() < EVEN;
        let step_derivative = match settings.derivative {
            Derivative::Auto => whole && at_steps && settings.cutoff_hz.is_none(),
            Derivative::Central => false,
            Derivative::Step => true,
        };
        let qacc = accelerations(model.nv(), &time_s, &qvel, step_derivative);

        let loaded = drives.as_ref().map(|own| (own, &qacc[..]));
        let remembered = memory.follow(&time_s, (&qpos, &qvel), &held, loaded, &swings)?;
        let sensors = sources
            .sensors
            .iter()
            .map(|b| Measured {
                address: b.address,
                sensor: b.object,
                name: recording.streams[b.stream].channels[b.column].name.clone(),
                values: samples(recording, b).all_at(&time_s),
            })
            .collect();
        let mut states = Self {
            name,
            goal: goal(recording, &bound, &time_s),
            free_body: free_body(model, &measured_qpos),
            ctrl: vec![0.0; time_s.len() * model.nu()],
            time_s,
            qpos,
            qvel,
            qacc,
            sensors,
            measured_qpos,
            passive: closure.passive,
            step_derivative,
            controls,
            memory: remembered,
        };
        for k in 0..states.len() {
            let row = k * model.nu()..(k + 1) * model.nu();
            let time = states.time_s[k];
            let mut ctrl = vec![0.0; model.nu()];
            states.controls_at(time, &mut ctrl);
            states.ctrl[row].copy_from_slice(&ctrl);
        }
        Ok(states)
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Whether there is no sample.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }

    /// The typical interval between samples, s.
    pub fn interval_s(&self) -> f64 {
        median_interval(&self.time_s)
    }

    /// The controls in force at a time: the last ones given, 0 before the first.
    pub fn controls_at(&self, time: f64, ctrl: &mut [f64]) {
        controls_at(&self.controls, time, ctrl);
    }

    /// What the model's supplement remembers at sample `k`.
    pub fn memory(&self, k: usize) -> &[f64] {
        let n = self.memory.len() / self.len();
        &self.memory[k * n..(k + 1) * n]
    }
}

fn controls_at(controls: &[Control], time: f64, ctrl: &mut [f64]) {
    // half a nanosecond: stamps are whole ones
    let time = time + 0.5e-9;
    for ((times, values), out) in controls.iter().zip(ctrl) {
        let given = times.partition_point(|t| *t <= time);
        *out = given.checked_sub(1).map_or(0.0, |i| values[i]);
    }
}

/// Whether the joint with this first address is a hinge or slide.
fn is_scalar(model: &Model, addresses: &[i32], address: usize) -> bool {
    let joint = addresses.iter().position(|a| *a as usize == address);
    joint.is_some_and(|joint| model.is_slide(joint).is_some())
}

/// How messages call a recording.
fn label(recording: &Recording) -> String {
    let meta = &recording.meta;
    match (meta.source.as_str(), meta.trial.as_str()) {
        ("", "") => "without name".to_owned(),
        ("", trial) => trial.to_owned(),
        (source, "") => source.to_owned(),
        (source, trial) => format!("{source}, trial {trial}"),
    }
}

/// The passive degrees of freedom that are not measured; any other joint has to be. A free body may lack its
/// orientation, or be absent as a whole: it then stays where the model puts it.
fn check_positions(
    model: &Model,
    measured: &[usize],
    passive: &[usize],
    name: &str,
) -> Result<Vec<usize>, CompareError> {
    let mut unknown = Vec::new();
    for joint in 0..model.njnt() {
        let (address, dof) = (
            model.jnt_qposadr()[joint] as usize,
            model.jnt_dofadr()[joint] as usize,
        );
        if model.is_slide(joint).is_none() || measured.contains(&address) {
            continue;
        }
        if !passive.contains(&dof) {
            let joint = model
                .name(ObjectKind::Joint, joint)
                .unwrap_or("without name");
            return Err(CompareError::MissingPosition {
                recording: name.to_owned(),
                joint: joint.to_owned(),
            });
        }
        unknown.push(dof);
    }
    Ok(unknown)
}

fn samples(recording: &Recording, channel: &BoundChannel) -> Samples {
    Samples::of(&recording.streams[channel.stream], channel.column)
}

/// Times of the channel with most samples, between the latest beginning and the earliest end of all.
fn common_times(channels: &[Samples]) -> Vec<f64> {
    let Some(longest) = channels.iter().max_by_key(|c| c.time_s.len()) else {
        return Vec::new();
    };
    let first = |c: &Samples| c.time_s.first().copied().unwrap_or(f64::INFINITY);
    let last = |c: &Samples| c.time_s.last().copied().unwrap_or(f64::NEG_INFINITY);
    let begin = channels.iter().map(first).fold(f64::NEG_INFINITY, f64::max);
    let end = channels.iter().map(last).fold(f64::INFINITY, f64::min);
    let inside = longest.time_s.iter().filter(|t| **t >= begin && **t <= end);
    inside.copied().collect()
}

/// Replace times at uneven intervals by even ones.
fn even(time_s: &mut Vec<f64>, interval: f64) {
    let uneven = |pair: &[f64]| (pair[1] - pair[0] - interval).abs() > EVEN * interval;
    if time_s.windows(2).any(uneven) {
        let (first, last) = (time_s[0], time_s[time_s.len() - 1]);
        let n = ((last - first) / interval).floor() as usize + 1;
        *time_s = (0..n).map(|i| first + i as f64 * interval).collect();
    }
}

/// `qpos0` at every time, with the measured numbers in their places.
fn fill(qpos0: &[f64], time_s: &[f64], addresses: &[usize], channels: &[Samples]) -> Vec<f64> {
    let mut qpos = qpos0.repeat(time_s.len());
    for (address, channel) in addresses.iter().zip(channels) {
        for (row, time) in qpos.chunks_exact_mut(qpos0.len()).zip(time_s) {
            row[*address] = channel.at(*time);
        }
    }
    qpos
}

/// x and y of the target.
fn goal(recording: &Recording, bound: &Bound, time_s: &[f64]) -> Option<Vec<f64>> {
    let find = |i: usize| bound.goal.iter().find(|b| b.address == i);
    let (x, y) = (samples(recording, find(0)?), samples(recording, find(1)?));
    Some(time_s.iter().flat_map(|t| [x.at(*t), y.at(*t)]).collect())
}

/// The first free body of which the place is recorded.
fn free_body(model: &Model, measured: &[usize]) -> Option<usize> {
    let address = |joint: usize| model.jnt_qposadr()[joint] as usize;
    let seen = |joint: &usize| (0..3).all(|i| measured.contains(&(address(*joint) + i)));
    (0..model.njnt())
        .filter(|joint| model.is_free(*joint))
        .find(seen)
        .map(address)
}
