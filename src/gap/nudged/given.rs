//! Effects that are given instead of searched for, by pulled simulations.

use super::forward::without;
use super::judge::{Judge, Problems};
use super::refit::Fitted;
use super::{STRETCH, begin, held, pulls, screen, settled};
use crate::gap::given::{Oracle, least};
use crate::gap::result::Gap;
use crate::gap::run::Input;
use crate::gap::stages::Keeper;
use crate::gap::{GapError, Watch, is_place};

/// As [`crate::gap::with_effects`], by simulations that are pulled at `hz`.
pub(in crate::gap) fn with_effects(
    input: &Input<'_>,
    hz: f64,
    effects: &[(String, String)],
    keeper: &mut dyn Keeper,
    watch: &mut Watch<'_>,
) -> Result<Option<Oracle>, GapError> {
    let problems = Problems::new(input)?;
    let (mut judge, base) = begin(input, &problems, hz, keeper, watch)?;
    let length_s = STRETCH / hz;
    let before = held(&judge, &base, length_s)?;
    let Some(fitted) = fitted(&judge, &base, effects, watch)? else {
        return Ok(None);
    };
    let detectability = detectability(&judge, &base, &fitted)?;
    let (fitted, _) = settled(&mut judge, fitted, watch)?;
    let after = held(&judge, &fitted, length_s)?;
    let holdout = before.zip(after).map(|gap| pulls(hz, gap));
    Ok(Some(Oracle {
        gap: Gap {
            holdout,
            ..Gap::default()
        },
        detectability,
    }))
}

/// See [`Oracle::detectability`].
fn detectability(
    judge: &Judge<'_>,
    base: &Fitted,
    fitted: &Fitted,
) -> Result<Option<f64>, GapError> {
    let n = fitted.point.written.len();
    let costs: Vec<Option<f64>> = if n == 1 {
        vec![Some(base.cost)]
    } else {
        let each = (0..n).map(|i| Ok(without(judge, fitted, i)?.map(|f| f.cost)));
        each.collect::<Result<_, GapError>>()?
    };
    Ok(least(fitted.cost, costs))
}

/// The base model with all effects, fitted from what is expected of each alone; none where one of them cannot act or be said.
fn fitted(
    judge: &Judge<'_>,
    base: &Fitted,
    effects: &[(String, String)],
    watch: &mut Watch<'_>,
) -> Result<Option<Fitted>, GapError> {
    let names: Vec<String> = effects.iter().map(|e| e.0.clone()).collect();
    let screened = screen::screen(judge, base, &names, watch)?;
    let mut chosen = Vec::new();
    for (name, place) in effects {
        let found = screened
            .iter()
            .find(|c| c.effect().about().name == name && is_place(&c.place().to_string(), place));
        let Some(c) = found else { return Ok(None) };
        chosen.push(c.chosen());
    }
    match judge.with(&base.point, &chosen) {
        Some(start) => judge.refit(start, &base.ensemble.slopes),
        None => Ok(None),
    }
}
