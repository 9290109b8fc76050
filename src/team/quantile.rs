use super::{Team, TeamError};

/// Digits of a key: eight of 256 values.
const DIGITS: u32 = 8;

impl Team {
    /// The value of everyone's `values` that has `rank` values below it when all are sorted by [`f64::total_cmp`];
    /// `None` when there are no more than `rank` of them.
    ///
    /// Found digit by digit from counts of the next digit, so that a message has 256 counts, however many values there
    /// are.
    ///
    /// # Errors
    /// When processes cannot reach each other.
    pub fn sorted_value(&self, values: &[f64], rank: usize) -> Result<Option<f64>, TeamError> {
        let mut candidates: Vec<u64> = values.iter().map(|value| key(*value)).collect();
        let (mut rank, mut found) = (rank as u64, 0_u64);
        for digit in (0..DIGITS).rev() {
            let digit_of = |key: u64| (key >> (8 * digit)) & 0xff;
            let mut counts = vec![0_u64; 256];
            for &candidate in &candidates {
                counts[digit_of(candidate) as usize] += 1;
            }
            let counts = self.all(&counts, |a, b| {
                a.iter().zip(&b).map(|(a, b)| a + b).collect()
            })?;
            let Some(chosen) = (0..256).find(|&value| {
                let below: u64 = counts[..=value].iter().sum();
                rank < below
            }) else {
                return Ok(None);
            };
            rank -= counts[..chosen].iter().sum::<u64>();
            found = found << 8 | chosen as u64;
            candidates.retain(|&candidate| digit_of(candidate) == chosen as u64);
        }
        Ok(Some(value(found)))
    }
}

/// A whole number that sorts as the value does.
fn key(value: f64) -> u64 {
    let bits = value.to_bits();
    if value.is_sign_negative() {
        !bits
    } else {
        bits | 1 << 63
    }
}

/// The value of a [`key`].
fn value(key: u64) -> f64 {
    f64::from_bits(if key >> 63 == 0 { !key } else { key ^ 1 << 63 })
}
