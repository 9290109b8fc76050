//! Play and stretch between motor and joint.

use phantom::compare::{Settings, States};
use phantom::mujoco::Swing;
use phantom::recording::{Kind, Meta, Recording, Stream};
use phantom::rng::{self, Purpose};

use crate::common::driven::channel;
use crate::machine::{ARMATURE, INERTIA, STEP, numeric, rotor, run, torque};

const N: usize = 1200;
/// of the link alone
const LINK: f64 = INERTIA - ARMATURE;

/// Two masses and what is between them, in steps of a thousandth.
fn two_masses(n: usize, between: impl Fn(f64, f64) -> f64, start: f64) -> Vec<[f64; 3]> {
    let fine = 1000;
    let dt = STEP / f64::from(fine);
    let (mut q, mut v, mut motor, mut w) = (0.0, 0.0, start, 0.0);
    let mut all = Vec::new();
    for k in 0..n {
        all.push([q, motor, v]);
        for _ in 0..fine {
            let passed = between(motor - q, w - v);
            v += dt * passed / LINK;
            w += dt * (torque(k) - passed) / ARMATURE;
            q += dt * v;
            motor += dt * w;
        }
    }
    all
}

#[test]
fn a_spring_between_motor_and_joint() {
    let (compliance, damping) = (0.02, 0.3);
    let simulated = run(
        &mut rotor(&numeric("transmission_compliance", "m", "0.02 0.3"), ""),
        N,
    );
    let friction = 2.0 * damping * (ARMATURE / compliance).sqrt();
    let fine = two_masses(
        N,
        |s, w| s / compliance + friction * w,
        compliance * torque(0),
    );
    let stretch = fine
        .iter()
        .map(|[q, m, _]| (m - q).abs())
        .fold(0.0, f64::max);
    let travel = fine.iter().map(|[q, ..]| q.abs()).fold(0.0, f64::max);
    assert!(stretch > 0.003 && travel > 0.1, "{stretch} {travel}");
    for (k, [q, motor, _]) in fine.iter().enumerate().skip(1) {
        assert!(
            (simulated.q[k] - q).abs() < 0.01 * travel,
            "step {k}: {} {q}",
            simulated.q[k]
        );
        let seen = simulated.reading[k][0] - simulated.q[k];
        assert!(
            (seen - (motor - q)).abs() < 0.08 * stretch,
            "step {k}: {seen} {}",
            motor - q
        );
    }
}

#[test]
fn play_between_motor_and_joint() {
    let play = 0.02;
    let simulated = run(&mut rotor(&numeric("backlash", "m", "0.02"), ""), N);
    // stiff flanks with a relative damping of 0.3, at the motor's own time scale
    let wall: f64 = 2e5;
    let damping = 0.6 * (wall * ARMATURE * LINK / INERTIA).sqrt();
    let flank = |s: f64, w: f64| {
        let depth = s.abs() - 0.5 * play;
        if depth > 0.0 {
            s.signum() * (wall * depth + damping * s.signum() * w).max(0.0)
        } else {
            0.0
        }
    };
    let fine = two_masses(N, flank, 0.5 * play);
    let travel = fine.iter().map(|[q, ..]| q.abs()).fold(0.0, f64::max);
    let mut crossings = 0;
    for k in 1..N {
        let [q, motor, _] = fine[k];
        assert!(
            (simulated.q[k] - q).abs() < 0.02 * travel,
            "step {k}: {} {q}",
            simulated.q[k]
        );
        let seen = simulated.reading[k][0] - simulated.q[k];
        assert!(seen.abs() <= 0.5 * play + 1e-12, "{seen}");
        if (motor - q) * (fine[k - 1][1] - fine[k - 1][0]) < 0.0 {
            crossings += 1;
        }
    }
    assert!(crossings > 3, "{crossings}");
    // resting on a flank the motor is where the equation has it
    let rests = (1..N).filter(|&k| (fine[k][1] - fine[k][0]).abs() >= 0.5 * play);
    let agree = rests.clone().filter(|&k| {
        (simulated.reading[k][0] - simulated.q[k] - (fine[k][1] - fine[k][0])).abs() < 0.02 * play
    });
    assert!(agree.count() as f64 > 0.97 * rests.count() as f64);
}

/// What the law takes from the joint is what the motor has: momentum is that of the torque alone.
#[test]
fn momentum_is_conserved() {
    for (kind, numbers) in [
        ("backlash", "0.02"),
        ("transmission_compliance", "0.01 0.2"),
    ] {
        let mut data = rotor(&numeric(kind, "m", numbers), "");
        let mut impulse = 0.0;
        for k in 0..N {
            data.ctrl_mut()[0] = torque(k);
            data.step().expect("step");
            impulse += STEP * torque(k);
            let [_, motor_speed] = data.encoder(0);
            let momentum = LINK * data.qvel()[0] + ARMATURE * motor_speed;
            assert!(
                (momentum - impulse).abs() < 1e-12,
                "{kind}, step {k}: {momentum} {impulse}"
            );
        }
    }
}

/// A rotor without inertia follows at once: the joint moves as if nothing were between.
#[test]
fn a_motor_without_inertia_only_moves_the_encoder() {
    let text = crate::machine::text(&numeric("transmission_compliance", "m", "0.02 0.3"), "");
    let text = text.replace(&format!("armature=\"{ARMATURE}\""), "");
    let make = |text: &str| {
        let model = phantom::mujoco::Model::from_xml_str(text).expect("loads");
        let model = phantom::supplement::attach(model).expect("a law");
        phantom::mujoco::Data::new(std::sync::Arc::new(model)).expect("data")
    };
    let simulated = run(&mut make(&text), N);
    let plain = run(&mut make(&text.replace("phantom:", "other:")), N);
    assert_eq!(simulated.q, plain.q);
    for k in 2..N {
        let stretch = simulated.reading[k][0] - simulated.q[k];
        assert!((stretch - 0.02 * torque(k - 1)).abs() < 1e-12, "step {k}");
    }
}

/// Readings alone say how a transmission was loaded: t = τ − J θ''.
#[test]
fn a_transmission_is_loaded_as_its_motor_moved() {
    // while play is crossed nothing passes through, and nothing says where the motor is
    for (kind, data, tolerance, least) in [
        ("transmission_compliance", "0.02 0.3", 0.05, 0.95),
        ("backlash", "0.01", 0.25, 0.7),
    ] {
        let custom = numeric(kind, "m", data);
        let simulated = run(&mut rotor(&custom, ""), N);
        let truth = |k: usize| simulated.reading[k][0] - simulated.q[k];
        let size = (0..N).map(|k| truth(k).abs()).fold(0.0, f64::max);
        let apart = 10;
        let bend = |k: usize| {
            let at = |k: usize| simulated.reading[k][0];
            (at(k + 1) - 2.0 * at(k) + at(k - 1)) / (STEP * STEP)
        };
        let mut right = 0;
        let middles: Vec<usize> = (200..N - 20).step_by(10).collect();
        for &k in &middles {
            let mut machine = rotor(&custom, "");
            machine.qpos_mut()[0] = simulated.q[k];
            machine.qvel_mut()[0] = simulated.v[k];
            for (at, since_s) in [
                (k - apart / 2, None),
                (k + apart / 2, Some(apart as f64 * STEP)),
            ] {
                machine.ctrl_mut()[0] = torque(at);
                (machine.load_memory(&|_| bend(at), since_s)).expect("a load");
            }
            let [.., s, _, _] = machine.memory()[..] else {
                panic!("memory of a transmission");
            };
            let seen = machine.encoder(0)[0] - simulated.q[k];
            assert!((seen - s).abs() < 1e-12, "{kind}: {seen} {s}");
            right += usize::from((s - truth(k)).abs() < tolerance * size);
        }
        assert!(
            right as f64 >= least * middles.len() as f64,
            "{kind}: {right} of {}",
            middles.len()
        );
    }
}

/// Commands of a loop that has a motor rattle, and what was shown and where the joint was under them.
fn rattling(custom: &str) -> (Vec<f64>, Vec<[f64; 2]>) {
    let mut machine = rotor(custom, "");
    let each = (0..N).map(|k| {
        let (shown, own) = (machine.encoder(0), machine.joint_state(0));
        // a loop that is late
        let before = shown[0] - own[0] - STEP * (shown[1] - own[1]);
        let ctrl = 0.1 * torque(k) - 0.5_f64.copysign(before);
        machine.ctrl_mut()[0] = ctrl;
        machine.step().expect("a step");
        (ctrl, [shown[0], own[0]])
    });
    each.unzip()
}

/// The commands of a loop do not have its motor rattle as it did, but where readings show it; the joint moves as it did.
#[test]
fn a_motor_that_rattles_is_where_readings_show_it() {
    const PLAY: f64 = 0.01;
    let (commands, truth) = rattling(&numeric("backlash", "m", "0.01"));
    let s = |k: usize| truth[k][0] - truth[k][1];
    let far = (300..N).filter(|&k| s(k).abs() > 0.2 * PLAY).count();
    assert!(far > N / 3, "{far}");
    // a play that is known to a twentieth
    let custom = numeric("backlash", "m", "0.0105");
    let off = |follows: bool| {
        let mut machine = rotor(&custom, "");
        let (mut squares, mut joint) = (0.0, 0.0_f64);
        for k in 0..N {
            let (shown, own) = (machine.encoder(0)[0], machine.joint_state(0)[0]);
            squares += (shown - own - s(k)).powi(2);
            joint = joint.max((own - truth[k][1]).abs());
            machine.show(follows.then_some((
                0,
                Swing {
                    offset: Some(s(k)),
                    range: PLAY,
                },
            )));
            machine.ctrl_mut()[0] = commands[k];
            machine.step().expect("a step");
        }
        ((squares / N as f64).sqrt(), joint)
    };
    let (followed, lost) = (off(true), off(false));
    assert!(followed.0 < 0.1 * PLAY, "{followed:?}");
    assert!(lost.0 > 3.0 * followed.0, "{followed:?} {lost:?}");
}

/// Of a motion that was filtered nothing is left of the rattling: the motor is in the middle, and the joint gets what it gets.
#[test]
fn a_motor_that_rattles_passes_on_what_it_gets_in_the_mean() {
    let speed = |custom: &str| {
        let mut machine = rotor(custom, "");
        machine.ctrl_mut()[0] = 0.3;
        machine.show([(
            0,
            Swing {
                offset: None,
                range: 0.01,
            },
        )]);
        machine.load_memory(&|_| 0.0, None).expect("a load");
        for _ in 0..50 {
            machine.step().expect("a step");
        }
        assert_eq!(machine.encoder(0), machine.joint_state(0));
        machine.qvel()[0]
    };
    let (played, plain) = (speed(&numeric("backlash", "m", "0.01")), speed(""));
    assert!(
        plain > 0.0 && (played - plain).abs() < 1e-12,
        "{played} {plain}"
    );
}

/// Identification gives the engine means around a knot; a motor on its spring feels what holds after it.
#[test]
fn a_motor_follows_the_command_that_holds() {
    let spring = numeric("transmission_compliance", "m", "0.02 0.3");
    // stretch, its speed and that of the joint
    let moved = |ctrl: f64, held: Option<[f64; 1]>| {
        let mut data = rotor(&spring, "");
        data.step().expect("a step at rest");
        data.ctrl_mut()[0] = ctrl;
        data.hold(held.as_ref().map(<[f64; 1]>::as_slice));
        data.step().expect("a step");
        let (shown, own) = (data.encoder(0), data.joint_state(0));
        [shown[0] - own[0], shown[1] - own[1], own[1]]
    };
    let (own, held) = (moved(1.5, None), moved(0.5, Some([1.5])));
    assert!(own[0] > 1e-4 && (held[0] - own[0]).abs() < 1e-2 * own[0]);
    // the momentum of both is the engine's command's
    let momentum = INERTIA * held[2] + ARMATURE * held[1];
    assert!((momentum - 0.5 * STEP).abs() < 1e-9, "{momentum}");
    // beyond the range of the actuator there is no more
    assert_eq!(moved(0.5, Some([2.0])), moved(0.5, Some([7.0])));
}

/// A motor that is hammered, read with noise: where the joint is, how fast, and how the spring is loaded, without what is
/// faster than joints.
#[test]
fn a_joint_is_found_behind_a_hammered_motor() {
    const NOISE: f64 = 1e-4;
    let spring = numeric("transmission_compliance", "m", "0.005 0.1");
    let mut machine = rotor(&spring, "");
    let channels = vec![
        channel("q", Kind::Sensor, "rad", None),
        channel("m", Kind::Control, "N m", None),
    ];
    let mut stream = Stream::new("all", Some(STEP.recip()), channels);
    let (mut q, mut v) = (Vec::new(), Vec::new());
    let mut rng = rng::stream(3, Purpose::SensorNoise, 0, 0);
    for k in 0..N {
        // as by a controller that takes noise for motion
        let noise = NOISE * rng::normal(&mut rng);
        let ctrl = torque(k) - 5e3 * noise;
        let reading = machine.encoder(0)[0] + noise;
        q.push(machine.qpos()[0]);
        v.push(machine.qvel()[0]);
        stream.push((k as f64 * STEP * 1e9).round() as i64, &[reading, ctrl]);
        machine.ctrl_mut()[0] = ctrl;
        machine.step().expect("a step");
    }
    let recording = Recording {
        meta: Meta::default(),
        streams: vec![stream],
    };
    let settings = Settings {
        cutoff_hz: Some(100.0),
        ..Settings::default()
    };
    let found = |custom: &str| {
        let machine = rotor(custom, "");
        States::new(&recording, machine.model(), &settings).expect("states")
    };
    let off = |found: &States| {
        let inner = 200..N - 200;
        let rms = |each: &dyn Fn(usize) -> f64| {
            let sum: f64 = inner.clone().map(|k| each(k).powi(2)).sum();
            (sum / inner.len() as f64).sqrt()
        };
        [
            rms(&|k| found.qpos[k] - q[k]),
            // the velocity of a step is that of its middle
            rms(&|k| found.qvel[k] - 0.5 * (v[k] + v[k + 1])),
        ]
    };
    let ([q_behind, v_behind], [q_seen, v_seen]) = (off(&found(&spring)), off(&found("")));
    assert!(q_behind < 0.15 * q_seen, "{q_behind} {q_seen}");
    assert!(v_behind < 0.15 * v_seen, "{v_behind} {v_seen}");
}
