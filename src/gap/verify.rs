//! Held-out recordings, before and after: did the gap shrink, and did nothing become worse?
//!
//! - **Forces**: what inverse dynamics needs at every recorded state against what the motors gave
//!   ([`crate::compare::forces`]), over all joints: root of the summed squares over that of the measured.
//! - **Rollouts**: from recorded states under recorded controls ([`crate::compare::rollouts`]).
//! - **Noise floor** of the forces: how far they move when as much noise is added to the recorded positions as the
//!   sensors have.

use std::sync::Arc;

use super::GapError;
use super::result::{Channel, Gap, Holdout, Rollout};
use super::run::Input;
use crate::compare::cutoff::cutoff_hz;
use crate::compare::{self, CompareError, Comparison, Settings};
use crate::mujoco::Model;
use crate::recording::{Kind, Recording};
use crate::rng::{self, Purpose};
use crate::sysid::instrument;
use crate::sysid::parameter::Parameters;
use crate::sysid::problem::Problem;

/// A channel is worse from this factor on.
const WORSE: f64 = 1.05;
/// Errors below this part of the largest of their unit do not count as worse.
const NEGLIGIBLE: f64 = 0.02;
/// Part of the shortest recording that is left out at most at each end, where filtered states are not to be trusted.
const ENDS: f64 = 0.1;
/// Above it drives swing and joints do not, Hz.
const DRIVE_HZ: f64 = 100.0;
/// Draws of noise for the floor.
const DRAWS: u64 = 2;

/// A model with what its instruments add.
pub(super) struct Machine {
    pub model: Arc<Model>,
    /// all held
    pub parameters: Parameters,
}

/// Standard deviation of the noise of a channel of `whole`.
pub(super) fn noise(whole: &Problem, channel: &str) -> Option<f64> {
    let found = whole.channels.iter().find(|c| c.name == channel);
    found.map(|c| c.sigma)
}

/// The protocol. Where it says nothing of cutoffs, states are without the noise of the readings ([`cutoff_hz`]), and forces
/// are compared as far as windows of `window_s` resolve them: beyond that they are noise of differences. Encoders that sit on
/// the motors of a `repaired` model swing as fast as commands turn; its joints do not.
pub(super) fn protocol(
    input: &Input<'_>,
    whole: &Problem,
    window_s: f64,
    repaired: &Model,
) -> Settings {
    let settings = input.protocol.clone();
    if settings.cutoff_hz.or(settings.force_cutoff_hz).is_some() {
        return settings;
    }
    let recordings = || input.holdout.iter().map(|(_, r)| r);
    let drives = repaired.has_loaded_drives() || input.model.model.has_loaded_drives();
    let cutoff_hz =
        cutoff_hz(recordings(), &|channel| noise(whole, channel)).or(drives.then_some(DRIVE_HZ));
    let streams = recordings()
        .flat_map(|r| &r.streams)
        .filter(|s| !s.is_empty());
    let shortest = (streams.map(|s| s.time(s.len() - 1) - s.time(0))).fold(f64::INFINITY, f64::min);
    let ends = cutoff_hz.map_or(0.0, |hz| (1.0 / hz).min(ENDS * shortest));
    Settings {
        skip_s: settings.skip_s.max(ends),
        cutoff_hz,
        force_cutoff_hz: Some(2.0 / window_s),
        ..settings
    }
}

/// The gap of both models on `recordings`.
///
/// # Errors
/// The engine fails.
pub(super) fn verify(
    before: &Machine,
    after: &Machine,
    recordings: &[(String, Recording)],
    settings: &Settings,
    sigma: &dyn Fn(&str) -> Option<f64>,
    seed: u64,
) -> Result<Gap, GapError> {
    let mut gap = Gap {
        holdout: None,
        rollout: Vec::new(),
        channels: Vec::new(),
        worse: Vec::new(),
        notes: Vec::new(),
    };
    if recordings.is_empty() {
        gap.notes
            .push("no held-out recordings were given: the gap is not verified".into());
        return Ok(gap);
    }
    let run = |machine: &Machine| -> Result<Comparison, CompareError> {
        let corrected: Vec<Recording> = (recordings.iter())
            .map(|(_, r)| instrument::corrected(r, &machine.parameters))
            .collect();
        compare::compare(&machine.model, &corrected, settings, None, &|| ())
    };
    let both = run(before).and_then(|b| Ok((b, run(after)?)));
    let (b, a) = match both {
        Ok(both) => both,
        Err(CompareError::Mujoco(error)) => return Err(CompareError::Mujoco(error).into()),
        Err(error) => {
            gap.notes
                .push(format!("forces and rollouts cannot be compared: {error}"));
            return Ok(gap);
        }
    };
    forces(&mut gap, &b, &a);
    match &mut gap.holdout {
        Some(forces) => {
            forces.noise_floor = floor(after, recordings, settings, sigma, seed, &a);
        }
        slot => {
            *slot = (settings.length_m).and_then(|length| distance(&b, &a, length));
        }
    }
    rollouts(&mut gap, &b, &a);
    gap.worse = worse(&gap.channels);
    Ok(gap)
}

/// Sum of squares of errors and of what was measured, over torques.
fn torque_sums(c: &Comparison) -> (f64, f64) {
    let torques = || {
        c.forces
            .iter()
            .flat_map(|f| &f.signals)
            .filter(|s| s.is_torque())
    };
    let sum = |value: fn(&compare::forces::Signal) -> f64| {
        torques()
            .map(|s| s.n as f64 * value(s) * value(s))
            .sum::<f64>()
    };
    (sum(|s| s.rms), sum(|s| s.measured_rms))
}

fn forces(gap: &mut Gap, b: &Comparison, a: &Comparison) {
    let ((before, measured), (after, _)) = (torque_sums(b), torque_sums(a));
    if measured > 0.0 {
        let percent = |sum: f64| 100.0 * (sum / measured).sqrt();
        gap.holdout = Some(Holdout {
            quantity: "force of inverse dynamics, of the measured".into(),
            before: percent(before),
            after: percent(after),
            noise_floor: None,
            unit: "%".into(),
        });
    }
    // the same signal of several recordings is one channel
    let mut seen: Vec<(String, String)> = Vec::new();
    for s in b.forces.iter().flat_map(|f| &f.signals) {
        let key = (s.name.clone(), s.samples.to_owned());
        if seen.contains(&key) {
            continue;
        }
        let rms = |c: &Comparison| {
            let same = (c.forces.iter().flat_map(|f| &f.signals))
                .filter(|o| o.name == s.name && o.samples == s.samples);
            let (sum, n) = same.fold((0.0, 0.0), |(sum, n), o| {
                (sum + o.n as f64 * o.rms * o.rms, n + o.n as f64)
            });
            f64::sqrt(sum / f64::max(n, 1.0))
        };
        let quantity = if s.is_torque() { "force" } else { "reading" };
        gap.channels.push(Channel {
            channel: s.name.clone(),
            quantity: format!("{quantity}, {}", s.samples),
            before: rms(b),
            after: rms(a),
            unit: s.unit.clone(),
        });
        seen.push(key);
    }
}

fn rollouts(gap: &mut Gap, b: &Comparison, a: &Comparison) {
    let (b, a) = (&b.rollouts, &a.rollouts);
    if a.diverged > b.diverged {
        gap.worse.push(format!(
            "{} rollouts break down, {} before",
            a.diverged, b.diverged
        ));
    }
    let mut sums: Vec<(Option<f64>, String, f64, f64, f64)> = Vec::new();
    for before in &b.growth {
        let same = |g: &&compare::rollouts::Growth| {
            g.channel == before.channel && g.horizon_s == before.horizon_s
        };
        let Some(after) = a.growth.iter().find(same) else {
            continue;
        };
        let horizon = before
            .horizon_s
            .map_or("to the end".to_owned(), |h| format!("{h} s"));
        gap.channels.push(Channel {
            channel: before.channel.clone(),
            quantity: format!("rollouts of {horizon}"),
            before: before.window_rms,
            after: after.window_rms,
            unit: before.unit.clone(),
        });
        // angles and places; velocities are no gap of their own
        if !matches!(before.unit.as_str(), "rad" | "m") {
            continue;
        }
        let key = |s: &&mut (Option<f64>, String, f64, f64, f64)| {
            s.0 == before.horizon_s && s.1 == before.unit
        };
        match sums.iter_mut().find(key) {
            Some(s) => {
                s.2 += before.window_rms.powi(2);
                s.3 += after.window_rms.powi(2);
                s.4 += 1.0;
            }
            None => sums.push((
                before.horizon_s,
                before.unit.clone(),
                before.window_rms.powi(2),
                after.window_rms.powi(2),
                1.0,
            )),
        }
    }
    sums.sort_by(|a, b| {
        let end = |h: Option<f64>| h.unwrap_or(f64::INFINITY);
        a.1.cmp(&b.1).then(end(a.0).total_cmp(&end(b.0)))
    });
    gap.rollout = (sums.into_iter())
        .map(|(horizon_s, unit, before, after, n)| Rollout {
            horizon_s,
            before: (before / n).sqrt(),
            after: (after / n).sqrt(),
            unit,
        })
        .collect();
}

/// How far free bodies are off over the longest horizon, the mean over rollouts, in percent of a length.
fn distance(b: &Comparison, a: &Comparison, length_m: f64) -> Option<Holdout> {
    let mean = |c: &Comparison| {
        let end = |g: &compare::rollouts::Growth| g.horizon_s.unwrap_or(f64::INFINITY);
        let all = || (c.rollouts.growth.iter()).filter(|g| g.channel.ends_with(" distance"));
        let longest = all().map(end).fold(0.0, f64::max);
        let (sum, n) = all()
            .filter(|g| end(g) == longest)
            .fold((0.0, 0.0), |(sum, n), g| (sum + g.mean, n + 1.0));
        (n > 0.0).then(|| 100.0 * sum / (n * length_m))
    };
    Some(Holdout {
        quantity: format!("distance in rollouts, of {length_m} m"),
        before: mean(b)?,
        after: mean(a)?,
        noise_floor: None,
        unit: "%".into(),
    })
}

/// What noise of the positions alone makes of the forces, in percent; none where nothing is known of it.
fn floor(
    machine: &Machine,
    recordings: &[(String, Recording)],
    settings: &Settings,
    sigma: &dyn Fn(&str) -> Option<f64>,
    seed: u64,
    clean: &Comparison,
) -> Option<f64> {
    let only_forces = Settings {
        horizons_s: vec![f64::MIN_POSITIVE],
        to_end: false,
        every_s: Some(f64::MAX),
        ..settings.clone()
    };
    let (mut sum, mut n) = (0.0, 0.0);
    for draw in 0..DRAWS {
        let noisy: Vec<Recording> = (recordings.iter().enumerate())
            .map(|(i, (_, r))| {
                let corrected = instrument::corrected(r, &machine.parameters);
                let mut rng = rng::stream(seed, Purpose::SensorNoise, draw, i as u64);
                with_noise(corrected, sigma, &mut rng)
            })
            .collect();
        let moved = compare::compare(&machine.model, &noisy, &only_forces, None, &|| ()).ok()?;
        for (f, g) in clean.forces.iter().zip(&moved.forces) {
            for (s, t) in f
                .signals
                .iter()
                .zip(&g.signals)
                .filter(|(s, _)| s.is_torque())
            {
                sum += (s.computed.iter().zip(&t.computed))
                    .map(|(a, b)| (a - b).powi(2))
                    .sum::<f64>();
                n += 1.0;
            }
        }
    }
    let (_, measured) = torque_sums(clean);
    (n > 0.0).then(|| 100.0 * (sum / DRAWS as f64 / measured).sqrt())
}

fn with_noise(
    mut recording: Recording,
    sigma: &dyn Fn(&str) -> Option<f64>,
    rng: &mut rng::Stream,
) -> Recording {
    for stream in &mut recording.streams {
        let width = stream.channels.len();
        for (column, channel) in stream.channels.iter().enumerate() {
            let (Kind::Sensor, Some(sigma)) = (channel.kind, sigma(&channel.name)) else {
                continue;
            };
            for value in stream.values.iter_mut().skip(column).step_by(width) {
                *value += sigma * rng::normal(rng);
            }
        }
    }
    recording
}

/// Channels whose error grew and is not small.
fn worse(channels: &[Channel]) -> Vec<String> {
    let most = |c: &Channel| {
        let alike = channels
            .iter()
            .filter(|o| o.unit == c.unit && o.quantity == c.quantity);
        alike.fold(0.0_f64, |m, o| m.max(o.before))
    };
    let grew = |c: &&Channel| c.after > WORSE * c.before && c.after > NEGLIGIBLE * most(c);
    let say = |c: &Channel| format!("{}, {}", c.channel, c.quantity);
    channels.iter().filter(grew).map(say).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::masses::{machine, record, searching};
    use crate::gap::repair;

    /// The first force of a filtered motion is off by hundreds of times, and what is left after filtering was 230 %.
    #[test]
    fn ends_do_not_spread() {
        let own = machine(r#"damping=".2""#, "");
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"damping\"\n";
        let settings = |cutoff_hz| Settings {
            skip_s: 0.1,
            cutoff_hz,
            force_cutoff_hz: Some(10.0),
            ..Settings::default()
        };
        searching(&own, &own, config, |search, _| {
            let found = repair::machine(&search.windows.problem, &search.x).expect("a machine");
            let held_out = [("sines".to_owned(), record(&own))];
            for cutoff_hz in [Some(20.0), None] {
                let settings = settings(cutoff_hz);
                let gap = verify(&found, &found, &held_out, &settings, &|_| None, 0);
                let percent = gap.expect("compared").holdout.expect("motors").after;
                assert!(percent < 2.0, "{cutoff_hz:?} {percent}");
            }
        });
    }
}
