//! Teams of threads: what processes do, without a launcher.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};

use phantom::team::{Communicator, Team, TeamError};

struct Member {
    rank: usize,
    to: Vec<Sender<Vec<u8>>>,
    from: Vec<Mutex<Receiver<Vec<u8>>>>,
}

impl Communicator for Member {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.to.len()
    }

    fn send(&self, to: usize, message: &[u8]) -> Result<(), TeamError> {
        let sent = self.to[to].send(message.to_vec());
        sent.map_err(|_| TeamError::Lost { rank: to })
    }

    fn receive(&self, from: usize) -> Result<Vec<u8>, TeamError> {
        let messages = self.from[from].lock().expect("one thread a member");
        messages.recv().map_err(|_| TeamError::Lost { rank: from })
    }

    fn broadcast(&self, message: &mut Vec<u8>) -> Result<(), TeamError> {
        if self.rank > 0 {
            *message = self.receive(0)?;
            return Ok(());
        }
        (1..self.size()).try_for_each(|to| self.send(to, message))
    }
}

/// What each of `size` members of a team makes of `work`, in order.
pub(crate) fn together<T: Send>(size: usize, work: impl Fn(Arc<Team>) -> T + Sync) -> Vec<T> {
    let mut members: Vec<Member> = (0..size)
        .map(|rank| Member {
            rank,
            to: Vec::new(),
            from: Vec::new(),
        })
        .collect();
    for from in 0..size {
        for to in 0..size {
            let (sender, receiver) = channel();
            members[from].to.push(sender);
            members[to].from.push(Mutex::new(receiver));
        }
    }
    std::thread::scope(|scope| {
        let work = &work;
        let threads: Vec<_> = members
            .into_iter()
            .map(|member| scope.spawn(move || work(Arc::new(Team::new(Box::new(member))))))
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().expect("no panic"))
            .collect()
    })
}
