//! In which band of frequencies a force is missing.
//!
//! ```text
//! P(f) = |Σ yₖ e^(−2πi f tₖ)|² / n        f = 0, 1/T, 2/T … 1/(2Δ)
//! ```
//!
//! of the values yₖ of a recording of length T, mostly Δ apart, summed over recordings and gathered in bands an octave wide;
//! the lowest is what does not change within a recording, and its slowest swing.

/// Values of one recording, at least.
const LEAST: usize = 8;

/// Hz between which most of `y` is, of values at (recording, s); none of few.
pub(super) fn band(at: &[(usize, f64)], y: &[f64]) -> Option<[f64; 2]> {
    let mut recordings: Vec<usize> = at.iter().map(|a| a.0).collect();
    recordings.dedup();
    let mut power: Vec<(f64, f64)> = Vec::new();
    for recording in recordings {
        let own: Vec<(f64, f64)> = (at.iter().zip(y))
            .filter(|(a, _)| a.0 == recording)
            .map(|(a, y)| (a.1, *y))
            .collect();
        if own.len() >= LEAST {
            power.extend(spectrum(&own)?);
        }
    }
    let swings = power.iter().map(|p| p.0).filter(|f| *f > 0.0);
    let slowest = swings.fold(f64::INFINITY, f64::min);
    let bound = |octave: i32| slowest * 2_f64.powi(octave);
    let octave = |f: f64| match f / slowest {
        part if part < 2.0 => 0,
        part => part.log2().floor() as i32,
    };
    let last = power.iter().map(|p| octave(p.0)).max()?;
    let of = |own: i32| -> f64 {
        let inside = power.iter().filter(|p| octave(p.0) == own);
        inside.map(|p| p.1).sum()
    };
    let most = (0..=last).max_by(|a, b| of(*a).total_cmp(&of(*b)))?;
    let low = if most == 0 { 0.0 } else { bound(most) };
    Some([low, bound(most + 1)])
}

/// (Hz, power) of values at times, s; none where they are at one time.
fn spectrum(own: &[(f64, f64)]) -> Option<Vec<(f64, f64)>> {
    let (first, last) = (own.first()?.0, own.last()?.0);
    let mut gaps: Vec<f64> = own.windows(2).map(|w| w[1].0 - w[0].0).collect();
    gaps.sort_by(f64::total_cmp);
    let apart = gaps[gaps.len() / 2];
    if apart <= 0.0 {
        return None;
    }
    let length = last - first + apart;
    let n = (length / apart / 2.0).floor() as usize;
    let at = |i: usize| {
        let f = i as f64 / length;
        let sum = own.iter().fold((0.0, 0.0), |sum, (t, y)| {
            let (sin, cos) = (std::f64::consts::TAU * f * t).sin_cos();
            (sum.0 + y * cos, sum.1 + y * sin)
        });
        // but for that at 0, each stands for another at −f
        let both = if i == 0 { 1.0 } else { 2.0 };
        (f, both * (sum.0 * sum.0 + sum.1 * sum.1) / own.len() as f64)
    };
    Some((0..=n).map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::band;

    #[test]
    fn a_swing_is_in_the_band_of_its_frequency() {
        // two recordings of 4 s, ten values a second
        let at: Vec<(usize, f64)> = (0..80)
            .map(|k| (k / 40, (k % 40) as f64 * 0.1 + 3.0))
            .collect();
        let of = |y: &dyn Fn(f64) -> f64| {
            let y: Vec<f64> = at.iter().map(|a| y(a.1)).collect();
            band(&at, &y).expect("enough")
        };
        assert_eq!(of(&|_| 2.0), [0.0, 0.5]);
        for hz in [0.6, 1.3, 1.7, 2.3, 4.2] {
            let [low, high] = of(&|t| 0.3 + (std::f64::consts::TAU * hz * t).sin());
            assert!(low < hz && hz < high, "{hz}: {low} {high}");
            assert_eq!(high, 2.0 * low);
        }
        assert_eq!(band(&at[..5], &[1.0; 5]), None);
    }
}
