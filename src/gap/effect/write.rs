//! Putting an effect into a model file.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use thiserror::Error;

use super::{Effect, Parameter, Place, Role, Sign, Site};
use crate::mjcf::attribute::{self, Target};
use crate::mjcf::structure::{self, Change};
use crate::mjcf::{MjcfError, edit, file};
use crate::mujoco::{Model, MujocoError};
use crate::supplement::{self, SupplementError};
use crate::sysid::parameter::{ParameterRule, Scale};

/// Why an effect cannot be written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EffectError {
    /// It cannot act there, or a value makes no sense.
    #[error("effect `{effect}` at `{place}`: {reason}")]
    Place {
        /// its name
        effect: &'static str,
        /// where
        place: String,
        /// what is wrong
        reason: String,
    },
    /// The model file cannot be changed.
    #[error(transparent)]
    Mjcf(#[from] MjcfError),
    /// The model does not load.
    #[error(transparent)]
    Supplement(#[from] SupplementError),
    /// The engine refused a number.
    #[error(transparent)]
    Mujoco(#[from] MujocoError),
    /// The file cannot be read.
    #[error("cannot read model {}: {reason}", file.display())]
    File {
        /// the file
        file: PathBuf,
        /// why
        reason: String,
    },
}

/// A model file and the model it describes.
#[derive(Debug, Clone)]
pub struct ModelFile {
    /// where it is, or would be: other files are looked up beside it
    pub path: PathBuf,
    /// its text
    pub xml: String,
    /// compiled, with supplements
    pub model: Arc<Model>,
}

impl ModelFile {
    /// Reads a file.
    ///
    /// # Errors
    /// It cannot be read or does not load.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, EffectError> {
        let path = path.as_ref();
        let xml = std::fs::read_to_string(path).map_err(|e| EffectError::File {
            file: path.into(),
            reason: e.to_string(),
        })?;
        Self::of_text(xml, path)
    }

    /// In other time steps, s.
    ///
    /// # Errors
    /// The engine refuses them.
    pub fn paced(&self, timestep_s: f64) -> Result<Self, EffectError> {
        let steps = Change::Option {
            attribute: "timestep",
            value: timestep_s.to_string(),
        };
        Self::of_text(structure::change(&self.xml, &[steps])?, &self.path)
    }

    /// A text that is not, or not yet, the file's content.
    ///
    /// # Errors
    /// It does not load.
    pub fn of_text(xml: String, path: impl AsRef<Path>) -> Result<Self, EffectError> {
        let path = path.as_ref().to_owned();
        let mut model = supplement::load_text(&xml, &path)?;
        if !model.has_contacts() {
            // looking for them takes a fifth of the steps of a machine that moves freely
            model.edit().set_contacts(false);
        }
        let model = Arc::new(model);
        Ok(Self { path, xml, model })
    }
}

/// Where the value of a parameter is kept.
#[derive(Debug, Clone, PartialEq)]
pub enum Number {
    /// a number of the model, by address; it is `origin + slope × value`, at least `least`
    Of {
        /// `kind/name`
        element: String,
        /// see [`crate::mjcf::attribute`]
        attribute: &'static str,
        /// its component
        component: usize,
        /// number of the model at value 0
        origin: f64,
        /// change by a value of 1
        slope: f64,
        /// its least value
        least: f64,
    },
    /// a number of the model, by address, times 1 + value
    Share {
        /// `kind/name`
        element: String,
        /// see [`crate::mjcf::attribute`]
        attribute: &'static str,
        /// its component
        component: usize,
    },
    /// this number of the supplement
    Custom(usize),
    /// in the structure of the file
    Fixed,
}

impl Number {
    /// A number that was not there before.
    pub(super) fn is(element: String, attribute: &'static str, component: usize) -> Self {
        Self::affine(element, attribute, component, 0.0, 1.0)
    }

    /// A number of any origin and slope.
    pub(super) fn affine(
        element: String,
        attribute: &'static str,
        component: usize,
        origin: f64,
        slope: f64,
    ) -> Self {
        let least = f64::NEG_INFINITY;
        Self::Of {
            element,
            attribute,
            component,
            origin,
            slope,
            least,
        }
    }
}

/// How an effect is said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Expression {
    /// changes of the file's structure, made first
    pub changes: Vec<Change>,
    /// kind, element and numbers of a supplement, if it needs one
    pub supplement: Option<(&'static str, String, Vec<f64>)>,
    /// one a parameter
    pub numbers: Vec<Number>,
}

impl Expression {
    /// Numbers of the model alone.
    pub(super) fn of(numbers: Vec<Number>) -> Self {
        Self {
            numbers,
            ..Self::default()
        }
    }

    /// A supplement whose numbers are the values in their order.
    pub(super) fn supplement(kind: &'static str, element: &str, values: &[f64]) -> Self {
        Self {
            supplement: Some((kind, element.to_owned(), values.to_vec())),
            numbers: (0..values.len()).map(Number::Custom).collect(),
            ..Self::default()
        }
    }
}

/// In which terms a model file says an effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// the engine's own
    Mjcf,
    /// custom elements
    Supplement,
}

/// A parameter of an effect as one to identify.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimated {
    /// index among the effect's parameters
    pub parameter: usize,
    /// of the model's number; starts at its value in the written model, and is held where it is a choice or starts at 0
    /// and cannot be negative
    pub rule: ParameterRule,
    /// value of the parameter there
    pub value: f64,
    /// change of the model's number by a value of 1
    pub slope: f64,
}

impl Estimated {
    /// The parameter's value where the model's number is `number`.
    pub fn value_of(&self, number: f64) -> f64 {
        self.value + (number - self.start()) / self.slope
    }

    /// The model's number where the parameter is `value`.
    pub fn number_of(&self, value: f64) -> f64 {
        self.start() + (value - self.value) * self.slope
    }

    fn start(&self) -> f64 {
        self.rule.start.unwrap_or(0.0)
    }
}

/// A model with an effect.
#[derive(Debug, Clone)]
pub struct Written {
    /// the changed file
    pub file: ModelFile,
    /// its parameters that are numbers of the model
    pub estimated: Vec<Estimated>,
    /// how it is said
    pub form: Form,
}

/// Writes an effect of given values (one a parameter, in order) into a model. Nothing changes where all sizes are 0.
///
/// # Errors
/// Values that make no sense, a place where it cannot act, a file that cannot be changed.
pub fn write(
    base: &ModelFile,
    effect: &dyn Effect,
    place: &Place,
    values: &[f64],
) -> Result<Written, EffectError> {
    let about = effect.about();
    let refuse = |reason: String| EffectError::Place {
        effect: about.name,
        place: place.to_string(),
        reason,
    };
    check(about.parameters, values).map_err(refuse)?;
    let sizes = about
        .parameters
        .iter()
        .zip(values)
        .filter(|(p, _)| p.is_size());
    if sizes.clone().all(|(_, value)| *value == 0.0) {
        return Ok(Written {
            file: base.clone(),
            estimated: Vec::new(),
            form: Form::Mjcf,
        });
    }
    let site = Site::new(&base.model, place).map_err(refuse)?;
    let Expression {
        mut changes,
        supplement,
        numbers,
    } = effect.express(&site, values).map_err(refuse)?;
    let custom = supplement.map(|(kind, element, data)| {
        let name = supplement::name_of(kind, &element);
        changes.push(Change::Numeric {
            name: name.clone(),
            data,
        });
        name
    });
    let structured = ModelFile::of_text(structure::change(&base.xml, &changes)?, &base.path)?;
    let mut targets: Vec<(usize, Target, f64, f64)> = Vec::new(); // parameter, number, its value, slope
    for (i, (number, &value)) in numbers.iter().zip(values).enumerate() {
        let (element, attribute, component) = match number {
            Number::Fixed => continue,
            Number::Custom(j) => {
                let name = custom.as_deref().unwrap_or_default();
                (&format!("custom/{name}"), "data", *j)
            }
            Number::Of {
                element,
                attribute,
                component,
                ..
            }
            | Number::Share {
                element,
                attribute,
                component,
            } => (element, *attribute, *component),
        };
        let target =
            attribute::resolve(&structured.model, element, attribute, &[component])?.remove(0);
        let (wanted, slope) = match number {
            Number::Of {
                origin,
                slope,
                least,
                ..
            } => ((origin + slope * value).max(*least), *slope),
            Number::Share { .. } => {
                let before = target.value(&structured.model);
                (before * (1.0 + value), before)
            }
            Number::Fixed | Number::Custom(_) => (value, 1.0),
        };
        targets.push((i, target, wanted, slope));
    }
    let file = with_numbers(&structured, &targets)?;
    let estimated = targets
        .iter()
        .map(|(i, target, _, slope)| {
            let start = target.value(&file.model);
            // a factor on what the file has now, which is `1 + value` times what it had
            let slope = match target.place {
                attribute::Place::Geometry(_) => slope / (1.0 + values[*i]),
                _ => *slope,
            };
            let rule = rule(&about.parameters[*i], target, start, values[*i], slope);
            Estimated {
                parameter: *i,
                rule,
                value: values[*i],
                slope,
            }
        })
        .collect();
    let form = if custom.is_some() {
        Form::Supplement
    } else {
        Form::Mjcf
    };
    Ok(Written {
        file,
        estimated,
        form,
    })
}

fn check(parameters: &[Parameter], values: &[f64]) -> Result<(), String> {
    if parameters.len() != values.len() {
        return Err(format!(
            "it has {} parameters, got {} values",
            parameters.len(),
            values.len()
        ));
    }
    for (p, value) in parameters.iter().zip(values) {
        if !value.is_finite() || (p.sign == Sign::Positive && *value < 0.0) {
            let expected = if p.sign == Sign::Positive {
                "a number of at least 0"
            } else {
                "a number"
            };
            return Err(format!("`{}` is {value}, expected {expected}", p.name));
        }
    }
    Ok(())
}

/// The file with numbers in place of those it has.
fn with_numbers(
    structured: &ModelFile,
    targets: &[(usize, Target, f64, f64)],
) -> Result<ModelFile, EffectError> {
    let changed: Vec<(&Target, f64)> = targets
        .iter()
        .filter(|(_, target, wanted, _)| target.value(&structured.model) != *wanted)
        .map(|(_, target, wanted, _)| (target, *wanted))
        .collect();
    if changed.is_empty() {
        return Ok(structured.clone());
    }
    let mut model = structured.model.try_clone()?;
    let mut numbers = model.edit();
    edit::write(&mut numbers, &changed, false);
    numbers.finish()?;
    let mut late = model.edit();
    edit::write(&mut late, &changed, true);
    drop(late);
    let addressed: Vec<&Target> = changed.iter().map(|(target, _)| *target).collect();
    let xml = file::rewrite(&structured.xml, &model, &addressed, "")?;
    ModelFile::of_text(xml, &structured.path)
}

/// A rule that starts at the written number and keeps to what makes sense.
fn rule(
    parameter: &Parameter,
    target: &Target,
    start: f64,
    value: f64,
    slope: f64,
) -> ParameterRule {
    let mut rule = ParameterRule::new(
        &format!("{}/{}", target.attribute.kind, target.element),
        target.attribute.name,
    );
    if target.attribute.width != 1 {
        rule.components = vec![target.component];
    }
    rule.scale = Some(Scale::Linear);
    rule.start = Some(start);
    rule.frozen = matches!(parameter.role, Role::Choice(_));
    if parameter.sign == Sign::Positive {
        // at 0 it cannot move both ways, which the estimator asks for
        rule.frozen |= value == 0.0;
        // the number at which the parameter is 0
        let bound = start - value * slope;
        if slope > 0.0 {
            rule.lower = Some(bound);
        } else {
            rule.upper = Some(bound);
        }
    }
    rule
}
