//! The spiral from above, and the distance over time.

use super::super::table::{Evaluated, Rollout, mean};
use super::super::{Case, Study};
use super::{STAND_IN, colour, figure};
use crate::report::{Curve, Panel, Panels, Section, Stroke};
use crate::rig::tracking::Place;

/// Rollouts of a kind.
type Pick = fn(&Evaluated) -> &Vec<Rollout>;

/// Paths of all rollouts of the first seed's policies, in simulation and on the rig, and their mean distance over time.
pub fn spiral(study: &Study, results: &[Evaluated]) -> Section {
    let seed = study.first_seed();
    let mut panels = Vec::new();
    let places: [(&str, Pick); 2] = [
        ("simulation", |r| &r.simulation),
        ("virtual rig", |r| &r.machine),
    ];
    for (name, pick) in places {
        let mut errors = Panel::new(&format!("Distance, {name}"), "time (s)", "cm");
        for case in Case::ALL {
            let Some(result) = results.iter().find(|r| r.case == case && r.seed == seed) else {
                continue;
            };
            let rollouts = pick(result);
            let mut panel = Panel::new(&format!("{}, {name}", case.label()), "x (cm)", "y (cm)");
            panel.equal = true;
            for rollout in rollouts {
                let object = rollout.path.iter().map(|p| p.object_m.map(|x| 100.0 * x));
                panel.curves.push(Curve::new(
                    "",
                    colour(case),
                    Stroke::Faint,
                    object.collect(),
                ));
            }
            if let Some(rollout) = rollouts.first() {
                let target = rollout.path.iter().map(|p| p.target_m.map(|x| 100.0 * x));
                panel
                    .curves
                    .push(Curve::new("", 0, Stroke::Thick, target.collect()));
            }
            panels.push(panel);
            errors.curves.push(Curve::new(
                case.name(),
                colour(case),
                Stroke::Thin,
                mean_distance(rollouts),
            ));
        }
        errors.y_range = Some([0.0, highest(&errors)]);
        panels.push(errors);
    }
    let caption = format!(
        "Object (coloured, {} rollouts) and target (black) from above; right: distance at each time, mean over the \
         rollouts. Policies of seed {seed}, object of {} kg. {STAND_IN} Each of its rollouts is on another machine of \
         the family; places are those the motion capture saw, with its noise, offset and late clock.",
        study.n_rollout,
        super::super::TRUE_MASS_KG
    );
    let panels = Panels {
        columns: 4,
        panel_size: (300, 300),
        panels,
    };
    let figure = figure("spiral", "Following the spiral", &caption, panels);
    Section::new("Spiral").figure(figure)
}

/// Mean over the rollouts that got as far.
fn mean_distance(rollouts: &[Rollout]) -> Vec<[f64; 2]> {
    let longest = rollouts.iter().map(|r| r.path.len()).max().unwrap_or(0);
    let at = |i: usize| {
        let there: Vec<&Place> = rollouts.iter().filter_map(|r| r.path.get(i)).collect();
        let column =
            |f: &dyn Fn(&Place) -> f64| mean(&there.iter().map(|p| f(p)).collect::<Vec<_>>());
        [column(&|p| p.time_s), column(&Place::distance_cm)]
    };
    (0..longest).map(at).collect()
}

fn highest(panel: &Panel) -> f64 {
    let points = panel.curves.iter().flat_map(|c| &c.points);
    1.05 * points.map(|p| p[1]).fold(0.1, f64::max)
}
