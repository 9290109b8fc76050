//! Effects where bodies touch, and of geometry.

use phantom::gap::effect::{Form, ModelFile};
use phantom::mujoco::{Cone, Data};

use crate::machine::{effect, file, with};

const GRAVITY: f64 = 9.81;

/// A block of 0.5 kg that slides and spins on a table without tipping, with a pair or without. `shape` is that of its geom.
fn block(pair: bool, cone: &str, shape: &str) -> ModelFile {
    let mask = if pair {
        r#"contype="0" conaffinity="0""#
    } else {
        ""
    };
    let contact = if pair {
        r#"<contact><pair name="p" geom1="block" geom2="table" friction="0.4 0.4 0.005 0.0001 0.0001" condim="3"
           solimp="0.9 0.9 0.001"/></contact>"#
    } else {
        ""
    };
    // constant impedance, so that stiffness is force over depth
    file(&format!(
        r#"<mujoco><option timestep="0.001" cone="{cone}" tolerance="1e-12" iterations="100"/>
        <default><geom friction="0.4 0.005 0.0001" solimp="0.9 0.9 0.001" {mask}/></default>
        <worldbody><geom name="table" type="plane" size="5 5 1"/>
        <body name="block" pos="0 0 0.05"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
        <joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/>
        <geom name="block" {shape} mass="0.5"/></body></worldbody>
        {contact}</mujoco>"#
    ))
}

const BOX: &str = r#"type="box" size="0.05 0.05 0.05""#;
/// Touches in one point: only torsional friction slows its spin.
const BALL: &str = r#"type="sphere" size="0.05""#;

/// What slows the settled block that slides or spins: friction over normal force, the mean over some steps.
///
/// A soft contact rises when it begins to slide, so the normal force is not the weight all the time.
fn friction(model: &ModelFile, dofs: &[usize], inertia: f64, speed: f64) -> f64 {
    let mut data = Data::new(model.model.clone()).expect("data");
    for _ in 0..1500 {
        data.step().expect("settles");
    }
    for dof in dofs {
        data.qvel_mut()[*dof] = speed;
    }
    let size = |data: &Data| {
        dofs.iter()
            .map(|d| data.qvel()[*d].powi(2))
            .sum::<f64>()
            .sqrt()
    };
    let (before, mut normal) = (size(&data), 0.0);
    for _ in 0..100 {
        data.step().expect("slides");
        let force = |i| data.contact_force(i).expect("contact")[0];
        normal += (0..data.contacts().len()).map(force).sum::<f64>();
    }
    inertia * (before - size(&data)) / (model.model.timestep() * normal)
}

/// Depth of the settled block in the table, m.
fn depth(model: &ModelFile) -> f64 {
    let mut data = Data::new(model.model.clone()).expect("data");
    for _ in 0..3000 {
        data.step().expect("settles");
    }
    -data.qpos()[2]
}

#[test]
fn sliding_friction_slows_a_block() {
    for pair in [true, false] {
        let base = block(pair, "elliptic", BOX);
        let place = if pair { "p" } else { "block+table" };
        for share in [0.5, -0.5] {
            let changed = with(&base, "contact_friction", place, &[share]).file;
            for (model, expected) in [(&base, 0.4), (&changed, 0.4 * (1.0 + share))] {
                let found = friction(model, &[0], 0.5, 2.0);
                assert!(
                    (found / expected - 1.0).abs() < 1e-3,
                    "{pair} {share}: {found}"
                );
            }
        }
    }
}

/// The block's own friction was changed, and put above the table's, however little the effect was.
#[test]
fn friction_that_the_other_geom_decides_is_changed_too() {
    let own = block(false, "elliptic", BOX).xml;
    let base = file(&own.replace(
        r#"name="table""#,
        r#"name="table" priority="1" friction="0.7 0.005 0.0001""#,
    ));
    for share in [1e-6, 0.3] {
        let changed = with(&base, "contact_friction", "block+table", &[share]).file;
        let found = friction(&changed, &[0], 0.5, 2.0) / 0.7 - 1.0;
        assert!((found - share).abs() < 1e-3, "{share}: {found}");
    }
}

#[test]
fn anisotropic_friction_slows_one_way() {
    for (pair, place) in [(true, "p"), (false, "block+table")] {
        let base = block(pair, "elliptic", BOX);
        let changed = with(&base, "anisotropic_friction", place, &[-0.6]).file;
        let [x, y] = [0, 1].map(|dof| friction(&changed, &[dof], 0.5, 2.0) / 0.4);
        let (least, most) = (x.min(y), x.max(y));
        assert!(
            (least - 0.4).abs() < 0.02 && (most - 1.0).abs() < 0.02,
            "{x} {y}"
        );
    }
}

#[test]
fn the_other_cone_is_round_or_square() {
    let diagonal = |model: &ModelFile| friction(model, &[0, 1], 0.5, 1.5) / 0.4;
    let square = block(true, "pyramidal", BOX);
    let round = with(&square, "friction_cone", "world", &[1.0]).file;
    assert_eq!(round.model.option().cone, Cone::Elliptic);
    let back = with(&round, "friction_cone", "world", &[1.0]).file;
    assert_eq!(back.model.option().cone, Cone::Pyramidal);
    // along an edge between two sides of the pyramid friction is less by √2
    let (square, round) = (diagonal(&square), diagonal(&round));
    assert!((round - 1.0).abs() < 0.02, "{round}");
    assert!((square * 2.0_f64.sqrt() - 1.0).abs() < 0.02, "{square}");
}

#[test]
fn torsional_friction_slows_spin() {
    for (pair, cone, form) in [
        (true, "elliptic", Form::Mjcf),
        (false, "elliptic", Form::Mjcf),
        (true, "pyramidal", Form::Supplement),
        (false, "pyramidal", Form::Supplement),
    ] {
        let base = block(pair, cone, BALL);
        let place = if pair { "p" } else { "block+table" };
        let written = with(&base, "torsional_friction", place, &[0.002, 0.1]);
        assert_eq!(written.form, form, "{pair} {cone}");
        let inertia = 0.4 * 0.5 * 0.05 * 0.05;
        let found = friction(&written.file, &[3], inertia, 3.0);
        assert!((found / 0.002 - 1.0).abs() < 1e-3, "{pair} {cone}: {found}");
        assert!(friction(&base, &[3], inertia, 3.0).abs() < 1e-9);
        let (softer, before) = (depth(&written.file), depth(&base));
        assert!(
            (softer / before - 1.0).abs() < 1e-3,
            "{pair} {cone}: as stiff as before"
        );
    }
}

#[test]
fn stiffness_and_damping_of_a_contact() {
    for pair in [true, false] {
        let base = block(pair, "elliptic", BOX);
        let place = if pair { "p" } else { "block+table" };
        let harder = with(&base, "contact_stiffness", place, &[1.0]).file;
        let ratio = depth(&base) / depth(&harder);
        assert!((ratio - 2.0).abs() < 0.02, "{pair}: {ratio}");
        // critically damped as before: T = 0.02 s over √2
        let solref = &harder.model.pair_solref()[..2];
        let expected = [-2.0 / 0.02_f64.powi(2), -2.0 * 2_f64.sqrt() / 0.02];
        for (own, expected) in solref.iter().zip(expected) {
            assert!((own / expected - 1.0).abs() < 1e-9, "{pair}: {solref:?}");
        }
        let lossy = with(&base, "contact_damping", place, &[1.0]).file;
        assert!(
            (depth(&base) / depth(&lossy) - 1.0).abs() < 1e-6,
            "{pair}: as stiff as before"
        );
        // settles more slowly: after a knock of 1 mm at overcritical damping more is left
        let left = |model: &ModelFile| {
            let mut data = Data::new(model.model.clone()).expect("data");
            for _ in 0..3000 {
                data.step().expect("settles");
            }
            let rest = data.qpos()[2];
            data.qpos_mut()[2] -= 0.001;
            for _ in 0..60 {
                data.step().expect("moves");
            }
            rest - data.qpos()[2]
        };
        assert!(
            left(&lossy) > 1.5 * left(&base),
            "{pair}: {} {}",
            left(&lossy),
            left(&base)
        );
    }
}

#[test]
fn a_heavier_object_presses_harder() {
    let free = block(true, "elliptic", BOX).xml;
    let (from, to) = (
        free.find("<joint").expect("joints"),
        free.find("<geom name=\"block\"").expect("a geom"),
    );
    let base = file(&format!("{}<freejoint/>{}", &free[..from], &free[to..]));
    let heavier = with(&base, "object_mass", "block", &[0.4]).file;
    let force = |model: &ModelFile| {
        let mut data = Data::new(model.model.clone()).expect("data");
        for _ in 0..3000 {
            data.step().expect("settles");
        }
        let force = |i| data.contact_force(i).expect("contact")[0];
        (0..data.contacts().len()).map(force).sum::<f64>()
    };
    assert!((force(&base) - 0.5 * GRAVITY).abs() < 1e-6);
    assert!((force(&heavier) - 0.7 * GRAVITY).abs() < 1e-6);
}

/// A finger over the table.
const FINGER: &str = r#"<mujoco><worldbody><geom name="table" type="plane" size="5 5 1"/>
  <body name="base" pos="0.1 0.2 0.5" euler="0 0 30"><geom name="pole" size="0.02" contype="0" conaffinity="0"/>
    <body name="link"><joint name="j" axis="0 1 0"/><geom size="0.01" mass="0.2"/>
      <body name="tip" pos="0.3 0 -0.1"><geom name="tip" size="0.02" mass="0.1"/><site name="tip"/></body></body></body>
  <body name="cube" pos="1 0 0.06"><freejoint/><geom name="cube" type="box" size="0.05 0.06 0.07" pos="0.01 0 0" mass="0.3"/></body>
  </worldbody></mujoco>"#;

fn tip(model: &ModelFile) -> [f64; 3] {
    let mut data = Data::new(model.model.clone()).expect("data");
    data.forward().expect("forward");
    std::array::from_fn(|i| data.site_xpos()[i])
}

#[test]
fn geometry_moves_the_tip() {
    let base = file(FINGER);
    let at = tip(&base);
    let moved = tip(&with(&base, "base_pose", "base", &[0.01, -0.02, 0.03, 0.1]).file);
    // relative to the base: turned by 30° and then by 0.1 rad more
    let arm = |angle: f64| [0.3 * angle.cos(), 0.3 * angle.sin(), -0.1];
    let thirty = 30_f64.to_radians();
    let (before, after) = (arm(thirty), arm(thirty + 0.1));
    for (i, shift) in [0.01, -0.02, 0.03].into_iter().enumerate() {
        let expected = at[i] - before[i] + after[i] + shift;
        assert!((moved[i] - expected).abs() < 1e-12, "{moved:?} {expected}");
    }
    let longer = tip(&with(&base, "length_scale", "tip", &[0.05]).file);
    for i in 0..3 {
        assert!(
            (longer[i] - at[i] - 0.05 * before[i]).abs() < 1e-12,
            "{longer:?}"
        );
    }
}

#[test]
fn shapes_grow() {
    let base = file(FINGER);
    let thicker = with(&base, "fingertip_radius", "tip", &[0.004]).file;
    let geom = |model: &ModelFile, name: &str| {
        model
            .model
            .id(phantom::mujoco::ObjectKind::Geom, name)
            .expect("a geom")
    };
    let (id, same) = (geom(&thicker, "tip"), geom(&base, "tip"));
    assert!((thicker.model.geom_size()[3 * id] - 0.024).abs() < 1e-15);
    assert!((thicker.model.geom_rbound()[id] - 0.024).abs() < 1e-15);
    // masses stay, although the compiler would take them from the shape
    assert!((thicker.model.total_mass() - base.model.total_mass()).abs() < 1e-12);
    assert_eq!(base.model.geom_size()[3 * same], 0.02);

    let scaled = with(&base, "length_scale", "cube", &[0.1]).file;
    let id = geom(&scaled, "cube");
    for (size, expected) in scaled.model.geom_size()[3 * id..]
        .iter()
        .zip([0.055, 0.066, 0.077])
    {
        assert!((size - expected).abs() < 1e-15);
    }
    assert!((scaled.model.geom_pos()[3 * id] - 0.011).abs() < 1e-15);
    let body = base.model.geom_bodyid()[geom(&base, "cube")] as usize;
    let inertia = |model: &ModelFile| model.model.body_inertia()[3 * body..3 * body + 3].to_vec();
    for (a, b) in inertia(&scaled).iter().zip(inertia(&base)) {
        assert!((a / b - 1.0).abs() < 1e-12);
    }
}

#[test]
fn places_are_where_an_effect_can_act() {
    let base = file(FINGER);
    let names = |name: &str| -> Vec<String> {
        effect(name)
            .places(&base.model)
            .iter()
            .map(ToString::to_string)
            .collect()
    };
    assert_eq!(names("base_pose"), ["base"]);
    assert_eq!(names("object_mass"), ["cube"]);
    assert_eq!(names("link_mass"), ["link", "tip"]);
    assert_eq!(names("length_scale"), ["tip", "cube"]);
    assert_eq!(names("fingertip_radius"), ["tip"]);
    let touching = ["tip+table", "cube+table", "tip+cube"];
    assert_eq!(names("contact_friction"), touching);
    assert_eq!(names("anisotropic_friction"), touching);
    assert!(names("torque_gain").is_empty() && names("force_sensor_bias").is_empty());
}
