//! Simulations under recorded controls, and inverse dynamics at states on their way.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use crate::mujoco::{Data, Model, MujocoError, State};
use crate::rng::{self, Purpose, Stream};
use crate::rollout::hold;
use crate::supplement::{self, SupplementError};

/// Physics steps of every simulation.
pub const N_STEP: usize = 300;
/// Physics steps for which a random control is held.
const HOLD: usize = 10;
/// Every how many steps inverse dynamics is recorded.
const INVERSE_EVERY: usize = 15;

/// Arrays of a model by name, row by row.
pub type Arrays = BTreeMap<&'static str, Vec<f64>>;

/// One model and what was simulated with it.
#[derive(Debug, Serialize)]
pub struct Physics {
    /// what this is
    pub name: String,
    /// model file, from the top of the repository
    pub model: String,
    /// every array of doubles of the model as loaded
    pub constants: Arrays,
    /// those that were drawn anew, as simulated
    pub changed: Arrays,
    /// time step as simulated, s
    pub timestep_s: f64,
    /// simulations
    pub runs: Vec<Run>,
    /// inverse dynamics
    pub inverse: Vec<Inverse>,
}

/// How a simulation is advanced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Advance {
    /// `mj_step`; what is recorded belongs to the state before, except for that state itself
    Step,
    /// after one `mj_step1`, repeatedly `mj_step2` and `mj_step1`, as in rollouts
    Halves,
}

/// A simulation. Entry `t` of an array belongs to the end of step `t`.
#[derive(Debug, Serialize)]
pub struct Run {
    /// how it was advanced
    pub advance: Advance,
    /// state before the first step
    pub start: Full,
    /// (T × nu) controls during the step
    pub ctrl: Vec<Vec<f64>>,
    /// (T × nq)
    pub qpos: Vec<Vec<f64>>,
    /// (T × nv)
    pub qvel: Vec<Vec<f64>>,
    /// (T × na)
    pub act: Vec<Vec<f64>>,
    /// (T × nv) the solver's starting point for the next step
    pub qacc_warmstart: Vec<Vec<f64>>,
    /// (T × memory) what supplements remember
    pub memory: Vec<Vec<f64>>,
    /// (T × nsensordata)
    pub sensordata: Vec<Vec<f64>>,
    /// (T) number of contacts
    pub ncon: Vec<usize>,
}

/// All that the next step depends on.
#[derive(Debug, Serialize)]
#[allow(missing_docs)] // MuJoCo's own names
pub struct Full {
    pub time: f64,
    pub qpos: Vec<f64>,
    pub qvel: Vec<f64>,
    pub act: Vec<f64>,
    pub mocap_pos: Vec<f64>,
    pub mocap_quat: Vec<f64>,
    pub qacc_warmstart: Vec<f64>,
    pub ctrl: Vec<f64>,
    pub memory: Vec<f64>,
}

/// Inverse dynamics at one state.
#[derive(Debug, Serialize)]
pub struct Inverse {
    /// the state
    pub state: Full,
    /// (nv) given acceleration
    pub qacc: Vec<f64>,
    /// (nv) the force that makes it, beyond constraint and passive forces
    pub qfrc_inverse: Vec<f64>,
}

impl Full {
    fn of(data: &Data) -> Self {
        Self {
            time: data.time(),
            qpos: data.qpos().to_vec(),
            qvel: data.qvel().to_vec(),
            act: data.act().to_vec(),
            mocap_pos: data.mocap_pos().to_vec(),
            mocap_quat: data.mocap_quat().to_vec(),
            qacc_warmstart: data.qacc_warmstart().to_vec(),
            ctrl: data.ctrl().to_vec(),
            memory: data.memory().to_vec(),
        }
    }
}

impl Physics {
    /// A case without simulations: `nominal` was loaded from `file`, `drawn` is what will be simulated.
    pub fn new(name: &str, file: &str, nominal: &Model, drawn: &Model) -> Self {
        let constants = arrays(nominal);
        let changed = arrays(drawn)
            .into_iter()
            .filter(|(name, values)| constants[name] != *values);
        Self {
            name: name.to_owned(),
            model: file.to_owned(),
            changed: changed.collect(),
            constants,
            timestep_s: drawn.timestep(),
            runs: Vec::new(),
            inverse: Vec::new(),
        }
    }

    /// Simulate from the state of `data`, whose derived quantities must be up to date, with the controls that
    /// `control` writes before each step.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn simulate(
        &mut self,
        data: &mut Data,
        advance: Advance,
        rng: &mut Stream,
        mut control: impl FnMut(usize, &Data, &mut [f64]),
    ) -> Result<(), MujocoError> {
        let mut side = Data::new(Arc::clone(data.model_arc()))?;
        let mut state = State::default();
        let mut ctrl = vec![0.0; data.model().nu()];
        let mut run = Run {
            advance,
            start: Full::of(data),
            ctrl: Vec::new(),
            qpos: Vec::new(),
            qvel: Vec::new(),
            act: Vec::new(),
            qacc_warmstart: Vec::new(),
            memory: Vec::new(),
            sensordata: Vec::new(),
            ncon: Vec::new(),
        };
        for t in 0..N_STEP {
            control(t, data, &mut ctrl);
            match advance {
                Advance::Step => {
                    data.ctrl_mut().copy_from_slice(&ctrl);
                    data.step()?;
                }
                Advance::Halves => hold(data, &ctrl, 1)?,
            }
            run.ctrl.push(ctrl.clone());
            run.qpos.push(data.qpos().to_vec());
            run.qvel.push(data.qvel().to_vec());
            run.act.push(data.act().to_vec());
            run.qacc_warmstart.push(data.qacc_warmstart().to_vec());
            run.memory.push(data.memory().to_vec());
            run.sensordata.push(data.sensordata().to_vec());
            run.ncon.push(data.ncon());
            if t % INVERSE_EVERY == 0 {
                data.save_state(&mut state);
                side.restore_state(&state)?;
                self.inverse.push(inverse(&mut side, rng)?);
            }
        }
        self.runs.push(run);
        Ok(())
    }
}

/// Inverse dynamics at the state of `data`, for an acceleration around its own.
fn inverse(data: &mut Data, rng: &mut Stream) -> Result<Inverse, MujocoError> {
    data.forward()?;
    for qacc in data.qacc_mut() {
        *qacc += (1.0 + qacc.abs()) * rng::normal(rng);
    }
    let (state, qacc) = (Full::of(data), data.qacc().to_vec());
    data.inverse()?;
    Ok(Inverse {
        state,
        qacc,
        qfrc_inverse: data.qfrc_inverse().to_vec(),
    })
}

/// Controls that are drawn anew every `HOLD` steps, uniform within `amplitude` of `centre`.
pub fn random_controls(
    mut rng: Stream,
    centre: Vec<f64>,
    amplitude: f64,
) -> impl FnMut(usize, &Data, &mut [f64]) {
    move |t, _, ctrl| {
        if t % HOLD == 0 {
            for (u, centre) in ctrl.iter_mut().zip(&centre) {
                *u = centre + rng::uniform(&mut rng, -amplitude, amplitude);
            }
        }
    }
}

/// Every array of doubles of a model.
fn arrays(model: &Model) -> Arrays {
    let named = Model::NUMERIC_FIELDS
        .iter()
        .filter_map(|&name| Some((name, model.numeric_field(name)?.to_vec())));
    named.filter(|(_, values)| !values.is_empty()).collect()
}

/// The pendulum, the arm and the box of the tests from their initial states, and the model with all supplements from its
/// keyframe.
///
/// # Errors
/// When a model cannot be loaded or the engine fails.
pub fn small_models(root: &Path, seed: u64) -> Result<Vec<Physics>, SupplementError> {
    // the pusher is driven towards the box on average
    let cases = [
        ("pendulum", vec![0.0], 2.0),
        ("arm", vec![0.0, 0.0], 4.0),
        ("push_box", vec![2.5], 2.5),
        ("supplemented", vec![-2.1, -0.4], 1.5),
    ];
    let record = |(index, (name, centre, amplitude)): (usize, (&str, Vec<f64>, f64))| {
        let file = format!("tests/models/{name}.xml");
        let model = Arc::new(supplement::load(root.join(&file))?);
        let mut physics = Physics::new(name, &file, &model, &model);
        for (i, advance) in [Advance::Step, Advance::Halves].into_iter().enumerate() {
            let draw = |purpose| rng::stream(seed, purpose, index as u64, i as u64);
            let mut data = Data::new(Arc::clone(&model))?;
            if model.extension().is_some() {
                data.reset_to_keyframe(0)?;
            }
            data.step1()?;
            let control = random_controls(draw(Purpose::Exploration), centre.clone(), amplitude);
            physics.simulate(&mut data, advance, &mut draw(Purpose::Start), control)?;
        }
        Ok(physics)
    };
    cases.into_iter().enumerate().map(record).collect()
}
