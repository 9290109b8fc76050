//! Quantiles of Student's t and of F.

use statrs::distribution::{ContinuousCDF, FisherSnedecor, StudentsT};

/// Beyond this many degrees of freedom t and F are their limits to five digits.
const MANY: f64 = 1e5;
/// Below this many a distribution has no scale worth the name.
const FEW: f64 = 0.1;

/// t with P(|T| ≤ t) = `p` for `dof` degrees of freedom; any number above 0, infinity is the normal distribution.
pub(crate) fn two_sided_t(p: f64, dof: f64) -> f64 {
    StudentsT::new(0.0, 1.0, within(dof)).map_or(f64::NAN, |t| t.inverse_cdf(0.5 * (1.0 + p)))
}

/// f with P(F ≤ f) = `p` for `m` and `n` degrees of freedom.
pub(super) fn f_quantile(p: f64, m: f64, n: f64) -> f64 {
    FisherSnedecor::new(within(m), within(n)).map_or(f64::NAN, |f| f.inverse_cdf(p))
}

/// A number of degrees of freedom that a distribution can have: residuals of rounding alone give any.
fn within(dof: f64) -> f64 {
    if dof.is_nan() {
        FEW
    } else {
        dof.clamp(FEW, MANY)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against closed forms: t₁ is Cauchy's distribution, t₂ algebraic, F₂,ₙ a power.
    #[test]
    fn agrees_with_closed_forms() {
        for p in [0.5, 0.9, 0.95, 0.99] {
            let cauchy = (std::f64::consts::FRAC_PI_2 * p).tan();
            assert!((two_sided_t(p, 1.0) / cauchy - 1.0).abs() < 1e-6);
            let two = p * (2.0 / (1.0 - p * p)).sqrt();
            assert!((two_sided_t(p, 2.0) / two - 1.0).abs() < 1e-6);
            let n = 7.0;
            let power = 0.5 * n * ((1.0 - p).powf(-2.0 / n) - 1.0);
            assert!((f_quantile(p, 2.0, n) / power - 1.0).abs() < 1e-6);
        }
        assert!((two_sided_t(0.95, f64::INFINITY) - 1.959_964).abs() < 3e-5);
        // F(1, n) is the square of t(n)
        let t = two_sided_t(0.95, 9.0);
        assert!((f_quantile(0.95, 1.0, 9.0) / (t * t) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn numbers_that_are_none_end() {
        for dof in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 0.0, 1e300] {
            assert!(two_sided_t(0.95, dof) > 0.0);
            assert!(f_quantile(0.65, dof, 4.0) > 0.0);
            assert!(f_quantile(0.65, 4.0, dof) > 0.0);
        }
    }
}
