//! Simulations of all windows, and their derivatives by finite differences, on all cores.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::apart::{Class, Unknown};
use super::simulate::{Pool, Simulated, Simulator};
use super::window::{Placed, State, Window};
use crate::sysid::SysidError;
use crate::sysid::islands::is_shown;
use crate::sysid::problem::Problem;

/// Change of a first position, rad or m, in a finite difference.
const STEP_POSITION: f64 = 1e-6;
/// Of a first velocity, rad/s or m/s.
const STEP_VELOCITY: f64 = 1e-6;
/// Of a parameter, relative to its typical change.
const STEP_PARAMETER: f64 = 1e-6;

/// All windows at one point of the search.
#[derive(Clone, Copy)]
pub(crate) struct Point<'a> {
    pub problem: &'a Problem,
    pub windows: &'a [Window],
    /// samples of each window
    pub placed: &'a [Vec<Placed>],
    /// free parameters
    pub x: &'a [f64],
    /// of each window
    pub states: &'a [State],
    /// whether they are unknowns
    pub free_states: bool,
    /// of each window (2 nv × n): what its first state may change along; none: everything
    pub directions: &'a [DMatrix<f64>],
    pub pool: &'a Pool,
}

/// Derivatives of one window by every unknown: those of its first state if that is free, then the parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Columns {
    /// per unknown (samples)
    pub samples: Vec<Vec<f64>>,
    /// per unknown (2 nv) of the last state
    pub end: Vec<Vec<f64>>,
}

impl Point<'_> {
    /// Every window simulated; `None` for those that diverge.
    pub(crate) fn simulate(&self) -> Result<Vec<Option<Simulated>>, SysidError> {
        let all: Vec<usize> = (0..self.windows.len()).collect();
        self.simulate_some(&all)
    }

    /// Some of the windows, likewise.
    pub(crate) fn simulate_some(
        &self,
        which: &[usize],
    ) -> Result<Vec<Option<Simulated>>, SysidError> {
        self.simulate_pushed(which, &|_, _, _| ())
    }

    /// The same, with forces at the degrees of freedom that `push` sets: of (window, knot in it, forces (nv)).
    pub(crate) fn simulate_pushed(
        &self,
        which: &[usize],
        push: &(dyn Fn(usize, usize, &mut [f64]) + Sync),
    ) -> Result<Vec<Option<Simulated>>, SysidError> {
        let controls = self.controls(self.x, which);
        let size = which.len().div_ceil(8 * rayon::current_num_threads());
        let parts: Vec<Result<Vec<Option<Simulated>>, SysidError>> = (which
            .par_chunks(size.max(1)))
        .map(|part| {
            Simulator::with(self.problem, self.pool, self.x, |simulator| {
                (part.iter())
                    .map(|&w| {
                        let window = &self.windows[w];
                        let controls = &controls[window.trial];
                        simulator.run_with(window, &self.states[w], controls, &mut |k, data| {
                            push(w, k, data.qfrc_applied_mut());
                        })
                    })
                    .collect()
            })
        })
        .collect();
        let mut all = Vec::with_capacity(which.len());
        for part in parts {
            all.extend(part?);
        }
        Ok(all)
    }

    /// Unknowns of a window's first state.
    pub(crate) fn n_state(&self) -> usize {
        match self.directions.first() {
            _ if !self.free_states => 0,
            Some(directions) => directions.ncols(),
            None => 2 * self.problem.model.nv(),
        }
    }

    /// Derivatives where the simulations are `base`.
    pub(crate) fn columns(&self, base: &[Simulated]) -> Result<Vec<Columns>, SysidError> {
        let classes = self.classes(base);
        let mut tasks: Vec<Task<'_>> = Vec::new();
        let states: Vec<Vec<Vec<Vec<Unknown>>>> = (classes.iter())
            .map(|c| (c.windows.iter().map(|w| self.state_groups(c, *w))).collect())
            .collect();
        let parameters: Vec<Vec<Vec<Unknown>>> =
            classes.iter().map(|c| self.parameter_groups(c)).collect();
        for (i, class) in classes.iter().enumerate() {
            let n_groups = states[i].iter().map(Vec::len).max().unwrap_or_default();
            let size = self.chunk((n_groups + parameters[i].len()) * class.windows.len());
            for (windows, states) in class.windows.chunks(size).zip(states[i].chunks(size)) {
                let state = (0..n_groups).map(|g| Change::State(g, states));
                let changes = state.chain(parameters[i].iter().map(|g| Change::Parameters(g)));
                tasks.extend(changes.map(|change| Task {
                    class,
                    windows,
                    change,
                }));
            }
        }
        let all: Vec<usize> = (0..self.windows.len()).collect();
        let controls = self.controls(self.x, &all);
        let parts: Vec<Result<Vec<Vec<Slope>>, SysidError>> = (tasks.par_iter())
            .map(|task| self.slopes(task, base, &controls))
            .collect();
        let n = self.n_state() + self.x.len();
        let mut all: Vec<Columns> = (self.placed.iter())
            .map(|placed| Columns {
                samples: vec![vec![0.0; placed.len()]; n],
                end: vec![vec![0.0; 2 * self.problem.model.nv()]; n],
            })
            .collect();
        for (task, part) in tasks.iter().zip(parts) {
            for (&w, slopes) in task.windows.iter().zip(part?) {
                for (j, samples, end) in slopes {
                    (all[w].samples[j], all[w].end[j]) = (samples, end);
                }
            }
        }
        Ok(all)
    }

    /// Slopes of the windows of a task, by every unknown that it changes.
    fn slopes(
        &self,
        task: &Task<'_>,
        base: &[Simulated],
        controls: &[Vec<f64>],
    ) -> Result<Vec<Vec<Slope>>, SysidError> {
        let n_state = self.n_state();
        let parameters = &self.problem.parameters;
        let typical: Vec<f64> = parameters.iter_free().map(|p| p.typical).collect();
        let step = |j: usize| match j.checked_sub(n_state) {
            Some(j) => STEP_PARAMETER * typical[j],
            None if j < n_state / 2 => STEP_POSITION,
            None => STEP_VELOCITY,
        };
        let mut x = self.x.to_vec();
        let mut moved_controls = Vec::new();
        if let Change::Parameters(group) = task.change {
            for (j, _) in group {
                x[j - n_state] += step(*j);
            }
            if group
                .iter()
                .any(|(j, _)| self.problem.moves_controls(j - n_state))
            {
                moved_controls = self.controls(&x, task.windows);
            }
        }
        let controls = if moved_controls.is_empty() {
            controls
        } else {
            &moved_controls
        };
        let slopes = |simulator: &mut Simulator<'_>, k: usize| {
            let w = task.windows[k];
            let (window, placed, base) = (&self.windows[w], &self.placed[w], &base[w]);
            let mut state = self.states[w].clone();
            let group = match task.change {
                Change::Parameters(group) => group,
                Change::State(g, of_windows) => match of_windows[k].get(g) {
                    Some(group) => {
                        let mut tangent = vec![0.0; 2 * self.problem.model.nv()];
                        for (j, _) in group {
                            self.add_tangent(w, *j, step(*j), &mut tangent);
                        }
                        state = state.moved(self.problem, &tangent)?;
                        group
                    }
                    None => return Ok(Vec::new()),
                },
            };
            let moved = simulator.run(window, &state, &controls[window.trial])?;
            // what diverges this close to what does not has no slope
            let moved = moved.as_ref().unwrap_or(base);
            let end = moved.end.minus(&base.end, self.problem)?;
            let change: Vec<f64> = (moved.samples(self.problem, window, placed))
                .zip(base.samples(self.problem, window, placed))
                .map(|(m, b)| m.0 - b.0)
                .collect();
            let one = |(j, reached): &Unknown| {
                let slope = |change: f64, part: Option<usize>| {
                    if is_shown(reached.as_ref(), part) {
                        change / step(*j)
                    } else {
                        0.0
                    }
                };
                let partition = &task.class.partition;
                let channels = &self.problem.trials[window.trial].samples;
                let samples = (change.iter().zip(placed))
                    .map(|(d, p)| slope(*d, partition.channels[channels[p.sample].channel]))
                    .collect();
                let of_dof = partition.dofs.iter().cycle();
                let end = end
                    .iter()
                    .zip(of_dof)
                    .map(|(d, part)| slope(*d, Some(*part)));
                (*j, samples, end.collect())
            };
            Ok(group.iter().map(one).collect())
        };
        Simulator::with(self.problem, self.pool, &x, |simulator| {
            (0..task.windows.len())
                .map(|k| slopes(simulator, k))
                .collect()
        })
    }

    /// A change by `step` along unknown `j` of the first state of window `w`, added to a tangent (2 nv).
    fn add_tangent(&self, w: usize, j: usize, step: f64, tangent: &mut [f64]) {
        match self.directions.get(w) {
            Some(directions) => {
                for (t, d) in tangent.iter_mut().zip(directions.column(j).iter()) {
                    *t += d * step;
                }
            }
            None => tangent[j] += step,
        }
    }

    /// Of every trial (knots × nu); of those without one of the windows `which`, nothing.
    fn controls(&self, x: &[f64], which: &[usize]) -> Vec<Vec<f64>> {
        let mut wanted = vec![false; self.problem.trials.len()];
        for w in which {
            wanted[self.windows[*w].trial] = true;
        }
        let trials = self.problem.trials.par_iter().zip(wanted);
        trials
            .map(|(trial, wanted)| {
                if wanted {
                    self.problem.controls(trial, x)
                } else {
                    Vec::new()
                }
            })
            .collect()
    }

    /// Windows a task, so that `n` simulations keep all cores busy.
    fn chunk(&self, n: usize) -> usize {
        let n_tasks = 8 * rayon::current_num_threads();
        (n.div_ceil(n_tasks)).clamp(1, self.windows.len().max(1))
    }
}

/// What is changed in one simulation of a window.
#[derive(Clone, Copy)]
enum Change<'t> {
    /// of each window's own groups of its first state, this one
    State(usize, &'t [Vec<Vec<Unknown>>]),
    Parameters(&'t [Unknown]),
}

/// Windows with one change each.
struct Task<'t> {
    class: &'t Class,
    windows: &'t [usize],
    change: Change<'t>,
}

/// By an unknown: of a window's samples and of its last state.
type Slope = (usize, Vec<f64>, Vec<f64>);

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mujoco::Model;
    use crate::recording::Recording;
    use crate::sysid::norm::Norm;
    use crate::sysid::parameter::Parameters;
    use crate::sysid::problem::{Channel, CommandTiming, Sample, Setting, Stage, Trial};

    /// Two arms; the second holds a ball by an equality, and a third ball falls onto the first arm.
    const MODEL: &str = r#"<mujoco><option timestep="0.002"/>
      <worldbody>
        <body name="a"><joint name="a" axis="0 1 0" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"/></body>
        <body name="b" pos="0 2 0"><joint name="b" axis="0 1 0" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"/></body>
        <body name="c" pos="1 2 0"><joint name="c" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body>
        <body name="d" pos="0.3 0 0.2"><freejoint name="d"/><geom size="0.1"/></body>
      </worldbody>
      <equality><joint joint1="c" joint2="b" solref="0.01 1"/></equality>
    </mujoco>"#;

    fn problem() -> Problem {
        let model = Model::from_xml_str(MODEL).expect("a model");
        let rules = r#"[
            {"element": "joint/?", "attribute": "damping", "scale": "linear", "lower": -1.0},
            {"element": "body/?", "attribute": "mass"}
        ]"#;
        let rules: Vec<_> = serde_json::from_str(rules).expect("rules");
        let names: Vec<String> = (0..4).map(|i| format!("q{i}")).collect();
        let sources = [0, 1, 2, 5].map(|i| model.nsensordata() + i);
        let channels = names.iter().zip(sources).map(|(name, source)| Channel {
            name: name.clone(),
            unit: "rad".into(),
            source,
            stage: Stage::Position,
            sigma: 1.0,
            sigma_known: true,
            norm: Norm::Quadratic,
            bias: Setting::Fixed(0.0),
            gain: Setting::Fixed(1.0),
            delay: Setting::Fixed(0.0),
        });
        let samples = (0..=50_u32).flat_map(|k| {
            (0..4).map(move |channel| Sample {
                channel,
                time: f64::from(k) * 0.002,
                value: 0.0,
                spread: 1.0,
            })
        });
        let trial = Trial {
            name: "t".into(),
            n_knots: 51,
            start_s: 0.0,
            controls: Arc::default(),
            samples: Arc::new(samples.collect()),
            recording: Arc::new(Recording::default()),
            path: None,
        };
        Problem {
            parameters: Parameters::new(&model, &rules, &names).expect("parameters"),
            force_sigma: vec![0.0; model.nv()],
            force_norm: vec![Norm::Quadratic; model.nv()],
            model: Arc::new(model),
            channels: channels.collect(),
            trials: vec![trial],
            force_sigma_relative: 0.01,
            command_delay: Vec::new(),
            notes: Vec::new(),
            command: CommandTiming::Held,
        }
    }

    #[test]
    fn changed_at_once_columns_are_those_of_changes_one_by_one() {
        let problem = problem();
        let window = |first, last| Window {
            trial: 0,
            first,
            last,
            followed: false,
            whole: true,
        };
        // the third ball touches the first arm in the second window alone
        let windows = [window(0, 25), window(25, 50)];
        let at = |z: f64| State {
            qpos: vec![0.1, 0.2, 0.2, 0.3, 0.0, z, 1.0, 0.0, 0.0, 0.0],
            qvel: vec![0.5, -0.3, -0.3, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0],
        };
        let states = [at(0.4), at(0.1)];
        let x = problem.parameters.start();
        let placed = super::super::window::place(&problem, &windows, &x);
        let pool = Pool::default();
        let mut loops = super::super::loops::Loops::new(&problem, &x)
            .expect("loops")
            .expect("a loop");
        let directions = loops.directions(&states).expect("directions");
        let point = Point {
            problem: &problem,
            windows: &windows,
            placed: &placed,
            x: &x,
            states: &states,
            free_states: true,
            directions: &directions,
            pool: &pool,
        };
        let simulate = |point: Point<'_>| -> Vec<Simulated> {
            let all = point.simulate().expect("simulated");
            all.into_iter().map(|s| s.expect("sound")).collect()
        };
        let base = simulate(point);
        let classes = point.classes(&base);
        assert_eq!(classes.len(), 2);
        let most = |c: usize| {
            let states = point.state_groups(&classes[c], c).len();
            (states, point.parameter_groups(&classes[c]).len())
        };
        // of 16 and 8 unknowns: the ball has 12 by itself, 14 with the arm that it touches
        assert_eq!((most(0), most(1)), ((12, 4), (14, 4)));
        let found = point.columns(&base).expect("columns");
        for j in 0..point.n_state() + x.len() {
            let mut moved = (states.to_vec(), x.clone());
            let step = if let Some(j) = j.checked_sub(point.n_state()) {
                let own = problem.parameters.iter_free().nth(j);
                let step = STEP_PARAMETER * own.expect("a parameter").typical;
                moved.1[j] += step;
                step
            } else {
                for (w, state) in moved.0.iter_mut().enumerate() {
                    let along = directions[w].column(j) * STEP_POSITION;
                    *state = state.moved(&problem, along.as_slice()).expect("moved");
                }
                STEP_POSITION
            };
            let alone = simulate(Point {
                x: &moved.1,
                states: &moved.0,
                ..point
            });
            for (w, columns) in found.iter().enumerate() {
                let slope = (alone[w].samples(&problem, &windows[w], &placed[w]))
                    .zip(base[w].samples(&problem, &windows[w], &placed[w]))
                    .map(|(m, b)| (m.0 - b.0) / step);
                for (a, b) in slope.zip(&columns.samples[j]) {
                    assert!((a - b).abs() < 1e-4 * (1.0 + a.abs()), "{w} {j} {a} {b}");
                }
                let end = alone[w].end.minus(&base[w].end, &problem).expect("end");
                for (a, b) in end.iter().zip(&columns.end[j]) {
                    let a = a / step;
                    assert!((a - b).abs() < 1e-4 * (1.0 + a.abs()), "{w} {j} {a} {b}");
                }
            }
        }
    }
}
