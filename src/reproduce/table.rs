//! Table 1: every policy on the spiral, in simulation and on the rig.

use std::path::PathBuf;
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::machine::machine;
use super::mass::{self, MassRow};
use super::{Case, ReproduceError, Study, TRUE_MASS_KG};
use crate::evaluate::{EvaluationRequest, evaluate};
use crate::policy::AffineGaussian;
use crate::randomise::Randomiser;
use crate::rig::RigConfig;
use crate::rig::tracking::{self, Place};
use crate::run_dir;
use crate::task::push::PushTask;
use crate::train::config::ensemble_rules;

/// Seed of starts and base positions: `phantom eval --seed 1`, unlike that of the evaluations during training.
const SEED: u64 = 1;
/// Samples of a path that are kept, 1/s.
const PATH_HZ: f64 = 100.0;

/// One rollout of a policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rollout {
    /// over the whole spiral, cm; after a breakdown the object counts as staying where it was
    pub mean_distance_cm: f64,
    /// why it ended early
    pub diverged: Option<String>,
    /// sampled at 100 Hz
    pub path: Vec<Place>,
}

/// All rollouts of one policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluated {
    /// of the policy
    pub case: Case,
    /// of the policy
    pub seed: u64,
    /// the policy itself: what was measured is known by it
    pub policy: AffineGaussian,
    /// of the machines
    pub rig: RigConfig,
    /// in simulation, at the true mass
    pub simulation: Vec<Rollout>,
    /// on the rig
    pub machine: Vec<Rollout>,
    /// in simulation, at other masses
    pub masses: Vec<MassRow>,
}

/// A row of the table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// of the policies
    pub case: Case,
    /// mean over seeds, cm
    pub simulation_cm: f64,
    /// standard deviation between seeds, cm
    pub simulation_sigma_cm: f64,
    /// mean over seeds, cm
    pub machine_cm: f64,
    /// standard deviation between seeds, cm
    pub machine_sigma_cm: f64,
    /// the paper's figures, simulation and hardware, cm
    pub paper_cm: [f64; 2],
    /// less the correct policy of the same seed: mean and standard error over seeds, simulation and rig, cm
    pub less_correct_cm: [[f64; 2]; 2],
}

/// Where the rollouts of a policy are kept.
fn file(study: &Study, case: Case, seed: u64) -> PathBuf {
    let name = format!("{}-seed{seed}.json", case.name());
    study.out.join("results").join(name)
}

/// The rollouts of `policy`, made now unless they were before.
///
/// # Errors
/// A rollout fails, or the file cannot be read or written.
pub fn evaluated(
    study: &Study,
    pool: &rayon::ThreadPool,
    case: Case,
    seed: u64,
    policy: &AffineGaussian,
) -> Result<Evaluated, ReproduceError> {
    let file = file(study, case, seed);
    if file.exists() {
        let found: Evaluated = run_dir::read_json(&file)?;
        let whole = found.simulation.len() == study.n_rollout;
        if found.policy == *policy && found.rig == study.rig && whole {
            return Ok(found);
        }
    }
    let made = pool.install(|| evaluate_anew(study, case, seed, policy))?;
    if let Some(parent) = file.parent() {
        std::fs::create_dir_all(parent).map_err(|reason| ReproduceError::File {
            file: parent.to_owned(),
            reason: reason.to_string(),
        })?;
    }
    let text = serde_json::to_vec(&made).map_err(|error| ReproduceError::File {
        file: file.clone(),
        reason: error.to_string(),
    })?;
    run_dir::write_atomic(&file, &text)?;
    Ok(made)
}

fn evaluate_anew(
    study: &Study,
    case: Case,
    seed: u64,
    policy: &AffineGaussian,
) -> Result<Evaluated, ReproduceError> {
    let machine: Vec<Result<_, ReproduceError>> = (0..study.n_rollout)
        .into_par_iter()
        .with_max_len(1)
        .map(|i| on_machine(study, policy, i as u64))
        .collect();
    let simulation = simulated(study, policy)?;
    let true_cm = mean_distance_cm(&simulation);
    Ok(Evaluated {
        case,
        seed,
        policy: policy.clone(),
        rig: study.rig.clone(),
        masses: mass::rows(study, policy, true_cm)?,
        simulation,
        machine: machine.into_iter().collect::<Result<_, _>>()?,
    })
}

/// Rollout on machine number `index`.
fn on_machine(
    study: &Study,
    policy: &AffineGaussian,
    index: u64,
) -> Result<Rollout, ReproduceError> {
    let rig = machine(&study.model, &study.rig, index)?;
    let followed = tracking::follow(&rig, policy, index)?;
    Ok(Rollout {
        mean_distance_cm: followed.mean_distance_cm(),
        diverged: followed.diverged,
        path: thinned(&followed.places),
    })
}

/// Rollouts at the true mass.
fn simulated(study: &Study, policy: &AffineGaussian) -> Result<Vec<Rollout>, ReproduceError> {
    let evaluation = at_mass(study, policy, TRUE_MASS_KG, study.n_rollout)?;
    let rollouts = evaluation.rollouts.iter().map(|r| {
        let place = |s: &crate::evaluate::Step| Place {
            time_s: s.time_s,
            object_m: s.object_m,
            target_m: s.target_m,
        };
        let places: Vec<Place> = r.steps.iter().map(place).collect();
        Rollout {
            mean_distance_cm: r.mean_distance_cm,
            diverged: r.diverged.clone(),
            path: thinned(&places),
        }
    });
    Ok(rollouts.collect())
}

/// The spiral with an object of `mass_kg`; starts and bases are the same for every policy and mass.
pub(super) fn at_mass(
    study: &Study,
    policy: &AffineGaussian,
    mass_kg: f64,
    n_rollout: usize,
) -> Result<crate::evaluate::Evaluation, ReproduceError> {
    let task = PushTask::new(&study.model, study.base.task.clone())?;
    let rules = ensemble_rules(study.base.train.base_sigma_m, Some(mass_kg), 0.0);
    let randomiser = Randomiser::new(&study.model, &rules)?;
    let request = EvaluationRequest {
        n_rollout,
        seed: SEED,
    };
    Ok(evaluate(
        &Arc::clone(&study.model),
        &task,
        &randomiser,
        policy,
        request,
    )?)
}

/// Places at [`PATH_HZ`].
fn thinned(places: &[Place]) -> Vec<Place> {
    let mut kept: Vec<Place> = Vec::new();
    for place in places {
        if place.time_s >= kept.len() as f64 / PATH_HZ {
            kept.push(*place);
        }
    }
    kept
}

/// The rows, over all seeds.
pub fn rows(results: &[Evaluated]) -> Vec<Row> {
    let of = |case: Case| results.iter().filter(move |r| r.case == case);
    let cm = |r: &Evaluated| {
        [
            mean_distance_cm(&r.simulation),
            mean_distance_cm(&r.machine),
        ]
    };
    let row = |case: Case| {
        let all: Vec<[f64; 2]> = of(case).map(cm).collect();
        let column = |i: usize| all.iter().map(|c| c[i]).collect::<Vec<f64>>();
        // of the same seed, so that the luck of a seed cancels where it can
        let differences = |i: usize| -> Vec<f64> {
            let pairs = of(case).filter_map(|r| {
                let correct = of(Case::Correct).find(|c| c.seed == r.seed)?;
                Some(cm(r)[i] - cm(correct)[i])
            });
            pairs.collect()
        };
        let less_correct = |i: usize| {
            let d = differences(i);
            [mean(&d), sigma(&d) / (d.len() as f64).sqrt()]
        };
        Row {
            case,
            simulation_cm: mean(&column(0)),
            simulation_sigma_cm: sigma(&column(0)),
            machine_cm: mean(&column(1)),
            machine_sigma_cm: sigma(&column(1)),
            paper_cm: case.paper_cm(),
            less_correct_cm: [less_correct(0), less_correct(1)],
        }
    };
    let present = Case::ALL.into_iter().filter(|c| of(*c).next().is_some());
    present.map(row).collect()
}

fn mean_distance_cm(rollouts: &[Rollout]) -> f64 {
    mean(
        &rollouts
            .iter()
            .map(|r| r.mean_distance_cm)
            .collect::<Vec<_>>(),
    )
}

/// Not a number for none.
pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Of a sample; not a number for one alone.
pub(super) fn sigma(values: &[f64]) -> f64 {
    let mean = mean(values);
    let sum: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (sum / (values.len() as f64 - 1.0)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_those_of_the_same_seed() {
        let policy = AffineGaussian::zeros(1, 1, 0.0);
        let result = |case, seed, cm: f64| Evaluated {
            case,
            seed,
            policy: policy.clone(),
            rig: RigConfig::default(),
            simulation: vec![
                Rollout {
                    mean_distance_cm: cm - 0.5,
                    diverged: None,
                    path: Vec::new(),
                },
                Rollout {
                    mean_distance_cm: cm + 0.5,
                    diverged: None,
                    path: Vec::new(),
                },
            ],
            machine: Vec::new(),
            masses: Vec::new(),
        };
        // seeds differ by 1 cm, cases by 0.1 and 0.3
        let results = [
            result(Case::Correct, 0, 1.0),
            result(Case::Correct, 1, 2.0),
            result(Case::Incorrect, 0, 1.1),
            result(Case::Incorrect, 1, 2.3),
        ];
        let rows = rows(&results);
        assert_eq!(rows.len(), 2);
        assert!((rows[0].simulation_cm - 1.5).abs() < 1e-12);
        assert!((rows[0].simulation_sigma_cm - 0.5_f64.sqrt()).abs() < 1e-12);
        let [difference, error] = rows[1].less_correct_cm[0];
        assert!((difference - 0.2).abs() < 1e-12 && (error - 0.1).abs() < 1e-12);
    }
}
