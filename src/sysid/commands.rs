//! Commands of actuators as a model in steps gets them: limited, then averaged.
//!
//! A command u(t) holds until the next; a step from t to t + h gets its mean. Whatever is not linear in a command comes before
//! that mean, or a bound that single commands meet is hardly met by any:
//!
//! ```text
//! (1/h) ∫ min(max(u(s − T − e), l), l') ds over the step        l: max(range, (force range − b) / g),  l' likewise
//! ```
//!
//! with T the command's delay, e half a step or 0 ([`CommandTiming`]), b and g bias and gain of a motor. Where a law stands between
//! the command and the motor the force range is the engine's affair.

use serde::{Deserialize, Serialize};

use super::parameter::{Instrument, Parameters, Role};
use super::problem::{Problem, Trial};
use crate::mjcf::attribute::Place;
use crate::mujoco::{Model, N_PRM};

/// When the command of a step acts.
///
/// The engine's step ties q₍k−1₎, qₖ and q₍k+1₎ to the command that holds from k to k + 1. In continuous time that second
/// difference is the mean acceleration around k, to which the command before k contributes as much: the engine takes
/// commands half a step early, which identification would see as damping (7 % of a Phantom's at 0.5 ms).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommandTiming {
    /// the mean of the command from half a step before a knot to half a step after it: machines, finer simulations
    #[default]
    Centred,
    /// the mean over the step that begins at the knot: recordings simulated by the engine with the model's own step
    Held,
}

impl Problem {
    /// Controls of every knot of a trial (`n_knots` × nu): means of the command over a step, see [`CommandTiming`].
    pub fn controls(&self, trial: &Trial, x: &[f64]) -> Vec<f64> {
        self.controls_from(trial, x, 0, trial.n_knots)
    }

    /// The same of `n` knots from `first`, which may lie before the trial's first (n × nu).
    pub(crate) fn controls_from(
        &self,
        trial: &Trial,
        x: &[f64],
        first: isize,
        n: usize,
    ) -> Vec<f64> {
        let early = match self.command {
            CommandTiming::Centred => 0.5 * self.model.timestep(),
            CommandTiming::Held => 0.0,
        };
        self.means(trial, x, (first, n), early)
    }

    /// What motors themselves get: means of the command over the step that begins at each of `n` knots from `first` (n × nu).
    /// None where those are the controls.
    pub(crate) fn held_controls(
        &self,
        trial: &Trial,
        x: &[f64],
        (first, n): (isize, usize),
    ) -> Option<Vec<f64>> {
        let held = self.command == CommandTiming::Held;
        (!held).then(|| self.means(trial, x, (first, n), 0.0))
    }

    /// Means of the commands, limited, over a step from `early` s before each of `n` knots from `first` (n × nu).
    fn means(&self, trial: &Trial, x: &[f64], (first, n): (isize, usize), early: f64) -> Vec<f64> {
        let (h, nu) = (self.model.timestep(), self.model.nu());
        let free = self.free_values(x);
        let mut out = vec![0.0; n * nu];
        for (i, series) in trial.controls.iter().enumerate() {
            let delay = self.command_delay[i].value(&free);
            let limits = limits(&self.model, &self.parameters, x, i);
            let mut at = 0;
            for k in 0..n {
                let from = (first as f64 + k as f64) * h - delay - early;
                out[k * nu + i] = mean_of_held(series, limits, from, from + h, &mut at);
            }
        }
        out
    }

    /// Whether controls change with estimated parameter `j`.
    pub(crate) fn moves_controls(&self, j: usize) -> bool {
        let limited = self.model.actuator_forcelimited();
        match &self.parameters.all[self.parameters.free[j]].role {
            Role::Instrument(what, _) => *what == Instrument::CommandDelay,
            Role::Model(targets) => targets.iter().any(|(target, _)| {
                (0..limited.len()).any(|i| limited[i] != 0 && limiting(i).contains(&target.place))
            }),
        }
    }
}

/// What the force range limits the command of an actuator by: range, gain, bias.
fn limiting(actuator: usize) -> [Place; 3] {
    let prm = |array| Place::Slots {
        array,
        first: N_PRM * actuator,
        len: 1,
    };
    [
        Place::ForceLimit(actuator),
        prm("actuator_gainprm"),
        prm("actuator_biasprm"),
    ]
}

/// What of an actuator's command is let through, with parameters at `x`.
fn limits(model: &Model, parameters: &Parameters, x: &[f64], i: usize) -> [f64; 2] {
    let limits = model.ctrl_limits(i);
    let between = model.extension().is_some_and(|e| e.changes_command(i));
    if model.actuator_forcelimited()[i] == 0 || between || !model.is_motor(i) {
        return limits;
    }
    let [range, gain, bias] = limiting(i).map(|place| parameters.number(&place, x));
    let range = range.map_or(
        [0, 1].map(|end| model.actuator_forcerange()[2 * i + end]),
        |limit| [-limit, limit],
    );
    let gain = gain.unwrap_or(model.actuator_gainprm()[N_PRM * i]);
    let bias = bias.unwrap_or(model.actuator_biasprm()[N_PRM * i]);
    if gain == 0.0 {
        return limits;
    }
    let [a, b] = range.map(|force| (force - bias) / gain);
    [limits[0].max(a.min(b)), limits[1].min(a.max(b))]
}

/// Mean over `from .. to` of a signal that holds each value, limited, until the next; `at` remembers the place.
fn mean_of_held(
    series: &[(f64, f64)],
    [low, high]: [f64; 2],
    from: f64,
    to: f64,
    at: &mut usize,
) -> f64 {
    const SLACK: f64 = 1e-9; // stamps are whole nanoseconds
    while *at + 1 < series.len() && series[*at + 1].0 <= from + SLACK {
        *at += 1;
    }
    let limited = |i: usize| series[i].1.min(high).max(low);
    let (mut sum, mut time, mut i) = (0.0, from, *at);
    while i + 1 < series.len() && series[i + 1].0 < to - SLACK {
        let next = series[i + 1].0.max(time);
        sum += limited(i) * (next - time);
        (time, i) = (next, i + 1);
    }
    (sum + limited(i) * (to - time)) / (to - from)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::mean_of_held;
    use crate::recording::{Channel, Kind, Meta, Recording, Stream};
    use crate::supplement;
    use crate::sysid::problem::{Problem, ProblemConfig};

    const ALL: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

    #[test]
    fn a_held_signal_is_averaged_over_the_step() {
        let series = [(0.0, 1.0), (0.1, 3.0), (0.15, -1.0)];
        let mean = |from, to| mean_of_held(&series, ALL, from, to, &mut 0);
        assert_eq!(mean(0.0, 0.1), 1.0);
        assert!((mean(0.05, 0.15) - 2.0).abs() < 1e-12);
        assert!((mean(0.1, 0.2) - 1.0).abs() < 1e-12);
        assert_eq!(mean(5.0, 6.0), -1.0);
        assert_eq!(mean(-2.0, -1.0), 1.0);
    }

    const STEP_S: f64 = 0.004;

    /// A motor of gain 2 that is asked for 3, -3, 3 … in each half step of its model, with `motor`, `custom` and `config` in it:
    /// the controls of the first four knots but one.
    fn controls(motor: &str, custom: &str, config: &str) -> [f64; 3] {
        let xml = format!(
            r#"<mujoco><option timestep="{STEP_S}"/><custom>{custom}</custom><worldbody><body>
            <joint name="j"/><geom size="0.1"/></body></worldbody>
            <actuator><general name="m" joint="j" gainprm="2" {motor}/></actuator>
            <sensor><jointpos name="q" joint="j"/></sensor></mujoco>"#
        );
        let model = supplement::load_text(&xml, "motor.xml").expect("loads");
        let channel = |name: &str, kind, unit: &str| Channel {
            name: name.into(),
            kind,
            unit: unit.into(),
            noise_sigma: Some(1e-5),
        };
        let channels = vec![
            channel("q", Kind::Sensor, "rad"),
            channel("m", Kind::Control, "1"),
        ];
        let half_s = 0.5 * STEP_S;
        let mut stream = Stream::new("all", Some(half_s.recip()), channels);
        for k in 0..60 {
            let asked = if k % 2 == 0 { 3.0 } else { -3.0 };
            stream.push((f64::from(k) * half_s * 1e9) as i64, &[0.0, asked]);
        }
        let recording = Recording {
            meta: Meta::default(),
            streams: vec![stream],
        };
        let config: ProblemConfig = toml::from_str(config).expect("a configuration");
        let problem = Problem::new(Arc::new(model), &config, &[("one".to_owned(), recording)]);
        let problem = problem.expect("a problem");
        let x = problem.parameters.start();
        for j in 0..x.len() {
            assert!(problem.moves_controls(j));
        }
        let all = problem.controls(&problem.trials[0], &x);
        [all[1], all[2], all[3]]
    }

    #[test]
    fn bounds_that_single_commands_meet_act_before_the_mean() {
        // 3 and -3 in turn: what is let through of each, and their mean
        let off = |low: f64, high: f64| [0.5 * (low + high); 3];
        assert_eq!(controls("", "", ""), off(-3.0, 3.0));
        let range = r#"ctrllimited="true" ctrlrange="-1 2""#;
        assert_eq!(controls(range, "", ""), off(-1.0, 2.0));
        let force = r#"forcelimited="true" forcerange="-1 5""#;
        assert_eq!(controls(force, "", ""), off(-0.5, 2.5));
        let biased = format!(r#"{force} biastype="affine" biasprm="-1 0 0""#);
        assert_eq!(controls(&biased, "", ""), off(0.0, 3.0));
        // what comes after another law is the engine's affair
        let lag = r#"<numeric name="phantom:actuator_lag:m" data="0.01"/>"#;
        assert_eq!(controls(force, lag, ""), off(-3.0, 3.0));
        assert_eq!(
            controls(&format!("{force} {range}"), lag, ""),
            off(-1.0, 2.0)
        );
    }

    #[test]
    fn bounds_are_those_of_the_parameters() {
        let force = r#"forcelimited="true" forcerange="-1 1" ctrllimited="true" ctrlrange="-1 5""#;
        let config =
            "[[parameter]]\nelement = \"actuator/m\"\nattribute = \"forcelimit\"\nstart = 4\n";
        assert_eq!(controls(force, "", config), [0.5; 3]);
    }
}
