//! Effects that are one law by two names.
//!
//! Dry friction that differs with direction holds a joint by anything between −(f + a) and f − a, and so does friction f beside an
//! offset of −a, up to a = f: friction never drives. No motion tells them apart, whatever fits of a joint that sticks make of
//! either. The other name belongs to the class at no distance, without a fit, and there is nothing to simulate. Where the friction was
//! found, one cause of both is likelier than two that meet in a joint: the variety takes the offset's place, if it can be fitted
//! as well.

use super::alike::{apart, price};
use super::effect::{CATALOGUE, DRY, Effect, named};
use super::inputs::is_wanted;
use super::model::Chosen;
use super::name::APART;
use super::search::Search;
use super::{GapError, Watch, repair};

impl Search<'_> {
    /// Effect `i` by its other name, if it has one where it is, in the size that it has.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn by_other_name(&self, i: usize) -> Result<Option<Chosen>, GapError> {
        let own = &self.chosen[i];
        let Some(other) = self.other_name(own) else {
            return Ok(None);
        };
        let fitted = repair::machine(&self.windows.problem, &self.x)?.model;
        Ok((own.values[0].abs() <= own.place.dry_level(&fitted)).then_some(other))
    }

    /// The same, however large it is.
    fn other_name(&self, own: &Chosen) -> Option<Chosen> {
        let (model, place) = (&self.built.file.model, &own.place);
        if !place.is_dry(model) {
            return None;
        }
        let by = |effect: &'static dyn Effect, size: f64| {
            let mut values = vec![0.0; effect.about().parameters.len()];
            *values.first_mut()? = size;
            let asked = is_wanted(&self.effects, effect.about().name);
            (asked && effect.places(model).contains(place)).then(|| Chosen {
                effect,
                place: place.clone(),
                values,
            })
        };
        let size = *own.values.first()?;
        if let Some((name, per_own)) = own.effect.in_dry_joints() {
            return by(named(name)?, per_own * size);
        }
        CATALOGUE.iter().find_map(|effect| {
            let (name, per_own) = effect.in_dry_joints()?;
            (name == own.effect.about().name).then(|| by(*effect, size / per_own))?
        })
    }

    /// Gives effect `i` its `other` name where that puts it and the dry friction that was found beside it down to one cause; whether
    /// it did.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn one_cause(
        &mut self,
        i: usize,
        other: &Chosen,
        watch: &mut Watch<'_>,
    ) -> Result<bool, GapError> {
        if !other.effect.about().is_variety() || !self.has(DRY, &other.place) {
            return Ok(false);
        }
        self.exchange_if_as_good(i, other.clone(), watch)
    }

    /// Puts another effect in the place of effect `i` where it can be fitted as well; whether it did.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn exchange_if_as_good(
        &mut self,
        i: usize,
        instead: Chosen,
        watch: &mut Watch<'_>,
    ) -> Result<bool, GapError> {
        let Some(fitted) = self.fitted_instead(i, instead, f64::INFINITY, watch)? else {
            return Ok(false);
        };
        let is_as_good = apart(price(fitted.cost, &fitted.x), price(self.cost, &self.x)) < APART;
        if is_as_good {
            *self = self.settled_with(fitted, watch)?;
        }
        Ok(is_as_good)
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::masses::{chosen, found, machine, searching};

    /// Friction found beside an offset is friction that differs with direction, not so where it was known.
    #[test]
    fn friction_and_an_offset_are_one_cause() {
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        for known in [false, true] {
            let base = machine(if known { r#"frictionloss=".15""# } else { "" }, "");
            let hidden = machine(r#"frictionloss=".15""#, "");
            let law = chosen(&hidden, "torque_offset", "a", &[-0.06]);
            let hidden = crate::gap::effect::write(&hidden, law.effect, &law.place, &law.values);
            searching(
                &base,
                &hidden.expect("written").file,
                config,
                |search, watch| {
                    let mut effects = vec![chosen(&base, "torque_offset", "a", &[-0.05])];
                    if !known {
                        effects.insert(0, chosen(&base, "coulomb_friction", "a", &[0.1]));
                    }
                    found(search, &effects, watch);
                    let screen = search.screen(watch).expect("screened").expect("whole");
                    search
                        .tell_apart(&screen, (None, false), watch)
                        .expect("told");
                    let last = search.chosen.last().expect("an effect");
                    let names = ["asymmetric_friction", "torque_offset"];
                    let (own, other) = (names[usize::from(known)], names[usize::from(!known)]);
                    assert_eq!(last.effect.about().name, own);
                    let size = if known { -0.06 } else { 0.06 };
                    assert!((last.values[0] - size).abs() < 1e-3, "{:?}", last.values);
                    let alike = &search.evidence.last().expect("evidence").alike;
                    let said: Vec<_> = alike.iter().map(|rival| rival.said().name).collect();
                    assert!(said.iter().any(|name| name == other), "{said:?}");
                },
            );
        }
    }

    /// Without friction an offset is nothing else.
    #[test]
    fn smooth_joints_tell() {
        let base = machine("", "");
        searching(&base, &base, "", |search, watch| {
            found(
                search,
                &[chosen(&base, "torque_offset", "a", &[0.05])],
                watch,
            );
            assert!(search.by_other_name(0).expect("a model").is_none());
        });
    }

    /// Friction never drives, an offset larger than it does.
    #[test]
    fn large_offsets_tell() {
        let base = machine(r#"frictionloss=".04""#, "");
        for (size, is_one) in [(0.03, true), (0.05, false)] {
            let law = chosen(&base, "torque_offset", "a", &[size]);
            let hidden = crate::gap::effect::write(&base, law.effect, &law.place, &law.values);
            searching(
                &base,
                &hidden.expect("written").file,
                "",
                |search, watch| {
                    found(search, std::slice::from_ref(&law), watch);
                    let other = search.by_other_name(0).expect("a model");
                    assert_eq!(other.is_some(), is_one);
                },
            );
        }
    }
}
