//! The paper's table and figures as sections of a report.

mod curve;
mod forces;
mod rollouts;
mod spiral;
mod tables;
mod weights;

pub use curve::curve;
pub use forces::forces;
pub use rollouts::rollouts;
pub use spiral::spiral;
pub use tables::table1;
pub use weights::weights;

use super::Case;
use crate::report::{Drawing, Figure, Panels};

/// What stands in every caption where the paper has hardware.
const STAND_IN: &str = "The virtual rig `paper` stands in for the paper's hardware.";

/// The page's colour of a case.
fn colour(case: Case) -> usize {
    match case {
        Case::Correct => 2,
        Case::Incorrect => 1,
        Case::Ensemble => 3,
    }
}

fn figure(name: &str, title: &str, caption: &str, panels: Panels) -> Figure {
    Figure {
        name: name.to_owned(),
        title: title.to_owned(),
        caption: caption.to_owned(),
        drawing: Drawing::Panels(panels),
    }
}
