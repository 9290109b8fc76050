//! Randomised models: what is drawn, how far, and that nothing is left of the last draw.

use crate::common::{phantom_model, point_mass_model};
use phantom::mujoco::{Data, Model, ObjectKind};
use phantom::randomise::{Distribution, Randomiser, Rule};
use phantom::rng::{self, Purpose};
use phantom::train::config::ensemble_rules;
use std::sync::Arc;

fn draws<R>(model: &Model, rules: &[Rule], n: u64, read: impl Fn(&Model) -> R) -> Vec<R> {
    let randomiser = Randomiser::new(model, rules).expect("rules");
    let mut data = Data::new(Arc::new(model.clone())).expect("data");
    (0..n)
        .map(|index| {
            let mut rng = rng::stream(2, Purpose::Model, 0, index);
            randomiser.draw(&mut data, &mut rng).expect("draw");
            data.reset();
            read(data.model())
        })
        .collect()
}

fn id(model: &Model, kind: ObjectKind, name: &str) -> usize {
    model.id(kind, name).expect(name)
}

fn moments(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    (mean, variance.sqrt())
}

#[test]
fn distributions_have_their_mean_and_spread_around_the_nominal_value() {
    let model = point_mass_model();
    let n = 4000;
    let cases = [
        (Distribution::Normal(0.1), 1.0, 0.1),
        (Distribution::Uniform(0.3), 1.0, 0.3 / 3.0_f64.sqrt()),
        (
            Distribution::LogNormal(0.2),
            0.02_f64.exp(),
            0.02_f64.exp() * (0.04_f64.exp() - 1.0).sqrt(),
        ),
        (Distribution::Fixed(0.25), 0.25, 0.0),
    ];
    for (distribution, mean, sigma) in cases {
        let rule = Rule::new("body/mass", "mass", &[], distribution);
        let masses = draws(&model, &[rule], n, |m| m.body_mass()[1]);
        let (got_mean, got_sigma) = moments(&masses);
        // four standard errors; drift from draw to draw would be far beyond
        let error = 4.0 / (n as f64).sqrt();
        assert!(
            (got_mean - mean).abs() <= error * sigma,
            "{distribution:?} {got_mean}"
        );
        assert!(
            (got_sigma - sigma).abs() <= error * sigma,
            "{distribution:?} {got_sigma}"
        );
    }
}

#[test]
fn every_kind_of_rule_changes_its_array_and_the_dynamics_constants() {
    let model = phantom_model();
    let arrays: [(&str, &str, &str); 15] = [
        ("body/p0_base", "pos", "body_pos"),
        ("body/p1_upper", "mass", "body_mass"),
        ("body/p1_upper", "ipos", "body_ipos"),
        ("body/p1_upper", "inertia", "body_inertia"),
        ("joint/p2_upper", "pos", "jnt_pos"),
        ("joint/p2_upper", "stiffness", "jnt_stiffness"),
        ("joint/p2_upper", "damping", "dof_damping"),
        ("joint/p2_upper", "frictionloss", "dof_frictionloss"),
        ("joint/p2_upper", "armature", "dof_armature"),
        ("geom/table", "friction", "geom_friction"),
        ("geom/object", "size", "geom_size"),
        ("geom/p?_tip", "solref", "geom_solref"),
        ("geom/p?_tip", "solimp", "geom_solimp"),
        ("site/p0_tip", "pos", "site_pos"),
        ("actuator/p*_m1", "gear", "actuator_gear"),
    ];
    for (element, attribute, array) in arrays {
        let rule = Rule::new(element, attribute, &[0], Distribution::Uniform(1e-4));
        let nominal = model.numeric_field(array).expect(array);
        let values = draws(&model, &[rule], 8, |m| {
            m.numeric_field(array).expect(array).to_vec()
        });
        let changed = |value: &Vec<f64>| value.iter().zip(nominal).filter(|(a, b)| a != b).count();
        // a number that is 0 and must not fall below stays there in half of the draws
        let most = values.iter().map(changed).max();
        let expected = if element.contains(['*', '?']) { 3 } else { 1 };
        assert_eq!(most, Some(expected), "{element} {attribute}");
        assert!(
            values.iter().any(|v| *v != values[0]),
            "{element} {attribute}"
        );
    }
}

#[test]
fn mass_scales_inertia_and_reaches_the_derived_constants() {
    let model = phantom_model();
    let object = id(&model, ObjectKind::Body, "object");
    let dof = model.nv() - 6; // the object's first
    let read = |m: &Model| {
        let inertia = m.body_inertia()[3 * object..3 * object + 3].to_vec();
        (
            m.body_mass()[object],
            inertia,
            m.body_subtreemass()[object],
            m.dof_invweight0()[dof],
        )
    };
    let (mass, inertia, _, weight) = read(&model);
    let rule = Rule::new("body/object", "mass", &[], Distribution::LogNormal(0.3));
    for (m, i, subtree, w) in draws(&model, &[rule], 20, read) {
        assert_ne!(m, mass);
        assert_eq!(m, subtree);
        for (a, b) in i.iter().zip(&inertia) {
            assert!((a / b / (m / mass) - 1.0).abs() < 1e-12);
        }
        assert!(
            (w / weight * (m / mass) - 1.0).abs() < 1e-6,
            "inverse weight follows"
        );
    }
}

#[test]
fn nothing_is_left_of_the_last_draw() {
    let model = phantom_model();
    let mut rules = ensemble_rules(0.005, Some(0.5), 0.05);
    rules.push(Rule::new(
        "geom/object",
        "size",
        &[],
        Distribution::Normal(0.001),
    ));
    let randomiser = Randomiser::new(&model, &rules).expect("rules");
    let mut data = Data::new(Arc::new(model.clone())).expect("data");
    let mut draw = |index| {
        randomiser
            .draw(&mut data, &mut rng::stream(0, Purpose::Model, 7, index))
            .expect("draw");
        let m = data.model();
        let arrays = Model::NUMERIC_FIELDS
            .iter()
            .filter_map(|name| m.numeric_field(name));
        arrays.flatten().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    let first = draw(3);
    let other = draw(4);
    assert_ne!(first, other);
    assert_eq!(first, draw(3));
}

#[test]
fn bases_move_independently_in_the_plane() {
    let model = phantom_model();
    let bases: Vec<usize> = (0..3)
        .map(|i| id(&model, ObjectKind::Body, &format!("p{i}_base")))
        .collect();
    let n = 2000;
    let shifts = draws(&model, &ensemble_rules(0.005, None, 0.0), n, |m| {
        let shift = |b: usize, k: usize| m.body_pos()[3 * b + k] - model.body_pos()[3 * b + k];
        bases
            .iter()
            .flat_map(|&b| [shift(b, 0), shift(b, 1), shift(b, 2)])
            .collect::<Vec<_>>()
    });
    for i in 0..9 {
        let column: Vec<f64> = shifts.iter().map(|s| s[i]).collect();
        let (mean, sigma) = moments(&column);
        if i % 3 == 2 {
            assert!(column.iter().all(|z| *z == 0.0));
            continue;
        }
        assert!(mean.abs() < 4.0 * 0.005 / (n as f64).sqrt());
        assert!((sigma / 0.005 - 1.0).abs() < 0.07, "{sigma}");
        for j in (0..i).filter(|j| j % 3 != 2) {
            let product: f64 = shifts.iter().map(|s| s[i] * s[j]).sum::<f64>() / n as f64;
            assert!(
                (product / 2.5e-5).abs() < 4.5 / (n as f64).sqrt(),
                "{i} {j}"
            );
        }
    }
}

#[test]
fn rules_on_one_number_act_in_turn() {
    let model = phantom_model();
    let object = id(&model, ObjectKind::Body, "object");
    let masses = draws(&model, &ensemble_rules(0.0, Some(0.8), 0.02), 1000, |m| {
        m.body_mass()[object]
    });
    let (mean, sigma) = moments(&masses);
    assert!(
        (mean - 0.8).abs() < 0.003,
        "a fixed mass with spread lies around the fixed mass: {mean}"
    );
    assert!((sigma - 0.02).abs() < 0.002, "{sigma}");
    let inertia = draws(&model, &ensemble_rules(0.0, Some(0.8), 0.02), 1, |m| {
        m.body_inertia()[3 * object]
    })[0];
    let expected = model.body_inertia()[3 * object] * masses[0] / model.body_mass()[object];
    assert!((inertia / expected - 1.0).abs() < 1e-12);
}

#[test]
fn a_far_draw_stays_physical_and_a_fixed_value_is_taken_as_it_is() {
    let model = point_mass_model();
    let wide = Rule::new("body/mass", "mass", &[], Distribution::Normal(50.0));
    assert!(
        draws(&model, &[wide], 200, |m| m.body_mass()[1])
            .iter()
            .all(|m| *m >= 0.01)
    );
    let tiny = Rule::new("body/mass", "mass", &[], Distribution::Fixed(0.001));
    assert_eq!(draws(&model, &[tiny], 1, |m| m.body_mass()[1]), [0.001]);
}

#[test]
fn the_bounding_radius_follows_the_size() {
    let model = phantom_model();
    let object = id(&model, ObjectKind::Geom, "object");
    let rule = Rule::new("geom/object", "size", &[0], Distribution::Fixed(0.09));
    let read = |m: &Model| (m.geom_rbound()[object], m.geom_size()[3 * object + 1]);
    let nominal = read(&model);
    assert!(
        (nominal.0 - 0.055_f64.hypot(nominal.1)).abs() < 1e-9,
        "as the compiler has it"
    );
    let drawn = draws(&model, &[rule], 1, read)[0];
    assert!((drawn.0 - 0.09_f64.hypot(drawn.1)).abs() < 1e-12);
}

#[test]
fn moving_a_link_reaches_the_derived_constants() {
    let model = phantom_model();
    let read = |m: &Model| m.dof_invweight0().to_vec();
    let link = Rule::new("body/p0_forearm", "pos", &[0], Distribution::Fixed(0.4));
    assert_ne!(draws(&model, &[link], 1, read)[0], read(&model));
}

#[test]
fn a_rule_that_cannot_be_applied_says_why() {
    let model = phantom_model();
    let normal = Distribution::Normal(0.1);
    let cases = [
        (
            Rule::new("body/object", "colour", &[], normal),
            "unknown attribute, known are: body pos",
        ),
        (
            Rule::new("light/x", "pos", &[], normal),
            "unknown attribute",
        ),
        (
            Rule::new("object", "mass", &[], normal),
            "not of the form `kind/name`",
        ),
        (
            Rule::new("body/nobody*", "mass", &[], normal),
            "no body is named `nobody*`",
        ),
        (
            Rule::new("body/p0_base", "pos", &[3], normal),
            "component 3 does not exist, the attribute has 3",
        ),
        (
            Rule::new("body/p0_base", "pos", &[1, 1], normal),
            "listed twice",
        ),
        (
            Rule::new("body/object", "mass", &[], Distribution::Normal(-1.0)),
            "distribution has -1",
        ),
        (
            Rule::new("body/object", "mass", &[], Distribution::Uniform(f64::NAN)),
            "distribution has NaN",
        ),
        (
            Rule::new("body/object", "mass", &[], Distribution::Fixed(0.0)),
            "expected a number above 0",
        ),
        (
            Rule::new("joint/p0_rod", "damping", &[], Distribution::Fixed(-1.0)),
            "of at least 0",
        ),
        (
            Rule::new("body/goal", "mass", &[], normal),
            "body `goal` has no mass",
        ),
        (
            Rule::new("body/object", "pos", &[], normal),
            "body `object` is free",
        ),
        (
            Rule::new("body/world", "pos", &[], normal),
            "cannot be moved",
        ),
        (
            Rule::new("geom/table", "size", &[], normal),
            "the shape of geom `table`",
        ),
    ];
    for (rule, expected) in cases {
        let error = Randomiser::new(&model, std::slice::from_ref(&rule))
            .expect_err(expected)
            .to_string();
        let prefix = format!("randomise rule `{} {}`: ", rule.element, rule.attribute);
        assert!(
            error.starts_with(&prefix) && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn rules_read_from_toml() {
    let text = "element = \"body/p*_base\"\nattribute = \"pos\"\ncomponents = [0, 1]\ndistribution = { normal = 0.005 }";
    let rule: Rule = toml::from_str(text).expect("toml");
    assert_eq!(
        rule,
        Rule::new("body/p*_base", "pos", &[0, 1], Distribution::Normal(0.005))
    );
    assert!(toml::from_str::<Rule>(&format!("{text}\nextra = 1")).is_err());
}
