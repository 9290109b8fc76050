//! What sensors make of the machine. All of these are supplements: the engine's sensors are ideal.

use super::place::{Site, encoders, wrenches};
use super::{About, Dimension, Effect, Expression, Neighbour, Parameter, Place, Shows};
use crate::mujoco::Model;

/// An encoder that is shifted.
#[derive(Debug)]
pub(super) struct EncoderOffset;

impl Effect for EncoderOffset {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "encoder_offset",
            law: "reading q + b",
            shows: Shows::Reading,
            signature: "b: gravity and contact as at another angle",
            parameters: &[Parameter::amplitude("offset", Dimension::Travel, [1e-3, 0.05]).signed()],
            neighbours: &[
                Neighbour {
                    name: "gravity_tilt",
                    split: "the tip against a fixture",
                },
                Neighbour {
                    name: "base_pose",
                    split: "touches all over the range",
                },
                Neighbour {
                    name: "encoder_scale",
                    split: "motion over the whole range",
                },
            ],
            behaviours: &["postures", "touch"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        encoders(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "encoder_offset",
            &site.place.name,
            values,
        ))
    }
}

/// An encoder that counts too much or too little.
#[derive(Debug)]
pub(super) struct EncoderScale;

impl Effect for EncoderScale {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "encoder_scale",
            law: "reading (1 + s) q",
            shows: Shows::Reading,
            signature: "s q: gravity, inertia and contact as at an angle further out",
            parameters: &[Parameter::amplitude("scale", Dimension::Share, [2e-3, 0.1]).signed()],
            neighbours: &[
                Neighbour {
                    name: "length_scale",
                    split: "touches all over the range",
                },
                Neighbour {
                    name: "encoder_offset",
                    split: "motion over the whole range",
                },
                Neighbour {
                    name: "transmission_compliance",
                    split: "the same angle under different loads",
                },
            ],
            behaviours: &["postures", "touch", "multi_sine"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        encoders(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "encoder_scale",
            &site.place.name,
            values,
        ))
    }
}

/// Encoders that are late.
#[derive(Debug)]
pub(super) struct SensorDelay;

impl Effect for SensorDelay {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "sensor_delay",
            law: "samples of encoders older than they say",
            shows: Shows::Reading,
            signature: "−T v: in all joints alike, against commands and other sensors",
            parameters: &[Parameter::amplitude(
                "time",
                Dimension::Time,
                [2.5e-4, 0.01],
            )],
            neighbours: &[
                Neighbour {
                    name: "actuator_delay",
                    split: "a clock common to commands and sensors, such as a tap",
                },
                Neighbour {
                    name: "actuator_lag",
                    split: "a chirp beyond 1/(2π T)",
                },
            ],
            behaviours: &["chirp", "touch"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        if encoders(model).is_empty() {
            Vec::new()
        } else {
            vec![Place::world()]
        }
    }

    fn express(&self, _: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement("sensor_delay", "encoders", values))
    }
}

/// A force sensor that is not zeroed.
#[derive(Debug)]
pub(super) struct ForceSensorBias;

impl Effect for ForceSensorBias {
    fn about(&self) -> &'static About {
        const ABOUT: About = About {
            name: "force_sensor_bias",
            law: "a constant added to every component",
            shows: Shows::Reading,
            signature: "a constant vector in the sensor's frame, in contact and without",
            parameters: &[
                Parameter::amplitude("x", Dimension::Force, [0.02, 1.0]).signed(),
                Parameter::amplitude("y", Dimension::Force, [0.02, 1.0]).signed(),
                Parameter::amplitude("z", Dimension::Force, [0.02, 1.0]).signed(),
            ],
            neighbours: &[
                Neighbour {
                    name: "payload",
                    split: "free air in several postures: weight turns with the sensor",
                },
                Neighbour {
                    name: "contact_friction",
                    split: "free air",
                },
            ],
            behaviours: &["postures", "touch"],
        };
        &ABOUT
    }

    fn places(&self, model: &Model) -> Vec<Place> {
        wrenches(model)
    }

    fn express(&self, site: &Site<'_>, values: &[f64]) -> Result<Expression, String> {
        Ok(Expression::supplement(
            "force_sensor_bias",
            &site.place.name,
            values,
        ))
    }
}
