//! Mass, centre of mass and inertia of a body that always stay physically consistent.
//!
//! A body's second moments, with Σ the second moment matrix about the body's origin, h = m c, form the 4 × 4
//! pseudo-inertia, which is positive definite exactly for what a density can have:
//!
//! ```text
//! J = [ Σ  h ]        I = tr(Σ) 1 − Σ   (about the origin)
//!     [ hᵀ m ]
//! ```
//!
//! A change is a relative log-Cholesky factor θ = (α, d1, d2, d3, s12, s23, s13, t1, t2, t3), zero for none:
//!
//! ```text
//! J(θ) = U T Tᵀ Uᵀ    with J = U Uᵀ, U upper triangular
//!
//!            [ e^d1  s12   s13   t1 ]
//! T = e^α ·  [  0   e^d2   s23   t2 ]
//!            [  0    0    e^d3   t3 ]
//!            [  0    0     0     1  ]
//! ```
//!
//! e^2α is the factor of the mass, d those of the extents, s shears, t moves the centre of mass in units of the
//! body's own extents.
//!
//! Reference: Rucker and Wensing 2022, "Smooth parameterization of rigid-body inertia".

use nalgebra::{Matrix3, Matrix4, Quaternion, SymmetricEigen, UnitQuaternion, Vector3};

/// Number of components of θ.
pub const N_INERTIA: usize = 10;

/// Inertia of one body as the engine keeps it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyInertia {
    /// kg
    pub mass: f64,
    /// centre of mass in the body frame, m
    pub ipos: [f64; 3],
    /// orientation of the principal axes in the body frame, w first
    pub iquat: [f64; 4],
    /// principal moments, kg m²
    pub inertia: [f64; 3],
}

impl BodyInertia {
    /// Inertia matrix about the centre of mass in the body frame.
    pub fn matrix(&self) -> Matrix3<f64> {
        let [w, x, y, z] = self.iquat;
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let r = rotation.to_rotation_matrix();
        r.matrix() * Matrix3::from_diagonal(&Vector3::from(self.inertia)) * r.matrix().transpose()
    }

    fn pseudo(&self) -> Matrix4<f64> {
        let central = self.matrix();
        let c = Vector3::from(self.ipos);
        let sigma = Matrix3::identity() * (0.5 * central.trace()) - central;
        let mut j = Matrix4::zeros();
        j.fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(sigma + self.mass * c * c.transpose()));
        j.fixed_view_mut::<3, 1>(0, 3).copy_from(&(self.mass * c));
        j.fixed_view_mut::<1, 3>(3, 0)
            .copy_from(&(self.mass * c.transpose()));
        j[(3, 3)] = self.mass;
        j
    }

    fn from_pseudo(j: &Matrix4<f64>) -> Self {
        let mass = j[(3, 3)];
        let c: Vector3<f64> = j.fixed_view::<3, 1>(0, 3) / mass;
        let sigma: Matrix3<f64> = j.fixed_view::<3, 3>(0, 0) - mass * c * c.transpose();
        let central = Matrix3::identity() * sigma.trace() - sigma;
        let eigen = SymmetricEigen::new(central);
        let mut axes = eigen.eigenvectors;
        if axes.determinant() < 0.0 {
            axes.set_column(2, &(-axes.column(2)));
        }
        let q = UnitQuaternion::from_matrix(&axes);
        Self {
            mass,
            ipos: c.into(),
            iquat: [q.w, q.i, q.j, q.k],
            inertia: eigen.eigenvalues.into(),
        }
    }

    /// This inertia changed by θ; `None` if it is not that of a body (a triangle inequality is violated).
    pub fn changed(&self, theta: &[f64; N_INERTIA]) -> Option<Self> {
        if theta.iter().all(|&t| t == 0.0) {
            return Some(*self);
        }
        let u = upper_factor(&self.pseudo())?;
        let [alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3] = *theta;
        let t = Matrix4::new(
            d1.exp(),
            s12,
            s13,
            t1, //
            0.0,
            d2.exp(),
            s23,
            t2, //
            0.0,
            0.0,
            d3.exp(),
            t3, //
            0.0,
            0.0,
            0.0,
            1.0,
        ) * alpha.exp();
        let ut = u * t;
        Some(Self::from_pseudo(&(ut * ut.transpose())))
    }
}

/// U upper triangular with J = U Uᵀ: the Cholesky factor with rows and columns taken in reverse.
fn upper_factor(j: &Matrix4<f64>) -> Option<Matrix4<f64>> {
    let reversed = Matrix4::from_fn(|r, c| j[(3 - r, 3 - c)]);
    let lower = reversed.cholesky()?.l();
    Some(Matrix4::from_fn(|r, c| lower[(3 - r, 3 - c)]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BODY: BodyInertia = BodyInertia {
        mass: 0.3,
        ipos: [0.02, -0.01, 0.05],
        iquat: [0.8, 0.6, 0.0, 0.0],
        inertia: [3e-4, 2e-4, 2.5e-4],
    };

    #[test]
    fn no_change_gives_the_same_body_through_the_factors() {
        let same = BodyInertia::from_pseudo(&BODY.pseudo());
        assert!((same.mass - BODY.mass).abs() < 1e-15);
        assert!((same.matrix() - BODY.matrix()).amax() < 1e-17);
    }

    #[test]
    fn alpha_scales_everything_and_t_moves_the_centre_of_mass() {
        let mut theta = [0.0; N_INERTIA];
        theta[0] = 0.5 * 2_f64.ln();
        let heavier = BODY.changed(&theta).expect("a body");
        assert!((heavier.mass - 0.6).abs() < 1e-14);
        assert!((heavier.matrix() - 2.0 * BODY.matrix()).amax() < 1e-15);
        theta[0] = 0.0;
        theta[9] = 0.1;
        let moved = BODY.changed(&theta).expect("a body");
        assert!((moved.mass - BODY.mass).abs() < 1e-14);
        assert!(moved.ipos[2] > BODY.ipos[2]);
    }

    #[test]
    fn any_theta_keeps_the_triangle_inequalities() {
        for k in 0..50 {
            let theta: [f64; N_INERTIA] =
                std::array::from_fn(|i| 2.0 * (f64::from(k) * 1.7 + i as f64 * 2.3).sin());
            let [a, b, c] = BODY.changed(&theta).expect("a body").inertia;
            assert!(a + b > c && b + c > a && c + a > b, "{a} {b} {c}");
        }
        let flat = BodyInertia {
            inertia: [1e-4, 1e-4, 3e-4],
            ..BODY
        };
        assert_eq!(flat.changed(&[0.1; N_INERTIA]), None);
    }
}
