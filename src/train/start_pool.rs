//! States to start the next iteration's trajectories from.
//!
//! One state of each good trajectory, good being the share with the highest mean reward. Every process needs the same
//! ones, so they are collected; what is sent is bounded by taking [`LIMIT`] at most. Trajectories of one iteration differ
//! by chance alone, so the ones with the lowest indices are as fair a sample as any.

use crate::rollout::{Start, Trajectory};
use crate::team::{Deal, TeamError};

/// States kept at most: some 350 kB of the pushing task.
const LIMIT: usize = 1024;

/// One visited state of each trajectory in the best `share` by mean reward, in trajectory order. `batch` holds this
/// process's trajectories.
pub(super) fn start_pool(
    deal: &Deal<'_>,
    batch: &[Trajectory],
    share: f64,
) -> Result<Vec<Start>, TeamError> {
    let is_usable = |t: &Trajectory| t.diverged.is_none();
    let [n_usable] = deal.totals(|place| [f64::from(u8::from(is_usable(&batch[place])))])?;
    let n_usable = n_usable as usize;
    let n_good = (share * n_usable as f64).round() as usize;
    let usable = batch.iter().filter(|t| is_usable(t));
    let rewards: Vec<f64> = usable.map(Trajectory::mean_reward).collect();
    let Some(threshold) = deal.team().sorted_value(&rewards, n_usable - n_good)? else {
        return Ok(Vec::new());
    };
    let mut good: Vec<(usize, Start)> = deal
        .mine()
        .iter()
        .zip(batch)
        .filter(|(_, t)| is_usable(t) && t.mean_reward() >= threshold)
        .filter_map(|(&index, t)| Some((index, t.visited.clone()?)))
        .collect();
    good.truncate(LIMIT);
    let pool = deal.team().all(&good, |mut left, right| {
        left.extend(right);
        left.sort_unstable_by_key(|(index, _)| *index);
        left.truncate(LIMIT);
        left
    })?;
    Ok(pool.into_iter().map(|(_, start)| start).collect())
}
