//! Where tosses and their model come apart: in flight, after touching, and at rest.
//!
//! In flight nothing but gravity acts: the acceleration a of p(t) = p₀ + v₀ t + a t²/2, fitted to each flight by least
//! squares, is compared with the model's. Flights count as their a is known, by n T⁴ (n samples of T s). What comes
//! after touching, and what lies still, is the deviation of rollouts.

use nalgebra::{Matrix3, Vector3};

use super::judge::{Judge, Seen};
use super::rest;
use crate::compare::States;
use crate::compare::start::starts;
use crate::gap::GapError;
use crate::gap::result::Located;
use crate::gap::score::{mean, rms, two_sided};
use crate::mujoco::ObjectKind;

/// Samples that a flight needs.
const LEAST_SAMPLES: usize = 8;

/// All cells, surest first.
pub(super) fn locate(judge: &Judge<'_>, seen: &Seen) -> Result<Vec<Located>, GapError> {
    let mut cells = in_flight(judge)?;
    cells.extend(at_rest(judge, seen)?);
    for (channel, horizon, deviations) in seen.rollouts.kinds() {
        let n = deviations.len();
        let (mean, error) = mean(&deviations);
        let t = (mean - noise(judge, channel)) / error;
        cells.push(Located {
            channel: channel.to_owned(),
            phase: match judge.protocol.horizons_s.get(horizon) {
                Some(seconds) => format!("{seconds} s on"),
                None => "to the end".to_owned(),
            },
            effect_size: rms(&deviations),
            mean,
            unit: unit(channel).to_owned(),
            p_value: if t > 0.0 {
                two_sided(t, n as f64 - 1.0)
            } else {
                1.0
            },
            n,
            band_hz: None,
            most_at: None,
        });
    }
    let tests = cells.len() as f64;
    for cell in &mut cells {
        cell.p_value = (cell.p_value * tests).min(1.0);
    }
    cells.sort_by(|a, b| a.p_value.total_cmp(&b.p_value));
    Ok(cells)
}

/// Heights at rest.
fn at_rest(judge: &Judge<'_>, seen: &Seen) -> Result<Option<Located>, GapError> {
    let size = rest::size(judge, &seen.point)?;
    Ok(size.map(|size| Located {
        channel: format!("{} z", size.place),
        phase: "at rest".to_owned(),
        effect_size: size.rms_m,
        mean: size.mean_m,
        unit: "m".to_owned(),
        p_value: size.p_value,
        n: size.n,
        band_hz: None,
        most_at: None,
    }))
}

fn unit(channel: &str) -> &'static str {
    if channel.ends_with(" distance") {
        "m"
    } else {
        "rad"
    }
}

/// Mean deviation that the noise of the sensors alone makes of a channel of a free body.
fn noise(judge: &Judge<'_>, channel: &str) -> f64 {
    let (joint, angle) = match (
        channel.strip_suffix(" distance"),
        channel.strip_suffix(" rotation"),
    ) {
        (Some(joint), _) => (joint, false),
        (_, Some(joint)) => (joint, true),
        _ => return 0.0,
    };
    let model = &judge.problem.model;
    let Ok(joint) = model.id(ObjectKind::Joint, joint) else {
        return 0.0;
    };
    let first = model.nsensordata() + model.jnt_qposadr()[joint] as usize;
    // a rotation is twice the length of its quaternion's vector
    let (own, factor) = if angle {
        (first + 3..first + 7, 2.0)
    } else {
        (first..first + 3, 1.0)
    };
    let all = judge
        .problem
        .channels
        .iter()
        .filter(|c| own.contains(&c.source));
    factor * all.map(|c| c.sigma * c.sigma).sum::<f64>().sqrt()
}

/// Accelerations in flight, less the model's gravity.
fn in_flight(judge: &Judge<'_>) -> Result<Vec<Located>, GapError> {
    let settings = judge.protocol;
    let Some(drop) = &settings.drop else {
        return Ok(Vec::new());
    };
    let model = &judge.problem.model;
    let joint = model.id(ObjectKind::Joint, &drop.joint)?;
    let address = model.jnt_qposadr()[joint] as usize;
    let mut flights: Vec<([f64; 3], f64)> = Vec::new();
    for trial in &judge.problem.trials {
        let states = States::new(&trial.recording, model, settings)?;
        let Some(all) = starts(model, &states, settings)? else {
            continue;
        };
        flights.extend(
            all.iter()
                .filter_map(|s| flight(&states, model.nq(), address, s.sample)),
        );
    }
    let n = flights.len() as f64;
    if n < 2.0 {
        return Ok(Vec::new());
    }
    let total: f64 = flights.iter().map(|f| f.1).sum();
    let cell = |axis: usize| {
        let gravity = model.option().gravity[axis];
        let off = |f: &([f64; 3], f64)| f.0[axis] - gravity;
        let mean = flights.iter().map(|f| f.1 * off(f)).sum::<f64>() / total;
        let of_mean = |f: &([f64; 3], f64)| (f.1 * (off(f) - mean)).powi(2);
        let sigma = (flights.iter().map(of_mean).sum::<f64>() * n / (n - 1.0)).sqrt() / total;
        let square = flights.iter().map(|f| f.1 * off(f).powi(2)).sum::<f64>() / total;
        Located {
            channel: format!("{} {}", drop.joint, ["x", "y", "z"][axis]),
            phase: "in flight".to_owned(),
            effect_size: square.sqrt(),
            mean,
            unit: "m/s^2".to_owned(),
            p_value: two_sided(mean / sigma.max(f64::MIN_POSITIVE), n - 1.0),
            n: flights.len(),
            band_hz: None,
            most_at: None,
        }
    };
    Ok((0..3).map(cell).collect())
}

/// Acceleration up to a sample, and how much it counts.
fn flight(states: &States, nq: usize, address: usize, last: usize) -> Option<([f64; 3], f64)> {
    let n = last + 1;
    if n < LEAST_SAMPLES {
        return None;
    }
    let end = states.time_s[last];
    let span = end - states.time_s[0];
    let mut left = Matrix3::zeros();
    let mut right = [Vector3::zeros(); 3];
    for k in 0..n {
        let t = (states.time_s[k] - end) / span;
        let row = Vector3::new(1.0, t, t * t);
        left += row * row.transpose();
        for (axis, sum) in right.iter_mut().enumerate() {
            *sum += row * states.qpos[k * nq + address + axis];
        }
    }
    let inverse = left.try_inverse()?;
    let bend = right.map(|r| 2.0 * (inverse * r)[2] / (span * span));
    Some((bend, n as f64 * span.powi(4)))
}
