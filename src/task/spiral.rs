//! The target path of the paper's evaluation: a spiral from the origin out to 4 cm, then one full circle, 4 s in all.
//!
//! The paper gives the radius, the duration and the order. Taken here: the radius grows linearly with time during the
//! first half while the angle makes one turn, and the second half is one turn at the full radius, so that the angular
//! speed is constant and the path has no corner at the joint.

/// Duration of the path, s.
pub const DURATION_S: f64 = 4.0;
/// Radius of the circle, m.
pub const RADIUS_M: f64 = 0.04;
/// When the spiral becomes the circle, s.
pub const SPIRAL_S: f64 = 2.0;

/// Target (x, y) in m at `time_s` since the start; constant after the end.
pub fn target(time_s: f64) -> [f64; 2] {
    let time_s = time_s.clamp(0.0, DURATION_S);
    let radius = RADIUS_M * (time_s / SPIRAL_S).min(1.0);
    let angle = std::f64::consts::TAU * time_s / SPIRAL_S;
    [radius * angle.cos(), radius * angle.sin()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn begins_at_the_origin_and_ends_on_the_circle() {
        assert_eq!(target(0.0), [0.0, 0.0]);
        for time in [2.0, 2.7, 3.3, 4.0, 9.0] {
            let [x, y] = target(time);
            assert!((x.hypot(y) - RADIUS_M).abs() < 1e-15);
        }
    }

    #[test]
    fn has_no_jump() {
        let step = 1e-4;
        for k in 0..40_000 {
            let ([x0, y0], [x1, y1]) =
                (target(f64::from(k) * step), target(f64::from(k + 1) * step));
            assert!(
                (x1 - x0).hypot(y1 - y0)
                    < 1.1 * RADIUS_M * std::f64::consts::PI * step + 0.02 * step + 1e-12
            );
        }
    }
}
