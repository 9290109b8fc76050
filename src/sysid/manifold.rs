//! Derivatives of the difference of two configurations, exact on quaternions.
//!
//! v = (q ⊖ q₋)/h. A change δ of q by `mj_integratePos` (δ in the tangent space, nv) changes v by
//!
//! ```text
//! ∂v/∂δ  =  J(φ)/h      ∂v/∂δ₋ = −J(−φ)/h      φ = h v
//! ```
//!
//! J is 1 for hinges, slides and translations. For the rotation of a ball or free joint it is the inverse right
//! Jacobian of SO(3), 1 + ½[φ]× + c [φ]×² with c = 1/θ² − (1 + cos θ)/(2 θ sin θ), θ = |φ|.

use crate::mujoco::Model;

/// First dof of the rotation of every ball and free joint.
pub(super) fn rotations(model: &Model) -> Vec<usize> {
    (0..model.njnt())
        .filter_map(|joint| {
            let first = model.jnt_dofadr()[joint] as usize;
            match model.jnt_type()[joint] {
                0 => Some(first + 3), // mjJNT_FREE
                1 => Some(first),     // mjJNT_BALL
                _ => None,
            }
        })
        .collect()
}

/// Inverse right Jacobian of SO(3), row by row.
pub(super) fn inverse_right(phi: [f64; 3]) -> [f64; 9] {
    let [x, y, z] = phi;
    let square = x * x + y * y + z * z;
    let c = if square < 1e-6 {
        1.0 / 12.0 + square / 720.0
    } else {
        let theta = square.sqrt();
        1.0 / square - (1.0 + theta.cos()) / (2.0 * theta * theta.sin())
    };
    [
        1.0 - c * (y * y + z * z),
        -0.5 * z + c * x * y,
        0.5 * y + c * x * z,
        0.5 * z + c * x * y,
        1.0 - c * (x * x + z * z),
        -0.5 * x + c * y * z,
        -0.5 * y + c * x * z,
        0.5 * x + c * y * z,
        1.0 - c * (x * x + y * y),
    ]
}

/// Replaces a matrix A (rows × nv) by A J, where J belongs to the velocity `qvel`; `sign` −1 gives A J(−φ).
pub(super) fn times_jacobian(
    a: &mut [f64],
    nv: usize,
    rotations: &[usize],
    qvel: &[f64],
    signed_h: f64,
) {
    for &first in rotations {
        let phi = [0, 1, 2].map(|i| signed_h * qvel[first + i]);
        let j = inverse_right(phi);
        for row in a.chunks_exact_mut(nv) {
            let old = [row[first], row[first + 1], row[first + 2]];
            for c in 0..3 {
                row[first + c] = old[0] * j[c] + old[1] * j[3 + c] + old[2] * j[6 + c];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FREE: &str =
        r#"<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>"#;

    #[test]
    fn agrees_with_finite_differences_of_the_engine() {
        let model = Model::from_xml_str(FREE).expect("loads");
        let h = 0.1;
        let qvel = [0.2, -0.1, 0.4, 3.0, -5.0, 2.0];
        let before = model.qpos0().to_vec();
        let mut after = before.clone();
        model.integrate_pos(&mut after, &qvel, h).expect("lengths");
        let eps = 1e-6;
        for (moved, sign) in [(true, 1.0), (false, -1.0)] {
            let mut expected: Vec<f64> = (0..36)
                .map(|i| if i % 7 == 0 { sign / h } else { 0.0 })
                .collect();
            times_jacobian(&mut expected, 6, &rotations(&model), &qvel, sign * h);
            for j in 0..6 {
                let [plus, minus] = [eps, -eps].map(|eps| {
                    let mut delta = [0.0; 6];
                    delta[j] = eps;
                    let (mut a, mut b) = (before.clone(), after.clone());
                    let q = if moved { &mut b } else { &mut a };
                    model.integrate_pos(q, &delta, 1.0).expect("lengths");
                    let mut v = [0.0; 6];
                    model.differentiate_pos(&mut v, h, &a, &b).expect("lengths");
                    v
                });
                for i in 0..6 {
                    let slope = (plus[i] - minus[i]) / (2.0 * eps);
                    assert!(
                        (slope - expected[6 * i + j]).abs() < 1e-6,
                        "{i} {j} {slope}"
                    );
                }
            }
        }
    }
}
