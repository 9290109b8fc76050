use std::sync::Mutex;

use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator as _, Destination as _, Root as _, Source as _};

use super::{Communicator, TeamError};

/// The processes that an MPI launcher started together.
///
/// MPI's default is kept that an error in a call ends the whole job. A panic ends it too: the others would wait for this
/// process for ever.
pub(super) struct World {
    rank: usize,
    size: usize,
    /// dropping it parts in peace; never dropped otherwise, since that waits for the others
    universe: Mutex<Option<Universe>>,
}

impl World {
    /// Meet the others.
    pub(super) fn join() -> Result<Self, TeamError> {
        // calls come from one thread at a time, but not always from the same one
        let wanted = mpi::Threading::Serialized;
        let failed = |reason: &str| TeamError::Mpi {
            reason: reason.to_owned(),
        };
        let Some((universe, threading)) = mpi::initialize_with_threading(wanted) else {
            return Err(failed("already in use in this process"));
        };
        let world = universe.world();
        let joined = Self {
            rank: world.rank() as usize,
            size: world.size() as usize,
            universe: Mutex::new(Some(universe)),
        };
        if threading < wanted {
            return Err(failed("the library was built without support for threads"));
        }
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            report(panic);
            std::process::abort();
        }));
        Ok(joined)
    }
}

impl Communicator for World {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.size
    }

    fn send(&self, to: usize, message: &[u8]) -> Result<(), TeamError> {
        SimpleCommunicator::world()
            .process_at_rank(to as i32)
            .send(message);
        Ok(())
    }

    fn receive(&self, from: usize) -> Result<Vec<u8>, TeamError> {
        let (message, _) = SimpleCommunicator::world()
            .process_at_rank(from as i32)
            .receive_vec();
        Ok(message)
    }

    fn broadcast(&self, message: &mut Vec<u8>) -> Result<(), TeamError> {
        let world = SimpleCommunicator::world();
        let first = world.process_at_rank(0);
        let mut length = message.len() as u64;
        first.broadcast_into(&mut length);
        message.resize(length as usize, 0);
        // the address of an empty vector is one that MPI gives a meaning of its own
        if !message.is_empty() {
            first.broadcast_into(&mut message[..]);
        }
        Ok(())
    }

    fn finish(&self) {
        let universe = self.universe.lock();
        drop(universe.map(|mut universe| universe.take()));
    }
}

impl Drop for World {
    fn drop(&mut self) {
        // without `finish`, this process is lost, and the launcher has to know
        let universe = self.universe.lock();
        std::mem::forget(universe.map(|mut universe| universe.take()));
    }
}
