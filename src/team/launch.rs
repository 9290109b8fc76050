use super::{Team, TeamError};

impl Team {
    /// The team this process was started into: by an MPI launcher, or alone.
    ///
    /// # Errors
    /// When MPI cannot be used, or this program was built without.
    pub fn from_environment() -> Result<Self, TeamError> {
        if !launched() {
            return Ok(Self::alone());
        }
        #[cfg(feature = "mpi")]
        return Ok(Self::new(Box::new(super::mpi::World::join()?)));
        #[cfg(not(feature = "mpi"))]
        Err(TeamError::WithoutMpi)
    }
}

/// Whether an MPI launcher started this process as one of several: Open MPI, MPICH and its kin, Slurm's own.
fn launched() -> bool {
    let count = |name| {
        let value = std::env::var(name).ok()?;
        value.parse::<usize>().ok()
    };
    ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE"]
        .iter()
        .find_map(|name| count(*name))
        .or_else(|| count("PMIX_RANK").and_then(|_| count("SLURM_NTASKS")))
        .is_some_and(|size| size > 1)
}
