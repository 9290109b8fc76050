//! The loop as a page.

use super::round::{Round, Tracking};
use super::{AdaptConfig, Objective};
use crate::report::{
    Curve, Drawing, Figure, Panel, Panels, Report, Section, Stroke, Table, number,
};

/// Tracking errors against rounds, and what was identified in each. `references` are names with one figure a round;
/// `lacking` is what the model of the truth has not.
pub fn report(
    config: &AdaptConfig,
    rounds: &[Round],
    references: &[(&str, Vec<Tracking>)],
    lacking: &[&str],
) -> Report {
    let mut report = Report::new("Adaptation to a machine");
    let adapted: Vec<Tracking> = rounds.iter().map(|r| r.tracking.clone()).collect();
    let mut all: Vec<(&str, &[Tracking])> = vec![("adapted", &adapted)];
    all.extend(references.iter().map(|(name, t)| (*name, t.as_slice())));
    report.sections.push(tracking(config, &all, lacking));
    for round in rounds {
        if let Some(section) = identified(round) {
            report.sections.push(section);
        }
    }
    report
}

fn tracking(config: &AdaptConfig, all: &[(&str, &[Tracking])], lacking: &[&str]) -> Section {
    let objective = match config.objective {
        Objective::Mean => "the mean over the models".to_owned(),
        Objective::Epopt(share) => format!("the worst {} % of the trajectories", 100.0 * share),
    };
    let mut columns = vec!["policy".to_owned()];
    let n = all.iter().map(|(_, t)| t.len()).max().unwrap_or(0);
    columns.extend((0..n).map(|i| format!("round {i}")));
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    let caption = format!(
        "Mean distance from the target on the machine, cm, ± standard deviation over {} rollouts",
        config.rollouts
    );
    let mut table = Table::new(&caption, &columns);
    let mut panel = Panel::new("", "round", "cm");
    for (i, (name, trackings)) in all.iter().enumerate() {
        let cell = |k: usize| {
            let one = |t: &Tracking| format!("{:.2} ± {:.2}", t.mean_cm, sigma(&t.rollouts_cm));
            trackings.get(k).map_or(String::new(), one)
        };
        let row = std::iter::once((*name).to_owned()).chain((0..n).map(cell));
        table.push(row.collect());
        let points = trackings.iter().enumerate();
        let points = points.map(|(k, t)| [k as f64, t.mean_cm]).collect();
        panel
            .curves
            .push(Curve::new(name, i, Stroke::Thick, points));
    }
    let mut words = format!(
        "Round 0 is the policy to begin with. Each round trains for {} iterations, for {objective}. `nominal` trains as \
         long on the nominal model, `truth` on the model of the rig's truth. The virtual rig stands in for a machine.",
        config.training.train.iterations
    );
    if !lacking.is_empty() {
        words.push_str(" No model of the engine has this of the truth: ");
        words.push_str(&lacking.join(", "));
        words.push('.');
    }
    let figure = Figure {
        name: "tracking".to_owned(),
        title: "Tracking error on the machine".to_owned(),
        caption: words,
        drawing: Drawing::Panels(Panels {
            columns: 1,
            panel_size: (620, 340),
            panels: vec![panel],
        }),
    };
    Section::new("Tracking").table(table).figure(figure)
}

fn identified(round: &Round) -> Option<Section> {
    let found = round.identified.as_ref()?;
    let caption = format!("Round {}: parameters, with intervals of 95 %", round.number);
    let mut table = Table::new(
        &caption,
        &[
            "parameter",
            "nominal",
            "identified",
            "from",
            "to",
            "truth",
            "unit",
        ],
    );
    for known in &found.parameters {
        let interval = known
            .interval
            .map_or([String::new(), String::new()], |i| i.map(number));
        let [from, to] = interval;
        table.push(vec![
            known.name.clone(),
            number(known.nominal),
            number(known.value),
            from,
            to,
            known.truth.map_or(String::new(), number),
            known.unit.clone(),
        ]);
    }
    let mut words = match found.added.as_slice() {
        [] => "No physics was added to the model.".to_owned(),
        added => format!("Added to the model: {}.", added.join("; ")),
    };
    if !found.converged {
        words.push_str(" The identification has not converged.");
    }
    let heading = format!("Round {}", round.number);
    Some(Section::new(&heading).text(&words).table(table))
}

fn sigma(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let sum: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (sum / (values.len() as f64 - 1.0).max(1.0)).sqrt()
}
