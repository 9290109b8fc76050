//! Table 1 beside the paper's, and how much the mass matters.

use super::super::mass;
use super::super::table::{Evaluated, Row, rows};
use super::super::{Case, Study};
use super::{STAND_IN, colour, figure};
use crate::report::{Curve, Panel, Panels, Section, Stroke, Table};

/// The section of the table.
pub fn table1(study: &Study, results: &[Evaluated]) -> Section {
    let rows = rows(results);
    let caption = format!(
        "Mean distance from the target, cm, {} rollouts of each policy, mean ± standard deviation over {} training \
         seeds, {} iterations each. {STAND_IN}",
        study.n_rollout,
        study.seeds.len(),
        study.iterations()
    );
    let mut table = Table::new(
        &caption,
        &[
            "policy",
            "simulation",
            "paper",
            "virtual rig",
            "paper, hardware",
        ],
    );
    let mut differences = Table::new(
        "Less the correct policy of the same seed, cm: mean ± standard error over seeds",
        &[
            "policy",
            "simulation",
            "paper",
            "virtual rig",
            "paper, hardware",
        ],
    );
    for row in &rows {
        table.push(vec![
            row.case.label().to_owned(),
            with_spread(row.simulation_cm, row.simulation_sigma_cm),
            row.paper_cm[0].to_string(),
            with_spread(row.machine_cm, row.machine_sigma_cm),
            row.paper_cm[1].to_string(),
        ]);
        if row.case != Case::Correct {
            differences.push(difference(row));
        }
    }
    let mut masses = Table::new(
        "Mean distance in simulation with objects of other masses, cm, mean over seeds",
        &std::iter::once("policy".to_owned())
            .chain(mass::MASSES_KG.iter().map(|m| format!("{m:.2} kg")))
            .collect::<Vec<_>>()
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>(),
    );
    let mut panel = Panel::new("", "mass of the object in the test (kg)", "cm");
    for case in Case::ALL {
        let means = mass::means(results, case);
        let mut row = vec![case.label().to_owned()];
        row.extend(means.iter().map(|[_, cm]| format!("{cm:.2}")));
        masses.push(row);
        let curve = Curve::new(case.label(), colour(case), Stroke::Thick, means);
        panel.curves.push(curve);
    }
    let title = "Distance against mass in the test";
    let words = "The same policies with objects of other masses, mean over seeds: how much the mass itself matters.";
    let panels = Panels {
        columns: 1,
        panel_size: (620, 320),
        panels: vec![panel],
    };
    Section::new("Table 1")
        .table(table)
        .table(differences)
        .table(masses)
        .figure(figure("masses", title, words, panels))
}

fn difference(row: &Row) -> Vec<String> {
    let correct = Case::Correct.paper_cm();
    let [simulation, machine] = row.less_correct_cm.map(|[mean, error]| {
        format!(
            "{}{}",
            if mean < 0.0 { "" } else { "+" },
            with_spread(mean, error)
        )
    });
    vec![
        row.case.label().to_owned(),
        simulation,
        format!("{:+.2}", row.paper_cm[0] - correct[0]),
        machine,
        format!("{:+.2}", row.paper_cm[1] - correct[1]),
    ]
}

/// A mean with its spread, which one seed alone has not.
fn with_spread(mean: f64, spread: f64) -> String {
    if spread.is_finite() {
        format!("{mean:.2} ± {spread:.2}")
    } else {
        format!("{mean:.2}")
    }
}
