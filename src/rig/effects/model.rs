//! Effects that are other numbers in the true model.

use super::{Bound, Effect, Place, kind};
use crate::mjcf::attribute::bounding_radius;
use crate::mujoco::{Cone, Model, ModelEdit, MujocoError, ObjectKind};

/// Change the numbers of `edit` as `bound` says.
///
/// # Errors
/// The reason why the effect does not fit an element.
pub(in crate::rig) fn apply(edit: &mut ModelEdit<'_>, bound: &Bound) -> Result<(), String> {
    let v = &bound.values;
    let share = 1.0 + v[0];
    match bound.effect {
        Effect::GravityTilt => tilt(edit, v[0], v[1]).map_err(|e| e.to_string())?,
        Effect::FrictionCone if v[0] > 0.5 => other_cone(edit).map_err(|e| e.to_string())?,
        _ => {}
    }
    let contact = kind(edit.model(), Place::Contact);
    for &id in &bound.elements {
        match bound.effect {
            Effect::RotorInertia => {
                let dof = edit.model().jnt_dofadr()[id] as usize;
                edit.dof_armature()[dof] += v[0];
            }
            Effect::LinkMass | Effect::ObjectMass => {
                edit.body_mass()[id] *= share;
                for x in &mut edit.body_inertia()[3 * id..3 * id + 3] {
                    *x *= share;
                }
            }
            Effect::Payload => payload(edit, id, v[0], [v[1], v[2], v[3]]),
            Effect::BasePose => {
                edit.body_pos()[3 * id] += v[0] * v[1].cos();
                edit.body_pos()[3 * id + 1] += v[0] * v[1].sin();
                yaw(&mut edit.body_quat()[4 * id..4 * id + 4], v[2]);
            }
            Effect::LengthScale => {
                for x in &mut edit.body_pos()[3 * id..3 * id + 3] {
                    *x *= share;
                }
            }
            Effect::FingertipRadius => {
                edit.geom_size()[3 * id] += v[0];
                let radius = bounding_radius(edit.model(), id)
                    .filter(|_| edit.model().geom_size()[3 * id] > 0.0)
                    .ok_or("the geom would have no size, or its shape is not made of one")?;
                edit.geom_rbound()[id] = radius;
            }
            Effect::ContactFriction => match contact {
                ObjectKind::Pair => {
                    edit.pair_friction()[5 * id] *= share;
                    edit.pair_friction()[5 * id + 1] *= share;
                }
                _ => edit.geom_friction()[3 * id] *= share,
            },
            Effect::AnisotropicFriction => match contact {
                ObjectKind::Pair => edit.pair_friction()[5 * id + 1] *= share,
                _ => return Err("it needs explicit contact pairs in the model".to_owned()),
            },
            // k ~ 1/(time constant × ratio)², damping ~ 1/time constant; negative numbers are -stiffness, -damping
            Effect::ContactStiffness => {
                let [constant, ratio] = solref(edit, contact, id);
                if *constant > 0.0 {
                    *constant /= share.sqrt();
                } else {
                    *constant *= share;
                    *ratio *= share.sqrt();
                }
            }
            Effect::ContactDamping => {
                let [constant, ratio] = solref(edit, contact, id);
                if *constant > 0.0 {
                    *constant /= share;
                }
                *ratio *= share;
            }
            _ => {}
        }
    }
    Ok(())
}

fn solref<'a>(edit: &'a mut ModelEdit<'_>, contact: ObjectKind, id: usize) -> [&'a mut f64; 2] {
    let all = match contact {
        ObjectKind::Pair => edit.pair_solref(),
        _ => edit.geom_solref(),
    };
    let (first, second) = all[2 * id..2 * id + 2].split_at_mut(1);
    [&mut first[0], &mut second[0]]
}

/// Turn gravity by `angle` towards `heading` in the plane.
fn tilt(edit: &mut ModelEdit<'_>, angle: f64, heading: f64) -> Result<(), MujocoError> {
    let mut option = edit.model().option();
    let size = option.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
    let sideways = size * angle.sin();
    option.gravity = [
        sideways * heading.cos(),
        sideways * heading.sin(),
        -size * angle.cos(),
    ];
    edit.set_option(&option)
}

fn other_cone(edit: &mut ModelEdit<'_>) -> Result<(), MujocoError> {
    let mut option = edit.model().option();
    option.cone = match option.cone {
        Cone::Pyramidal => Cone::Elliptic,
        Cone::Elliptic => Cone::Pyramidal,
    };
    edit.set_option(&option)
}

/// Turn an orientation by `angle` about the parent's z axis.
fn yaw(quat: &mut [f64], angle: f64) {
    let (s, c) = (0.5 * angle).sin_cos();
    let [w, x, y, z] = [quat[0], quat[1], quat[2], quat[3]];
    quat.copy_from_slice(&[c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]);
}

/// A point mass at `place` of the body's frame: mass, centre and, in the body's inertial axes, the diagonal of the inertia.
///
/// Products of inertia that the point makes in those axes are left out: the engine stores a diagonal and its axes.
fn payload(edit: &mut ModelEdit<'_>, body: usize, mass: f64, place: [f64; 3]) {
    let before = edit.model().body_mass()[body];
    let total = before + mass;
    let centre: [f64; 3] = std::array::from_fn(|k| edit.model().body_ipos()[3 * body + k]);
    let offset: [f64; 3] = std::array::from_fn(|k| place[k] - centre[k]);
    let axes = inertial_axes(edit.model(), body);
    let along: [f64; 3] =
        std::array::from_fn(|k| (0..3).map(|i| axes[3 * i + k] * offset[i]).sum());
    let reduced = before * mass / total;
    let square: f64 = along.iter().map(|x| x * x).sum();
    for k in 0..3 {
        edit.body_inertia()[3 * body + k] += reduced * (square - along[k] * along[k]);
        edit.body_ipos()[3 * body + k] += offset[k] * mass / total;
    }
    edit.body_mass()[body] = total;
}

/// Rotation matrix of the inertial axes in the body's frame, row by row.
fn inertial_axes(model: &Model, body: usize) -> [f64; 9] {
    let q = &model.body_iquat()[4 * body..4 * body + 4];
    let [w, x, y, z] = [q[0], q[1], q[2], q[3]];
    [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    ]
}

#[cfg(test)]
mod tests {
    use super::yaw;

    #[test]
    fn yaw_turns_about_the_parents_axis() {
        let mut quat = [1.0, 0.0, 0.0, 0.0];
        yaw(&mut quat, std::f64::consts::PI);
        assert!((quat[0].abs() < 1e-15) && (quat[3] - 1.0).abs() < 1e-15);
        let mut same = [0.5, 0.5, 0.5, 0.5];
        yaw(&mut same, 0.0);
        assert_eq!(same, [0.5; 4]);
    }
}
