//! Learning curves: reward, and distance in evaluations, against iterations.

use std::path::Path;

use super::super::table::mean;
use super::super::{Case, ReproduceError, Study, policies};
use super::{colour, figure};
use crate::report::{Curve, Panel, Panels, Section, Stroke};
use crate::run_dir::METRICS_FILE;

/// What is drawn: column, title, unit.
const COLUMNS: [[&str; 3]; 3] = [
    ["reward", "Mean reward a control step", ""],
    [
        "final_distance_cm",
        "Object to goal at the end of a trajectory",
        "cm",
    ],
    ["eval_distance_cm", "Spiral, mean policy, true mass", "cm"],
];

/// One curve a seed, pale, and their mean.
///
/// # Errors
/// The metrics of a run cannot be read.
pub fn curve(study: &Study) -> Result<Section, ReproduceError> {
    let mut panels: Vec<Panel> = COLUMNS
        .iter()
        .map(|[_, title, unit]| Panel::new(title, "iteration", unit))
        .collect();
    for case in Case::ALL {
        for ([column, ..], panel) in COLUMNS.iter().zip(&mut panels) {
            let mut seeds = Vec::new();
            for seed in &study.seeds {
                let file = policies::folder(study, case, *seed).join(METRICS_FILE);
                seeds.push(points(&file, column, study.iterations())?);
            }
            let c = colour(case);
            let middle = Curve::new(case.label(), c, Stroke::Thick, means(&seeds));
            let seeds = seeds
                .into_iter()
                .map(|p| Curve::new("", c, Stroke::Faint, p));
            panel.curves.extend(seeds);
            panel.curves.push(middle);
        }
    }
    let steps =
        study.base.train.trajectories * study.base.horizon() * study.base.train.control_hold;
    let caption = format!(
        "Mean of {} seeds (thick) and each of them. An iteration is {} trajectories of {} s, {:.0} thousand physics \
         steps. The incorrect and ensemble policies learn with heavier objects; the spiral is always followed with \
         {} kg.",
        study.seeds.len(),
        study.base.train.trajectories,
        study.base.train.trajectory_s,
        1e-3 * steps as f64,
        super::super::TRUE_MASS_KG
    );
    let panels = Panels {
        columns: 3,
        panel_size: (380, 330),
        panels,
    };
    Ok(
        Section::new("Learning curves").figure(figure(
            "curve",
            "Learning curves",
            &caption,
            panels,
        )),
    )
}

/// Iteration and value of a column, where it has one.
fn points(file: &Path, column: &str, last: u64) -> Result<Vec<[f64; 2]>, ReproduceError> {
    let failed = |reason: String| ReproduceError::File {
        file: file.to_owned(),
        reason,
    };
    let mut reader = csv::Reader::from_path(file).map_err(|e| failed(e.to_string()))?;
    let headers = reader.headers().map_err(|e| failed(e.to_string()))?;
    let Some(place) = headers.iter().position(|h| h == column) else {
        return Err(failed(format!("has no column `{column}`")));
    };
    let mut points = Vec::new();
    for row in reader.records() {
        let row = row.map_err(|e| failed(e.to_string()))?;
        let number = |i: usize| row.get(i).and_then(|cell| cell.parse::<f64>().ok());
        if let (Some(iteration), Some(value)) = (number(0), number(place))
            && iteration <= last as f64
        {
            points.push([iteration, value]);
        }
    }
    Ok(points)
}

/// Mean at every abscissa that all curves have.
fn means(curves: &[Vec<[f64; 2]>]) -> Vec<[f64; 2]> {
    let Some(first) = curves.first() else {
        return Vec::new();
    };
    let at = |x: f64| -> Option<f64> {
        let of = |c: &Vec<[f64; 2]>| c.iter().find(|p| p[0] == x).map(|p| p[1]);
        let values: Option<Vec<f64>> = curves.iter().map(of).collect();
        values.map(|v| mean(&v))
    };
    let all = first.iter().filter_map(|[x, _]| Some([*x, at(*x)?]));
    all.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_need_every_curve() {
        let curves = [
            vec![[1.0, 2.0], [2.0, 4.0], [3.0, 9.0]],
            vec![[1.0, 4.0], [3.0, 1.0]],
        ];
        assert_eq!(means(&curves), [[1.0, 3.0], [3.0, 5.0]]);
    }
}
