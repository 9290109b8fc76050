//! A comparison as a report.

use std::fmt::Write as _;

use super::forces::{Forces, Signal};
use super::policy::Tracking;
use super::rollouts::{Growth, Rollouts};
use super::{Comparison, Settings};
use crate::report::{Chart, Line, Report, Section, Table, number};

/// Recordings of which every signal is drawn; tables have them all.
const DRAWN: usize = 3;

/// The page of a comparison.
pub fn report(title: &str, comparison: &Comparison, settings: &Settings) -> Report {
    let mut report = Report::new(title);
    if !comparison.forces.is_empty() {
        report.sections.push(forces(&comparison.forces));
    }
    let recorded = "Rollouts under the recorded controls";
    report
        .sections
        .push(rollouts(recorded, &comparison.rollouts, settings));
    if let Some(policy) = &comparison.policy_rollouts {
        report
            .sections
            .push(rollouts("Rollouts under the policy", policy, settings));
    }
    if !comparison.tracking.is_empty() {
        report.sections.push(tracking(&comparison.tracking));
    }
    report
}

fn forces(all: &[Forces]) -> Section {
    let mut table = Table::new(
        "Instantaneous forces, computed less measured",
        &[
            "signal",
            "recording",
            "samples",
            "n",
            "rms",
            "measured rms",
            "unit",
            "relative",
        ],
    );
    for forces in all {
        for signal in &forces.signals {
            table.push(vec![
                signal.name.clone(),
                forces.recording.clone(),
                signal.samples.to_owned(),
                signal.n.to_string(),
                number(signal.rms),
                number(signal.measured_rms),
                signal.unit.clone(),
                format!("{:.2} %", signal.relative_percent),
            ]);
        }
    }
    let mut section = Section::new("Instantaneous forces")
        .text(
            "At every recorded state, the model's force against the measured one. Sensors in contact are shown in the \
             frame of the contact, normal first; otherwise in the frame of their site.",
        )
        .table(table);
    for forces in all.iter().take(DRAWN) {
        for signal in &forces.signals {
            section = section.chart(force_chart(forces, signal));
        }
    }
    section
}

fn force_chart(forces: &Forces, signal: &Signal) -> Chart {
    let case = match signal.samples {
        "all" => String::new(),
        case => format!(", {case}"),
    };
    let title = format!("{}{case} ({})", signal.name, forces.recording);
    // a line must not bridge the samples of the other case
    let usual = signal
        .time_s
        .windows(2)
        .map(|p| p[1] - p[0])
        .fold(f64::INFINITY, f64::min);
    let broken = |values: &[f64]| {
        let gap = |i: usize| i > 0 && signal.time_s[i] - signal.time_s[i - 1] > 2.5 * usual;
        let keep = |(i, v): (usize, &f64)| if gap(i) { f64::NAN } else { *v };
        values.iter().enumerate().map(keep).collect::<Vec<_>>()
    };
    Chart::new(&title, "time (s)", &signal.unit, signal.time_s.clone())
        .series("measured", Line::Solid, broken(&signal.measured))
        .series("model", Line::Solid, broken(&signal.computed))
}

fn rollouts(heading: &str, rollouts: &Rollouts, settings: &Settings) -> Section {
    let mut columns = vec![
        "channel",
        "horizon",
        "n",
        "rms at end",
        "rms over it",
        "mean",
        "sigma",
        "unit",
    ];
    if settings.length_m.is_some() {
        columns.push("mean of length");
    }
    let mut table = Table::new(
        &format!("{heading}: deviation from the recording"),
        &columns,
    );
    for g in &rollouts.growth {
        let horizon = g
            .horizon_s
            .map_or("to end".to_owned(), |h| format!("{h} s"));
        let mut row = vec![g.channel.clone(), horizon, g.n.to_string()];
        row.extend([g.end_rms, g.window_rms, g.mean, g.mean_sigma].map(number));
        row.push(g.unit.clone());
        if let Some(length) = settings.length_m {
            row.push(of_length(g, length));
        }
        table.push(row);
    }
    let mut text = format!(
        "{} rollouts from recorded states; {} broke down and are left out.",
        rollouts.n, rollouts.diverged
    );
    if rollouts.skipped > 0 {
        let _ = write!(text, " {} recordings have no start.", rollouts.skipped);
    }
    let mut section = Section::new(heading).text(&text).table(table);
    for unit in ["m", "rad", "m/s", "rad/s"] {
        if let Some(chart) = growth_chart(&rollouts.growth, unit) {
            section = section.chart(chart);
        }
    }
    section
}

/// Distances in percent of a length, angles in degrees.
fn of_length(growth: &Growth, length: f64) -> String {
    match growth.unit.as_str() {
        "m" => format!(
            "{:.1} ± {:.1} %",
            100.0 * growth.mean / length,
            100.0 * growth.mean_sigma / length
        ),
        "rad" => format!(
            "{:.1} ± {:.1}°",
            growth.mean.to_degrees(),
            growth.mean_sigma.to_degrees()
        ),
        _ => String::new(),
    }
}

/// Deviation over horizon, for the channels of a unit.
fn growth_chart(growth: &[Growth], unit: &str) -> Option<Chart> {
    let these: Vec<&Growth> = growth.iter().filter(|g| g.unit == unit).collect();
    let mut x: Vec<f64> = these.iter().filter_map(|g| g.horizon_s).collect();
    x.sort_by(f64::total_cmp);
    x.dedup();
    if x.len() < 2 {
        return None;
    }
    let mut names: Vec<&str> = these.iter().map(|g| g.channel.as_str()).collect();
    names.dedup();
    let title = format!("Deviation at the end of the horizon ({unit})");
    let mut chart = Chart::new(&title, "horizon (s)", &format!("rms ({unit})"), x.clone());
    for name in names {
        let at = |h: &f64| {
            let found = these
                .iter()
                .find(|g| g.channel == name && g.horizon_s == Some(*h));
            found.map_or(f64::NAN, |g| g.end_rms)
        };
        chart = chart.series(name, Line::Solid, x.iter().map(at).collect());
    }
    Some(chart)
}

fn tracking(all: &[Tracking]) -> Section {
    let mut table = Table::new(
        "Distance between object and target",
        &["recording", "origin", "mean (cm)", "worst (cm)"],
    );
    let mut section = Section::new("Policy");
    for t in all {
        let cells = [100.0 * t.mean_m, 100.0 * t.worst_m].map(|d| format!("{d:.3}"));
        let [mean, worst] = cells;
        table.push(vec![t.recording.clone(), t.origin.to_owned(), mean, worst]);
    }
    section = section.table(table);
    for t in all.iter().take(2 * DRAWN) {
        let cm = t.distance_m.iter().map(|d| 100.0 * d).collect();
        let title = format!("Distance to target, {} ({})", t.origin, t.recording);
        section = section.chart(
            Chart::new(&title, "time (s)", "cm", t.time_s.clone()).series(
                t.origin,
                Line::Solid,
                cm,
            ),
        );
    }
    section
}
