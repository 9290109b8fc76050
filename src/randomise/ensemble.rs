//! Models drawn beforehand, one row of numbers each: the ensemble that identification hands to training.
//!
//! ```toml
//! [ensemble]
//! numbers = ["dof_damping[0]", "body_mass[3]"]     # entries of mjModel's arrays, or of `gravity`
//! elements = ["joint/p0_turret", "body/p0_upper"]  # whose they are, to notice another model
//! models = [[0.0021, 0.301], [0.0019, 0.312]]      # one row a model
//! ```
//!
//! Entries of arrays, not addresses, so that a row means the same in the model that was identified and in the one it
//! came from.

use serde::{Deserialize, Serialize};

use crate::mjcf::attribute;
use crate::mujoco::{Model, ModelEdit, ObjectKind};

/// The table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ensemble {
    /// `array[index]`
    pub numbers: Vec<String>,
    /// `kind/name` of each number's element; empty where it has no name
    pub elements: Vec<String>,
    /// (models × numbers)
    pub models: Vec<Vec<f64>>,
}

/// One number of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Entry {
    Array(&'static str, usize),
    Gravity(usize),
}

const GRAVITY: &str = "gravity";

impl Ensemble {
    /// The numbers of `models` in which any of them differs from `nominal`, of the given arrays; `gravity` counts as
    /// one.
    pub fn new(nominal: &Model, models: &[Model], arrays: &[&str]) -> Self {
        let values = |model: &Model, array: &str| match array {
            GRAVITY => model.option().gravity.to_vec(),
            _ => model.numeric_field(array).unwrap_or_default().to_vec(),
        };
        let mut out = Self {
            models: vec![Vec::new(); models.len()],
            ..Self::default()
        };
        for array in arrays {
            let own = values(nominal, array);
            let drawn: Vec<Vec<f64>> = models.iter().map(|m| values(m, array)).collect();
            for i in 0..own.len() {
                if drawn.iter().all(|d| d[i] == own[i]) {
                    continue;
                }
                out.numbers.push(format!("{array}[{i}]"));
                out.elements.push(element(nominal, array, i));
                for (row, d) in out.models.iter_mut().zip(&drawn) {
                    row.push(d[i]);
                }
            }
        }
        out
    }

    /// Where each number is in `model`.
    pub(super) fn resolve(&self, model: &Model) -> Result<Vec<Entry>, String> {
        if self.models.is_empty() {
            return Err("`models` has no row".into());
        }
        if self.elements.len() != self.numbers.len() {
            let (a, b) = (self.elements.len(), self.numbers.len());
            return Err(format!(
                "`elements` has {a} names, expected {b}, one a number"
            ));
        }
        for (i, row) in self.models.iter().enumerate() {
            if row.len() != self.numbers.len() {
                let (a, b) = (row.len(), self.numbers.len());
                return Err(format!("`models[{i}]` has {a} numbers, expected {b}"));
            }
            if let Some(j) = row.iter().position(|v| !v.is_finite()) {
                return Err(format!(
                    "`models[{i}][{j}]` is {}, expected a number",
                    row[j]
                ));
            }
        }
        (self.numbers.iter().zip(&self.elements))
            .map(|(number, name)| {
                let entry = entry(model, number)?;
                let (array, index) = match entry {
                    Entry::Array(array, index) => (array, index),
                    Entry::Gravity(i) => (GRAVITY, i),
                };
                let found = element(model, array, index);
                if found == *name {
                    Ok(entry)
                } else {
                    Err(format!(
                        "`{number}` is of `{found}` in this model, expected `{name}`; it was drawn for another model"
                    ))
                }
            })
            .collect()
    }
}

impl Entry {
    pub(super) fn set(self, edit: &mut ModelEdit<'_>, value: f64) {
        match self {
            Self::Array(array, index) => {
                if let Some(numbers) = edit.numeric_field_mut(array) {
                    numbers[index] = value;
                }
            }
            Self::Gravity(component) => {
                let mut option = edit.model().option();
                option.gravity[component] = value;
                // finite: checked when resolved
                let _ = edit.set_option(&option);
            }
        }
    }

    pub(super) fn array(self) -> Option<&'static str> {
        match self {
            Self::Array(array, _) => Some(array),
            Self::Gravity(_) => None,
        }
    }
}

fn entry(model: &Model, number: &str) -> Result<Entry, String> {
    let parts = number.strip_suffix(']').and_then(|n| n.split_once('['));
    let Some((name, Ok(index))) = parts.map(|(name, i)| (name, i.parse::<usize>())) else {
        return Err(format!("`{number}` is not of the form `array[index]`"));
    };
    if name == GRAVITY && index < 3 {
        return Ok(Entry::Gravity(index));
    }
    let array = Model::NUMERIC_FIELDS.iter().find(|field| **field == name);
    let size = array
        .and_then(|a| model.numeric_field(a))
        .map_or(0, <[f64]>::len);
    match array {
        Some(array) if index < size => Ok(Entry::Array(array, index)),
        Some(array) => Err(format!("`{number}`: `{array}` has {size} numbers")),
        None => Err(format!("the model has no array `{name}`")),
    }
}

/// `kind/name` of the element an entry belongs to.
fn element(model: &Model, array: &str, index: usize) -> String {
    let width = model
        .numeric_field_shaped(array)
        .map_or(1, |(_, (_, width))| width.max(1));
    let row = index / width;
    let (kind, id) = match array.split_once('_').map_or(array, |(first, _)| first) {
        "body" => ("body", row),
        "jnt" => ("joint", row),
        "dof" => ("joint", model.dof_jntid()[row] as usize),
        "qpos" => ("joint", joint_of(model, row)),
        "geom" => ("geom", row),
        "site" => ("site", row),
        "pair" => ("pair", row),
        "eq" => ("equality", row),
        "tendon" => ("tendon", row),
        "actuator" => ("actuator", row),
        _ => return String::new(),
    };
    let name = attribute::object_kind(kind).and_then(|k: ObjectKind| model.name(k, id));
    name.map_or_else(String::new, |name| format!("{kind}/{name}"))
}

fn joint_of(model: &Model, qpos: usize) -> usize {
    model
        .jnt_qposadr()
        .partition_point(|&a| a as usize <= qpos)
        .saturating_sub(1)
}
