//! The pushing task on the shipped model.

use crate::common::{phantom_model, phantom_model_with};
use phantom::mujoco::{Data, ObjectKind};
use phantom::randomise::Randomiser;
use phantom::rng::{self, Purpose};
use phantom::task::push::{PushConfig, PushTask, TipDistance};
use phantom::task::{Task, TaskError};
use phantom::train::config::ensemble_rules;
use std::sync::Arc;

fn stream(index: u64) -> rng::Stream {
    rng::stream(9, Purpose::Start, 0, index)
}

fn started(index: u64) -> (PushTask, Data) {
    let model = phantom_model();
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let mut data = Data::new(Arc::new(model)).expect("data");
    task.start(&mut data, &mut stream(index)).expect("start");
    (task, data)
}

#[test]
fn reward_is_the_formula() {
    for (tip_distance, weights) in [
        (TipDistance::Space, [3.0, 1.0, 0.1]),
        (TipDistance::Plane, [2.0, 0.5, 0.3]),
    ] {
        let model = phantom_model();
        let config = PushConfig {
            tip_distance,
            goal_weight: weights[0],
            tip_weight: weights[1],
            torque_weight: weights[2],
            ..PushConfig::default()
        };
        let task = PushTask::new(&model, config).expect("task");
        let mut data = Data::new(Arc::new(model)).expect("data");
        let mut rng = stream(0);
        for _ in 0..20 {
            task.start(&mut data, &mut rng).expect("start");
            let at = data.qpos().len() - 7;
            data.qpos_mut()[at] = rng::uniform(&mut rng, -0.05, 0.05);
            data.qpos_mut()[at + 2] += 0.01;
            data.forward().expect("forward");
            let action: Vec<f64> = (0..9).map(|_| rng::normal(&mut rng)).collect();
            data.ctrl_mut().copy_from_slice(&action);
            data.forward().expect("forward");

            let body = |name: &str| {
                let id = data.model().id(ObjectKind::Body, name).expect(name);
                [0, 1, 2].map(|k| data.xpos()[3 * id + k])
            };
            let norm = |v: [f64; 3]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
            let (o, g) = (body("object"), body("goal"));
            let mut expected = 1.0 - weights[0] * norm([o[0] - g[0], o[1] - g[1], 0.0]);
            for finger in 0..3 {
                let f = body(&format!("p{finger}_tip"));
                let height = if tip_distance == TipDistance::Space {
                    f[2] - o[2]
                } else {
                    0.0
                };
                expected -= weights[1] * norm([f[0] - o[0], f[1] - o[1], height]);
            }
            // what the motors give: 2 N m at most for turret and upper link, 1.55 N m for the crank
            let limit = |k: usize| if k % 3 == 2 { 1.55 } else { 2.0 };
            let given = action
                .iter()
                .enumerate()
                .map(|(k, a)| a.clamp(-limit(k), limit(k)));
            expected -= weights[2] * given.map(|a| a * a).sum::<f64>();
            let reward = task.reward(&data);
            // the tip's site may lie off its body's origin by rounding of the file only
            assert!((reward - expected).abs() < 1e-9, "{reward} {expected}");
        }
    }
}

#[test]
fn starts_are_clear_of_the_object_with_closed_loops() {
    let model = phantom_model();
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let randomiser = Randomiser::new(&model, &ensemble_rules(0.005, None, 0.0)).expect("rules");
    let object = model.id(ObjectKind::Geom, "object").expect("geom");
    let tips: Vec<usize> = (0..3)
        .map(|i| {
            model
                .id(ObjectKind::Geom, &format!("p{i}_tip"))
                .expect("geom")
        })
        .collect();
    let mut data = Data::new(Arc::new(model)).expect("data");
    let (mut seen, mut square) = (Vec::new(), 0.0);
    for index in 0..500 {
        randomiser
            .draw(&mut data, &mut rng::stream(1, Purpose::Model, 0, index))
            .expect("draw");
        data.reset();
        task.start(&mut data, &mut stream(index)).expect("start");
        for contact in data.contacts() {
            let [a, b] = contact.geoms();
            let touch = (a == object && tips.contains(&b)) || (b == object && tips.contains(&a));
            assert!(!touch, "draw {index}");
        }
        assert!(!data.warnings().any());
        let equality = 0; // mjCNSTR_EQUALITY
        let rows = data.efc_type().iter().zip(data.efc_pos()).take(data.nefc());
        let residuals: Vec<f64> = rows
            .filter(|(t, _)| **t == equality)
            .map(|(_, r)| *r)
            .collect();
        assert!(residuals.len() >= 6, "two loops a finger");
        assert!(
            residuals.iter().all(|r| r.abs() < 1e-9),
            "draw {index}: {residuals:?}"
        );
        let [x, y] = [task.goal(&data)[0], task.goal(&data)[1]];
        assert!(x.hypot(y) <= 0.06 + 1e-15);
        square += (x * x + y * y) / 500.0;
        assert_eq!(task.object(&data)[..2], [0.0, 0.0]);
        seen.push(data.qpos()[..15].to_vec());
    }
    // uniform in the disc: E r² = R² / 2 with variance R⁴ / 12, four standard errors
    let tolerance = 4.0 * 0.0036 / (12.0 * 500.0_f64).sqrt();
    assert!((square - 0.0018).abs() < tolerance, "{square}");
    seen.sort_by(|a, b| a[0].total_cmp(&b[0]));
    seen.dedup();
    assert_eq!(seen.len(), 500, "no two starts alike");
}

#[test]
fn observation_is_what_the_sensors_say() {
    let (task, mut data) = started(4);
    for (k, u) in data.ctrl_mut().iter_mut().enumerate() {
        *u = 0.1 * (k as f64).sin();
    }
    for _ in 0..200 {
        data.step().expect("step");
    }
    data.step1().expect("step1");
    let mut observation = vec![0.0; task.n_observation()];
    task.observe(&data, &mut observation);
    let names = task.observation_names();
    assert_eq!(names.len(), 36);
    for (name, value) in names[..30].iter().zip(&observation) {
        let id = data
            .model()
            .id(ObjectKind::Sensor, name)
            .expect("a sensor of that name");
        let at = data.model().sensor_adr()[id] as usize;
        assert_eq!(data.sensordata()[at], *value, "{name}");
    }
    let id = data
        .model()
        .id(ObjectKind::Sensor, "object_pos")
        .expect("sensor");
    let at = data.model().sensor_adr()[id] as usize;
    for k in 0..3 {
        assert!((data.sensordata()[at + k] - observation[30 + k]).abs() < 1e-12);
    }
    assert_eq!(observation[33..], data.mocap_pos()[..3]);
    assert_eq!(
        names[30..],
        [
            "object_x", "object_y", "object_z", "goal_x", "goal_y", "goal_z"
        ]
    );
    assert!(observation[15..30].iter().any(|v| *v != 0.0), "it moved");
}

#[test]
fn groups_cover_the_observation_in_order() {
    let (task, _) = started(0);
    let mut next = 0;
    for group in task.observation_groups() {
        assert_eq!(group.columns.start, next);
        next = group.columns.end;
    }
    assert_eq!(next, task.n_observation());
    assert_eq!(task.action_names().len(), task.n_action());
}

#[test]
fn a_new_goal_moves_nothing_else() {
    let (task, mut data) = started(1);
    let before = (
        data.qpos().to_vec(),
        data.qvel().to_vec(),
        task.goal(&data).to_vec(),
    );
    task.new_goal(&mut data, &mut stream(77)).expect("goal");
    assert_eq!((data.qpos(), data.qvel()), (&before.0[..], &before.1[..]));
    assert_ne!(task.goal(&data), before.2);
    assert_eq!(task.goal(&data)[2], before.2[2], "its height stays");
    task.set_goal(&mut data, 0.01, -0.02);
    let object = task.object(&data);
    let expected = (object[0] - 0.01).hypot(object[1] + 0.02);
    assert_eq!(task.distance_m(&data), expected);
}

#[test]
fn a_model_that_does_not_fit_is_named() {
    let rename = |name: &str, to: &str| (format!("name=\"{name}\""), format!("name=\"{to}\""));
    let cases = [
        (rename("start_low", "other"), "start_low"),
        (rename("loop_rod", "other"), "loop_rod"),
        (
            (" mocap=\"true\"".to_owned(), String::new()),
            "body `goal` is not a mocap body",
        ),
    ];
    for ((from, to), expected) in cases {
        let model = phantom_model_with(&from, &to);
        let error = PushTask::new(&model, PushConfig::default()).expect_err(expected);
        assert!(error.to_string().contains(expected), "{error}");
    }
    // joints: missing, and in another order (swap two names everywhere)
    let missing = phantom_model_with("p1_crank", "p1_krank");
    let error = PushTask::new(&missing, PushConfig::default())
        .expect_err("missing")
        .to_string();
    assert!(error.contains("'p1_crank'"), "{error}");
    let swapped = phantom_model_with("p0_", "pX_");
    let error = PushTask::new(&swapped, PushConfig::default())
        .expect_err("missing")
        .to_string();
    assert!(error.contains("'p0_turret'"), "{error}");
}

#[test]
fn joints_in_another_order_are_named() {
    let text = std::fs::read_to_string("xml/phantom.xml").expect("readable");
    let swapped = text
        .replace("p0_", "pZ_")
        .replace("p1_", "p0_")
        .replace("pZ_", "p1_");
    let directory = tempfile::tempdir().expect("directory");
    let path = directory.path().join("swapped.xml");
    std::fs::write(&path, swapped).expect("writable");
    let model = phantom::mujoco::Model::from_xml_path(&path).expect("loads");
    let error = PushTask::new(&model, PushConfig::default()).expect_err("order");
    assert!(matches!(error, TaskError::Model { .. }));
    assert!(
        error
            .to_string()
            .contains("joint `p0_turret` is at qpos[5]"),
        "{error}"
    );
}

#[test]
fn a_start_that_cannot_be_clear_is_an_error() {
    // the object fills the whole workspace
    let mut model = phantom_model();
    let object = model.id(ObjectKind::Geom, "object").expect("geom");
    let mut edit = model.edit();
    edit.geom_size()[3 * object] = 0.5;
    edit.geom_rbound()[object] = 0.6;
    edit.finish().expect("edited");
    let task = PushTask::new(&model, PushConfig::default()).expect("task");
    let mut data = Data::new(Arc::new(model)).expect("data");
    let error = task.start(&mut data, &mut stream(0)).expect_err("no room");
    assert!(
        error
            .to_string()
            .contains("no start state clear of the object"),
        "{error}"
    );
}

#[test]
fn a_goal_moves_straight_on_within_its_disc() {
    let (radius, speed, control_s) = (0.06, 0.2, 0.008);
    let model = phantom_model();
    let task = |goal_speed_m_s| {
        let config = PushConfig {
            goal_speed_m_s,
            ..PushConfig::default()
        };
        PushTask::new(&model, config).expect("task")
    };
    let (moving, still) = (task(speed), task(0.0));
    let mut data = Data::new(Arc::new(model.clone())).expect("data");
    let mut turns = 0;
    for index in 0..20 {
        moving.start(&mut data, &mut stream(index)).expect("start");
        let mut last: Option<[f64; 2]> = None;
        for _ in 0..125 {
            let before = [moving.goal(&data)[0], moving.goal(&data)[1]];
            still.pass(&mut data, control_s);
            assert_eq!(moving.goal(&data)[..2], before);
            moving.pass(&mut data, control_s);
            let after = [moving.goal(&data)[0], moving.goal(&data)[1]];
            let step = [after[0] - before[0], after[1] - before[1]];
            assert!((step[0].hypot(step[1]) - speed * control_s).abs() < 1e-12);
            assert!(after[0].hypot(after[1]) < radius + speed * control_s);
            let mut input = vec![0.0; moving.n_value_input()];
            moving.observe_value(&data, &mut input);
            for (seen, step) in input[38..].iter().zip(step) {
                assert!((seen * control_s - step).abs() < 1e-12);
            }
            if let Some(last) = last {
                let straight = (step[0] - last[0]).hypot(step[1] - last[1]) < 1e-9;
                let at_edge = before[0].hypot(before[1]) > radius;
                assert!(straight || at_edge);
                turns += u32::from(!straight);
            }
            last = Some(step);
        }
    }
    assert!(turns > 10, "{turns}");
}

#[test]
fn a_goal_jumps_no_farther_than_it_may_and_stays_in_its_disc() {
    let (radius, jump) = (0.06, 0.02);
    let model = phantom_model();
    let config = PushConfig {
        goal_jump_m: Some(jump),
        ..PushConfig::default()
    };
    let task = PushTask::new(&model, config).expect("task");
    let mut data = Data::new(Arc::new(model.clone())).expect("data");
    let object = model.id(ObjectKind::Joint, "object").expect("joint");
    let at = model.jnt_qposadr()[object] as usize;
    for place in [[0.0, 0.0], [0.03, -0.02], [0.055, 0.0], [0.2, 0.2]] {
        let (mut farthest, mut nearest) = (0.0_f64, f64::INFINITY);
        for index in 0..100 {
            data.qpos_mut()[at..at + 2].copy_from_slice(&place);
            task.new_goal(&mut data, &mut stream(index)).expect("goal");
            let goal = [task.goal(&data)[0], task.goal(&data)[1]];
            assert!(goal[0].hypot(goal[1]) < radius + 1e-12);
            let distance = (goal[0] - place[0]).hypot(goal[1] - place[1]);
            (farthest, nearest) = (farthest.max(distance), nearest.min(distance));
        }
        if place[0] < 0.1 {
            assert!(
                farthest < jump + 1e-12 && farthest > 0.9 * jump,
                "{farthest}"
            );
            assert!(nearest < 0.2 * jump, "{nearest}");
        } else {
            // an object outside has its goal on the edge
            assert!(nearest > 0.2, "{nearest}");
        }
    }
    let bad = PushConfig {
        goal_jump_m: Some(-0.01),
        ..PushConfig::default()
    };
    let error = PushTask::new(&model, bad).expect_err("negative");
    assert!(error.to_string().contains("`task.goal_jump_m`"), "{error}");
}
