//! Samples of several streams in the order of their stamps.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::Stream;

/// (stream, sample) in the order of time; streams of equal stamps in their order, samples of a stream in theirs even
/// where time runs backwards.
pub(super) fn by_time(streams: &[Stream]) -> impl Iterator<Item = (usize, usize)> + '_ {
    let head = |stream: usize, sample: usize| {
        let stamp = *streams[stream].stamps_ns.get(sample)?;
        Some(Reverse((stamp, stream, sample)))
    };
    let mut heads: BinaryHeap<_> = (0..streams.len()).filter_map(|s| head(s, 0)).collect();
    std::iter::from_fn(move || {
        let Reverse((_, stream, sample)) = heads.pop()?;
        heads.extend(head(stream, sample + 1));
        Some((stream, sample))
    })
}
