//! An identification as a report.

use super::fit::Status;
use super::holdout::{Holdout, Residual, Verdict};
use super::interval::{Estimate, Label};
use super::parameter::Scale;
use super::predict::Explained;
use super::problem::Problem;
use super::summary::{Outcome, Summary};
use crate::report::{Axis, Chart, Line, Report, Section, Table, number};

/// Recordings whose channels are drawn; tables have them all.
const DRAWN: usize = 2;
/// Channels drawn a recording: those explained worst.
const CHANNELS: usize = 12;
/// Parameters up to which the matrix of correlations is shown.
const MATRIX: usize = 40;

/// The page.
pub fn report(title: &str, problem: &Problem, outcome: &Outcome, summary: &Summary) -> Report {
    let mut report = Report::new(title);
    report.sections.push(verdict(summary));
    report.sections.push(parameters(summary));
    report
        .sections
        .extend(summary.holdout.as_ref().map(held_out));
    report.sections.push(residuals(summary));
    if !summary.leave_one_sensor_out.is_empty() {
        report.sections.push(left_out(summary));
    }
    report.sections.push(convergence(problem, outcome, summary));
    for (trial, explained) in problem.trials.iter().zip(&outcome.explained).take(DRAWN) {
        report
            .sections
            .push(fit(problem, &trial.name, explained, summary));
    }
    report
}

/// The answer in one sentence a line.
pub fn sentences(summary: &Summary) -> Vec<String> {
    let last = summary.history.last().map_or(0, |_| summary.history.len());
    let mut lines = vec![match summary.status {
        Status::Converged => format!("Converged after {last} iterations."),
        Status::ConvergedAtKink => format!(
            "Converged after {last} iterations, at a kink of dry friction or contact: the cost rises on all sides."
        ),
        Status::Stalled => {
            format!("Did not converge: after {last} iterations no step lowers the cost any more.")
        }
        Status::MaxIterations => format!("Did not converge within {last} iterations."),
        Status::Interrupted => format!("Interrupted after {last} iterations; best so far."),
    }];
    lines.extend(summary.horizon_s.map(|horizon| {
        let behind = if summary.level > 0.0 {
            format!(
                "what is behind, ones that forces of {} % of those at each joint push",
                number(100.0 * summary.level)
            )
        } else {
            "what is behind was not used".to_owned()
        };
        format!(
            "Simulations of the model follow the first {} s of each recording; {behind}.",
            number(horizon)
        )
    }));
    lines.push(match &summary.holdout {
        None if summary.status == Status::Interrupted => {
            "Not tested: it was interrupted before held-out recordings had their turn.".to_owned()
        }
        None => "Not tested: no held-out recordings (--holdout), so nothing shows that the identified model is \
                 better than the nominal one."
            .to_owned(),
        Some(h) => {
            let rollouts = match h.prediction.as_ref().and_then(|p| p.ratio) {
                Some(r) => format!(", errors of rollouts are {r:.2} times the nominal model's"),
                None => String::new(),
            };
            let verdict = match h.verdict {
                Verdict::Better => "Better",
                Verdict::NotBetter => "Not better",
            };
            format!(
                "{verdict} on held-out recordings: the cost a knot goes from {} to {} (difference {} ± {}){rollouts}.",
                number(h.nominal.cost_per_knot),
                number(h.identified.cost_per_knot),
                number(h.gain),
                number(2.0 * h.gain_sigma),
            )
        }
    });
    let count = |label| {
        summary
            .parameters
            .iter()
            .filter(|p| p.label == label)
            .count()
    };
    for (label, words) in [
        (Label::Prior, "are mostly their priors"),
        (Label::AtBound, "are at a bound"),
        (Label::Undetermined, "are not determined"),
    ] {
        if count(label) > 0 {
            lines.push(format!(
                "{} of {} parameters {words}.",
                count(label),
                summary.parameters.len()
            ));
        }
    }
    if !summary.inseparable.is_empty() {
        lines.push("The recordings cannot separate:".to_owned());
        lines.extend(summary.inseparable.iter().map(|c| format!("  {}", c.text)));
    }
    lines
}

fn verdict(summary: &Summary) -> Section {
    let text = |s: Section, line: &String| s.text(line);
    let section = sentences(summary).iter().fold(Section::new("Result"), text);
    let mut table = Table::new(
        "Recordings",
        &["recording", "duration (s)", "knots", "samples"],
    );
    for r in &summary.recordings {
        let cells = [
            number(r.duration_s),
            r.knots.to_string(),
            r.samples.to_string(),
        ];
        table.push(std::iter::once(r.name.clone()).chain(cells).collect());
    }
    let section = section.table(table);
    summary.notes.iter().fold(section, |s, note| s.text(note))
}

/// Before and after.
pub fn parameter_table(parameters: &[Estimate]) -> Table {
    let mut table = Table::new(
        "Parameters",
        &[
            "parameter",
            "nominal",
            "identified",
            "change",
            "95 % from",
            "to",
            "spread",
            "",
            "unit",
        ],
    );
    for p in parameters {
        let [low, high] = match p.interval {
            Some(ends) => ends.map(number),
            None => [String::new(), String::new()],
        };
        let spread = match (p.x_sigma.filter(|_| p.interval.is_some()), p.scale) {
            (None, _) => String::new(),
            (Some(s), Scale::Log) => format!("{} %", number(100.0 * s)),
            (Some(s), Scale::Linear) => number(s),
        };
        let label = match p.label {
            Label::Identified => "",
            Label::Prior => "prior",
            Label::AtBound => "at bound",
            Label::Undetermined => "not determined",
            Label::Frozen => "held",
        };
        table.push(vec![
            p.name.clone(),
            number(p.nominal),
            number(p.value),
            change(p.nominal, p.value),
            low,
            high,
            spread,
            label.to_owned(),
            p.unit.clone(),
        ]);
    }
    table
}

/// Change of a value, relative to what it was.
fn change(from: f64, to: f64) -> String {
    if from == 0.0 || from == to {
        return String::new();
    }
    let percent = 100.0 * (to - from) / from.abs();
    match percent.abs() {
        p if p >= 1000.0 => format!("× {}", number(to / from)),
        p if p >= 10.0 => format!("{percent:+.0} %"),
        _ => format!("{percent:+.1} %"),
    }
}

fn parameters(summary: &Summary) -> Section {
    let mut section = Section::new("Parameters")
        .text(
            "Intervals leave the motion free, take noise as it is in the recordings, autocorrelation included, and \
             hold given the model. \"prior\": the recordings add little to what was known before.",
        )
        .table(parameter_table(&summary.parameters));
    if !summary.correlation.strong.is_empty() {
        let mut table = Table::new("Strong correlations", &["parameter", "with", "correlation"]);
        for pair in &summary.correlation.strong {
            table.push(vec![
                pair.first.clone(),
                pair.second.clone(),
                format!("{:+.3}", pair.correlation),
            ]);
        }
        section = section.table(table);
    }
    let names = &summary.correlation.names;
    if (2..=MATRIX).contains(&names.len()) {
        let numbers: Vec<String> = (1..=names.len()).map(|i| i.to_string()).collect();
        let mut columns = vec!["correlation"];
        columns.extend(numbers.iter().map(String::as_str));
        let mut table = Table::new("Correlations", &columns);
        for (i, (name, row)) in names.iter().zip(&summary.correlation.matrix).enumerate() {
            let cells = row.iter().take(i + 1).map(|c| format!("{c:+.2}"));
            let blank = std::iter::repeat_n(String::new(), names.len() - i - 1);
            let head = std::iter::once(format!("{} {name}", i + 1));
            table.push(head.chain(cells).chain(blank).collect());
        }
        section = section.table(table);
    }
    section
}

fn held_out(h: &Holdout) -> Section {
    let mut table = Table::new(
        "Residuals, parameters held",
        &[
            "signal",
            "nominal rms",
            "identified rms",
            "assumed sigma",
            "unit",
        ],
    );
    let signals = |r: &Residual| -> Vec<(String, f64, f64, String)> {
        let channels = r
            .channels
            .iter()
            .map(|c| (c.name.clone(), c.rms, c.sigma, c.unit.clone()));
        let forces = r.forces.iter().map(|f| {
            let name = format!("unexplained force at {}", f.name);
            (name, f.rms, f.sigma, "N m or N".to_owned())
        });
        channels.chain(forces).collect()
    };
    for (a, b) in signals(&h.nominal).into_iter().zip(signals(&h.identified)) {
        table.push(vec![a.0, number(a.1), number(b.1), number(a.2), a.3]);
    }
    let mut section = Section::new("Held-out recordings")
        .text(&format!(
            "Not used in the fit: {}.",
            h.recordings.join(", ")
        ))
        .table(table);
    if let Some(p) = &h.prediction {
        let mut table = Table::new(
            "Rollouts from recorded states under the recorded controls: rms error",
            &[
                "channel",
                "horizon (s)",
                "nominal",
                "identified",
                "ratio",
                "unit",
            ],
        );
        for g in &p.growth {
            table.push(vec![
                g.channel.clone(),
                g.horizon_s
                    .map_or("to the end".to_owned(), |s| s.to_string()),
                number(g.nominal),
                number(g.identified),
                format!("{:.3}", g.identified / g.nominal),
                g.unit.clone(),
            ]);
        }
        section = section
            .text(&format!(
                "{} rollouts; the simulation broke down in {} with the nominal and {} with the identified model.",
                p.n, p.diverged[0], p.diverged[1]
            ))
            .table(table);
    }
    if let Some(reason) = &h.no_prediction {
        section = section.text(&format!("No rollouts: {reason}."));
    }
    section
}

fn residuals(summary: &Summary) -> Section {
    let mut channels = Table::new(
        "Channels: measured less model",
        &["channel", "samples", "rms", "sigma", "", "unit"],
    );
    for c in &summary.channels {
        let origin = if c.sigma_known {
            "given"
        } else {
            "from the signal"
        };
        channels.push(vec![
            c.name.clone(),
            c.n.to_string(),
            number(c.rms),
            number(c.sigma),
            origin.to_owned(),
            c.unit.clone(),
        ]);
    }
    let mut forces = Table::new(
        "Forces that nothing explains (N m or N)",
        &["joint", "rms", "sigma"],
    );
    for f in &summary.forces {
        forces.push(vec![f.name.clone(), number(f.rms), number(f.sigma)]);
    }
    let section = Section::new("Residuals");
    if summary.forces.is_empty() {
        return section.table(channels);
    }
    section
        .text(&format!(
            "Up to {:.2} % of the forces may stay unexplained, by the evidence of the recordings.",
            100.0 * summary.level
        ))
        .table(channels)
        .table(forces)
}

fn left_out(summary: &Summary) -> Section {
    let mut table = Table::new(
        "Channels predicted without their sensor: rms error",
        &["channel", "sigma", "fitted with it", "without it", "unit"],
    );
    for c in &summary.leave_one_sensor_out {
        let without = c.without.map_or("motion not determined".to_owned(), number);
        table.push(vec![
            c.channel.clone(),
            number(c.sigma),
            number(c.with),
            without,
            c.unit.clone(),
        ]);
    }
    Section::new("Leave one sensor out").table(table)
}

fn convergence(problem: &Problem, outcome: &Outcome, summary: &Summary) -> Section {
    let n = summary.history.len();
    let x: Vec<f64> = (1..=n).map(|i| i as f64).collect();
    let of = |f: &dyn Fn(&super::fit::Iteration) -> f64| summary.history.iter().map(f).collect();
    let cost = Chart::new("Cost", "iteration", "cost", x.clone())
        .series("cost", Line::Solid, of(&|i| i.cost))
        .log();
    let mut steps = Chart::new(
        "Distance of the parameters to the result",
        "iteration",
        "sizes",
        x,
    );
    steps.y_axis = Axis::Log;
    if let Some(end) = summary.history.last() {
        for (j, p) in problem.parameters.iter_free().enumerate() {
            let distance = of(&|i| (i.x[j] - end.x[j]).abs() / p.typical);
            steps = steps.series(&p.name, Line::Solid, distance);
        }
    }
    let weakest = &outcome.summary.weakest;
    Section::new("Convergence")
        .text(&format!(
            "The motion is determined least at joint {}, {} at {} s (ratio {:.1e}).",
            weakest.joint,
            weakest.recording,
            number(weakest.time_s),
            weakest.ratio
        ))
        .chart(cost)
        .chart(steps)
}

/// Measured and fitted channels of a recording, and the forces that nothing explains.
fn fit(problem: &Problem, name: &str, explained: &Explained, summary: &Summary) -> Section {
    let mut section = Section::new(&format!("Fit: {name}"));
    let mut worst: Vec<usize> = (0..problem.channels.len())
        .filter(|&c| !explained.channels[c].time_s.is_empty())
        .collect();
    let misfit = |c: usize| summary.channels[c].rms / summary.channels[c].sigma;
    worst.sort_by(|&a, &b| misfit(b).total_cmp(&misfit(a)));
    worst.truncate(CHANNELS);
    for c in worst {
        let (channel, p) = (&problem.channels[c], &explained.channels[c]);
        let title = format!("{} ({name})", channel.name);
        let chart = Chart::new(&title, "time (s)", &channel.unit, p.time_s.clone())
            .series("measured", Line::Solid, p.measured.clone())
            .series("model", Line::Solid, p.predicted.clone());
        let error = p
            .measured
            .iter()
            .zip(&p.predicted)
            .map(|(m, z)| m - z)
            .collect();
        let residual = Chart::new(
            &format!("{title}: residual"),
            "time (s)",
            &channel.unit,
            p.time_s.clone(),
        )
        .series("measured less model", Line::Solid, error);
        section = section.chart(chart).chart(residual);
    }
    let (nv, h) = (problem.model.nv(), problem.model.timestep());
    let time = (0..explained.force.len() / nv)
        .map(|k| k as f64 * h)
        .collect();
    let title = format!("Forces that nothing explains ({name})");
    let mut chart = Chart::new(&title, "time (s)", "N m or N", time);
    for (dof, residual) in summary.forces.iter().enumerate() {
        let values = explained
            .force
            .iter()
            .skip(dof)
            .step_by(nv)
            .copied()
            .collect();
        chart = chart.series(&residual.name, Line::Solid, values);
    }
    section.chart(chart)
}
