//! Processes that train one policy together, and get the bits that one process alone would get.
//!
//! Every process runs the same program on its own share of the trajectories ([`Deal`]); all else, the update and the
//! start states of the next iteration, each of them computes for itself from sums over all trajectories. So the sums
//! have to be equal to the last bit, on any number of processes. Addition of floating-point numbers depends on the
//! order, hence the order is fixed: a binary tree over the trajectories, not over the processes.
//!
//! ```text
//!            ┌─────── + ───────┐              leaves   lanes of trajectories, summed one after the other
//!        ┌── + ──┐         ┌── + ──┐          nodes    left + right
//!      lane    lane      lane    lane
//!      └ process 0 ┘     └ process 1 ┘        or all four in one process, or one in each
//! ```
//!
//! A process sums the branches whose lanes are all its own with its threads, and sends what it has to the process that
//! owns the first lane of the branch above. Messages are as long as the sum, however many samples there are.
//!
//! An error of one process reaches all others at the next [`Team::agree`], so that none waits for ever. A process that
//! ends without a word is the launcher's business, which then ends the others.

mod deal;
mod launch;
#[cfg(feature = "mpi")]
mod mpi;
mod quantile;

use std::fmt::Display;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

pub use deal::Deal;

/// How the processes of a team reach each other; between one pair, messages arrive in the order they were sent in.
pub trait Communicator: Send + Sync {
    /// Number of this process, from 0.
    fn rank(&self) -> usize;
    /// Number of processes.
    fn size(&self) -> usize;
    /// Send `message` to process `to`.
    ///
    /// # Errors
    /// When that process is known to be gone.
    fn send(&self, to: usize, message: &[u8]) -> Result<(), TeamError>;
    /// Wait for the next message of process `from`.
    ///
    /// # Errors
    /// When that process is known to be gone.
    fn receive(&self, from: usize) -> Result<Vec<u8>, TeamError>;
    /// Give everyone the `message` of process 0. All processes call it.
    ///
    /// # Errors
    /// When a process is known to be gone.
    fn broadcast(&self, message: &mut Vec<u8>) -> Result<(), TeamError>;
    /// Part in peace. All processes call it; a process that ends without is taken for lost.
    fn finish(&self) {}
}

/// Why processes could not work together.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum TeamError {
    /// Another process failed; its error is the cause.
    #[error("process {rank}: {reason}")]
    Elsewhere {
        /// which process
        rank: usize,
        /// its error
        reason: String,
        /// whether that was a fatal error of the engine
        is_fatal: bool,
    },
    /// Processes that compute the same have different results.
    #[error(
        "process {rank} has another {what} than process 0: all of them need the same program, model and kind of processor"
    )]
    Differs {
        /// what should be the same
        what: &'static str,
        /// the first process that differs
        rank: usize,
    },
    /// A process is gone.
    #[error("process {rank} is gone")]
    Lost {
        /// which process
        rank: usize,
    },
    /// A message makes no sense.
    #[error("a message between processes cannot be read, are they of the same build: {reason}")]
    Message {
        /// how it fails to
        reason: String,
    },
    /// A launcher started several processes of a program that cannot work in a team.
    #[error(
        "started as one of several processes by an MPI launcher, but built without MPI: build with `cargo build --release --features mpi`"
    )]
    WithoutMpi,
    /// MPI cannot be used.
    #[error("MPI: {reason}")]
    Mpi {
        /// what is missing
        reason: String,
    },
}

impl TeamError {
    /// Whether the other processes cannot know of this error, and are not to be waited for.
    pub fn is_lonely(&self) -> bool {
        matches!(self, Self::Lost { .. } | Self::Message { .. })
    }
}

/// What can be sent.
pub trait Message: Serialize + DeserializeOwned + Send {}
impl<T: Serialize + DeserializeOwned + Send> Message for T {}

/// What a process has exchanged with others so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// messages sent and received
    pub messages: u64,
    /// bytes sent and received, a broadcast counted once at each process
    pub bytes: u64,
    /// time of it, waiting for others included
    pub time: Duration,
}

/// One process's place in a team; see the module.
#[derive(Default)]
pub struct Team {
    communicator: Option<Box<dyn Communicator>>, // none: alone
    messages: AtomicU64,
    bytes: AtomicU64,
    nanoseconds: AtomicU64,
}

impl Team {
    /// A team of this process alone.
    pub const fn alone() -> Self {
        Self {
            communicator: None,
            messages: AtomicU64::new(0),
            bytes: AtomicU64::new(0),
            nanoseconds: AtomicU64::new(0),
        }
    }

    /// A team of the processes that `communicator` reaches.
    pub fn new(communicator: Box<dyn Communicator>) -> Self {
        Self {
            communicator: Some(communicator),
            ..Self::alone()
        }
    }

    /// Number of this process, from 0.
    pub fn rank(&self) -> usize {
        self.communicator.as_ref().map_or(0, |c| c.rank())
    }

    /// Number of processes.
    pub fn size(&self) -> usize {
        self.communicator.as_ref().map_or(1, |c| c.size())
    }

    /// Whether this is the process that writes and prints.
    pub fn is_first(&self) -> bool {
        self.rank() == 0
    }

    /// What this process has exchanged so far.
    pub fn traffic(&self) -> Traffic {
        Traffic {
            messages: self.messages.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            time: Duration::from_nanos(self.nanoseconds.load(Ordering::Relaxed)),
        }
    }

    /// Part in peace; without it, the end of this process is the end of all.
    pub fn finish(&self) {
        if let Some(communicator) = &self.communicator {
            communicator.finish();
        }
    }

    /// Everyone's value, joined in the order of processes; all get the result.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn all<T: Message + Clone + Sync>(
        &self,
        mine: &T,
        join: impl Fn(T, T) -> T + Sync,
    ) -> Result<T, TeamError> {
        let joined = self.tree(0..self.size(), &|rank| rank, &|_| mine.clone(), &join)?;
        self.from_first(joined)
    }

    /// The value of process 0, the only one that needs to have one, for all.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn from_first<T: Message>(&self, value: Option<T>) -> Result<T, TeamError> {
        let mut message = Vec::new();
        match (&self.communicator, value) {
            (None, Some(value)) => Ok(value),
            (Some(communicator), Some(value)) if communicator.rank() == 0 => {
                message = encode(&value)?;
                self.timed(|| communicator.broadcast(&mut message))?;
                self.count(&message);
                Ok(value)
            }
            (Some(communicator), _) if communicator.rank() > 0 => {
                self.timed(|| communicator.broadcast(&mut message))?;
                self.count(&message);
                decode(&message)
            }
            _ => Err(TeamError::Message {
                reason: "process 0 has nothing to say".to_owned(),
            }),
        }
    }

    /// This process's result, if all processes have one; else an error for all of them: their own, or that of the first
    /// process that has one. `is_fatal` tells fatal errors of the engine.
    ///
    /// # Errors
    /// As above, and when processes cannot reach each other.
    pub fn agree<T, E: Display + From<TeamError>>(
        &self,
        result: Result<T, E>,
        is_fatal: impl Fn(&E) -> bool,
    ) -> Result<T, E> {
        let failure = result
            .as_ref()
            .err()
            .map(|error| (self.rank(), error.to_string(), is_fatal(error)));
        match (result, self.all(&failure, Option::or)?) {
            (Ok(_), Some((rank, reason, is_fatal))) => Err(TeamError::Elsewhere {
                rank,
                reason,
                is_fatal,
            }
            .into()),
            (result, _) => result,
        }
    }

    /// Make sure that everyone has the same `value` as process 0.
    ///
    /// # Errors
    /// Names `what` and the first process that differs.
    pub fn same(&self, what: &'static str, value: &impl Serialize) -> Result<(), TeamError> {
        let mine = crc32fast::hash(&encode(value)?);
        let first = self.from_first(self.is_first().then_some(mine))?;
        let differing = (mine != first).then_some(self.rank());
        match self.all(&differing, Option::or)? {
            Some(rank) => Err(TeamError::Differs { what, rank }),
            None => Ok(()),
        }
    }

    /// Join the `leaves` in a binary tree of halves. `owner` tells whose a leaf is and never falls; the result goes to
    /// the owner of the first leaf, nothing to the others.
    fn tree<T: Message>(
        &self,
        leaves: Range<usize>,
        owner: &impl Fn(usize) -> usize,
        leaf: &(impl Fn(usize) -> T + Sync),
        join: &(impl Fn(T, T) -> T + Sync),
    ) -> Result<Option<T>, TeamError> {
        let (me, first, last) = (self.rank(), owner(leaves.start), owner(leaves.end - 1));
        if !(first..=last).contains(&me) {
            return Ok(None);
        }
        if first == last {
            return Ok(Some(branch(leaves, leaf, join)));
        }
        let middle = middle(&leaves);
        let from = owner(middle);
        // all processes walk the tree in the same order: the first exchange not yet made has both its sides waiting
        let left = self.tree(leaves.start..middle, owner, leaf, join)?;
        let right = self.tree(middle..leaves.end, owner, leaf, join)?;
        let right = self.carry(right, from, first)?;
        Ok(left.zip(right).map(|(left, right)| join(left, right)))
    }

    /// Bring `value` from one process to another.
    fn carry<T: Message>(
        &self,
        value: Option<T>,
        from: usize,
        to: usize,
    ) -> Result<Option<T>, TeamError> {
        let me = self.rank();
        match (&self.communicator, value) {
            (Some(communicator), Some(value)) if from != to && me == from => {
                let message = encode(&value)?;
                self.timed(|| communicator.send(to, &message))?;
                self.count(&message);
                Ok(None)
            }
            (Some(communicator), _) if from != to && me == to => {
                let message = self.timed(|| communicator.receive(from))?;
                self.count(&message);
                decode(&message).map(Some)
            }
            (_, value) => Ok(value),
        }
    }

    fn timed<T>(&self, exchange: impl FnOnce() -> T) -> T {
        let begin = Instant::now();
        let result = exchange();
        let nanoseconds = u64::try_from(begin.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.nanoseconds.fetch_add(nanoseconds, Ordering::Relaxed);
        result
    }

    fn count(&self, message: &[u8]) {
        self.messages.fetch_add(1, Ordering::Relaxed);
        self.bytes
            .fetch_add(message.len() as u64, Ordering::Relaxed);
    }
}

/// The part of a tree that one process owns, on all its threads.
fn branch<T: Send>(
    leaves: Range<usize>,
    leaf: &(impl Fn(usize) -> T + Sync),
    join: &(impl Fn(T, T) -> T + Sync),
) -> T {
    if leaves.len() == 1 {
        return leaf(leaves.start);
    }
    let middle = middle(&leaves);
    let (left, right) = rayon::join(
        || branch(leaves.start..middle, leaf, join),
        || branch(middle..leaves.end, leaf, join),
    );
    join(left, right)
}

fn middle(leaves: &Range<usize>) -> usize {
    leaves.start + leaves.len() / 2
}

fn encode(value: &impl Serialize) -> Result<Vec<u8>, TeamError> {
    postcard::to_allocvec(value).map_err(|error| TeamError::Message {
        reason: error.to_string(),
    })
}

fn decode<T: DeserializeOwned>(message: &[u8]) -> Result<T, TeamError> {
    postcard::from_bytes(message).map_err(|error| TeamError::Message {
        reason: error.to_string(),
    })
}
