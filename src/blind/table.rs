//! Scores of a suite as a table: one row an arm, effect, severity and noise.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use statrs::statistics::{Data, OrderStatistics};

use super::score::Scored;

/// Cases of one kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// arm
    pub arm: String,
    /// hidden effect; `*`: all of the arm
    pub effect: String,
    /// factor on amplitudes; none: all
    pub severity: Option<f64>,
    /// factor on noise; none: all
    pub noise: Option<f64>,
    /// least and most detectability (in JSON `null` where there is no most); none: all
    pub between: Option<[f64; 2]>,
    /// cases
    pub n: usize,
    /// part of them where something was found
    pub detected: f64,
    /// part with the right class and nothing else
    pub class: f64,
    /// part with the right first name
    pub exact: f64,
    /// part with the expected answer
    pub right: f64,
    /// 95 % interval of that (Wilson)
    pub right_ci95: [f64; 2],
    /// mean size of classes
    pub class_size: Option<f64>,
    /// part of intervals with the truth, and their number
    pub coverage: Option<(f64, usize)>,
    /// median part of the gap that was closed
    pub closed: Option<f64>,
    /// median detectability
    pub detectability: Option<f64>,
    /// mean seconds of a search
    pub seconds: f64,
}

/// Bounds of detectability: below the first, chance does as much.
const LEVELS: [f64; 5] = [2.0, 4.0, 8.0, 16.0, 32.0];

/// All rows: arms as a whole, then by severity and noise, then by effect; last arms by detectability.
pub fn table(scores: &[Scored]) -> Vec<Row> {
    let mut rows = by_kind(scores);
    let arms: BTreeSet<&str> = scores.iter().map(|s| &*s.arm).collect();
    for arm in arms {
        rows.extend(by_detectability(arm, scores));
    }
    rows
}

/// Cases of an arm in which something is hidden, by how much there is to see of it.
fn by_detectability(arm: &str, scores: &[Scored]) -> Vec<Row> {
    let mut ends = vec![0.0];
    ends.extend(LEVELS);
    ends.push(f64::INFINITY);
    let each = ends.windows(2).filter_map(|end| {
        let inside = |d: f64| (end[0]..end[1]).contains(&d);
        let cases: Vec<&Scored> = (scores.iter())
            .filter(|s| s.arm == arm && s.detectability.is_some_and(inside))
            .collect();
        (!cases.is_empty()).then(|| Row {
            arm: arm.to_owned(),
            effect: "*".to_owned(),
            between: Some([end[0], end[1]]),
            ..row(&cases)
        })
    });
    each.collect()
}

fn by_kind(scores: &[Scored]) -> Vec<Row> {
    type Key = (String, u8, String, String, String);
    let mut groups: BTreeMap<Key, Vec<&Scored>> = BTreeMap::new();
    for s in scores {
        let effect = match &s.truth[..] {
            [] => "-".to_owned(),
            [one] => one.name.clone(),
            _ => "several".to_owned(),
        };
        let (severity, noise) = (s.severity.to_string(), s.noise.to_string());
        for (order, effect, severity, noise) in [
            (0, "*", "", ""),
            (1, "*", &*severity, &*noise),
            (2, &*effect, &*severity, &*noise),
        ] {
            let key = (
                s.arm.clone(),
                order,
                effect.into(),
                severity.into(),
                noise.into(),
            );
            groups.entry(key).or_default().push(s);
        }
    }
    let number = |text: &str| text.parse().ok();
    groups
        .into_iter()
        .map(|((arm, _, effect, severity, noise), s)| Row {
            arm,
            effect,
            severity: number(&severity),
            noise: number(&noise),
            ..row(&s)
        })
        .collect()
}

fn row(s: &[&Scored]) -> Row {
    let n = s.len();
    let part = |f: &dyn Fn(&Scored) -> bool| s.iter().filter(|s| f(s)).count() as f64 / n as f64;
    let sizes: Vec<usize> = s.iter().flat_map(|s| s.class_sizes.clone()).collect();
    let covered: Vec<bool> = (s.iter().flat_map(|s| &s.covered))
        .map(super::Covered::inside)
        .collect();
    let right = part(&|s| s.right);
    Row {
        arm: String::new(),
        effect: String::new(),
        severity: None,
        noise: None,
        between: None,
        n,
        detected: part(&|s| s.detected),
        class: part(&|s| s.class),
        exact: part(&|s| s.exact),
        right,
        right_ci95: wilson(right, n),
        class_size: (!sizes.is_empty())
            .then(|| sizes.iter().sum::<usize>() as f64 / sizes.len() as f64),
        coverage: (!covered.is_empty()).then(|| {
            let inside = covered.iter().filter(|c| **c).count();
            (inside as f64 / covered.len() as f64, covered.len())
        }),
        closed: median(s.iter().filter_map(|s| s.closed).collect()),
        detectability: median(s.iter().filter_map(|s| s.detectability).collect()),
        seconds: s.iter().map(|s| s.seconds).sum::<f64>() / n as f64,
    }
}

fn median(values: Vec<f64>) -> Option<f64> {
    (!values.is_empty()).then(|| Data::new(values).median())
}

/// Interval of a proportion (Wilson 1927), which is right for few cases and near 0 and 1.
fn wilson(p: f64, n: usize) -> [f64; 2] {
    const Z: f64 = 1.959_963_984_540_054; // 97.5 % of the normal distribution
    let n = n as f64;
    let centre = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_of_proportions_solve_their_equation() {
        // the ends are where the observed proportion is Z standard deviations away
        for (k, n) in [(0, 60), (3, 300), (38, 40), (7, 7)] {
            let p = f64::from(k) / f64::from(n);
            for end in wilson(p, n as usize) {
                let sigma = (end * (1.0 - end) / f64::from(n)).sqrt();
                if sigma > 1e-9 {
                    assert!(
                        ((p - end).abs() / sigma - 1.96).abs() < 1e-3,
                        "{k}/{n}: {end}"
                    );
                }
            }
        }
    }

    #[test]
    fn every_case_is_of_one_level() {
        let case = |detectability| Scored {
            case: String::new(),
            arm: "one".into(),
            severity: 1.0,
            noise: 1.0,
            truth: Vec::new(),
            detectability,
            verdict: crate::gap::result::Verdict::None,
            found: Vec::new(),
            class_sizes: Vec::new(),
            detected: false,
            class: false,
            exact: false,
            right: false,
            covered: Vec::new(),
            closed: None,
            remaining: [None; 2],
            seconds: 0.0,
        };
        let scores = [0.0, 1.9, 2.0, 9.0, 1e3].map(|d| case(Some(d)));
        let rows = by_detectability("one", &[&scores[..], &[case(None)]].concat());
        let found: Vec<_> = rows
            .iter()
            .map(|r| (r.between.unwrap_or_default()[0], r.n))
            .collect();
        assert_eq!(found, [(0.0, 2), (2.0, 1), (8.0, 1), (32.0, 1)]);
    }

    #[test]
    fn medians_of_even_and_odd_numbers() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), Some(2.5));
        assert_eq!(median(Vec::new()), None);
    }
}
