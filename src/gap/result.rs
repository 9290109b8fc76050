//! The answer.

use serde::{Deserialize, Serialize};

use super::decoy::Decoys;
use super::effect::{Effect, Place};

/// In one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// effects were found, each with one name
    Effect,
    /// effects were found, of which some could be others
    Ambiguous,
    /// something is missing that no effect of the catalogue explains
    Unknown,
    /// nothing is missing that these recordings show
    None,
}

/// A number of an effect.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Value {
    /// of the effect's parameter
    #[serde(skip)]
    pub name: String,
    /// estimate
    pub value: f64,
    /// 95 % interval; none where it is not estimated
    pub ci95: Option<[f64; 2]>,
    /// of the numbers
    pub unit: String,
}

/// An effect that would explain nearly as much.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Where {
    /// effect
    pub name: String,
    /// place
    #[serde(rename = "where")]
    pub at: String,
    /// squared distance in units of the noise
    pub separation: f64,
}

impl Where {
    /// An effect at a place.
    pub(super) fn of(effect: &dyn Effect, place: &Place, separation: f64) -> Self {
        Self {
            name: effect.about().name.to_owned(),
            at: place.to_string(),
            separation,
        }
    }
}

/// An effect that was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Named {
    /// of the catalogue
    pub name: String,
    /// place
    #[serde(rename = "where")]
    pub at: String,
    /// names that these recordings cannot tell apart, its own first
    pub class: Vec<String>,
    /// that it is this one
    pub probability: f64,
    /// of as much by chance, in any candidate
    pub p_value: f64,
    /// numbers, by name
    #[serde(serialize_with = "by_name")]
    pub parameters: Vec<Value>,
    /// `mjcf` or `supplement`
    pub expressed_as: &'static str,
    /// formula
    pub law: String,
    /// part of the cost that it explained when it was found
    pub gain: f64,
    /// its response over that of the motors
    pub size: Option<f64>,
    /// what it takes off held-out recordings beside decoys of its size; none where windows are not simulated
    pub decoys: Option<Decoys>,
    /// the class with places
    pub alike: Vec<Where>,
}

fn by_name<S: serde::Serializer>(values: &[Value], s: S) -> Result<S::Ok, S::Error> {
    s.collect_map(values.iter().map(|v| (&v.name, v)))
}

/// A place and phase where the base model disagrees with the recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Located {
    /// joint or sensor
    pub channel: String,
    /// contact, direction and speed
    pub phase: String,
    /// root mean square of what is missing
    pub effect_size: f64,
    /// its mean
    pub mean: f64,
    /// of both
    pub unit: String,
    /// of a mean like this by chance, in any cell
    pub p_value: f64,
    /// windows
    pub n: usize,
    /// Hz between which most of what the channel lacks is, in any phase; none where it is not told
    pub band_hz: Option<[f64; 2]>,
    /// recording and time where most is missing; none where it is not told
    pub most_at: Option<String>,
}

/// An error of held-out recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Holdout {
    /// what it is
    pub quantity: String,
    /// base model, fitted
    pub before: f64,
    /// with the effects
    pub after: f64,
    /// what noise of the sensors alone leaves
    pub noise_floor: Option<f64>,
    /// of all
    pub unit: String,
}

/// Rollouts of held-out recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rollout {
    /// s; none: to the end
    pub horizon_s: Option<f64>,
    /// root mean square over channels of the same unit, base model
    pub before: f64,
    /// with the effects
    pub after: f64,
    /// of both
    pub unit: String,
}

/// An error of one channel before and after.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Channel {
    /// joint, sensor or body
    pub channel: String,
    /// `force`, `reading` or a horizon
    pub quantity: String,
    /// base model, fitted
    pub before: f64,
    /// with the effects
    pub after: f64,
    /// of both
    pub unit: String,
}

/// The gap before and after.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Gap {
    /// errors at every sample; none without held-out recordings
    pub holdout: Option<Holdout>,
    /// errors of simulations
    pub rollout: Vec<Rollout>,
    /// all errors by channel
    pub channels: Vec<Channel>,
    /// channels that became worse
    pub worse: Vec<String>,
    /// why parts are missing
    pub notes: Vec<String>,
}

/// What to record next.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Experiment {
    /// effects that it tells apart, or shows
    pub effects: Vec<String>,
    /// described motion
    pub motion: String,
    /// behaviours of `phantom record`
    pub behaviours: Vec<String>,
    /// what simulated motions promise, best first; empty where none was simulated
    pub expected: Vec<Expected>,
}

/// What a motion as long as the recorded ones would tell of what was found and those that are alike.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Expected {
    /// described
    pub motion: String,
    /// natural logarithm of the odds for what was found against the likeliest of the others, were it there
    pub log_odds: f64,
}

/// An effect that these recordings cannot speak of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Untestable {
    /// effect
    pub name: String,
    /// places
    #[serde(rename = "where")]
    pub at: Vec<String>,
    /// why
    pub reason: String,
    /// behaviours that would show it
    pub behaviours: Vec<String>,
}

/// A line of the evidence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tested {
    /// effect
    pub name: String,
    /// place
    #[serde(rename = "where")]
    pub at: String,
    /// expected values, in the order of its parameters
    pub expected: Vec<f64>,
    /// part of the cost that it would explain
    pub gain: f64,
    /// of that by chance, alone
    pub p_value: f64,
    /// part that nothing else absorbs
    pub visible: f64,
    /// response over that of the motors
    pub size: Option<f64>,
}

/// What is left where no effect explains it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Left {
    /// joint
    pub channel: String,
    /// root mean square of the missing force
    pub size: f64,
    /// the same as a part of the motors' there
    pub of_motor: f64,
    /// of the size
    pub unit: String,
    /// part of its variance that a flexible function of these inputs predicts, held out
    pub explainable: f64,
    /// inputs and what is lost without each
    pub inputs: Vec<(String, f64)>,
}

/// What is left of the readings, above noise, as a part of what motors do to them; none where motors do nothing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Remaining {
    /// with the base model
    pub before: Option<f64>,
    /// with the effects
    pub after: Option<f64>,
}

/// Everything.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Answer {
    /// in one word
    pub verdict: Verdict,
    /// found, in the order of finding
    pub effects: Vec<Named>,
    /// where the base model disagrees
    pub located: Vec<Located>,
    /// before and after
    pub gap: Gap,
    /// effects that cannot be tested
    pub untestable: Vec<Untestable>,
    /// what to record next
    pub next_experiment: Option<Experiment>,
    /// file of the repaired model, beside the answer
    pub model: String,
    /// first screen, best first
    pub evidence: Vec<Tested>,
    /// what is left unexplained
    pub left: Vec<Left>,
    /// which decides whether anything is
    pub remaining: Remaining,
    /// simulating the repaired model and searching again
    pub round_trip: Option<RoundTrip>,
    /// s of a window, or of the longest rollout
    pub window_s: f64,
    /// windows, or rollouts
    pub n_windows: usize,
    /// candidates tested
    pub n_candidates: usize,
}

/// The repaired model simulated, and searched again.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RoundTrip {
    /// effects found beside those in the model
    pub found: Vec<String>,
    /// numbers of the effects in the model
    pub returned: Vec<Returned>,
}

/// A number that was simulated, and what was found of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Returned {
    /// effect and parameter
    pub name: String,
    /// place
    #[serde(rename = "where")]
    pub at: String,
    /// simulated
    pub put_in: f64,
    /// found
    pub value: f64,
    /// 95 % interval
    pub ci95: [f64; 2],
}

impl Returned {
    /// Whether it came back within its interval.
    pub fn is_inside(&self) -> bool {
        (self.ci95[0]..=self.ci95[1]).contains(&self.put_in)
    }
}
