//! A model file with chosen effects, and what is estimated of both.

use crate::mjcf::attribute;
use crate::mujoco::ObjectKind;
use crate::sysid::parameter::{self, ParameterRule};
use crate::sysid::problem::Problem;

use super::GapError;
use super::effect::{
    self, Effect, Estimated, Form, ModelFile, Parameter, Place, Role, Scales, TWO_PERIODS,
};

/// An effect that was put into the model.
#[derive(Debug, Clone)]
pub struct Chosen {
    /// which
    pub effect: &'static dyn Effect,
    /// where
    pub place: Place,
    /// one a parameter of the effect
    pub values: Vec<f64>,
}

/// The base model with effects.
#[derive(Debug, Clone)]
pub(super) struct Built {
    /// text and model
    pub file: ModelFile,
    /// of the base model, then of the effects
    pub rules: Vec<ParameterRule>,
    /// effect (index) and what is estimated of it, in the order of their rules
    pub estimated: Vec<(usize, Estimated)>,
    /// how each effect is said
    pub forms: Vec<Form>,
    /// effect (index) that differs with direction, and name of the number that is its level: what was known of that was so without it
    pub levels: Vec<(usize, String)>,
}

impl Built {
    /// Writes the effects into `base` one after the other. None may become absurdly large.
    ///
    /// # Errors
    /// One of them cannot be said there.
    pub(super) fn new(
        base: &ModelFile,
        rules: &[ParameterRule],
        chosen: &[Chosen],
        measured: &Measured,
    ) -> Result<Self, GapError> {
        let mut built = Self {
            file: base.clone(),
            rules: rules.to_vec(),
            estimated: Vec::new(),
            forms: Vec::new(),
            levels: Vec::new(),
        };
        for (i, c) in chosen.iter().enumerate() {
            let written = effect::write(&built.file, c.effect, &c.place, &c.values)?;
            built.file = written.file;
            built.forms.push(written.form);
            let scales = measured.scales(&built.file.model, &c.place);
            for mut e in written.estimated {
                let parameter = &c.effect.about().parameters[e.parameter];
                let ends = parameter.sensible(&scales).map(|value| e.number_of(value));
                let (lower, upper) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
                let start = e.rule.start.unwrap_or(0.0);
                if lower < start && start < upper {
                    e.rule.lower = Some(e.rule.lower.map_or(lower, |own| own.max(lower)));
                    e.rule.upper = Some(e.rule.upper.map_or(upper, |own| own.min(upper)));
                }
                // what is left without the effect is another effect's number, or none; where the two together hold a joint one way
                // only, no slope leads to both, and what was known of the joint without it would have it so
                if parameter.role == Role::Companion {
                    if c.effect.in_dry_joints().is_some() {
                        let ParameterRule {
                            element, attribute, ..
                        } = &e.rule;
                        built.levels.push((i, format!("{element} {attribute}")));
                    }
                    continue;
                }
                built.rules.push(e.rule.clone());
                built.estimated.push((i, e));
            }
        }
        built.pass_over_added(base);
        Ok(built)
    }

    /// Globs of the base model's rules mean its own elements, not those of effects.
    fn pass_over_added(&mut self, base: &ModelFile) {
        let first = self.rules.len() - self.estimated.len();
        for rule in &mut self.rules[..first] {
            let kind = rule.element.split_once('/').map(|(kind, _)| kind);
            let Some(kind) = kind.and_then(attribute::object_kind) else {
                continue;
            };
            let model = &self.file.model;
            let names = (0..model.count(kind)).filter_map(|id| model.name(kind, id));
            let added = names.filter(|name| base.model.id(kind, name).is_err());
            rule.except.extend(added.map(str::to_owned));
        }
    }

    /// `problem` with this model and its parameters.
    ///
    /// # Errors
    /// A number is a parameter twice: of the base model and of an effect.
    pub(super) fn problem(&self, problem: &Problem) -> Result<Problem, GapError> {
        let mut parameters = problem.parameters_of(&self.file.model, &self.rules)?;
        let is_level = |p: &parameter::Parameter| self.levels.iter().any(|l| l.1 == p.name);
        for level in parameters.all.iter_mut().filter(|p| is_level(p)) {
            level.prior_sigma = f64::INFINITY;
        }
        Ok(Problem {
            model: self.file.model.clone(),
            parameters,
            ..problem.clone()
        })
    }

    /// With the shapes of effects `which` (by index) held; none if there is no such.
    pub(super) fn holding_shapes(
        &self,
        chosen: &[Chosen],
        which: impl Fn(&Chosen) -> bool,
    ) -> Option<Self> {
        let mut held = self.clone();
        let first = held.rules.len() - held.estimated.len();
        let mut any = false;
        for (rule, (i, e)) in held.rules[first..].iter_mut().zip(&held.estimated) {
            let role = &chosen[*i].effect.about().parameters[e.parameter].role;
            if matches!(role, Role::Shape(_)) && !rule.frozen && which(&chosen[*i]) {
                (rule.frozen, any) = (true, true);
            }
        }
        any.then_some(held)
    }

    /// Free parameters that are shapes, and the effect that each is of.
    pub(super) fn shapes<'a>(
        &'a self,
        problem: &Problem,
        chosen: &'a [Chosen],
    ) -> impl Iterator<Item = (usize, usize)> + 'a {
        let role = |i: usize, p: usize| chosen[i].effect.about().parameters[p].role;
        let free = self.free(problem).into_iter();
        let shapes = free.filter(move |f| matches!(role(f.1, f.2), Role::Shape(_)));
        shapes.map(|f| (f.0, f.1))
    }

    /// Index of each estimated number among all parameters of the problem.
    fn first(&self, problem: &Problem) -> usize {
        problem.parameters.all.len() - self.estimated.len()
    }

    /// Values of the effects' parameters where the free ones are `x`.
    pub(super) fn values(&self, problem: &Problem, x: &[f64], chosen: &[Chosen]) -> Vec<Chosen> {
        let values = problem.parameters.values(x);
        let first = self.first(problem);
        let mut out = chosen.to_vec();
        for (k, (i, e)) in self.estimated.iter().enumerate() {
            out[*i].values[e.parameter] = e.value_of(values[first + k]);
        }
        out
    }

    /// Effect, its parameter and the change of its value by one of x, for every free number of an effect; with the
    /// index among the free parameters.
    pub(super) fn free(&self, problem: &Problem) -> Vec<(usize, usize, usize, f64)> {
        let first = self.first(problem);
        let position = |k: usize| problem.parameters.free.iter().position(|f| *f == first + k);
        let numbers = self.estimated.iter().enumerate();
        numbers
            .filter_map(|(k, (i, e))| Some((position(k)?, *i, e.parameter, e.slope.recip())))
            .collect()
    }
}

/// Part of the way to where an effect is absurd at which it is there: a fit stops short of its bounds.
const AT_BOUND: f64 = 0.01;

/// Sizes that the recordings show at every hinge and slide.
#[derive(Debug, Clone, Default)]
pub(super) struct Measured {
    /// by the joint's name: force, speed, travel, acceleration
    joints: Vec<(String, [f64; 4])>,
}

impl Measured {
    /// Of motions (knots × nq) under the controls of `problem`.
    ///
    /// # Errors
    /// The engine refuses a number.
    pub(super) fn new(
        problem: &Problem,
        x: &[f64],
        motions: &[Vec<f64>],
    ) -> Result<Self, GapError> {
        let model = &problem.model;
        let forces = crate::sysid::joint::force_scale(problem, x)?;
        let (nq, h) = (model.nq(), model.timestep());
        let mut joints = Vec::new();
        for joint in 0..model.njnt() {
            let Some(name) = model.name(ObjectKind::Joint, joint) else {
                continue;
            };
            if model.is_slide(joint).is_none() {
                continue;
            }
            let address = model.jnt_qposadr()[joint] as usize;
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            let (mut speed, mut acceleration, mut n) = (0.0, 0.0, 0.0);
            for motion in motions {
                let q: Vec<f64> = motion.iter().skip(address).step_by(nq).copied().collect();
                let span = (q.len() - 1) as f64 * h;
                let (a, b, c) = (q[0], q[q.len() / 2], q[q.len() - 1]);
                low = low.min(a).min(c);
                high = high.max(a).max(c);
                speed += ((c - a) / span).powi(2);
                acceleration += ((a - 2.0 * b + c) / (0.25 * span * span)).powi(2);
                n += 1.0;
            }
            let dof = model.jnt_dofadr()[joint] as usize;
            let root = |sum: f64| f64::sqrt(sum / f64::max(n, 1.0));
            let sizes = [forces[dof], root(speed), high - low, root(acceleration)];
            joints.push((name.to_owned(), sizes));
        }
        Ok(Self { joints })
    }

    /// Scales at a place: the model's, where recordings show nothing.
    pub(super) fn scales(&self, model: &crate::mujoco::Model, place: &Place) -> Scales {
        let mut scales = Scales::of(model, place);
        let name = place.joint_name(model);
        let found = name.and_then(|n| self.joints.iter().find(|(own, _)| *own == n));
        if let Some((_, [force, speed, travel, acceleration])) = found {
            let take = |own: &mut f64, measured: f64| {
                if measured > 0.0 && measured.is_finite() {
                    *own = measured;
                }
            };
            take(&mut scales.force, *force);
            take(&mut scales.speed, *speed);
            take(&mut scales.travel, *travel);
            take(&mut scales.acceleration, *acceleration);
        }
        scales
    }
}

impl Chosen {
    /// Whether any of its sizes is one that could be seen at all, by its range.
    pub(super) fn counts(&self, scales: &Scales) -> bool {
        let parameters = self.effect.about().parameters.iter();
        let mut sizes = parameters.zip(&self.values).filter(|(p, _)| p.is_size());
        sizes.any(|(p, value)| p.counts(*value, scales))
    }

    /// Whether a size or a positive shape of it went as far as it could: then it stands for something else.
    pub(super) fn absurd(&self, scales: &Scales) -> bool {
        let parameters = self.effect.about().parameters.iter();
        let mut each = parameters.zip(&self.values);
        each.any(|(p, value)| {
            let [least, most] = p.sensible(scales);
            match p.role {
                Role::Amplitude | Role::Bent(_) => value.abs() >= (1.0 - AT_BOUND) * most,
                Role::Shape(_) => least > 0.0 && *value <= (1.0 + AT_BOUND) * least,
                _ => false,
            }
        })
    }

    /// Whether it is a ripple of so few periods that what another effect leaves of a force by position looks like it, as a spring does
    /// of one that stiffens.
    pub(super) fn has_few_periods(&self, scales: &Scales) -> bool {
        let per_turn = self.effect.periodic().and(self.values.last());
        per_turn.is_some_and(|n| n * scales.travel < TWO_PERIODS)
    }
}

/// Values to look at an effect with: one set for each of its sizes, by grid value. All other sizes of the set are 0.
#[derive(Debug, Clone)]
pub(super) struct Variant {
    /// (size, values): columns of the candidate
    pub columns: Vec<(f64, Vec<f64>)>,
    /// index of the parameter that each column stands for
    pub parameters: Vec<usize>,
}

impl Variant {
    /// Fall of the cost, which is `gain` at the sizes that are `expected`: what is there as a whole is there once.
    pub(super) fn worth(&self, parameters: &[Parameter], (gain, expected): (f64, &[f64])) -> f64 {
        match (&self.parameters[..], expected) {
            (_, [0.0]) => 0.0,
            ([p], [beta]) if parameters[*p].is_whole() => gain * (2.0 - 1.0 / beta) / beta,
            _ => gain,
        }
    }

    /// Its columns of which what is `expected` makes sense.
    pub(super) fn sensible(
        &self,
        parameters: &[Parameter],
        expected: &[f64],
        scales: &Scales,
    ) -> Vec<usize> {
        let each = self.parameters.iter().zip(expected).enumerate();
        let sensible =
            each.filter(|(_, (p, expected))| parameters[**p].makes_sense(**expected, scales));
        sensible.map(|(i, _)| i).collect()
    }

    /// Whether they all are.
    pub(super) fn makes_sense(
        &self,
        parameters: &[Parameter],
        expected: &[f64],
        scales: &Scales,
    ) -> bool {
        self.sensible(parameters, expected, scales).len() == self.parameters.len()
    }

    /// The columns `kept` alone.
    pub(super) fn only(&self, kept: &[usize]) -> Self {
        Self {
            columns: kept.iter().map(|i| self.columns[*i].clone()).collect(),
            parameters: kept.iter().map(|i| self.parameters[*i]).collect(),
        }
    }
}

/// All variants of an effect: every shape at its first value, and each at its others with the rest at their first.
pub(super) fn variants(parameters: &[Parameter], scales: &Scales) -> Vec<Variant> {
    let grids: Vec<Vec<f64>> = parameters.iter().map(|p| p.grid(scales)).collect();
    let first = parameters
        .iter()
        .zip(&grids)
        .map(|(p, grid)| match grid.first() {
            Some(first) => *first,
            None if p.is_size() => p.typical(scales),
            None => 0.0,
        });
    let first: Vec<f64> = first.collect();
    let mut sets = vec![first.clone()];
    for (i, grid) in grids.iter().enumerate() {
        for other in grid.iter().skip(1) {
            let mut set = first.clone();
            set[i] = *other;
            sets.push(set);
        }
    }
    let sizes: Vec<usize> = (0..parameters.len())
        .filter(|i| parameters[*i].is_size())
        .collect();
    sets.into_iter()
        .map(|set| {
            let columns = sizes.iter().map(|&i| {
                let mut values = set.clone();
                for &j in sizes.iter().filter(|j| **j != i) {
                    values[j] = 0.0;
                }
                // all or nothing: the column is the whole effect
                let size = if parameters[i].is_whole() {
                    1.0
                } else {
                    values[i]
                };
                (size, values)
            });
            Variant {
                columns: columns.collect(),
                parameters: sizes.clone(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gap::effect::named;
    use crate::gap::masses::{chosen, found, machine, searching};
    use crate::gap::repair;

    /// A compliance had no bound once it was tried in several sizes.
    #[test]
    fn a_size_at_its_bound_is_absurd_however_it_acts() {
        let base = machine(r#"armature=".01""#, "");
        for (name, place, rest) in [
            ("transmission_compliance", "ma", &[0.3][..]),
            ("quadratic_drag", "a", &[]),
        ] {
            let with = |size: f64| chosen(&base, name, place, &[&[size], rest].concat());
            let own = with(0.0);
            let scales = Scales::of(&base.model, &own.place);
            let most = own.effect.about().parameters[0].sensible(&scales)[1];
            assert!(with(most).absurd(&scales) && !with(0.5 * most).absurd(&scales));
        }
    }

    /// A ripple and a cogging of 1.85 periods in the motion of a finger's crank fitted best at two, and were said to be absurd.
    #[test]
    fn a_ripple_has_one_and_a_half_periods() {
        let base = machine("", "");
        for (name, place) in [("torque_ripple", "ma"), ("cogging", "a")] {
            let own = chosen(&base, name, place, &[0.0; 3]);
            let scales = Scales::of(&base.model, &own.place);
            let of = |periods: f64| {
                let per_turn = 2.0 * std::f64::consts::PI * periods / scales.travel;
                chosen(&base, name, place, &[0.01, 0.0, per_turn])
            };
            let absurd = |periods| of(periods).absurd(&scales);
            let few = |periods| of(periods).has_few_periods(&scales);
            assert!(!absurd(1.85) && absurd(1.5), "{name}");
            assert!(few(1.85) && !few(2.1), "{name}");
        }
    }

    /// Friction that differs with direction comes with its own level: what was known of the joint's without it does not hold that back.
    #[test]
    fn friction_that_differs_has_its_own_level() {
        let base = machine(r#"frictionloss=".03""#, "");
        let hidden = machine(r#"frictionloss=".12""#, "");
        let law = chosen(&hidden, "asymmetric_friction", "a", &[0.04, 0.0]);
        let hidden = effect::write(&hidden, law.effect, &law.place, &law.values);
        let config = "[[parameter]]\nelement = \"joint/a\"\nattribute = \"frictionloss\"\nprior_sigma = 0.3\n";
        let hidden = hidden.expect("written").file;
        searching(&base, &hidden, config, |search, watch| {
            found(search, &[law], watch);
            let own = &search.chosen[0];
            assert!((own.values[0] - 0.04).abs() < 2e-3, "{:?}", own.values);
            let fitted = repair::machine(&search.windows.problem, &search.x).expect("a model");
            let level = own.place.dry_level(&fitted.model);
            assert!((level - 0.12).abs() < 2e-3, "{level}");
        });
    }

    /// The cost is a parabola in the size, whose least is elsewhere.
    #[test]
    fn what_is_there_as_a_whole_is_there_once() {
        let base = machine("", "");
        let friction = chosen(&base, "coulomb_friction", "a", &[1.0]);
        let bound = named("torque_saturation").expect("in the catalogue");
        let of = |effect: &dyn Effect, (gain, expected): (f64, f64)| {
            let parameters = effect.about().parameters;
            let variant = Variant {
                columns: vec![(1.0, vec![1.0])],
                parameters: vec![0],
            };
            variant.worth(parameters, (gain, &[expected]))
        };
        for (gain, expected) in [(3.0, 0.5), (3.0, 1.0), (3.0, 2.0), (3.0, -1.0), (0.0, 0.0)] {
            // Φᵀr b + ½ ΦᵀΦ b² at b = 1
            let square = if expected == 0.0 {
                0.0
            } else {
                2.0 * gain / (expected * expected)
            };
            let once = square * expected - 0.5 * square;
            assert!((of(bound, (gain, expected)) - once).abs() < 1e-12);
            assert_eq!(of(friction.effect, (gain, expected)), gain);
        }
    }
}
