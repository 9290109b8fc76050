//! Sums of outer products Σ x xᵀ over many samples, in an order that does not depend on threads.
//!
//! Trajectories are dealt to a fixed number of lanes (trajectory `i` to lane `i mod LANES`); each lane adds its own in
//! order, and the lanes are added in order. Threads only decide who works on which lane.
//!
//! Within a lane samples are gathered into panels, and a panel is added by matrix products on column blocks of the
//! lower triangle, which is some five times faster than rank-one updates.

use nalgebra::{DMatrix, DMatrixView};
use rayon::prelude::*;

/// Lanes of every reduction. Even, so that the parity of a trajectory is the parity of its lane.
pub(crate) const LANES: usize = 8;
const PANEL: usize = 512;
const BLOCK: usize = 96;

/// A growing Σ x xᵀ of which only the lower triangle is kept.
#[derive(Debug, Clone)]
pub(crate) struct Gram {
    sum: DMatrix<f64>, // (n × n) lower triangle
    panel: Vec<f64>,   // (n × samples) column-major, not yet added
    count: usize,
}

impl Gram {
    pub(crate) fn new(n: usize) -> Self {
        Self {
            sum: DMatrix::zeros(n, n),
            panel: Vec::with_capacity(n * PANEL),
            count: 0,
        }
    }

    /// Add one sample, which `fill` appends to the vector it is given.
    pub(crate) fn push(&mut self, fill: impl FnOnce(&mut Vec<f64>)) {
        fill(&mut self.panel);
        self.count += 1;
        debug_assert_eq!(self.panel.len() % self.sum.nrows(), 0);
        if self.panel.len() >= self.sum.nrows() * PANEL {
            self.flush();
        }
    }

    fn flush(&mut self) {
        let n = self.sum.nrows();
        let samples = self.panel.len() / n;
        if samples == 0 {
            return;
        }
        let panel = DMatrixView::from_slice(&self.panel, n, samples);
        let transposed = panel.transpose();
        for start in (0..n).step_by(BLOCK) {
            let width = BLOCK.min(n - start);
            self.sum.view_mut((start, start), (n - start, width)).gemm(
                1.0,
                &panel.rows(start, n - start),
                &transposed.columns(start, width),
                1.0,
            );
        }
        self.panel.clear();
    }

    /// The sum (lower triangle valid) and the number of samples in it.
    pub(crate) fn finish(mut self) -> (DMatrix<f64>, usize) {
        self.flush();
        (self.sum, self.count)
    }
}

/// Sum over `items` in lanes: `work` handles the items of one lane in order; results come back in lane order.
pub(crate) fn lanes<T: Sync, R: Send>(
    items: &[T],
    work: impl Fn(&mut dyn Iterator<Item = &T>) -> R + Sync,
) -> Vec<R> {
    (0..LANES)
        .into_par_iter()
        .with_max_len(1)
        .map(|lane| work(&mut items.iter().skip(lane).step_by(LANES)))
        .collect()
}

/// Copy the lower triangle to the upper one.
pub(crate) fn symmetrise(matrix: &mut DMatrix<f64>) {
    matrix.fill_upper_triangle_with_lower_triangle();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equals_the_sum_of_outer_products() {
        let n = 130; // more than one block
        let samples: Vec<Vec<f64>> = (0..700)
            .map(|k| {
                (0..n)
                    .map(|i| f64::from((k * 31 + i * 17) % 23) - 11.0)
                    .collect()
            })
            .collect();
        let mut gram = Gram::new(n as usize);
        let mut expected = DMatrix::<f64>::zeros(n as usize, n as usize);
        for sample in &samples {
            gram.push(|panel| panel.extend_from_slice(sample));
            let x = nalgebra::DVector::from_column_slice(sample);
            expected += &x * x.transpose();
        }
        let (mut sum, count) = gram.finish();
        symmetrise(&mut sum);
        assert_eq!(count, samples.len());
        assert_eq!(sum, expected, "integers are summed exactly in any order");
    }
}
