//! First states of windows that a common step does not suit, one window at a time.
//!
//! With parameters held, windows have nothing to do with each other. Where friction holds or a stop is met, one
//! linearisation serves a window badly, and one step for all leaves it far from what the model could do with it: its
//! misfit then weighs on parameters. Such a window, and one that fits much worse than others, takes steps of its own, each with
//! its own damping:
//!
//! ```text
//! ds = −(RᵀR + λ D)⁻¹ Rᵀ Qᵀ r        until ½ |Qᵀ r|² is a small part of the mean window's cost
//! ```
//!
//! with Q, R of [`super::linear`], at the window's own point, or from one of those that were measured, or where the window
//! before it ends, if that is nearer. One that still costs as much as ten is looked for from elsewhere: a single window that ends
//! at a limit by mistake would have all the weight.

use std::collections::BTreeMap;
use std::mem;

use super::followed::Followed;
use super::linear::{Linear, Row, damped};
use super::windows::Windows;
use crate::sysid::shooting::window::State;

/// Part of the mean cost of a window that its state may still take off it.
const SETTLED: f64 = 0.05;
/// Cost of a window, in mean ones, from which it may have gone astray.
const ASTRAY: f64 = 2.0;
/// Steps of a window at most.
const STEPS: usize = 5;
/// Cost of a window, in mean ones, from which its first state is looked for once more from the one that was measured calmly.
const LOST: f64 = 10.0;
/// Those, of [`Windows::measured`].
const CALMLY: [usize; 2] = [1, 2];
const FIRST_DAMPING: f64 = 1e-6;
const LEAST_DAMPING: f64 = 1e-9;
const MOST_DAMPING: f64 = 1e2;

/// Whether going on is no use where windows are, some of which are left.
type InVain<'a> = &'a dyn Fn(&[Followed], &[usize]) -> bool;

impl Windows {
    /// Brings the windows `here`, at parameters `x`, nearer to what their first states allow; `linear` is of a near
    /// point. Windows that the engine refuses to follow stay where they are, and all do once those that stay anyway cost `bound`.
    pub(super) fn settle(&self, x: &[f64], here: &mut [Followed], linear: &Linear, bound: f64) {
        let total: f64 = here.iter().map(|f| f.cost).sum();
        let mean = total / here.len() as f64;
        let enough = SETTLED * mean;
        // what the state could take off, were the window linear
        let left: Vec<usize> = (0..here.len())
            .filter(|&w| {
                let row = &linear.rows[w];
                let left = || 0.5 * here[w].along(row).norm_squared();
                !here[w].is_like(row) || here[w].cost > ASTRAY * mean || left() > enough
            })
            .collect();
        let bound = bound - self.problem.parameters.prior_cost(x);
        let is_lost = |f: &Followed| f.cost > LOST * mean;
        // what is left or lost may get better by all that it costs
        let in_vain = |here: &[Followed], left: &[usize]| {
            let each = here.iter().enumerate();
            let stay = each.filter(|(w, f)| !is_lost(f) && !left.contains(w));
            stay.map(|(_, f)| f.cost).sum::<f64>() >= bound
        };
        if left.is_empty() || in_vain(here, &left) {
            return;
        }
        let mut held = self.holding(x);
        // steps for another model may have led a window astray
        let ends =
            (0..here.len()).map(|w| self.preceding(w).map_or(&here[w].state, |p| &here[p].end));
        let ends: Vec<State> = ends.cloned().collect();
        let [first, ..] = &self.measured;
        for (way, begin) in self.measured.iter().chain([&ends]).enumerate() {
            // what does not shake was measured in one way
            let new = left.iter().filter(|&&w| way == 0 || begin[w] != first[w]);
            let new: Vec<usize> = new.copied().collect();
            let Ok(found) = held.simulate_some(&[], begin, &new) else {
                continue;
            };
            for (&w, found) in new.iter().zip(found) {
                if let Some(found) = found
                    && found.cost < here[w].cost
                {
                    here[w] = found;
                }
            }
        }
        held.approach(here, left, enough, &in_vain);
        if in_vain(here, &[]) {
            return;
        }
        for way in CALMLY {
            let lost: Vec<usize> = (0..here.len()).filter(|&w| is_lost(&here[w])).collect();
            held.begin_again((here, way), &lost, enough, &in_vain);
        }
    }

    /// Looks for the first states of the windows `lost` once more, from those that were measured in this `way`, however far off these
    /// are: what ends at a joint's limit is nearer than what is on its way, and leads nowhere.
    fn begin_again(
        &mut self,
        (here, way): (&mut [Followed], usize),
        lost: &[usize],
        enough: f64,
        in_vain: InVain<'_>,
    ) {
        if lost.is_empty() {
            return;
        }
        let Ok(found) = self.simulate_some(&[], &self.measured[way], lost) else {
            return;
        };
        let begun = lost.iter().zip(found);
        let before: Vec<(usize, Followed)> = begun
            .filter_map(|(&w, found)| Some((w, mem::replace(&mut here[w], found?))))
            .collect();
        let left = before.iter().map(|b| b.0).collect();
        self.approach(here, left, enough, in_vain);
        for (w, before) in before {
            let nearer = here[w].cost < before.cost;
            if !nearer {
                here[w] = before;
            }
        }
    }

    /// Steps of the windows `left` from where they are `here`, without parameters, until no more than `enough` is left in
    /// their first states, or going on is `in_vain`.
    fn approach(
        &mut self,
        here: &mut [Followed],
        mut left: Vec<usize>,
        enough: f64,
        in_vain: InVain<'_>,
    ) {
        self.states = here.iter().map(|f| f.state.clone()).collect();
        let mut damping = vec![FIRST_DAMPING; here.len()];
        // derivatives of each at its state
        let mut rows: BTreeMap<usize, Row> = BTreeMap::new();
        for _ in 0..STEPS {
            let moved: Vec<usize> = (left.iter().copied())
                .filter(|w| !rows.contains_key(w))
                .collect();
            if !moved.is_empty() {
                let followed: Vec<&Followed> = moved.iter().map(|&w| &here[w]).collect();
                let Ok(linear) = self.only(&moved).linearise_at(&[], &followed) else {
                    return;
                };
                rows.extend(moved.into_iter().zip(linear.rows));
            }
            let mut states = self.states.clone();
            let mut tried: Vec<usize> = Vec::new();
            for w in left {
                let Some(row) = rows.get(&w) else {
                    continue;
                };
                let along = here[w].along(row);
                let own = damped(&row.triangle, &along, damping[w]);
                let rest = &along + &row.triangle * &own;
                if 0.5 * (along.norm_squared() - rest.norm_squared()) <= enough {
                    continue;
                }
                // a step may leave what the engine accepts: then it is none
                let ds = row.change(own);
                let Ok(state) = here[w].state.moved(&self.problem, ds.as_slice()) else {
                    continue;
                };
                states[w] = state;
                tried.push(w);
            }
            if tried.is_empty() {
                break;
            }
            let Ok(found) = self.simulate_some(&[], &states, &tried) else {
                return;
            };
            let mut next = Vec::new();
            for (&w, found) in tried.iter().zip(found) {
                match found {
                    Some(found) if found.cost < here[w].cost => {
                        self.states[w] = found.state.clone();
                        here[w] = found;
                        rows.remove(&w);
                        damping[w] = (damping[w] * 0.1).max(LEAST_DAMPING);
                        next.push(w);
                    }
                    _ if damping[w] < MOST_DAMPING => {
                        damping[w] *= 100.0;
                        next.push(w);
                    }
                    _ => {}
                }
            }
            left = next;
            if in_vain(here, &left) {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{CALMLY, Windows};
    use crate::gap::masses::{machine, searching};

    /// A fit of masses, one of which meets stops, finds first states again that were lost.
    fn come_back(lose: impl FnOnce(&mut Windows), iterations: usize) {
        let base = machine(r#"damping=".2" limited="true" range="-3 3""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &base, config, |search, _| {
            let (x, mut windows) = (search.x.clone(), search.windows.clone());
            lose(&mut windows);
            let fit = (windows.fit(&x, iterations, &mut |_| true)).expect("fitted");
            assert!(fit.cost < 1.1 * search.cost, "{} {}", fit.cost, search.cost);
        });
    }

    /// A window that has lost its first state is brought back where the others leave room for it below the bound.
    #[test]
    fn nothing_is_settled_in_vain() {
        const WINDOW: usize = 3;
        let base = machine(r#"damping=".2""#, "");
        let config = "[[parameter]]\nelement = \"joint/b\"\nattribute = \"damping\"\n";
        searching(&base, &base, config, |search, _| {
            let (x, mut windows) = (&search.x, search.windows.clone());
            windows.states[WINDOW].qvel[0] += 1.0;
            let here = windows.followed(x).expect("followed");
            let linear = windows.linearise(x).expect("linear");
            let others: f64 = (here.iter().enumerate())
                .filter(|(w, _)| *w != WINDOW)
                .map(|(_, f)| f.cost)
                .sum();
            let stay = others + windows.problem.parameters.prior_cost(x);
            let settled = |bound: f64| {
                let mut here = here.clone();
                windows.settle(x, &mut here, &linear, bound);
                here[WINDOW].cost
            };
            let lost = here[WINDOW].cost;
            assert_eq!(settled(0.9 * stay), lost);
            assert!(settled(1.1 * stay) < 0.01 * lost);
        });
    }

    /// A window that begins so fast that its mass ends at a stop, however fast exactly.
    #[test]
    fn a_lost_window_begins_where_the_one_before_ends() {
        const WINDOW: usize = 3;
        let lose = |windows: &mut Windows| {
            let [first, calm, mean] = &mut windows.measured;
            for states in [&mut windows.states, first, calm, mean] {
                states[WINDOW].qvel[0] = 3e3;
            }
        };
        come_back(lose, 3);
    }

    /// The first window, which none precedes: one of its masses ends at a stop, and where it was measured in one calm way, or the other, the
    /// other mass is farther off.
    #[test]
    fn a_lost_window_begins_again_from_farther_off() {
        for way in CALMLY {
            let lose = |windows: &mut Windows| {
                let other = |i: &usize| *i != way;
                for i in (0..windows.measured.len()).filter(other) {
                    windows.measured[i][0].qvel[0] = 3e3;
                }
                windows.states[0].qvel[0] = 3e3;
                windows.measured[way][0].qvel[1] += 4e1;
            };
            come_back(lose, 6);
        }
    }
}
