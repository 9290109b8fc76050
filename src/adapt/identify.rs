//! From recordings to models.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{AdaptConfig, AdaptError, Adaptation, IdentifyMethod};
use crate::mujoco::Model;
use crate::randomise::Ensemble;
use crate::recording::Recording;
use crate::supplement;
use crate::sysid::ensemble;
use crate::sysid::fit::{Iteration, Start, Status};
use crate::sysid::interval::Label;
use crate::sysid::joint::JointSettings;
use crate::sysid::method::Method;
use crate::sysid::parameter::{ParameterRule, Parameters};
use crate::sysid::problem::Problem;
use crate::sysid::shooting::ShootingSettings;
use crate::sysid::summary::Outcome;

/// A parameter with what is known of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Known {
    /// address
    pub name: String,
    /// of the values
    pub unit: String,
    /// in the model
    pub nominal: f64,
    /// of the rig; no real machine tells
    pub truth: Option<f64>,
    /// identified
    pub value: f64,
    /// of 95 %
    pub interval: Option<[f64; 2]>,
    /// determined by the recordings, not by its prior
    pub identified: bool,
}

/// What the recordings say.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Identified {
    /// model file that was identified: the nominal one, or that with missing physics added
    pub model: PathBuf,
    /// what was added, in words
    pub added: Vec<String>,
    /// all parameters
    pub parameters: Vec<Known>,
    /// whether the solver converged
    pub converged: bool,
    /// models drawn from the posterior
    pub ensemble: Ensemble,
}

/// Physics that a model was found to lack.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Missing {
    /// model file that has it
    pub model: PathBuf,
    /// what it is, in words
    pub effects: Vec<String>,
    /// what is estimated of that, its numbers after the others
    pub parameters: Vec<ParameterRule>,
}

/// What a search for missing physics ends with.
#[derive(Debug)]
pub enum Found {
    /// nothing is missing that could be named
    Nothing,
    /// this
    Missing(Missing),
    /// the search was stopped
    Stopped,
}

/// Recordings with names.
pub type Named = Vec<(String, Recording)>;

/// The model file with supplements, at the time step of identification.
fn load(file: &Path, timestep_s: Option<f64>) -> Result<Model, AdaptError> {
    let mut model = supplement::load(file).map_err(|source| AdaptError::Supplement {
        file: file.to_owned(),
        source,
    })?;
    // what supplements remember is counted in steps
    if let (Some(timestep), None) = (timestep_s, model.extension()) {
        model.edit().set_timestep(timestep)?;
    }
    Ok(model)
}

/// The method with its settings.
fn method(config: &AdaptConfig) -> Method {
    match config.identify_method {
        IdentifyMethod::Joint => {
            let joint = JointSettings::default();
            Method::Joint(JointSettings {
                max_iterations: config.identify_iterations.unwrap_or(joint.max_iterations),
                ..joint
            })
        }
        IdentifyMethod::Shooting => {
            let shooting = ShootingSettings::default();
            Method::Shooting(ShootingSettings {
                window_s: config.identify_window_s,
                max_iterations: config
                    .identify_iterations
                    .unwrap_or(shooting.max_iterations),
                ..shooting
            })
        }
    }
}

/// The posterior given `recordings`, and models drawn from it.
pub(super) fn identify(
    adaptation: &Adaptation,
    recordings: &Named,
    missing: Option<&Missing>,
    watch: &mut dyn FnMut(&Iteration) -> bool,
) -> Result<Identified, AdaptError> {
    let config = &adaptation.config;
    let (file, mut parameters) = (&adaptation.model_path, adaptation.parameters.clone());
    let file = missing.map_or(file, |m| &m.model);
    if let Some(missing) = missing {
        parameters.parameter.clone_from(&missing.parameters);
    }
    let model = Arc::new(load(file, config.identify_timestep_s)?);
    let problem = Problem::new(Arc::clone(&model), &parameters, recordings)?;
    let method = method(config);
    let start = Start {
        x: problem.parameters.start(),
        trajectories: None,
        force_scale: None,
    };
    let fit = method.solve(&problem, &start, watch)?;
    let outcome = Outcome::new(&problem, &method, &fit)?;
    let draws = ensemble::draw(
        &problem.parameters,
        &fit.x,
        &outcome.posterior,
        config.models,
        config.training.train.seed,
    );
    let (truth, _) = adaptation.rig.true_model()?;
    let channels: Vec<String> = problem.channels.iter().map(|c| c.name.clone()).collect();
    let truth = Parameters::new(&truth, &parameters.parameter, &channels).ok();
    let true_value = |name: &str| {
        let found = truth.iter().flat_map(|t| &t.all).find(|p| p.name == name);
        found.map(|p| p.nominal)
    };
    let known = outcome.posterior.estimates.iter().map(|e| Known {
        truth: true_value(&e.name),
        name: e.name.clone(),
        unit: e.unit.clone(),
        nominal: e.nominal,
        value: e.value,
        interval: e.interval,
        identified: e.label == Label::Identified,
    });
    Ok(Identified {
        model: file.clone(),
        added: missing.map(|m| m.effects.clone()).unwrap_or_default(),
        parameters: known.collect(),
        converged: matches!(fit.status, Status::Converged),
        ensemble: ensemble::models(&model, &problem.parameters, &draws)?,
    })
}
