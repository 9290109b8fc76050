use std::time::SystemTime;

use serde::{Deserialize, Serialize};

/// What made a run: written to `provenance.json` before the first iteration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Version of this program.
    pub phantom_version: String,
    /// Commit it was built from, or `unknown` outside a git checkout.
    pub git_commit: String,
    /// Whether its sources differed from that commit; none outside a git checkout.
    pub git_dirty: Option<bool>,
    /// `mjVERSION_HEADER` of the `MuJoCo` headers it was built with.
    pub mujoco_header_version: String,
    /// The compiler, as it names itself.
    pub rustc_version: String,
    /// Start of the run, RFC 3339 in UTC.
    pub started: String,
    /// Worker threads of each process.
    pub threads: usize,
    /// Processes that work together.
    pub processes: usize,
    /// Command line, program name first.
    pub command_line: Vec<String>,
}

impl Provenance {
    /// Describes this build, now.
    pub fn capture(threads: usize, command_line: impl IntoIterator<Item = String>) -> Self {
        Self {
            phantom_version: env!("CARGO_PKG_VERSION").to_owned(),
            git_commit: env!("PHANTOM_GIT_COMMIT").to_owned(),
            git_dirty: env!("PHANTOM_GIT_DIRTY").parse().ok(),
            mujoco_header_version: env!("PHANTOM_MUJOCO_HEADER_VERSION").to_owned(),
            rustc_version: env!("PHANTOM_RUSTC_VERSION").to_owned(),
            started: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
            threads,
            processes: 1,
            command_line: command_line.into_iter().collect(),
        }
    }

    /// The same, as one of `processes`.
    #[must_use]
    pub fn in_team(self, processes: usize) -> Self {
        Self { processes, ..self }
    }
}
