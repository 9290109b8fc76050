//! `phantom sysid design`: what to record next.

use std::process::ExitCode;

use clap::Args;

use crate::cli::CliError;

/// What to record next
#[derive(Debug, Args)]
pub(super) struct DesignArgs {}

impl DesignArgs {
    pub(super) fn run(self) -> Result<ExitCode, CliError> {
        Ok(ExitCode::SUCCESS)
    }
}
