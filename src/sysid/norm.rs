//! How much a whitened residual costs.

use serde::{Deserialize, Serialize};

/// ρ(r), equal to r²/2 near 0.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Norm {
    /// r²/2
    #[default]
    Quadratic,
    /// r²/2 up to the threshold, linear beyond
    Huber(f64),
    /// c² (√(1 + (r/c)²) − 1), smooth everywhere
    SmoothL1(f64),
}

impl Norm {
    /// ρ(r).
    pub fn cost(self, r: f64) -> f64 {
        match self {
            Self::Quadratic => 0.5 * r * r,
            Self::Huber(c) if r.abs() <= c => 0.5 * r * r,
            Self::Huber(c) => c * (r.abs() - 0.5 * c),
            Self::SmoothL1(c) => c * c * ((1.0 + (r / c).powi(2)).sqrt() - 1.0),
        }
    }

    /// ρ'(r)/r: the weight with which least squares has the same gradient.
    pub fn weight(self, r: f64) -> f64 {
        match self {
            Self::Quadratic => 1.0,
            Self::Huber(c) if r.abs() <= c => 1.0,
            Self::Huber(c) => c / r.abs(),
            Self::SmoothL1(c) => 1.0 / (1.0 + (r / c).powi(2)).sqrt(),
        }
    }

    /// Whether its threshold is usable.
    pub fn is_valid(self) -> bool {
        match self {
            Self::Quadratic => true,
            Self::Huber(c) | Self::SmoothL1(c) => c.is_finite() && c > 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Norm;

    #[test]
    fn the_weight_is_the_slope_over_the_residual() {
        for norm in [Norm::Quadratic, Norm::Huber(1.5), Norm::SmoothL1(0.7)] {
            for r in [-4.0, -1.0, 0.3, 2.0, 50.0] {
                let eps = 1e-6;
                let slope = (norm.cost(r + eps) - norm.cost(r - eps)) / (2.0 * eps);
                assert!((norm.weight(r) * r - slope).abs() < 1e-6, "{norm:?} {r}");
            }
            assert_eq!(norm.cost(0.0), 0.0);
        }
    }
}
