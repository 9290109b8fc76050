//! Passes with parameters held: how likely what lies behind the horizon is, point by point.
//!
//! In the passes of `follow` parameters go where luck leads the simulations that have them, by more than recordings leave
//! open. Where all simulations have the same, log p is known to some nats, and a quadratic averages over
//! that. Points are drawn in clouds: the first about the mean of those passes, as wide as they scatter; each next about
//! the mean m of the better quarter of all points so far, with its covariance, widened to S. Where the cost says little,
//! clouds grow until it does. All points together give
//!
//! ```text
//! −log p(behind | x) ≈ F₀ + g·z + ½ zᵀ H z        z = x − m
//! x̂ = m − (H + C⁻¹ + S⁻¹)⁻¹ (g + C⁻¹ (m − μ))
//! ```
//!
//! with mean μ and covariance C of the swarm at its horizon; S⁻¹ holds what the points do not tell.
//!
//! | symbol | name |
//! | --- | --- |
//! | m, S^½ | `Kernel` of a cloud |
//! | μ, C | `Clouds::known` |

use nalgebra::{DMatrix, DVector};

use super::follow::{Follower, Freedom};
use super::kernel::Kernel;
use crate::rng::{self, Purpose};
use crate::sysid::SysidError;
use crate::sysid::fit::Iteration;
use crate::sysid::surface::{Surface, needed};

/// Most parameters of which points are taken: a quadratic of more needs too many.
const MOST: usize = 6;
/// Clouds, and points of one for each number of the quadratic.
const CLOUDS: u64 = 3;
const POINTS: usize = 3;
/// Part of the points about which the next are drawn, and how much wider.
const BETTER: usize = 4;
const WIDTH: f64 = 1.5;
/// Cost (nats) by which a point may lie above the best and count half.
const NEAR: f64 = 20.0;
/// Number of the first pass; those before are of `follow`.
const FIRST: u64 = 1 << 16;

/// Whether points are taken of so many parameters.
pub(super) fn suits(n_parameters: usize) -> bool {
    n_parameters <= MOST
}

/// Clouds of points.
pub(super) struct Clouds<'a, 'b> {
    pub follower: &'a Follower<'b>,
    /// of every pass
    pub freedom: Freedom<'a>,
    /// what the swarm knows of parameters at its horizon
    pub known: Kernel,
}

/// Parameters and their cost.
type Point = (Vec<f64>, f64);

/// Where the next points are drawn; `None` if there are too few.
fn next(points: &mut [Point]) -> Option<Kernel> {
    points.sort_by(|a, b| a.1.total_cmp(&b.1));
    let better: Vec<DVector<f64>> = (points.iter().take(points.len() / BETTER))
        .map(|p| DVector::from_column_slice(&p.0))
        .collect();
    if better.len() <= better.first()?.len() {
        return None;
    }
    let mut cloud = Kernel::of(&better);
    cloud.root *= WIDTH;
    Some(cloud)
}

impl Clouds<'_, '_> {
    /// From `centre`, where passes scatter by `scatter`. `record` is told of the best point so far, and stops the search
    /// by `false`; `None` then, and where too few points follow the motion.
    pub(super) fn least(
        &self,
        centre: &[f64],
        scatter: &[f64],
        record: &mut dyn FnMut(Iteration) -> bool,
    ) -> Result<Option<Vec<f64>>, SysidError> {
        let n = centre.len();
        let mut cloud = Kernel {
            mean: DVector::from_column_slice(centre),
            root: DMatrix::from_diagonal(&DVector::from_column_slice(scatter)),
        };
        let mut points = Vec::new();
        for round in 0..CLOUDS {
            if round > 0 {
                let Some(narrower) = next(&mut points) else {
                    return Ok(None);
                };
                cloud = narrower;
            }
            if !self.add(&mut points, &cloud, round, record)? {
                return Ok(None);
            }
        }
        if points.len() <= needed(n) {
            return Ok(None);
        }
        let unit: Vec<f64> = cloud.root.row_iter().map(|row| row.norm()).collect();
        let points: Vec<_> = points
            .into_iter()
            .map(|(x, cost)| (x, vec![cost]))
            .collect();
        let surface = Surface::new(cloud.mean.as_slice(), &unit, &points, NEAR)?;
        let known = self.known.precision();
        let curvature = &surface.curvature + &known + cloud.precision();
        let slope = &surface.slope + known * (&cloud.mean - &self.known.mean);
        let off = surface.least(&curvature, &slope);
        let least = cloud.mean.iter().zip(&off).map(|(m, d)| m + d);
        Ok(Some(least.collect()))
    }

    /// Adds those points of a cloud that follow the motion; false if interrupted.
    fn add(
        &self,
        points: &mut Vec<Point>,
        cloud: &Kernel,
        round: u64,
        record: &mut dyn FnMut(Iteration) -> bool,
    ) -> Result<bool, SysidError> {
        let mut rng = rng::stream(self.follower.swarm.seed, Purpose::Swarm, FIRST, round);
        let n = (POINTS * needed(cloud.mean.len())) as u64;
        for k in 0..n {
            let x = self
                .follower
                .inside(cloud.moved(&cloud.mean, 1.0, &mut rng).as_slice());
            let number = FIRST + round * n + k;
            let Some(passed) = self.follower.pass(number, &x, &self.freedom)? else {
                continue;
            };
            points.push((x, -passed.evidence));
            let Some((x, cost)) = points.iter().min_by(|a, b| a.1.total_cmp(&b.1)) else {
                continue;
            };
            let goes_on = record(Iteration {
                level: self.freedom.force,
                cost: *cost,
                damping: 0.0,
                horizon_s: None,
                step: 0.0,
                x: x.clone(),
            });
            if !goes_on {
                return Ok(false);
            }
        }
        Ok(true)
    }
}
