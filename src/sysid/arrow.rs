//! Least squares over a trajectory and shared parameters: a block band with a dense border.
//!
//! The rows of the linearised problem belong to windows of three knots,
//!
//! ```text
//! A₋ δq₍k−1₎ + A₀ δq₍k₎ + A₊ δq₍k+1₎ + B δx = −r
//! ```
//!
//! An orthogonal elimination runs along the trajectory (a square-root information filter): rows of window k are
//! appended to what is left of earlier ones, Householder reflections make the columns of q₍k−1₎ triangular, and its nv
//! rows are put aside for the way back. What is left at the end are rows in δx alone. Time and memory are linear in the
//! number of knots, and the condition number is that of the problem, not its square as with normal equations.
//!
//! The rows that a window leaves without any state are the innovations: what its measurements say beyond everything
//! before. If the model is right they are white with variance 1, and they carry all the information on x:
//!
//! ```text
//! Σ innovations  B̃ᵀB̃ = information on x with the trajectory marginalised (Schur complement)
//! ```
//!
//! Reference: Bierman 1977, "Factorization Methods for Discrete Sequential Estimation".

/// Elimination of one trajectory.
#[derive(Debug)]
pub(super) struct Arrow {
    nv: usize,
    np: usize,
    width: usize,              // 3 nv + np + 1: window, parameters, right-hand side
    carry: Vec<f64>,           // (2 nv × width) triangular in its first 2 nv columns
    front: Vec<f64>,           // rows of the current window
    n_rows: usize,             // in `front`
    kept: Vec<f64>,            // per knot nv × width
    pub innovations: Vec<f64>, // rows of np + 1
    pub innovation_knots: Vec<usize>, // knot of each
    weakest: f64,              // least ratio of a diagonal entry to its column
    weakest_at: (usize, usize),
    scratch: Vec<f64>,
}

impl Arrow {
    pub(super) fn new(nv: usize, np: usize) -> Self {
        let width = 3 * nv + np + 1;
        Self {
            nv,
            np,
            width,
            carry: vec![0.0; 2 * nv * width],
            front: Vec::new(),
            n_rows: 0,
            kept: Vec::new(),
            innovations: Vec::new(),
            innovation_knots: Vec::new(),
            weakest: f64::INFINITY,
            weakest_at: (0, 0),
            scratch: vec![0.0; width],
        }
    }

    /// Adds a row of zeros to the current window, to be filled in: columns q₋, q, q₊, x, right-hand side.
    pub(super) fn row(&mut self) -> &mut [f64] {
        self.n_rows += 1;
        if self.front.len() < self.n_rows * self.width {
            self.front.resize(self.n_rows * self.width, 0.0);
        }
        let row = &mut self.front[(self.n_rows - 1) * self.width..self.n_rows * self.width];
        row.fill(0.0);
        row
    }

    /// Ends window k and eliminates q₍k−1₎. For k = 0, whose first block is empty, nothing is put aside.
    pub(super) fn close(&mut self, k: usize) {
        let (nv, width) = (self.nv, self.width);
        // the columns of q₊ have no carried rows yet: they need nv rows of the front at least
        let mut used = 0;
        for j in 0..3 * nv {
            if j < 2 * nv {
                let pivot = &mut self.carry[j * width..(j + 1) * width];
                let rows = &mut self.front[..self.n_rows * width];
                reflect(pivot, rows, width, j, &mut self.scratch);
            } else {
                if used == self.n_rows {
                    self.row();
                }
                let rows = &mut self.front[used * width..self.n_rows * width];
                let (pivot, rows) = rows.split_at_mut(width);
                reflect(pivot, rows, width, j, &mut self.scratch);
                used += 1;
            }
        }
        for i in used..self.n_rows {
            let row = &self.front[i * width + 3 * nv..(i + 1) * width];
            if row.iter().any(|&v| v != 0.0) {
                self.innovations.extend_from_slice(row);
                self.innovation_knots.push(k);
            }
        }
        if k > 0 {
            for i in 0..nv {
                let row = &self.carry[i * width..(i + 1) * width];
                let size = row[i..3 * nv].iter().fold(0.0_f64, |m, v| m.max(v.abs()));
                let ratio = if size > 0.0 { row[i].abs() / size } else { 0.0 };
                if ratio < self.weakest {
                    (self.weakest, self.weakest_at) = (ratio, (k - 1, i));
                }
            }
            self.kept.extend_from_slice(&self.carry[..nv * width]);
        }
        // shift: (q, q₊) become the first two blocks
        let state = 3 * nv;
        for i in 0..2 * nv {
            let (from_carry, at) = if i < nv {
                (true, nv + i)
            } else {
                (false, i - nv)
            };
            for c in 0..width {
                let value = {
                    let source = if from_carry { &self.carry } else { &self.front };
                    let column = if c < 2 * nv {
                        c + nv
                    } else if c < state {
                        usize::MAX
                    } else {
                        c
                    };
                    if column == usize::MAX {
                        0.0
                    } else {
                        source[at * width + column]
                    }
                };
                self.carry[i * width + c] = value;
            }
        }
        self.n_rows = 0;
    }

    /// Ends the trajectory after its last window: what is left belongs to the last knot.
    pub(super) fn finish(&mut self, n_knots: usize) {
        let (nv, width) = (self.nv, self.width);
        // after the last close the blocks are (q_last, beyond); rows beyond hold only zeros in states
        self.kept.extend_from_slice(&self.carry[..nv * width]);
        for i in nv..2 * nv {
            let row = &self.carry[i * width + 3 * nv..(i + 1) * width];
            if row.iter().any(|&v| v != 0.0) {
                self.innovations.extend_from_slice(row);
                self.innovation_knots.push(n_knots - 1);
            }
        }
    }

    /// The trajectory's change (`n_knots` × nv) for a change `x` of the parameters.
    pub(super) fn back_substitute(&self, x: &[f64]) -> Vec<f64> {
        let (nv, width) = (self.nv, self.width);
        if nv == 0 {
            return Vec::new();
        }
        let n = self.kept.len() / (nv * width);
        let mut q = vec![0.0; (n + 2) * nv];
        for k in (0..n).rev() {
            for i in (0..nv).rev() {
                let row = &self.kept[(k * nv + i) * width..(k * nv + i + 1) * width];
                let mut sum = row[width - 1];
                for (b, x) in row[3 * nv..3 * nv + self.np].iter().zip(x) {
                    sum -= b * x;
                }
                for (a, q) in row[i + 1..3 * nv].iter().zip(&q[k * nv + i + 1..]) {
                    sum -= a * q;
                }
                q[k * nv + i] = if row[i] == 0.0 { 0.0 } else { sum / row[i] };
            }
        }
        q.truncate(n * nv);
        q
    }

    /// Sum of the logarithms of the diagonal over the trajectory.
    pub(super) fn log_diagonal(&self) -> f64 {
        let rows = self.kept.chunks_exact(self.width).enumerate();
        rows.map(|(i, row)| row[i % self.nv].abs().max(f64::MIN_POSITIVE).ln())
            .sum()
    }

    /// Least ratio of a diagonal entry to its row, with its knot and degree of freedom: 0 is unobservable.
    pub(super) fn weakest(&self) -> (f64, (usize, usize)) {
        (self.weakest, self.weakest_at)
    }
}

/// Householder reflection of `pivot` and `rows` that leaves column `j` in the pivot alone.
fn reflect(pivot: &mut [f64], rows: &mut [f64], width: usize, j: usize, w: &mut [f64]) {
    let mut square = 0.0;
    for row in rows.chunks_exact(width) {
        square += row[j] * row[j];
    }
    if square == 0.0 {
        return;
    }
    let a = pivot[j];
    let norm = (a * a + square).sqrt();
    let alpha = if a > 0.0 { -norm } else { norm };
    let v0 = a - alpha;
    let beta = 2.0 / (v0 * v0 + square);
    // w = beta · vᵀ A
    let w = &mut w[j + 1..width];
    for (w, p) in w.iter_mut().zip(&pivot[j + 1..]) {
        *w = v0 * p;
    }
    for row in rows.chunks_exact(width) {
        let v = row[j];
        if v != 0.0 {
            for (w, a) in w.iter_mut().zip(&row[j + 1..]) {
                *w += v * a;
            }
        }
    }
    for w in w.iter_mut() {
        *w *= beta;
    }
    pivot[j] = alpha;
    for (p, w) in pivot[j + 1..].iter_mut().zip(&*w) {
        *p -= v0 * w;
    }
    for row in rows.chunks_exact_mut(width) {
        let v = row[j];
        if v != 0.0 {
            row[j] = 0.0;
            for (a, w) in row[j + 1..].iter_mut().zip(&*w) {
                *a -= v * w;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// The dense solution of the same rows.
    #[test]
    fn agrees_with_dense_least_squares() {
        let (nv, np, n) = (2, 3, 7);
        let mut seed = 1.0_f64;
        let mut random = || {
            seed = (seed * 78.233).sin() * 43758.5453;
            seed -= seed.floor();
            2.0 * seed - 1.0
        };
        let mut arrow = Arrow::new(nv, np);
        let (mut rows, mut right) = (Vec::new(), Vec::new());
        for k in 0..n {
            for _ in 0..5 {
                let mut dense = vec![0.0; nv * n + np];
                let row = arrow.row();
                for block in 0..3 {
                    let knot = (k + block).wrapping_sub(1);
                    if knot < n {
                        for i in 0..nv {
                            let value = random();
                            row[block * nv + i] = value;
                            dense[knot * nv + i] = value;
                        }
                    }
                }
                for i in 0..np {
                    let value = random();
                    row[3 * nv + i] = value;
                    dense[nv * n + i] = value;
                }
                let value = random();
                row[3 * nv + np] = value;
                rows.push(dense);
                right.push(value);
            }
            arrow.close(k);
        }
        arrow.finish(n);
        let a = DMatrix::from_fn(rows.len(), nv * n + np, |i, j| rows[i][j]);
        let b = DVector::from_vec(right);
        let expected = a.clone().svd(true, true).solve(&b, 1e-12).expect("solved");
        let left =
            DMatrix::from_row_slice(arrow.innovation_knots.len(), np + 1, &arrow.innovations);
        let p = left.columns(0, np).into_owned();
        let x = p
            .clone()
            .svd(true, true)
            .solve(&left.column(np).into_owned(), 1e-12)
            .expect("solved");
        assert!((&x - expected.rows(nv * n, np)).amax() < 1e-12);
        let q = DVector::from_vec(arrow.back_substitute(x.as_slice()));
        assert!((q - expected.rows(0, nv * n)).amax() < 1e-11);
        // the innovations hold the Schur complement
        let normal = a.transpose() * &a;
        let m = nv * n;
        let inverse = normal
            .view((0, 0), (m, m))
            .into_owned()
            .try_inverse()
            .expect("regular");
        let schur = normal.view((m, m), (np, np))
            - normal.view((m, 0), (np, m)) * inverse * normal.view((0, m), (m, np));
        assert!((p.transpose() * p - schur).amax() < 1e-11);
    }
}
