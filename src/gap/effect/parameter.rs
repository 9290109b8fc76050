//! Parameters of effects: what they mean, how large they may be.
//!
//! Machines differ by orders of magnitude, so ranges are multiples of a machine's own [`Scales`]: dry friction in parts of
//! the force at the joint, damping in parts of that force at the joint's speed, and so on.

use super::{Place, PlaceKind};
use crate::mjcf::attribute::{dofs, norm};
use crate::mujoco::{Model, ObjectKind};

/// The part a parameter has in its effect.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Role {
    /// where all of these are 0 there is no effect; small ones add up
    Amplitude,
    /// an amplitude that does not act in proportion to its size; to be tried with several, in multiples of the scale
    Bent(&'static [f64]),
    /// as an amplitude, but at 0 there is only a simpler effect
    Companion,
    /// says nothing at amplitude 0; to be tried on a grid, in multiples of the scale, the first one first
    Shape(&'static [f64]),
    /// a shape that is not estimated, only chosen from a grid
    Choice(&'static [f64]),
    /// an amplitude that does nothing until it is large; to be tried on a grid like a shape
    Threshold(&'static [f64]),
    /// there (1) or not (0)
    Switch,
}

/// Which values make sense.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// at least 0
    Positive,
    /// any
    Either,
}

/// What a parameter is made of, and so its unit and the size that matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dimension {
    /// N m or N
    Force,
    /// N m s/rad or N s/m
    ForcePerSpeed,
    /// N m s²/rad² or N s²/m²
    ForcePerSpeedSquared,
    /// N m/rad or N/m
    ForcePerTravel,
    /// kg m² or kg
    ForcePerAcceleration,
    /// rad/s or m/s
    Speed,
    /// rad or m
    Travel,
    /// rad/(N m) or m/N
    TravelPerForce,
    /// periods a turn, or rad/m
    PerTravel,
    /// rad
    Angle,
    /// rad/s
    Spin,
    /// m
    Length,
    /// kg
    Mass,
    /// s
    Time,
    /// without
    Share,
}

/// How many times the largest size to be expected a size may be.
const BEYOND: f64 = 4.0;
/// Factor of a threshold's column that still means about that threshold.
const ALL_OR_NOTHING: [f64; 2] = [0.4, 2.5];

/// One parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// name
    pub name: &'static str,
    /// unit and scale
    pub dimension: Dimension,
    /// part in the effect
    pub role: Role,
    /// values that make sense
    pub sign: Sign,
    /// size of a barely visible effect, in multiples of the scale; of a positive shape the least that makes sense
    pub low: f64,
    /// size of the largest to be expected
    pub high: f64,
}

impl Parameter {
    const fn new(name: &'static str, dimension: Dimension, role: Role, range: [f64; 2]) -> Self {
        let [low, high] = range;
        let sign = Sign::Positive;
        Self {
            name,
            dimension,
            role,
            sign,
            low,
            high,
        }
    }

    /// A size of at least 0.
    pub(super) const fn amplitude(
        name: &'static str,
        dimension: Dimension,
        range: [f64; 2],
    ) -> Self {
        Self::new(name, dimension, Role::Amplitude, range)
    }

    /// A size of at least 0 that is to be tried with these.
    pub(super) const fn bent(
        name: &'static str,
        dimension: Dimension,
        tried: &'static [f64],
        range: [f64; 2],
    ) -> Self {
        Self::new(name, dimension, Role::Bent(tried), range)
    }

    /// A size at 0 of which a simpler effect is left.
    pub(super) const fn companion(
        name: &'static str,
        dimension: Dimension,
        range: [f64; 2],
    ) -> Self {
        Self::new(name, dimension, Role::Companion, range)
    }

    /// A shape.
    pub(super) const fn shape(
        name: &'static str,
        dimension: Dimension,
        grid: &'static [f64],
        range: [f64; 2],
    ) -> Self {
        Self::new(name, dimension, Role::Shape(grid), range)
    }

    /// A shape that stays as chosen.
    pub(super) const fn choice(
        name: &'static str,
        dimension: Dimension,
        grid: &'static [f64],
        range: [f64; 2],
    ) -> Self {
        Self::new(name, dimension, Role::Choice(grid), range)
    }

    /// The same with either sign.
    pub(super) const fn signed(mut self) -> Self {
        self.sign = Sign::Either;
        self
    }

    /// Its unit at a place.
    pub fn unit(&self, scales: &Scales) -> &'static str {
        let pick = |hinge, slide| if scales.slide { slide } else { hinge };
        match self.dimension {
            Dimension::Force => pick("N m", "N"),
            Dimension::ForcePerSpeed => pick("N m s/rad", "N s/m"),
            Dimension::ForcePerSpeedSquared => pick("N m s^2/rad^2", "N s^2/m^2"),
            Dimension::ForcePerTravel => pick("N m/rad", "N/m"),
            Dimension::ForcePerAcceleration => pick("kg m^2", "kg"),
            Dimension::Speed => pick("rad/s", "m/s"),
            Dimension::Travel => pick("rad", "m"),
            Dimension::TravelPerForce => pick("rad/(N m)", "m/N"),
            Dimension::PerTravel => pick("1", "rad/m"),
            Dimension::Angle => "rad",
            Dimension::Spin => "rad/s",
            Dimension::Length => "m",
            Dimension::Mass => "kg",
            Dimension::Time => "s",
            Dimension::Share => "1",
        }
    }

    /// The size that 1 stands for in its range and grid.
    pub fn scale(&self, scales: &Scales) -> f64 {
        let Scales {
            force,
            speed,
            travel,
            acceleration,
            length,
            mass,
            ..
        } = *scales;
        match self.dimension {
            Dimension::Force => force,
            Dimension::ForcePerSpeed => force / speed,
            Dimension::ForcePerSpeedSquared => force / (speed * speed),
            Dimension::ForcePerTravel => force / travel,
            Dimension::ForcePerAcceleration => force / acceleration,
            Dimension::Speed => speed,
            Dimension::Travel => travel,
            Dimension::TravelPerForce => travel / force,
            Dimension::PerTravel => 1.0 / travel,
            Dimension::Length => length,
            Dimension::Mass => mass,
            Dimension::Angle | Dimension::Spin | Dimension::Time | Dimension::Share => 1.0,
        }
    }

    /// A size to test for: the geometric mean of the range; of a shape the first of its grid.
    pub fn typical(&self, scales: &Scales) -> f64 {
        let multiple = match self.role {
            Role::Shape(grid) | Role::Choice(grid) | Role::Threshold(grid) => grid[0],
            Role::Switch => 1.0,
            Role::Amplitude | Role::Bent(_) | Role::Companion => (self.low * self.high).sqrt(),
        };
        multiple * self.scale(scales)
    }

    /// The largest size to be expected: of its range, or that is tried.
    pub(in crate::gap) fn most(&self, scales: &Scales) -> f64 {
        let tried = self.grid(scales).into_iter();
        tried.fold(self.high * self.scale(scales), f64::max)
    }

    /// The values of its grid; empty if it has none.
    pub fn grid(&self, scales: &Scales) -> Vec<f64> {
        match self.role {
            Role::Shape(grid) | Role::Choice(grid) | Role::Threshold(grid) | Role::Bent(grid) => {
                grid.iter().map(|x| x * self.scale(scales)).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Values beyond which an effect is absurd: of a shape that is positive, from its range's low end.
    pub(in crate::gap) fn sensible(&self, scales: &Scales) -> [f64; 2] {
        let beyond = match self.role {
            Role::Threshold(_) => 1.0, // a share of what there is
            _ => BEYOND,
        };
        let most = beyond * self.high;
        let least = match (self.role, self.sign) {
            (Role::Shape(_), Sign::Positive) => self.low,
            _ => -most,
        };
        [least, most].map(|multiple| multiple * self.scale(scales))
    }

    /// Whether it is a size that is tried at several values, as it acts otherwise at each.
    pub(in crate::gap) fn bends(&self) -> bool {
        matches!(self.role, Role::Bent(_))
    }

    /// Whether it is there as a whole or not at all: its column has no size of its own.
    pub(in crate::gap) fn is_whole(&self) -> bool {
        matches!(self.role, Role::Threshold(_) | Role::Switch)
    }

    /// Size of its column: the usual one, or of a whole 1.
    pub(in crate::gap) fn unit_size(&self, scales: &Scales) -> f64 {
        if self.is_whole() {
            1.0
        } else {
            self.typical(scales)
        }
    }

    /// Whether `expected` of its column makes sense: a size, or what the whole is multiplied by.
    pub(in crate::gap) fn makes_sense(&self, expected: f64, scales: &Scales) -> bool {
        if self.is_whole() {
            return (ALL_OR_NOTHING[0]..=ALL_OR_NOTHING[1]).contains(&expected);
        }
        // steps of the model are a little like a drive that gives way
        let counts = !self.bends() || self.counts(expected, scales);
        let positive = self.sign == Sign::Either || expected > 0.0;
        positive && counts && expected.abs() <= self.sensible(scales)[1]
    }

    /// Whether a size is one that could be seen at all, by its range.
    pub(in crate::gap) fn counts(&self, value: f64, scales: &Scales) -> bool {
        self.is_whole() || value.abs() >= self.low * self.scale(scales)
    }

    /// Whether the effect is absent where it and its like are 0.
    pub fn is_size(&self) -> bool {
        matches!(
            self.role,
            Role::Amplitude | Role::Bent(_) | Role::Threshold(_) | Role::Switch
        )
    }
}

/// Sizes that are usual at a place of a machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scales {
    /// force or torque, N m or N
    pub force: f64,
    /// speed, rad/s or m/s
    pub speed: f64,
    /// range of motion, rad or m
    pub travel: f64,
    /// acceleration, rad/s² or m/s²
    pub acceleration: f64,
    /// length, m
    pub length: f64,
    /// mass, kg
    pub mass: f64,
    /// whether the joint is a slide
    pub slide: bool,
}

/// Part of a motor's greatest force that it needs most of the time.
const USUAL_LOAD: f64 = 0.1;
/// Rad of travel of a hinge without limits.
const HINGE_TRAVEL: f64 = 1.0;
/// m of travel of a slide without limits.
const SLIDE_TRAVEL: f64 = 0.2;
/// 1/s: travels in a second, and speeds reached in a second.
const RATES: [f64; 2] = [1.0, 6.0];
/// m: a hand's machine. Larger bodies have their own.
const LENGTH: f64 = 0.1;
/// N and N m of sensors at fingertips.
const READING: [f64; 2] = [1.0, 0.01];

impl Scales {
    /// What the model alone lets expect; what is measured on the machine is better.
    pub fn of(model: &Model, place: &Place) -> Self {
        let joint = place.joint(model);
        let slide = joint.is_some_and(|j| model.is_slide(j) == Some(true));
        let range = joint.filter(|j| model.jnt_limited()[*j] != 0);
        let travel = match range {
            Some(j) => model.jnt_range()[2 * j + 1] - model.jnt_range()[2 * j],
            None if slide => SLIDE_TRAVEL,
            None => HINGE_TRAVEL,
        };
        let speed = RATES[0] * travel;
        let acceleration = RATES[1] * speed;
        let inertia = joint.map_or(1.0, |j| model.dof_M0()[dofs(model, j).start]);
        let force = match (place.kind, joint) {
            (PlaceKind::Sensor, _) => READING[usize::from(place.unit(model) == Some("N m"))],
            (_, Some(j)) => {
                capacity(model, j).map_or(inertia * acceleration, |most| USUAL_LOAD * most)
            }
            _ => 1.0,
        };
        let body = place.body(model);
        let mass = body.map_or(model.total_mass(), |b| model.body_subtreemass()[b]);
        Self {
            force,
            speed,
            travel,
            acceleration,
            length: body.map_or(0.0, |b| reach(model, b)).max(LENGTH),
            mass,
            slide,
        }
    }
}

/// How far a body goes from its origin: to its centre of mass, the joints after it and the ends of its geoms, m.
fn reach(model: &Model, body: usize) -> f64 {
    let at = |of: &[f64], i: usize| norm(&of[3 * i..3 * i + 3]);
    let bodies = (body + 1..model.nbody()).filter(|&b| model.body_parentid()[b] as usize == body);
    let geoms = (0..model.ngeom()).filter(|&g| model.geom_bodyid()[g] as usize == body);
    let joints = bodies.map(|b| at(model.body_pos(), b));
    let ends = geoms.map(|g| at(model.geom_pos(), g) + model.geom_rbound()[g]);
    (joints.chain(ends)).fold(at(model.body_ipos(), body), f64::max)
}

/// The greatest force that motors can give a joint.
fn capacity(model: &Model, joint: usize) -> Option<f64> {
    let name = model.name(ObjectKind::Joint, joint)?;
    (0..model.nu())
        .filter(|&u| super::place::joint_of(model, u).as_deref() == Some(name))
        .filter_map(|u| super::drive::full_torque(model, u))
        .reduce(f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of an arm of six joints, steps of the model were called a compliance of 1.4e-5 rad/(N m) at the fifth.
    #[test]
    fn less_than_a_drive_could_give_way_makes_no_sense() {
        let scales = Scales {
            force: 3.0,
            speed: 1.0,
            travel: 1.0,
            acceleration: 6.0,
            length: 0.1,
            mass: 1.0,
            slide: false,
        };
        let give = Parameter::bent(
            "compliance",
            Dimension::TravelPerForce,
            &[1e-3],
            [1e-4, 0.05],
        );
        assert!(give.makes_sense(1e-4, &scales) && !give.makes_sense(1.4e-5, &scales));
        assert!(!give.makes_sense(-1e-3, &scales));
    }

    /// Columns of a soft drive, tried in more than its range, were taken again at the end of that, where its motor swings
    /// otherwise.
    #[test]
    fn what_is_tried_may_be_expected() {
        let give = super::super::named("transmission_compliance").expect("in the catalogue");
        let scales = Scales {
            force: 1.01,
            speed: 0.1,
            travel: 0.2,
            acceleration: 2.4,
            length: 0.2,
            mass: 0.3,
            slide: false,
        };
        let compliance = &give.about().parameters[0];
        let most = compliance.most(&scales);
        assert!(compliance.grid(&scales).iter().all(|c| *c <= most));
        assert!(most > compliance.high * compliance.scale(&scales));
    }

    /// A column of a threshold five times over is of another threshold.
    #[test]
    fn a_whole_is_there_about_once() {
        let scales = Scales {
            force: 8.0,
            speed: 1.0,
            travel: 1.0,
            acceleration: 1.0,
            length: 0.3,
            mass: 0.5,
            slide: false,
        };
        let cut = Parameter {
            name: "cut",
            dimension: Dimension::Share,
            role: Role::Threshold(&[0.5]),
            sign: Sign::Positive,
            low: 0.1,
            high: 0.98,
        };
        assert!(cut.makes_sense(1.1, &scales));
        assert!(!cut.makes_sense(5.08, &scales) && !cut.makes_sense(-1.0, &scales));
        let time = Parameter::amplitude("time", Dimension::Time, [5e-4, 0.02]);
        assert!(time.makes_sense(0.08, &scales));
        assert!(!time.makes_sense(0.081, &scales) && !time.makes_sense(-0.01, &scales));
        assert!(time.signed().makes_sense(-0.08, &scales));
    }
}
