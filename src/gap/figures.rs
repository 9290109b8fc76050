//! The answer as sentences, tables and charts.

use std::fmt::Write as _;

use super::result::{Answer, Experiment, Named, Verdict};
use super::run::{MissingSeries, Outcome};
use crate::report::number;
use crate::report::{Chart, Line, Report, Section, Table};

/// Lines of the evidence that are shown.
const LINES: usize = 25;

/// What a person has to know, line by line.
pub fn summary(answer: &Answer) -> Vec<String> {
    let mut out = Vec::new();
    for l in answer.located.iter().take(5) {
        let band = (l.band_hz).map_or(String::new(), |hz| format!(", mostly at {} Hz", range(hz)));
        let most = (l.most_at.as_ref()).map_or(String::new(), |at| format!(", most in {at}"));
        out.push(format!(
            "disagreement: {} ({}): {} {} rms, mean {}{band}{most}",
            l.channel,
            l.phase,
            number(l.effect_size),
            l.unit,
            number(l.mean)
        ));
    }
    out.push(verdict(answer));
    for e in &answer.effects {
        out.push(format!("  {}", sentence(e)));
    }
    for l in &answer.left {
        out.push(format!(
            "  unexplained: {} {} rms at {}, of which {:.0} % follows from {}",
            number(l.size),
            l.unit,
            l.channel,
            100.0 * l.explainable,
            inputs(&l.inputs)
        ));
    }
    if let (Some(before), Some(after)) = (answer.remaining.before, answer.remaining.after) {
        out.push(format!(
            "readings that nothing explains: {} -> {} % of what the motors do to them",
            number(100.0 * before),
            number(100.0 * after)
        ));
    }
    if let Some(h) = &answer.gap.holdout {
        let floor = h
            .noise_floor
            .map_or(String::new(), |f| format!("; noise alone {}", number(f)));
        out.push(format!(
            "held-out {}: {} -> {} {}{floor}",
            h.quantity,
            number(h.before),
            number(h.after),
            h.unit
        ));
    }
    for r in &answer.gap.rollout {
        let horizon = r
            .horizon_s
            .map_or("to the end".to_owned(), |h| format!("{h} s"));
        out.push(format!(
            "held-out rollouts, {horizon}: {} -> {} {}",
            number(r.before),
            number(r.after),
            r.unit
        ));
    }
    for worse in &answer.gap.worse {
        out.push(format!("WORSE: {worse}"));
    }
    if let Some(again) = &answer.round_trip {
        let found = if again.found.is_empty() {
            "nothing more".to_owned()
        } else {
            again.found.join(", ")
        };
        out.push(format!(
            "round trip: the repaired model, simulated and searched again, lacks {found}"
        ));
        for r in &again.returned {
            let outside = if r.is_inside() { "" } else { ", OUTSIDE" };
            out.push(format!(
                "  {} at {}: {} put in, {} ({} to {}) came back{outside}",
                r.name,
                r.at,
                number(r.put_in),
                number(r.value),
                number(r.ci95[0]),
                number(r.ci95[1]),
            ));
        }
    }
    out.extend(answer.gap.notes.iter().map(|n| format!("note: {n}")));
    if let Some(next) = &answer.next_experiment {
        out.push(format!(
            "next: {} ({}){}",
            next.motion,
            next.effects.join(", "),
            promised(next)
        ));
    }
    out
}

/// What simulated motions promise of the next experiment, to be added to a line.
fn promised(next: &Experiment) -> String {
    let Some(best) = next.expected.first() else {
        return String::new();
    };
    let odds = number(best.log_odds);
    if best.motion == next.motion {
        format!("; ln odds {odds} in simulation")
    } else {
        let n = next.expected.len();
        format!("; none of {n} motions simulated tells more, ln odds {odds} at most")
    }
}

fn verdict(answer: &Answer) -> String {
    match answer.verdict {
        Verdict::Effect => format!("verdict: effect, {} found", answer.effects.len()),
        Verdict::Ambiguous => format!(
            "verdict: ambiguous, {} found, of which some have several names on these recordings",
            answer.effects.len()
        ),
        Verdict::Unknown => {
            let what =
                "verdict: unknown, something is missing that no effect of the catalogue explains";
            match answer.effects.len() {
                0 => what.to_owned(),
                n => format!("{what}; {n} found, which take a part of it or stand for it"),
            }
        }
        Verdict::None => format!(
            "verdict: none, nothing is missing that these recordings show ({} candidates tested)",
            answer.n_candidates
        ),
    }
}

fn inputs(all: &[(String, f64)]) -> String {
    let most = all.iter().max_by(|a, b| a.1.total_cmp(&b.1));
    most.map_or(String::new(), |(name, _)| name.clone())
}

fn range([low, high]: [f64; 2]) -> String {
    format!("{} to {}", number(low), number(high))
}

/// An effect in a sentence.
fn sentence(e: &Named) -> String {
    let mut out = format!("{} at {}:", e.name, e.at);
    for v in &e.parameters {
        let _ = write!(out, " {} {}", v.name, number(v.value));
        if let Some(ci95) = v.ci95 {
            let _ = write!(out, " ({})", range(ci95));
        }
        if v.unit != "1" {
            let _ = write!(out, " {}", v.unit);
        }
        out.push(',');
    }
    let _ = write!(
        out,
        " probability {:.2}, p {:.1e}",
        e.probability, e.p_value
    );
    if e.class.len() > 1 {
        let _ = write!(out, "; could also be {}", e.class[1..].join(", "));
    }
    out
}

/// The page.
pub fn report(title: &str, outcome: &Outcome, diff: &str) -> Report {
    let answer = &outcome.answer;
    let mut page = Report::new(title);
    let mut first = Section::new("Answer");
    for line in summary(answer) {
        first = first.text(line.trim());
    }
    page.sections.push(first);
    page.sections.push(effects(answer));
    page.sections.push(maps(outcome));
    page.sections.push(evidence(answer));
    page.sections.push(gap(answer));
    let mut change = Section::new("Change of the model file");
    let mut table = Table::new("model.diff", &["line"]);
    for line in diff.lines() {
        table.push(vec![line.to_owned()]);
    }
    change = change.table(table);
    page.sections.push(change);
    page.sections.push(untested(answer));
    page
}

fn effects(answer: &Answer) -> Section {
    let mut table = Table::new(
        "What was found",
        &[
            "effect",
            "where",
            "law",
            "parameter",
            "value",
            "95 %",
            "unit",
            "probability",
            "p",
            "best decoy",
            "class",
            "as",
        ],
    );
    for e in &answer.effects {
        let decoys = (e.decoys).map_or(String::new(), |d| {
            format!("{:.2} of it, of {}", d.best / d.own, d.n)
        });
        for v in &e.parameters {
            let interval = v.ci95.map_or("held".to_owned(), range);
            table.push(vec![
                e.name.clone(),
                e.at.clone(),
                e.law.clone(),
                v.name.clone(),
                number(v.value),
                interval,
                v.unit.clone(),
                format!("{:.3}", e.probability),
                format!("{:.1e}", e.p_value),
                decoys.clone(),
                e.class.join(", "),
                e.expressed_as.to_owned(),
            ]);
        }
    }
    Section::new("Effects").table(table)
}

fn maps(outcome: &Outcome) -> Section {
    let answer = &outcome.answer;
    let what = if outcome.missing[0].is_some() {
        format!(
            "Force at each joint that brings the fitted model onto the recording, one number for each of {} stretches of {} s.",
            answer.n_windows, answer.window_s
        )
    } else {
        format!(
            "Rollouts from where bodies fall, up to {} s ({} rollouts): acceleration in flight less gravity, height at rest \
             less the model's, mean deviation of whole rollouts.",
            number(answer.window_s),
            answer.n_windows
        )
    };
    let mut section = Section::new("Where model and recordings disagree").text(&what);
    let mut table = Table::new(
        "Cells whose mean is not chance, base model",
        &[
            "channel",
            "phase",
            "rms",
            "mean",
            "unit",
            "p (family)",
            "n",
            "mostly, Hz",
            "most of all",
        ],
    );
    for l in &answer.located {
        table.push(vec![
            l.channel.clone(),
            l.phase.clone(),
            number(l.effect_size),
            number(l.mean),
            l.unit.clone(),
            format!("{:.1e}", l.p_value),
            l.n.to_string(),
            l.band_hz.map(range).unwrap_or_default(),
            l.most_at.clone().unwrap_or_default(),
        ]);
    }
    section = section.table(table);
    if let [Some(before), Some(after)] = &outcome.missing {
        for j in 0..before.joints.len() {
            if after.joints.get(j) == before.joints.get(j) {
                section = section
                    .chart(over_speed(before, after, j))
                    .chart(over_time(before, after, j));
            }
        }
    }
    section
}

fn over_speed(before: &MissingSeries, after: &MissingSeries, j: usize) -> Chart {
    let mut order: Vec<usize> = (0..before.force[j].len()).collect();
    order.sort_by(|a, b| before.velocity[j][*a].total_cmp(&before.velocity[j][*b]));
    let pick = |v: &[f64]| {
        order
            .iter()
            .filter_map(|i| v.get(*i).copied())
            .collect::<Vec<_>>()
    };
    let x = pick(&before.velocity[j]);
    let mut late = pick(&after.force[j]);
    late.resize(x.len(), f64::NAN);
    Chart::new(
        &format!("{}: missing force over velocity", before.joints[j]),
        "velocity (rad/s or m/s)",
        &format!("force ({})", before.units[j]),
        x,
    )
    .series("before", Line::Points, pick(&before.force[j]))
    .series("after", Line::Points, late)
}

fn over_time(before: &MissingSeries, after: &MissingSeries, j: usize) -> Chart {
    let x: Vec<f64> = (0..before.force[j].len()).map(|i| i as f64).collect();
    let mut late = after.force[j].clone();
    late.resize(x.len(), f64::NAN);
    Chart::new(
        &format!("{}: missing force over time", before.joints[j]),
        "stretch",
        &format!("force ({})", before.units[j]),
        x,
    )
    .series("before", Line::Solid, before.force[j].clone())
    .series("after", Line::Solid, late)
}

fn evidence(answer: &Answer) -> Section {
    let mut table = Table::new(
        "First screen, best first",
        &[
            "effect",
            "where",
            "expected",
            "part of the cost",
            "p (alone)",
            "visible",
            "of motors",
        ],
    );
    for t in answer.evidence.iter().take(LINES) {
        let expected: Vec<String> = t.expected.iter().map(|v| number(*v)).collect();
        table.push(vec![
            t.name.clone(),
            t.at.clone(),
            expected.join(" "),
            format!("{:.1} %", 100.0 * t.gain),
            format!("{:.1e}", t.p_value),
            format!("{:.0} %", 100.0 * t.visible),
            t.size
                .map_or("-".to_owned(), |s| format!("{:.1} %", 100.0 * s)),
        ]);
    }
    Section::new("Evidence")
        .text(&format!(
            "{} candidates were tested against the fitted base model.",
            answer.n_candidates
        ))
        .table(table)
}

fn gap(answer: &Answer) -> Section {
    let mut section = Section::new("Held-out recordings, before and after");
    for note in &answer.gap.notes {
        section = section.text(note);
    }
    let mut table = Table::new(
        "Errors by channel",
        &["channel", "quantity", "before", "after", "unit"],
    );
    for c in &answer.gap.channels {
        table.push(vec![
            c.channel.clone(),
            c.quantity.clone(),
            number(c.before),
            number(c.after),
            c.unit.clone(),
        ]);
    }
    section = section.table(table);
    let units: Vec<&String> = answer.gap.rollout.iter().map(|r| &r.unit).collect();
    let mut seen: Vec<&String> = Vec::new();
    for unit in units {
        if seen.contains(&unit) {
            continue;
        }
        seen.push(unit);
        let own: Vec<_> = (answer.gap.rollout.iter())
            .filter(|r| r.unit == *unit && r.horizon_s.is_some())
            .collect();
        if own.len() > 1 {
            let x = own.iter().filter_map(|r| r.horizon_s).collect();
            section = section.chart(
                Chart::new(
                    &format!("Rollout error ({unit})"),
                    "horizon (s)",
                    &format!("rms ({unit})"),
                    x,
                )
                .series(
                    "before",
                    Line::Solid,
                    own.iter().map(|r| r.before).collect(),
                )
                .series(
                    "after",
                    Line::Solid,
                    own.iter().map(|r| r.after).collect(),
                ),
            );
        }
    }
    section
}

fn untested(answer: &Answer) -> Section {
    let mut table = Table::new(
        "What these recordings cannot tell",
        &["effect", "where", "why", "shown by"],
    );
    for u in &answer.untestable {
        table.push(vec![
            u.name.clone(),
            u.at.join(", "),
            u.reason.clone(),
            u.behaviours.join(", "),
        ]);
    }
    let mut section = Section::new("Not testable, and the next experiment").table(table);
    if let Some(next) = &answer.next_experiment {
        section = section.text(&format!(
            "Next: {} (for {}{}); behaviours: {}.",
            next.motion,
            next.effects.join(", "),
            promised(next),
            next.behaviours.join(", ")
        ));
        if !next.expected.is_empty() {
            let mut table = Table::new(
                "What simulated motions, as long as the recorded, would tell",
                &["motion", "ln odds"],
            );
            for e in &next.expected {
                table.push(vec![e.motion.clone(), number(e.log_odds)]);
            }
            section = section.table(table);
        }
    }
    section
}
