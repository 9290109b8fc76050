//! What each effect at each place is expected to do, from the columns of a screen.
//!
//! An effect of several sizes, as a tilt about two axes, may show in one of them alone: across the plane that an arm moves in gravity's
//! turn is seen by its square, and what is expected of it by its slope may be senseless. Where the sizes that make sense gain nearly
//! all that the effect would, it is judged by them, and a fit starts from the usual size of the others.

use nalgebra::DVector;

use super::effect::{Effect, Place, Sign};
use super::linear::{Column, Linear};
use super::model::{Chosen, Measured, Variant};
use super::score::{Normal, Score};
use crate::mujoco::Model;

/// Part of what an effect gains that its sizes that make sense gain alone.
const NEARLY: f64 = 0.9;
/// Part of a response that a channel must show to count.
const SHOWN: f64 = 0.1;

/// An effect at a place, with what it would explain.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    pub effect: &'static dyn Effect,
    pub place: Place,
    /// expected values, one a parameter
    pub values: Vec<f64>,
    /// index of its columns in the screen
    pub columns: Vec<usize>,
    /// the parameter that each stands for
    pub parameters: Vec<usize>,
    /// none: nothing of it can be seen
    pub score: Option<Score>,
    /// length of its response over that of the motors', where it shows most; none without motors
    pub size: Option<f64>,
    /// whether the expected values make sense
    pub sensible: bool,
    /// the same with other shapes that make sense, best first
    pub others: Vec<Candidate>,
}

impl Candidate {
    /// Itself and its other shapes.
    pub(super) fn shapes(&self) -> impl Iterator<Item = &Self> {
        std::iter::once(self).chain(&self.others)
    }

    /// As it is expected.
    pub(super) fn chosen(&self) -> Chosen {
        self.with(self.values.clone())
    }

    /// With these values, one a parameter.
    pub(super) fn with(&self, values: Vec<f64>) -> Chosen {
        Chosen {
            effect: self.effect,
            place: self.place.clone(),
            values,
        }
    }
}

/// What candidates are made from.
pub(super) struct Table<'a> {
    pub model: &'a Model,
    pub measured: &'a Measured,
    pub columns: &'a [Column],
    pub normal: &'a Normal,
    pub linear: &'a Linear,
    /// squared length of what the motors do to each channel; none without motors
    pub motors: Option<&'a [f64]>,
}

impl Table<'_> {
    /// The candidate whose columns are `own`, of `variant`.
    pub(super) fn candidate(
        &self,
        effect: &'static dyn Effect,
        place: &Place,
        variant: Variant,
        own: Vec<usize>,
    ) -> Candidate {
        let parameters = effect.about().parameters;
        let scales = self.measured.scales(self.model, place);
        let mut values = variant.columns[0].1.clone();
        for (&i, (_, own)) in variant.parameters.iter().zip(&variant.columns) {
            values[i] = own[i];
        }
        let mut judged = (variant, own);
        let mut score = self.normal.score(&judged.1);
        let mut sensible = true;
        if let Some(whole) = &score {
            let kept = judged.0.sensible(parameters, &whole.expected, &scales);
            sensible = kept.len() == judged.1.len();
            if !sensible
                && let Some((shown, part)) = self.shown(&judged, &kept, whole.gain)
                && shown.0.makes_sense(parameters, &part.expected, &scales)
            {
                for (&i, beta) in judged.0.parameters.iter().zip(&whole.expected) {
                    if parameters[i].sign == Sign::Either {
                        values[i] = values[i].copysign(*beta);
                    }
                }
                (judged, score, sensible) = (shown, Some(part), true);
            }
        }
        let (variant, own) = judged;
        if let Some(score) = &score {
            for (&i, beta) in variant.parameters.iter().zip(&score.expected) {
                if !parameters[i].is_whole() {
                    values[i] = *beta;
                }
            }
        }
        Candidate {
            effect,
            place: place.clone(),
            values,
            size: score.as_ref().and_then(|score| self.size(&own, score)),
            columns: own,
            parameters: variant.parameters,
            score,
            sensible,
            others: Vec::new(),
        }
    }

    /// A variant's columns `kept` alone, and their score, if they gain nearly what all do, `gain`.
    fn shown(
        &self,
        (variant, own): &(Variant, Vec<usize>),
        kept: &[usize],
        gain: f64,
    ) -> Option<((Variant, Vec<usize>), Score)> {
        let columns: Vec<usize> = kept.iter().map(|i| own[*i]).collect();
        let part = (!columns.is_empty()).then(|| self.normal.score(&columns))??;
        (part.gain >= NEARLY * gain).then(|| ((variant.only(kept), columns), part))
    }

    /// Length of the response over that of the motors'.
    fn size(&self, own: &[usize], score: &Score) -> Option<f64> {
        let motors = self.motors?;
        let response: Vec<DVector<f64>> = (0..self.linear.rows.len())
            .map(|w| {
                let mut sum = self.columns[own[0]].parts[w].clone() * score.expected[0];
                for (c, beta) in own.iter().zip(&score.expected).skip(1) {
                    sum.axpy(*beta, &self.columns[*c].parts[w], 1.0);
                }
                sum
            })
            .collect();
        largest_part(&self.linear.by_channel(&response), motors)
    }
}

/// The one of a candidate's shapes that gains most where it was not estimated, with the others.
pub(super) fn best_shape(mut all: Vec<Candidate>) -> Option<Candidate> {
    let held = |c: &Candidate| {
        let score = c.score.as_ref().filter(|_| c.sensible);
        score.map_or(f64::NEG_INFINITY, |s| s.held_gain)
    };
    all.sort_by(|a, b| held(b).total_cmp(&held(a)));
    let mut shapes = all.into_iter();
    let best = shapes.next()?;
    Some(Candidate {
        others: shapes.filter(|c| held(c) > 0.0).collect(),
        ..best
    })
}

/// Length of a response over that of the motors, of the channel where it is largest among those that show most of it:
/// what motors do elsewhere, as to an object they throw, says nothing of its size. None where motors do nothing.
pub(super) fn largest_part(response: &[f64], motors: &[f64]) -> Option<f64> {
    let total: f64 = response.iter().sum();
    let shown = response
        .iter()
        .zip(motors)
        .filter(|(r, m)| **r >= SHOWN * total && **m > 0.0);
    shown.map(|(r, m)| (r / m).sqrt()).reduce(f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::effect::named;
    use crate::gap::linear::{Row, squares};
    use crate::gap::masses::{machine, searching};
    use crate::gap::model::variants;

    /// An arm in a vertical plane: of a tilt across it hardly anything shows, and 0.6 rad of it were expected.
    #[test]
    fn a_size_that_hardly_shows_may_be_senseless() {
        const TILT: [f64; 2] = [0.7, 0.05];
        let tilt = named("gravity_tilt").expect("in the catalogue");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        let base = machine("", "");
        searching(&base, &base, config, |search, _| {
            let found = |across: f64| {
                let mut linear = search.windows.linearise(&search.x).expect("linear");
                let columns = [across, 100.0].map(|size| {
                    // what is across is as often with the plane as against it
                    let turned = |i: usize| {
                        if size == across && i % 2 == 1 {
                            -size
                        } else {
                            size
                        }
                    };
                    let of = |row: &Row| DVector::from_fn(row.residual.len(), |i, _| turned(i));
                    let parts: Vec<_> = linear.rows.iter().map(of).collect();
                    let raw = squares(&parts);
                    Column { parts, raw }
                });
                for (column, by) in columns.iter().zip(TILT) {
                    for (row, part) in linear.rows.iter_mut().zip(&column.parts) {
                        row.residual.axpy(-by, part, 1.0);
                    }
                }
                let normal = Normal::new(&linear.rows, &columns, &search.stretch_of, &[(0.0, 0.0)]);
                let table = Table {
                    model: &base.model,
                    measured: &search.measured,
                    columns: &columns,
                    normal: &normal,
                    linear: &linear,
                    motors: None,
                };
                let place = Place::world();
                let scales = search.measured.scales(&base.model, &place);
                let variant = variants(tilt.about().parameters, &scales).remove(0);
                table.candidate(tilt, &place, variant, vec![0, 1])
            };
            let along = found(1.0);
            assert!(along.sensible && along.columns == [1] && along.parameters == [1]);
            assert!((along.values[1] - TILT[1]).abs() < 1e-3, "{along:?}");
            assert!(along.values[0] > 0.0 && along.values[0] < 0.1, "{along:?}");
            let both = found(10.0);
            assert!(!both.sensible && both.columns == [0, 1], "{both:?}");
        });
    }

    #[test]
    fn a_size_is_judged_where_it_shows() {
        // squared lengths of a joint's channel and of an object's that motors throw far
        let (friction, motors) = ([4.0, 0.2], [100.0, 1e12]);
        assert_eq!(largest_part(&friction, &motors), Some(0.2));
        // seen at the object alone it is as small as it looks
        assert_eq!(largest_part(&[0.0, 1e8], &motors), Some(0.01));
        assert_eq!(largest_part(&friction, &[0.0, 0.0]), None);
    }
}
