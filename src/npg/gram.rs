//! Sums of outer products Σ x xᵀ over many samples.
//!
//! Samples are gathered into panels, and a panel is added by matrix products on column blocks of the lower triangle,
//! which is some five times faster than rank-one updates. The triangle is what is added up between lanes of trajectories
//! and sent between processes (see [`crate::team`]).

use nalgebra::{DMatrix, DMatrixView};

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

    /// The number of samples and the lower triangle, column by column: what adds up.
    pub(crate) fn packed(mut self) -> Vec<f64> {
        self.flush();
        let mut packed = Vec::with_capacity(packed_len(self.sum.nrows()));
        packed.push(self.count as f64);
        let n = self.sum.nrows();
        for (j, column) in self.sum.as_slice().chunks_exact(n).enumerate() {
            packed.extend_from_slice(&column[j..]);
        }
        packed
    }
}

/// Length of a packed [`Gram`] of `n` features.
pub(crate) fn packed_len(n: usize) -> usize {
    1 + n * (n + 1) / 2
}

/// The sum, both triangles, and the number of samples of a packed [`Gram`] of `n` features.
pub(crate) fn unpack(n: usize, packed: &[f64]) -> (DMatrix<f64>, usize) {
    let mut sum = DMatrix::zeros(n, n);
    let mut rest = &packed[1..];
    for (j, column) in sum.as_mut_slice().chunks_exact_mut(n).enumerate() {
        let (values, after) = rest.split_at(n - j);
        column[j..].copy_from_slice(values);
        rest = after;
    }
    sum.fill_upper_triangle_with_lower_triangle();
    (sum, packed[0] as usize)
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
        let packed = gram.packed();
        assert_eq!(packed.len(), packed_len(n as usize));
        let (sum, count) = unpack(n as usize, &packed);
        assert_eq!(count, samples.len());
        assert_eq!(sum, expected, "integers are summed exactly in any order");
    }
}
