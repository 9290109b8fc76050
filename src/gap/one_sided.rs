//! Friction that holds a joint one way only.
//!
//! With f± = max(c ± a, 0), where c is the joint's friction, forces of c + |a| one way and none the other are one law for all c up to
//! |a|, and no slope leads from there to friction both ways. A fit that was led there goes on, once what is left is weighed again, from
//! c = (c + |a|)/2, half of which differs with direction: where friction is one way only, it returns.

use super::search::Search;

/// Part of the friction that differs with direction where a fit goes on.
const DIFFERS: f64 = 0.5;

impl Search<'_> {
    /// Moves the numbers from which a fit goes on to friction both ways, where an effect has it one way only.
    pub(super) fn hold_both_ways(&mut self) {
        let problem = &self.windows.problem;
        let free = self.built.free(problem);
        for (effect, level) in &self.built.levels {
            let size = free.iter().find(|f| f.1 == *effect);
            let mut all = problem.parameters.iter_free().enumerate();
            let level = all.find(|(_, p)| p.name == *level);
            let (Some((size_at, _, _, slope)), Some((level_at, level))) = (size, level) else {
                continue;
            };
            let (c, a) = (level.to_value(self.x[level_at]), self.x[*size_at] * slope);
            if a.abs() > c {
                let both = (0.5 * (c + a.abs())).clamp(level.lower, level.upper);
                self.x[level_at] = level.to_x(both);
                self.x[*size_at] = DIFFERS * both.copysign(a) / slope;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::gap::masses::{chosen, found, machine, searching};

    /// One way only the law is the same whatever the level, and a fit goes on from where it is both ways, once.
    #[test]
    fn a_fit_goes_on_from_friction_both_ways() {
        let base = machine(r#"frictionloss=".12""#, "");
        let law = chosen(&base, "asymmetric_friction", "a", &[0.04, 0.0]);
        let hidden = crate::gap::effect::write(&base, law.effect, &law.place, &law.values);
        let hidden = hidden.expect("written").file;
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\n";
        searching(&base, &hidden, config, |search, watch| {
            found(search, &[law], watch);
            let problem = &search.windows.problem;
            let [(size_at, _, _, slope)] = search.built.free(problem)[..] else {
                panic!("one size");
            };
            let parameters: Vec<_> = problem.parameters.iter_free().cloned().collect();
            let [(_, name)] = &search.built.levels[..] else {
                panic!("one level");
            };
            let level_at = parameters.iter().position(|p| p.name == *name);
            let level_at = level_at.expect("free");
            let level = &parameters[level_at];
            let start = search.x.clone();
            let at = |c: f64, a: f64| {
                let mut x = start.clone();
                (x[level_at], x[size_at]) = (level.to_x(c), a / slope);
                x
            };
            let square = |x: &[f64]| {
                let linear = search.windows.linearise(x).expect("follows");
                let each = linear.rows.iter().map(|row| row.residual.norm_squared());
                each.sum::<f64>()
            };
            let parts = square(&at(0.105, 0.105)) / square(&at(0.03, 0.18));
            assert!((parts - 1.0).abs() < 1e-6, "{parts}");
            for sign in [1.0, -1.0] {
                search.x = at(0.03, sign * 0.18);
                for _ in 0..2 {
                    search.hold_both_ways();
                    let (c, a) = (
                        level.to_value(search.x[level_at]),
                        search.x[size_at] * slope,
                    );
                    assert!((c - 0.105).abs() < 1e-12 && (a - sign * 0.0525).abs() < 1e-12);
                }
            }
        });
    }
}
