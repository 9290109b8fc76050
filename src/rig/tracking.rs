//! A policy on the machine: the spiral as the motion capture sees it.

use serde::{Deserialize, Serialize};

use super::behaviour::PolicyBehaviour;
use super::{Rig, RigError, Trial};
use crate::policy::AffineGaussian;
use crate::recording::Recording;
use crate::task::spiral;

/// Place of the object at a time, with its target.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// since the start, s
    pub time_s: f64,
    /// x, y, m
    pub object_m: [f64; 2],
    /// x, y, m
    pub target_m: [f64; 2],
}

impl Place {
    /// Between object and target, cm.
    pub fn distance_cm(&self) -> f64 {
        let ([x, y], [a, b]) = (self.object_m, self.target_m);
        100.0 * (x - a).hypot(y - b)
    }
}

/// What came of one spiral.
#[derive(Debug)]
pub struct Followed {
    /// all streams
    pub recording: Recording,
    /// why the simulation broke down
    pub diverged: Option<String>,
    /// of the object, frame by frame
    pub places: Vec<Place>,
}

impl Followed {
    /// Mean distance of object and target over the frames, cm. After a breakdown the object counts as staying where it
    /// was last seen, so that an early one is no way to a good figure.
    pub fn mean_distance_cm(&self) -> f64 {
        mean_distance_cm(&self.places, self.diverged.is_some())
    }
}

/// Let `policy` follow the spiral in trial `number` of the machine.
///
/// # Errors
/// The policy does not fit, or the engine refuses; a breakdown is part of the result.
pub fn follow(rig: &Rig, policy: &AffineGaussian, number: u64) -> Result<Followed, RigError> {
    let mut behaviour = PolicyBehaviour::new(policy.clone(), rig.model())?;
    let trial = Trial {
        number,
        label: "policy".to_owned(),
        seconds: spiral::DURATION_S,
    };
    let outcome = rig.record(&mut behaviour, &trial, |_| ())?;
    Ok(Followed {
        places: places(&outcome.recording),
        recording: outcome.recording,
        diverged: outcome.diverged,
    })
}

/// What the motion capture saw of the object, beside the target at the times it stamped.
fn places(recording: &Recording) -> Vec<Place> {
    let (Some((stream, x)), Some((_, y))) = (
        recording.channel("object_pos[0]"),
        recording.channel("object_pos[1]"),
    ) else {
        return Vec::new();
    };
    let place = |i: usize| Place {
        time_s: stream.time(i),
        object_m: [stream.row(i)[x], stream.row(i)[y]],
        target_m: spiral::target(stream.time(i)),
    };
    let seen = (0..stream.len()).map(place);
    seen.filter(|p| p.time_s <= spiral::DURATION_S).collect()
}

fn mean_distance_cm(places: &[Place], broke_down: bool) -> f64 {
    let mut distances: Vec<f64> = places.iter().map(Place::distance_cm).collect();
    if broke_down {
        let interval = match places {
            [.., a, b] => b.time_s - a.time_s,
            _ => spiral::DURATION_S / 100.0,
        };
        let (object_m, mut time_s) = places
            .last()
            .map_or(([0.0; 2], 0.0), |p| (p.object_m, p.time_s));
        loop {
            time_s += interval;
            if time_s > spiral::DURATION_S {
                break;
            }
            let missed = Place {
                time_s,
                object_m,
                target_m: spiral::target(time_s),
            };
            distances.push(missed.distance_cm());
        }
    }
    distances.iter().sum::<f64>() / distances.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn still(seconds: f64) -> Vec<Place> {
        let n = (240.0 * seconds) as usize;
        let place = |i: usize| Place {
            time_s: i as f64 / 240.0,
            object_m: [0.0; 2],
            target_m: spiral::target(i as f64 / 240.0),
        };
        (0..n).map(place).collect()
    }

    #[test]
    fn an_early_breakdown_is_no_way_to_a_good_figure() {
        // an object that stays at the origin: 4 cm on the circle, 2 cm on average before
        let whole = mean_distance_cm(&still(4.0), false);
        assert!((whole - 3.0).abs() < 0.01, "{whole}");
        for seconds in [0.0, 0.5] {
            let broken = mean_distance_cm(&still(seconds), true);
            assert!((broken - whole).abs() < 0.05, "{broken}");
        }
    }
}
