//! Combinations of parameters that recordings cannot tell apart, in words.
//!
//! The information, in units of the parameters' sizes (a factor e on log scales), has small eigenvalues in directions
//! that hardly change any measurement. A basis of these directions with as many zeros as possible (Gauss-Jordan
//! elimination with full pivoting) separates what belongs together: one direction with equal weights on two
//! logarithms says that only their ratio is known.

use nalgebra::{DMatrix, SymmetricEigen};
use serde::Serialize;

use super::parameter::{Parameter, Scale};

/// Spread along a direction, in sizes, from which it counts as unknown.
const UNKNOWN: f64 = 0.3;
/// Weight relative to the largest that belongs to a direction.
const PART: f64 = 0.1;
/// How alike two weights are that count as equal.
const EQUAL: f64 = 0.1;

/// A direction in the parameters that the recordings do not determine.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Combination {
    /// the sentence
    pub text: String,
    /// addresses
    pub parameters: Vec<String>,
    /// change of each along the direction, in its size; the largest is 1
    pub weights: Vec<f64>,
}

/// The directions of which `information` (scaled by the parameters' sizes) knows little.
pub(super) fn combinations(
    parameters: &[&Parameter],
    information: &DMatrix<f64>,
) -> Vec<Combination> {
    let n = parameters.len();
    if n == 0 {
        return Vec::new();
    }
    let eigen = SymmetricEigen::new(information.clone());
    let unknown: Vec<usize> = (0..n)
        .filter(|&i| eigen.eigenvalues[i] < UNKNOWN.powi(-2))
        .collect();
    let mut basis = DMatrix::from_fn(unknown.len(), n, |r, c| eigen.eigenvectors[(c, unknown[r])]);
    reduce(&mut basis);
    let mut out: Vec<Combination> = (0..basis.nrows())
        .map(|r| {
            let row: Vec<f64> = basis.row(r).iter().copied().collect();
            describe(parameters, &row)
        })
        .collect();
    out.sort_by_key(|c| {
        parameters
            .iter()
            .position(|p| Some(&p.name) == c.parameters.first())
    });
    out
}

/// Gauss-Jordan elimination with full pivoting: each row has a column of its own.
fn reduce(basis: &mut DMatrix<f64>) {
    let (rows, columns) = basis.shape();
    let mut free: Vec<usize> = (0..columns).collect();
    for r in 0..rows {
        let candidates = (r..rows).flat_map(|i| free.iter().map(move |&j| (i, j)));
        let best = candidates.max_by(|a, b| basis[*a].abs().total_cmp(&basis[*b].abs()));
        let Some((i, j)) = best.filter(|&at| basis[at] != 0.0) else {
            return;
        };
        basis.swap_rows(r, i);
        free.retain(|&c| c != j);
        let pivot = basis[(r, j)];
        basis.row_mut(r).iter_mut().for_each(|v| *v /= pivot);
        for other in (0..rows).filter(|&o| o != r) {
            let factor = basis[(other, j)];
            for c in 0..columns {
                basis[(other, c)] -= factor * basis[(r, c)];
            }
        }
    }
}

fn describe(parameters: &[&Parameter], direction: &[f64]) -> Combination {
    let largest = direction
        .iter()
        .fold(0.0_f64, |m, v| if v.abs() > m.abs() { *v } else { m });
    let parts: Vec<(&Parameter, f64)> = (parameters.iter().zip(direction))
        .map(|(p, v)| (*p, v / largest))
        .filter(|(_, v)| v.abs() > PART)
        .collect();
    let text = match parts.as_slice() {
        [(p, _)] => format!("{} is not determined by the recordings", words(p)),
        [a, b] => pair(*a, *b),
        parts => several(parts),
    };
    Combination {
        text,
        parameters: parts.iter().map(|(p, _)| p.name.clone()).collect(),
        weights: parts.iter().map(|(_, v)| *v).collect(),
    }
}

fn pair(a: (&Parameter, f64), b: (&Parameter, f64)) -> String {
    let names = format!("{} and {}", words(a.0), words(b.0));
    let alike = |x: f64, y: f64| (x.abs() / y.abs()).ln().abs() < EQUAL;
    let (da, db) = (a.1 * a.0.typical, b.1 * b.0.typical); // in units, where linear
    let kind = if a.0.scale == Scale::Linear && b.0.scale == Scale::Linear && alike(da, db) {
        if da * db > 0.0 { "difference" } else { "sum" }
    } else if alike(a.1, b.1) && relative(a.0) && relative(b.0) {
        if growth(a) * growth(b) > 0.0 {
            "ratio"
        } else {
            "product"
        }
    } else {
        return several(&[a, b]);
    };
    format!("{names} only as a {kind}")
}

/// Whether a change by the parameter's size is one by its own value.
fn relative(p: &Parameter) -> bool {
    p.scale == Scale::Log || p.start.abs() >= p.typical
}

/// Part by which the magnitude grows along the direction.
fn growth((p, weight): (&Parameter, f64)) -> f64 {
    match p.scale {
        Scale::Log => weight,
        Scale::Linear => weight * p.start.signum(),
    }
}

/// What makes up for what.
fn several(parts: &[(&Parameter, f64)]) -> String {
    let change = |part: &(&Parameter, f64), base: f64| {
        let (p, part) = (part.0, 0.1 * part.1 / base);
        if relative(p) {
            format!("{} {:+.0} %", words(p), 100.0 * growth((p, part)))
        } else {
            let text = format!("{} {:+.2e} {}", words(p), part * p.typical, p.unit);
            text.trim_end().to_owned()
        }
    };
    let base = parts[0].1;
    let others: Vec<String> = parts[1..].iter().map(|p| change(p, base)).collect();
    format!(
        "a change of {} is made up for by {}",
        change(&parts[0], base),
        others.join(" and ")
    )
}

/// `mass of p0_upper` for `body/p0_upper mass`.
pub(super) fn words(p: &Parameter) -> String {
    match p.name.split_once(' ') {
        Some((element, attribute)) => {
            let name = element.split_once('/').map_or(element, |(_, name)| name);
            format!("{attribute} of {name}")
        }
        None => p.name.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mujoco::Model;
    use crate::sysid::parameter::{ParameterRule, Parameters};

    const MODEL: &str = r#"<mujoco><worldbody>
      <body name="a"><joint name="ja" damping="1"/><geom size=".1" mass="1"/></body>
      <body name="b" pos="1 1 0"><joint name="jb" damping="1"/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><motor name="m" joint="ja" gear="2"/></actuator></mujoco>"#;

    fn parameters() -> Parameters {
        let model = Model::from_xml_str(MODEL).expect("loads");
        let rule = |element: &str, attribute: &str| ParameterRule {
            components: if attribute == "gear" { vec![0] } else { vec![] },
            ..ParameterRule::new(element, attribute)
        };
        let rules = [
            rule("body/a", "mass"),
            rule("body/b", "mass"),
            rule("actuator/m", "gear"),
            rule("joint/*", "damping"),
            ParameterRule {
                components: vec![0, 1],
                ..ParameterRule::new("body/b", "pos")
            },
        ];
        Parameters::new(&model, &rules, &[]).expect("fits")
    }

    /// Information of measurements that are the given combinations (rows), very exact.
    fn of(rows: &[[f64; 7]]) -> Vec<String> {
        let parameters = parameters();
        let free: Vec<&Parameter> = parameters.iter_free().collect();
        let a = DMatrix::from_fn(rows.len(), 7, |i, j| 1e4 * rows[i][j] * free[j].typical);
        let found = combinations(&free, &(a.transpose() * a));
        found.into_iter().map(|c| c.text).collect()
    }

    #[test]
    fn says_what_is_known_only_together() {
        // mass a / gear, mass b · damping ja, position difference, nothing of damping jb
        let texts = of(&[
            [1., 0., -0.5, 0., 0., 0., 0.],
            [0., 1., 0., 1., 0., 0., 0.],
            [0., 0., 0., 0., 0., 1., -1.],
        ]);
        assert_eq!(
            texts,
            [
                "mass of a and gear[0] of m only as a ratio",
                "mass of b and damping of ja only as a product",
                "damping of jb is not determined by the recordings",
                "pos[0] of b and pos[1] of b only as a difference",
            ]
        );
    }

    #[test]
    fn unequal_and_larger_groups_are_spelled_out() {
        let every = |rows: &[[f64; 7]]| {
            let mut all = rows.to_vec();
            for j in 3..7 {
                let mut row = [0.0; 7];
                row[j] = 1.0;
                all.push(row);
            }
            of(&all)
        };
        // a² b is all that is known of two, and the third is known
        let texts = every(&[[2., 1., 0., 0., 0., 0., 0.], [0., 0., 1., 0., 0., 0., 0.]]);
        assert_eq!(
            texts,
            ["a change of mass of a +10 % is made up for by mass of b -20 %"]
        );
        // two of three: they grow together
        let texts = every(&[
            [1., -1., 0., 0., 0., 0., 0.],
            [0., 1., -0.5, 0., 0., 0., 0.],
        ]);
        assert_eq!(
            texts,
            [
                "a change of mass of a +10 % is made up for by mass of b +10 % and gear[0] of m +10 %"
            ]
        );
        assert!(
            every(&[
                [1., 0., 0., 0., 0., 0., 0.],
                [0., 1., 0., 0., 0., 0., 0.],
                [0., 0., 1., 0., 0., 0., 0.]
            ])
            .is_empty()
        );
    }
}
