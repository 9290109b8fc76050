//! A model with effects, fitted beside the present one of a search.

use super::model::{Built, Chosen};
use super::search::{ITERATIONS, Search};
use super::windows::Windows;
use super::{GapError, Watch};

/// A model with effects, as a fit left it.
#[derive(Clone)]
pub(super) struct Fitted {
    pub chosen: Vec<Chosen>,
    /// as it was written
    pub written: Vec<Chosen>,
    pub built: Built,
    pub x: Vec<f64>,
    /// cost by itself
    pub itself: f64,
    /// as it is rated beside the model before it, see [`super::late`]
    pub cost: f64,
    pub windows: Windows,
}

/// A model, and the windows that it was fitted to with parameters.
pub(super) type AtHand<'a> = (&'a Built, &'a Windows, &'a [f64]);

impl Fitted {
    /// The fitted model.
    pub(super) fn at_hand(&self) -> AtHand<'_> {
        (&self.built, &self.windows, &self.x)
    }

    /// Goes on with the fit, of a model that is compared with the present one of `search`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn improve(
        &mut self,
        search: &Search<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<(), GapError> {
        self.improve_below(f64::INFINITY, search, watch)
    }

    /// The same, given up where no cost below `bound` is foretold.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn improve_below(
        &mut self,
        bound: f64,
        search: &Search<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<(), GapError> {
        let fit = (self.windows).fit_below(bound, &self.x, ITERATIONS, &mut watch.fit_nearly())?;
        (self.x, self.itself) = (fit.x, fit.cost);
        self.chosen = (self.built).values(&self.windows.problem, &self.x, &self.written);
        self.cost = search.rated((&self.windows, &self.x, fit.cost), &self.chosen, watch)?;
        Ok(())
    }
}
