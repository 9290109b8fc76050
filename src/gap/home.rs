//! Where on a link an effect is said to be.
//!
//! Bodies that are fixed to one another are one link: a mass on a forearm, 0.2 m along it, is a mass on the tip that is fixed there.
//! No motion tells one from the other. It is looked for on one of them and said of the nearest ([`Effect::nearest`]), in whose
//! frame its numbers are then fitted once more, as of one law by another name ([`super::one_law`]).
//!
//! [`Effect::nearest`]: super::effect::Effect::nearest

use super::model::Chosen;
use super::search::Search;
use super::{GapError, Watch};

impl Search<'_> {
    /// Takes the effect found last to the body of its link that it is nearest to.
    ///
    /// # Errors
    /// The engine refuses a number; [`GapError::Stopped`].
    pub(super) fn at_home(&mut self, watch: &mut Watch<'_>) -> Result<(), GapError> {
        let Some((i, own)) = self.chosen.iter().enumerate().next_back() else {
            return Ok(());
        };
        // of the base model: what an effect puts into it is no place
        let near = (own.effect).nearest(&self.base.model, &own.place, &own.values);
        let Some((place, values)) = near else {
            return Ok(());
        };
        let there = Chosen {
            effect: own.effect,
            place,
            values,
        };
        self.exchange_if_as_good(i, there, watch)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::effect::{ModelFile, write};
    use crate::gap::masses::{chosen, found, machine, searching};

    /// A mass at the end of a link, 1 cm below the tip that is fixed there.
    #[test]
    fn what_is_at_the_tip_is_said_of_the_tip() {
        let tip =
            r#"<body name="arm"><body name="tip" pos="0 0 .3"><geom size=".01" mass=".1"/></body>"#;
        let xml = machine("", "").xml.replacen("<body>", tip, 1);
        let base = ModelFile::of_text(xml, "link.xml").expect("loads");
        let load = chosen(&base, "payload", "arm", &[0.2, 0.0, 0.0, 0.29]);
        let hidden = write(&base, load.effect, &load.place, &load.values).expect("written");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &hidden.file, config, |search, watch| {
            found(search, &[load], watch);
            search.settle(watch).expect("fitted");
            let before = search.cost;
            search.at_home(watch).expect("fitted");
            let own = &search.chosen[0];
            assert_eq!(own.place.to_string(), "tip");
            assert!((own.values[0] - 0.2).abs() < 2e-3, "{own:?}");
            assert!((own.values[3] + 0.01).abs() < 1e-3, "{own:?}");
            assert!(search.cost < 1.01 * before, "{} {before}", search.cost);
            assert!(search.built.file.xml.contains("tip_payload"));
            // and stays
            let known = own.values.clone();
            search.at_home(watch).expect("looked at");
            assert_eq!(search.chosen[0].values, known);
        });
    }
}
