//! Quantiles of Student's t and of F, from the incomplete beta function.
//!
//! ```text
//! P(|t_ν| ≤ t) = 1 − I(ν/(ν + t²); ν/2, ½)        P(F_{m,n} ≤ f) = I(m f/(m f + n); m/2, n/2)
//! ```
//!
//! I is computed by its continued fraction (Lentz' algorithm), quantiles by bisection.

/// t with P(|T| ≤ t) = `p` for `dof` degrees of freedom; any number above 0, infinity is the normal distribution.
pub(super) fn two_sided_t(p: f64, dof: f64) -> f64 {
    // beyond this many the difference to the normal distribution is below 1e-5
    let dof = dof.min(1e5);
    let inside = |t: f64| 1.0 - incomplete_beta(dof / (dof + t * t), 0.5 * dof, 0.5);
    bisect(|t| inside(t) < p)
}

/// f with P(F ≤ f) = `p` for `m` and `n` degrees of freedom.
pub(super) fn f_quantile(p: f64, m: f64, n: f64) -> f64 {
    bisect(|f| incomplete_beta(m * f / (m * f + n), 0.5 * m, 0.5 * n) < p)
}

/// Where `below` turns false, from 0 on.
fn bisect(below: impl Fn(f64) -> bool) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    while below(high) && high < 1e12 {
        (low, high) = (high, 2.0 * high);
    }
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if below(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// Regularised incomplete beta function I(x; a, b).
fn incomplete_beta(x: f64, a: f64, b: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    if x >= 1.0 {
        return 1.0;
    }
    // the fraction converges fast on this side of the mean only
    if x > (a + 1.0) / (a + b + 2.0) {
        return 1.0 - incomplete_beta(1.0 - x, b, a);
    }
    let front = a * x.ln() + b * (-x).ln_1p() - ln_beta(a, b);
    front.exp() * fraction(x, a, b) / a
}

fn fraction(x: f64, a: f64, b: f64) -> f64 {
    const TINY: f64 = 1e-300;
    let guard = |v: f64| if v.abs() < TINY { TINY } else { v };
    let mut c = 1.0;
    let mut d = 1.0 / guard(1.0 - (a + b) * x / (a + 1.0));
    let mut h = d;
    for m in 1..500 {
        let m = f64::from(m);
        for numerator in [
            m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0)),
        ] {
            d = 1.0 / guard(1.0 + numerator * d);
            c = guard(1.0 + numerator / c);
            h *= d * c;
        }
        if (d * c - 1.0).abs() < 1e-15 {
            break;
        }
    }
    h
}

fn ln_beta(a: f64, b: f64) -> f64 {
    ln_gamma(a) + ln_gamma(b) - ln_gamma(a + b)
}

/// ln Γ(x) for x > 0, by Stirling's series after raising x above 10.
fn ln_gamma(x: f64) -> f64 {
    let (mut x, mut shift) = (x, 0.0);
    while x < 10.0 {
        shift -= x.ln();
        x += 1.0;
    }
    let (r, r2) = (1.0 / x, 1.0 / (x * x));
    let series = r * (1.0 / 12.0 - r2 * (1.0 / 360.0 - r2 * (1.0 / 1260.0 - r2 / 1680.0)));
    shift + (x - 0.5) * x.ln() - x + 0.5 * (2.0 * std::f64::consts::PI).ln() + series
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against closed forms: t₁ is Cauchy's distribution, t₂ algebraic, F₂,ₙ a power.
    #[test]
    fn agrees_with_closed_forms() {
        for p in [0.5, 0.9, 0.95, 0.99] {
            let cauchy = (std::f64::consts::FRAC_PI_2 * p).tan();
            assert!((two_sided_t(p, 1.0) / cauchy - 1.0).abs() < 1e-10);
            let two = p * (2.0 / (1.0 - p * p)).sqrt();
            assert!((two_sided_t(p, 2.0) / two - 1.0).abs() < 1e-10);
            let n = 7.0;
            let power = 0.5 * n * ((1.0 - p).powf(-2.0 / n) - 1.0);
            assert!((f_quantile(p, 2.0, n) / power - 1.0).abs() < 1e-10);
        }
        assert!((two_sided_t(0.95, f64::INFINITY) - 1.959_964).abs() < 3e-5);
        // F(1, n) is the square of t(n)
        let t = two_sided_t(0.95, 9.0);
        assert!((f_quantile(0.95, 1.0, 9.0) / (t * t) - 1.0).abs() < 1e-9);
    }
}
