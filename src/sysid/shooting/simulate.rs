//! One window, simulated.

use std::sync::{Arc, Mutex, PoisonError};

use super::window::{Placed, State, Window};
use crate::mujoco::{self, Contact, Data, Model, Swing};
use crate::supplement::MEMORY_S;
use crate::sysid::SysidError;
use crate::sysid::path::Path;
use crate::sysid::problem::{Problem, Trial};
use crate::sysid::reach::Contacts;

/// What the model makes of a window.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Simulated {
    /// (knots × channels) sensors
    sensors: Vec<f64>,
    /// (knots × nq)
    pub qpos: Vec<f64>,
    /// at the last knot
    pub end: State,
    /// pairs of geoms that touch at some knot
    pub contacts: Contacts,
}

impl Simulated {
    /// Each sample as its sensor has it, and the slope there, per step.
    pub(crate) fn samples<'a>(
        &'a self,
        problem: &'a Problem,
        window: &'a Window,
        placed: &'a [Placed],
    ) -> impl Iterator<Item = (f64, f64)> + 'a {
        let n_channels = problem.channels.len();
        placed.iter().map(move |p| {
            let channel = problem.trials[window.trial].samples[p.sample].channel;
            let value = |knot: usize| self.sensors[knot * n_channels + channel];
            // at the last knot there is no next one
            let from = p.knot.min(window.len() - 2);
            let slope = value(from + 1) - value(from);
            (value(p.knot) + p.part * slope, slope)
        })
    }
}

/// Simulations to be used again: to make one takes as long as a hundred steps.
#[derive(Default)]
pub(crate) struct Pool(Mutex<Vec<Data>>);

impl Pool {
    /// One of the problem's model, its numbers and state whatever they were.
    pub(crate) fn take(&self, problem: &Problem) -> Result<Data, SysidError> {
        let found = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop();
        Ok(match found {
            Some(data) => data,
            None => Data::new(Arc::clone(&problem.model))?,
        })
    }

    /// Gives one back that no error has stopped.
    pub(crate) fn put(&self, data: Data) {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        all.push(data);
    }
}

/// Sets the applied forces of a simulation that stands at a knot, counted from the window's first.
pub(crate) type Push<'p> = dyn FnMut(usize, &mut Data) + 'p;

/// A simulation with parameters of its own.
pub(crate) struct Simulator<'a> {
    problem: &'a Problem,
    x: &'a [f64],
    data: Data,
    /// the initial state: to put it back is quicker than a reset, which clears all of the engine's memory
    initial: mujoco::State,
}

impl<'a> Simulator<'a> {
    /// What `run` gives with the parameters `x`; the simulation comes from `pool`, and returns there.
    pub(crate) fn with<R>(
        problem: &'a Problem,
        pool: &Pool,
        x: &'a [f64],
        run: impl FnOnce(&mut Self) -> Result<R, SysidError>,
    ) -> Result<R, SysidError> {
        let mut data = pool.take(problem)?;
        problem.parameters.apply(&problem.model, x, &mut data)?;
        data.reset();
        let initial = data.state();
        let mut simulator = Self {
            problem,
            x,
            data,
            initial,
        };
        let result = run(&mut simulator)?;
        pool.put(simulator.data);
        Ok(result)
    }

    /// Simulates a window from `state` under the controls of its trial (knots × nu). `None` where it diverges.
    pub(crate) fn run(
        &mut self,
        window: &Window,
        state: &State,
        controls: &[f64],
    ) -> Result<Option<Simulated>, SysidError> {
        self.run_with(window, state, controls, &mut |_, _| ())
    }

    /// The same, with forces that `push` sets at each knot.
    pub(crate) fn run_with(
        &mut self,
        window: &Window,
        state: &State,
        controls: &[f64],
        push: &mut Push<'_>,
    ) -> Result<Option<Simulated>, SysidError> {
        let Self {
            problem,
            x,
            data,
            initial,
        } = self;
        let (nq, nu) = (problem.model.nq(), problem.model.nu());
        let n_channels = problem.channels.len();
        let mut sensors = vec![0.0; window.len() * n_channels];
        let mut qpos = Vec::with_capacity(window.len() * nq);
        let mut end = state.clone();
        let mut contacts = Contacts::new();
        data.restore_state(initial)?;
        data.hold(None);
        data.clear_warnings();
        data.qpos_mut().copy_from_slice(&state.qpos);
        data.qvel_mut().copy_from_slice(&state.qvel);
        let trial = &problem.trials[window.trial];
        let swings = swings(problem, trial, data.model());
        data.show(swings(window.first));
        if !data.memory().is_empty() {
            let first = window.first as isize - past_len(&problem.model) as isize;
            let n = past_len(&problem.model) + beyond(&problem.model);
            let commands = problem.controls_from(trial, x, first, n);
            let begin_s = window.first as f64 * problem.model.timestep();
            let path = trial.path.as_ref().map(|p| (p, begin_s));
            past(data, state, &commands, path)?;
        }
        let knots = (window.first as isize, window.len());
        let held = problem
            .model
            .has_loaded_drives()
            .then(|| problem.held_controls(trial, x, knots));
        let held = held.flatten();
        for (k, row) in (window.first..=window.last).zip(sensors.chunks_exact_mut(n_channels)) {
            data.ctrl_mut()
                .copy_from_slice(&controls[k * nu..(k + 1) * nu]);
            qpos.extend_from_slice(data.qpos());
            if k == window.last {
                end.qpos.copy_from_slice(data.qpos());
                end.qvel.copy_from_slice(data.qvel());
            }
            let from = (k - window.first) * nu;
            data.hold(held.as_ref().map(|held| &held[from..from + nu]));
            if k > window.first {
                data.show(swings(k));
            }
            push(k - window.first, data);
            self::read(problem, &problem.model, data, row, false);
            // the step leaves the sensors of its beginning
            data.step()?;
            if data.warnings().diverged() {
                return Ok(None);
            }
            self::read(problem, &problem.model, data, row, true);
            contacts.extend(data.contacts().iter().map(Contact::geoms));
        }
        Ok(Some(Simulated {
            sensors,
            qpos,
            end,
            contacts,
        }))
    }
}

/// At a knot of the trial: joints whose motors are put where its recorded path shows them, and where that is.
fn swings<'a>(
    problem: &'a Problem,
    trial: &'a Trial,
    model: &Model,
) -> impl Fn(usize) -> Vec<(usize, Swing)> + use<'a> {
    let extension = problem.model.extension();
    let late_s = (extension.and_then(|e| e.encoder_delay_s(model))).unwrap_or(0.0);
    let joints: Vec<usize> = problem.model.followed_joints().collect();
    move |knot| {
        let Some(path) = &trial.path else {
            return Vec::new();
        };
        let time_s = knot as f64 * problem.model.timestep() + late_s;
        let address = |j: usize| problem.model.jnt_qposadr()[j] as usize;
        (joints.iter())
            .map(|&j| (j, path.swing(address(j), time_s)))
            .collect()
    }
}

/// Steps that an extension remembers.
fn past_len(model: &Model) -> usize {
    (MEMORY_S / model.timestep()).ceil() as usize
}

/// Half the time that a motor's acceleration is a mean over, s.
const HALF_S: f64 = 0.03;
/// Time between the two loads of transmissions that say how they move, s.
const APART_S: f64 = 0.015;

/// Steps after a state in which its transmissions' loads show.
fn beyond(model: &Model) -> usize {
    if !model.has_loaded_drives() {
        return 0;
    }
    ((HALF_S + 0.5 * APART_S) / model.timestep()).ceil() as usize
}

/// What happened before `state` and is still felt: commands (steps × nu, some of them after it) on their way, loaded
/// transmissions, readings of hinges and slides that are late. Those moved as they move now; or as on the path `recorded` from
/// its time of the state, if they are late.
fn past(
    data: &mut Data,
    state: &State,
    commands: &[f64],
    recorded: Option<(&Path, f64)>,
) -> Result<(), SysidError> {
    let model = Arc::clone(data.model_arc());
    let (h, nu, n) = (model.timestep(), model.nu(), past_len(&model));
    let late_s = (model.extension()).and_then(|e| e.encoder_delay_s(data.model()));
    // the path, and when it was where the state is
    let path = (recorded.zip(late_s.filter(|s| *s > 0.0)))
        .map(|((path, begin_s), late_s)| (path, begin_s + late_s));
    let scalar: Vec<(usize, usize)> = (model.scalar_joints())
        .map(|j| {
            (
                model.jnt_qposadr()[j] as usize,
                model.jnt_dofadr()[j] as usize,
            )
        })
        .collect();
    for k in 0..n {
        data.ctrl_mut()
            .copy_from_slice(&commands[k * nu..(k + 1) * nu]);
        let ago = (n - k) as f64 * h;
        for (q, v) in &scalar {
            let moved = match path {
                Some((path, now)) => path.at(*q, now) - path.at(*q, now - ago),
                None => ago * state.qvel[*v],
            };
            data.qpos_mut()[*q] = state.qpos[*q] - moved;
        }
        if k + 1 < n {
            data.advance_past()?;
        }
    }
    if let Some(recorded) = recorded.filter(|_| model.has_loaded_drives()) {
        load(data, state, commands, recorded)?;
    } else {
        // springs and play of transmissions are where the last command had them
        data.forward()?;
        data.advance_memory();
    }
    data.qpos_mut().copy_from_slice(&state.qpos);
    Ok(())
}

/// Loads transmissions as the recorded motion says: before and after the state, and from both.
fn load(
    data: &mut Data,
    state: &State,
    commands: &[f64],
    (path, begin_s): (&Path, f64),
) -> Result<(), SysidError> {
    let model = Arc::clone(data.model_arc());
    let (h, nu) = (model.timestep(), model.nu());
    // no shorter than a step, which has a command in any case
    let (present, half) = (past_len(&model) as f64, (HALF_S / h).max(1.0));
    data.qpos_mut().copy_from_slice(&state.qpos);
    for (side, since_s) in [(-0.5, None), (0.5, Some(APART_S))] {
        let at_s = side * APART_S;
        let middle = present + at_s / h;
        let mut mean = vec![0.0; nu];
        let mut sum = 0.0;
        for (k, row) in commands.chunks_exact(nu).enumerate() {
            let weight = (1.0 - (k as f64 + 0.5 - middle).abs() / half).max(0.0);
            sum += weight;
            for (m, c) in mean.iter_mut().zip(row) {
                *m += weight * c;
            }
        }
        for (ctrl, m) in data.ctrl_mut().iter_mut().zip(&mean) {
            *ctrl = m / sum;
        }
        let address = |joint: usize| model.jnt_qposadr()[joint] as usize;
        let acceleration = |j: usize| path.acceleration(address(j), begin_s + at_s, HALF_S);
        data.load_memory(&acceleration, since_s)?;
    }
    Ok(())
}

/// Channels of a knot: the model's `sensors` after the step, or joint positions and velocities before it.
fn read(problem: &Problem, model: &Model, data: &Data, row: &mut [f64], sensors: bool) {
    let (n_sensordata, nq) = (model.nsensordata(), model.nq());
    for (value, channel) in row.iter_mut().zip(&problem.channels) {
        let i = channel.source;
        match (i < n_sensordata, sensors) {
            (true, true) => *value = data.sensordata()[i],
            (false, false) if i < n_sensordata + nq => *value = data.qpos()[i - n_sensordata],
            (false, false) => *value = data.qvel()[i - n_sensordata - nq],
            _ => {}
        }
    }
}
