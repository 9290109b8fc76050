//! Arguments of `phantom sysid`.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::super::{CliError, count, positive};
use crate::compare::Settings;
use crate::recording::{Binding, Recording, read_trials};
use crate::sysid::SysidError;
use crate::sysid::joint::JointSettings;
use crate::sysid::method::Method;
use crate::sysid::nudging::NudgingSettings;
use crate::sysid::rollouts::RolloutSettings;
use crate::sysid::sequential::SequentialSettings;
use crate::sysid::shooting::ShootingSettings;

/// How to solve.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MethodName {
    /// Inverse dynamics along an estimated motion
    Joint,
    /// Simulations of windows whose first states are estimated
    Shooting,
    /// Simulations of whole recordings that weak forces nudge along the recorded motion; for motion in contact
    Nudging,
    /// Rollouts from recorded states, as `phantom compare` makes them by the protocol; searched without slopes
    Rollout,
    /// A swarm of simulations that sees more and more of the recordings, for chaotic motion in contact; few parameters
    Sequential,
}

#[derive(Debug, Args)]
#[allow(clippy::struct_excessive_bools, reason = "flags of a command line")]
pub(super) struct FitArgs {
    /// Recordings to identify from: .mcap, .csv or .csv.gz
    #[arg(value_name = "FILE", required = true)]
    pub(super) files: Vec<PathBuf>,
    /// Model (MJCF) [default: xml/phantom.xml]
    #[arg(long, value_name = "FILE.xml")]
    pub(super) model: Option<PathBuf>,
    /// What to estimate, with priors, noise and norms (TOML)
    #[arg(long, value_name = "FILE.toml", required = true)]
    parameters: Option<PathBuf>,
    /// Folder for the results; made if need be
    #[arg(long, value_name = "DIR", default_value = "sysid")]
    pub(super) out: PathBuf,
    /// Recordings that are not used, to see whether the identified model is better
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub(super) holdout: Vec<PathBuf>,
    /// Names, scales and units of the recordings' channels (TOML)
    #[arg(long, value_name = "FILE.toml")]
    binding: Option<PathBuf>,
    /// How to roll out held-out recordings, as in `phantom compare` (TOML)
    #[arg(long, value_name = "FILE.toml")]
    pub(super) protocol: Option<PathBuf>,
    /// Models to draw from the posterior
    #[arg(long, value_name = "N", default_value = "32", value_parser = count)]
    pub(super) ensemble: usize,
    /// Seed of the draws, and of the search of --method rollout and sequential
    #[arg(long, value_name = "S", default_value = "0")]
    pub(super) seed: u64,
    /// Time step to identify with, s, in place of the model's; the interval between samples is often best
    #[arg(long, value_name = "S", value_parser = positive)]
    pub(super) timestep: Option<f64>,
    /// How to solve: by inverse dynamics, by simulating windows, by searching for the best rollouts, or by a swarm of
    /// simulations from the recordings' beginnings
    #[arg(long, value_enum, default_value = "joint")]
    method: MethodName,
    /// Length of a window of shooting, s, no more than a recording; `inf` for whole recordings [default: 0.5]
    #[arg(long, value_name = "S")]
    window: Option<f64>,
    /// Velocity by which the motion may jump from window to window, m/s or rad/s [default: by any]
    #[arg(long, value_name = "V")]
    jump_sigma: Option<f64>,
    /// Windows of shooting start from the measured states as they are
    #[arg(long)]
    hold_states: bool,
    /// Natural frequency with which --method nudging pulls simulations along the recorded motion, Hz [default: 5]
    #[arg(long, value_name = "HZ", value_parser = positive)]
    pull: Option<f64>,
    /// Chains of simulations of --method sequential; more follow chaotic motion farther [default: 100]
    #[arg(long, value_name = "N", value_parser = count)]
    chains: Option<usize>,
    /// Recordings begin at rest: velocities are 0, what no sensor shows is as in the model (--method sequential)
    #[arg(long)]
    at_rest: bool,
    /// Most iterations (joint: at a level of unexplained force; rollout: generations; sequential: horizons; nudging: ensembles)
    #[arg(long, value_name = "N", value_parser = count)]
    max_iterations: Option<usize>,
    /// Also fit without each sensor, and predict it
    #[arg(long)]
    pub(super) leave_one_sensor_out: bool,
    /// Print sysid.json
    #[arg(long)]
    pub(super) json: bool,
}

impl FitArgs {
    pub(super) fn parameters(&self) -> &Path {
        // clap has made sure of it
        self.parameters.as_deref().unwrap_or(Path::new(""))
    }

    pub(super) fn method(&self, protocol: &Settings) -> Result<Method, CliError> {
        let joint = JointSettings::default();
        let shooting = ShootingSettings::default();
        let windows = "shooting; the others have no windows";
        let only = [
            (
                "--window",
                self.window.is_some(),
                MethodName::Shooting,
                windows,
            ),
            (
                "--jump-sigma",
                self.jump_sigma.is_some(),
                MethodName::Shooting,
                windows,
            ),
            (
                "--hold-states",
                self.hold_states,
                MethodName::Shooting,
                windows,
            ),
            (
                "--pull",
                self.pull.is_some(),
                MethodName::Nudging,
                "nudging",
            ),
            (
                "--chains",
                self.chains.is_some(),
                MethodName::Sequential,
                "sequential",
            ),
            (
                "--at-rest",
                self.at_rest,
                MethodName::Sequential,
                "sequential",
            ),
        ];
        let misplaced = only
            .iter()
            .find(|(_, given, of, _)| *given && *of != self.method);
        if let Some((flag, _, _, method)) = misplaced {
            let reason = format!("{flag} is for --method {method}");
            return Err(SysidError::Setting { reason }.into());
        }
        match self.method {
            MethodName::Joint => Ok(Method::Joint(JointSettings {
                max_iterations: self.max_iterations.unwrap_or(joint.max_iterations),
                ..joint
            })),
            MethodName::Nudging => {
                let nudging = NudgingSettings::default();
                Ok(Method::Nudging(NudgingSettings {
                    hz: self.pull.unwrap_or(nudging.hz),
                    max_iterations: self.max_iterations.unwrap_or(nudging.max_iterations),
                }))
            }
            MethodName::Rollout => {
                let rollout = RolloutSettings::default();
                Ok(Method::Rollout(RolloutSettings {
                    protocol: protocol.clone(),
                    generations: self.max_iterations.unwrap_or(rollout.generations),
                    seed: self.seed,
                    ..rollout
                }))
            }
            MethodName::Sequential => {
                let sequential = SequentialSettings::default();
                let settings = SequentialSettings {
                    n_chains: self.chains.unwrap_or(sequential.n_chains),
                    at_rest: self.at_rest,
                    max_iterations: self.max_iterations.unwrap_or(sequential.max_iterations),
                    seed: self.seed,
                    ..sequential
                };
                settings.check()?;
                Ok(Method::Sequential(settings))
            }
            MethodName::Shooting => {
                let settings = ShootingSettings {
                    window_s: self.window.unwrap_or(shooting.window_s),
                    jump_sigma: self.jump_sigma,
                    free_states: !self.hold_states,
                    max_iterations: self.max_iterations.unwrap_or(shooting.max_iterations),
                    ..shooting
                };
                settings.check()?;
                Ok(Method::Shooting(settings))
            }
        }
    }

    /// Recordings to fit to and held-out ones. Of trials that `rollouts` splits by their numbers, those that it leaves
    /// out are for fitting.
    pub(super) fn recordings(&self, rollouts: &Settings) -> Result<[Named; 2], CliError> {
        let mut fitted = read_all(&self.files, self.binding.as_deref())?;
        let mut held_out = read_all(&self.holdout, self.binding.as_deref())?;
        if rollouts.except_multiples_of.is_some() {
            fitted.retain(|(_, r)| !rollouts.uses_trial(&r.meta.trial));
            held_out.retain(|(_, r)| rollouts.uses_trial(&r.meta.trial));
        }
        Ok([fitted, held_out])
    }
}

/// Recordings with names.
pub(in crate::cli) type Named = Vec<(String, Recording)>;

/// Recordings with names: the file's, and the trial's where a file has several.
pub(in crate::cli) fn read_all(
    files: &[PathBuf],
    binding: Option<&Path>,
) -> Result<Vec<(String, Recording)>, CliError> {
    let binding = match binding {
        Some(file) => Binding::from_file(file)?,
        None => Binding::default(),
    };
    let mut all = Vec::new();
    for file in files {
        let trials = read_trials(file, &binding)?;
        let several = trials.len() > 1;
        let name = file
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        for recording in trials {
            let name = if several {
                format!("{name}, trial {}", recording.meta.trial)
            } else {
                name.clone()
            };
            all.push((name, recording));
        }
    }
    Ok(all)
}
