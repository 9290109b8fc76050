//! Reading and writing parameters in a compiled model.

use nalgebra::{Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::attribute::{Place, Target, body_geoms, bounding_radius, norm, pair_inverse_mass};
use super::inertia::{BodyInertia, N_INERTIA};
use crate::mujoco::{Model, ModelEdit};

/// Arrays no derived constant depends on. Nor does one on `body_pos` of a body fixed to the world: moving a whole
/// mechanism changes no inertia.
pub(crate) const SURFACE: &[&str] = &[
    "geom_friction",
    "geom_solref",
    "geom_solimp",
    "pair_friction",
    "pair_solref",
    "pair_solimp",
    "pair_margin",
    "pair_gap",
    "jnt_solref",
    "jnt_solimp",
    "dof_solref",
    "dof_solimp",
    "eq_solref",
    "eq_solimp",
    "dof_damping",
    "dof_frictionloss",
    "tendon_damping",
    "tendon_stiffness",
    "tendon_frictionloss",
    "jnt_stiffness",
    "qpos_spring",
    "actuator_gainprm",
    "actuator_biasprm",
    "numeric_data",
];

impl Target {
    /// Whether constants that the engine derives depend on it.
    pub fn is_inertial(&self, model: &Model) -> bool {
        match self.place {
            Place::Slots {
                array: "body_pos",
                first,
                ..
            } => model.body_parentid()[first / 3] != 0,
            Place::Slots { array, .. } => !SURFACE.contains(&array),
            Place::Mass(_) | Place::Inertia(..) => true,
            Place::Rotation(body, _) | Place::Length(body) => model.body_parentid()[body] != 0,
            _ => false,
        }
    }

    /// Whether its value in the model depends on derived constants, so that it has to be written after them.
    pub fn follows_constants(&self) -> bool {
        matches!(
            self.place,
            Place::ContactStiffness(_)
                | Place::ContactDamping(_)
                | Place::ContactHardness(_)
                | Place::ContactRatio(_)
        )
    }

    /// Its value in `model`. Changes relative to the nominal model (inertia, rotation, tilt) are 0, factors (geometry) 1.
    pub fn value(&self, model: &Model) -> f64 {
        match self.place {
            Place::Slots { array, first, .. } => {
                model.numeric_field(array).map_or(0.0, |a| a[first])
            }
            Place::Mass(body) => model.body_mass()[body],
            Place::Gravity(component) => model.option().gravity[component],
            Place::Inertia(..) | Place::Rotation(..) | Place::Tilt(_) => 0.0,
            Place::ContactStiffness(pair) | Place::ContactHardness(pair) => contact(model, pair).0,
            Place::ContactDamping(pair) => contact(model, pair).1,
            Place::ContactRatio(pair) => damping_ratio(model, pair),
            Place::Sliding(pair) => model.pair_friction()[5 * pair],
            Place::Geometry(_) => 1.0,
            Place::Length(body) => norm(&model.body_pos()[3 * body..3 * body + 3]),
            Place::ForceLimit(actuator) => model.actuator_forcerange()[2 * actuator + 1],
        }
    }
}

/// Writes `values` of `targets` into a model that holds nominal numbers.
///
/// Those that follow derived constants are left out; call again with `constants_done` after recomputing these.
pub fn write(edit: &mut ModelEdit<'_>, targets: &[(&Target, f64)], constants_done: bool) {
    let mut theta: Vec<(usize, [f64; N_INERTIA])> = Vec::new();
    let mut turns: Vec<(usize, [f64; 3])> = Vec::new();
    let mut tilt = None;
    for &(target, value) in targets {
        if target.follows_constants() != constants_done {
            continue;
        }
        match target.place {
            Place::Slots { array, first, len } => {
                if let Some(numbers) = edit.numeric_field_mut(array) {
                    numbers[first..first + len].fill(value);
                }
                if array == "geom_size" {
                    resize(edit, first / 3);
                }
            }
            Place::Mass(body) => {
                let factor = value / edit.model().body_mass()[body];
                edit.body_mass()[body] = value;
                edit.body_inertia()[3 * body..3 * body + 3]
                    .iter_mut()
                    .for_each(|i| *i *= factor);
            }
            Place::Inertia(body, component) => entry(&mut theta, body)[component] = value,
            Place::Rotation(body, axis) => entry(&mut turns, body)[axis] = value,
            Place::Gravity(component) => {
                let mut option = edit.model().option();
                option.gravity[component] = value;
                // finite: bounds were checked
                let _ = edit.set_option(&option);
            }
            Place::Tilt(axis) => tilt.get_or_insert([0.0; 3])[axis] = value,
            Place::ContactStiffness(pair) => set_stiffness(edit, pair, value),
            Place::ContactDamping(pair) => set_damping(edit, pair, value),
            Place::ContactHardness(pair) => {
                let ratio = damping_ratio(edit.model(), pair);
                set_ratio(edit, pair, value, ratio);
            }
            Place::ContactRatio(pair) => {
                let (stiffness, _) = contact(edit.model(), pair);
                set_ratio(edit, pair, stiffness, value);
            }
            Place::Sliding(pair) => {
                let sliding = &mut edit.pair_friction()[5 * pair..5 * pair + 2];
                let ratio = sliding[1] / sliding[0];
                sliding[0] = value;
                sliding[1] = if ratio.is_finite() {
                    ratio * value
                } else {
                    value
                };
            }
            Place::Length(body) => {
                let pos = &mut edit.body_pos()[3 * body..3 * body + 3];
                let factor = value / norm(pos);
                for x in pos {
                    *x *= factor;
                }
            }
            Place::Geometry(body) => {
                for geom in body_geoms(edit.model(), body) {
                    for i in 3 * geom..3 * geom + 3 {
                        edit.geom_size()[i] *= value;
                        edit.geom_pos()[i] *= value;
                    }
                    resize(edit, geom);
                }
            }
            Place::ForceLimit(actuator) => {
                let range = &mut edit.actuator_forcerange()[2 * actuator..2 * actuator + 2];
                range.copy_from_slice(&[-value, value]);
            }
        }
    }
    for (body, theta) in theta {
        if let Some(changed) = body_inertia(edit.model(), body).changed(&theta) {
            edit.body_mass()[body] = changed.mass;
            edit.body_ipos()[3 * body..3 * body + 3].copy_from_slice(&changed.ipos);
            edit.body_iquat()[4 * body..4 * body + 4].copy_from_slice(&changed.iquat);
            edit.body_inertia()[3 * body..3 * body + 3].copy_from_slice(&changed.inertia);
        }
    }
    for (body, turn) in turns {
        let at = 4 * body;
        let q = &mut edit.body_quat()[at..at + 4];
        let nominal = UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]));
        let turned = nominal * UnitQuaternion::from_scaled_axis(Vector3::from(turn));
        q.copy_from_slice(&[turned.w, turned.i, turned.j, turned.k]);
    }
    if let Some(turn) = tilt {
        let mut option = edit.model().option();
        let tilted =
            Rotation3::from_scaled_axis(Vector3::from(turn)) * Vector3::from(option.gravity);
        option.gravity = tilted.into();
        let _ = edit.set_option(&option);
    }
}

fn entry<const N: usize>(list: &mut Vec<(usize, [f64; N])>, body: usize) -> &mut [f64; N] {
    let at = list
        .iter()
        .position(|(b, _)| *b == body)
        .unwrap_or_else(|| {
            list.push((body, [0.0; N]));
            list.len() - 1
        });
    &mut list[at].1
}

/// The engine computes the radius of the bounding sphere only when it compiles.
fn resize(edit: &mut ModelEdit<'_>, geom: usize) {
    let radius = bounding_radius(edit.model(), geom);
    if let (Some(radius), Some(bound)) = (radius, edit.geom_rbound().get_mut(geom)) {
        *bound = radius;
    }
}

/// Inertia of a body.
pub fn body_inertia(model: &Model, body: usize) -> BodyInertia {
    let three = |a: &[f64]| [a[3 * body], a[3 * body + 1], a[3 * body + 2]];
    let q = model.body_iquat();
    BodyInertia {
        mass: model.body_mass()[body],
        ipos: three(model.body_ipos()),
        iquat: std::array::from_fn(|i| q[4 * body + i]),
        inertia: three(model.body_inertia()),
    }
}

/// Stiffness (N/m) and damping (N s/m) of a contact pair that is fully engaged (impedance d = dmax).
///
/// At rest the engine's contact force is k d² r / ((1 − d) w) with r the penetration, w the sum of inverse weights and,
/// in acceleration units, k = 1/(dmax² T² ζ²) or `−solref[0]`/dmax²; likewise b d/((1 − d) w) per velocity with
/// b = 2/(dmax T) or `−solref[1]`/dmax.
pub fn contact(model: &Model, pair: usize) -> (f64, f64) {
    let (dmax, scale) = engagement(model, pair);
    let (a, b) = (
        model.pair_solref()[2 * pair],
        model.pair_solref()[2 * pair + 1],
    );
    let k = if a > 0.0 {
        1.0 / (dmax * a * b).powi(2)
    } else {
        -a / (dmax * dmax)
    };
    let damping = if b > 0.0 { 2.0 / (dmax * a) } else { -b / dmax };
    (k * dmax * scale, damping * scale)
}

/// Damping ratio ζ of a contact pair, as in the first form of solref: b = 2 ζ √k in the units of [`contact`]'s formulas.
fn damping_ratio(model: &Model, pair: usize) -> f64 {
    let (dmax, scale) = engagement(model, pair);
    let (stiffness, damping) = contact(model, pair);
    0.5 * damping / scale / (stiffness / (dmax * scale)).sqrt()
}

/// dmax and dmax/((1 − dmax) w).
fn engagement(model: &Model, pair: usize) -> (f64, f64) {
    let dmax = model.pair_solimp()[5 * pair + 1];
    (dmax, dmax / ((1.0 - dmax) * pair_inverse_mass(model, pair)))
}

fn set_stiffness(edit: &mut ModelEdit<'_>, pair: usize, stiffness: f64) {
    let (_, damping) = contact(edit.model(), pair);
    set_contact(edit, pair, stiffness, damping);
}

fn set_damping(edit: &mut ModelEdit<'_>, pair: usize, damping: f64) {
    let (stiffness, _) = contact(edit.model(), pair);
    set_contact(edit, pair, stiffness, damping);
}

fn set_ratio(edit: &mut ModelEdit<'_>, pair: usize, stiffness: f64, ratio: f64) {
    let (dmax, scale) = engagement(edit.model(), pair);
    let damping = 2.0 * ratio * (stiffness / (dmax * scale)).sqrt() * scale;
    set_contact(edit, pair, stiffness, damping);
}

/// Writes the direct form of solref, (−stiffness, −damping) in acceleration units.
fn set_contact(edit: &mut ModelEdit<'_>, pair: usize, stiffness: f64, damping: f64) {
    let (dmax, scale) = engagement(edit.model(), pair);
    let solref = &mut edit.pair_solref()[2 * pair..2 * pair + 2];
    solref[0] = -stiffness * dmax / scale;
    solref[1] = -damping * dmax / scale;
}
