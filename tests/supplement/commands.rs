//! What happens to commands on their way.

use crate::machine::{STEP, assert_close, derive, numeric, rotor, run, torque};

const N: usize = 1200;

fn of_command(kind: &str, numbers: &str, control: impl FnMut(usize, f64) -> f64) {
    let mut control = control;
    let simulated = run(&mut rotor(&numeric(kind, "m", numbers), ""), N);
    let [q, v] = derive(N, |k, q, _| control(k, q));
    assert_close(&simulated.q, &q, 1e-11, kind);
    assert_close(&simulated.v, &v, 1e-11, kind);
}

#[test]
fn a_delay_holds_each_command_back() {
    // 3.4 steps: 60 % of the step's time the command of 3 steps ago, 40 % that of 4
    of_command("actuator_delay", "0.0034", |k, _| {
        0.6 * torque(k.saturating_sub(3)) + 0.4 * torque(k.saturating_sub(4))
    });
    of_command("actuator_delay", "0.05", |k, _| {
        torque(k.saturating_sub(50))
    });
    of_command("actuator_delay", "0.0002", |k, _| {
        0.8 * torque(k) + 0.2 * torque(k.saturating_sub(1))
    });
}

#[test]
fn a_lag_is_the_solution_of_its_equation() {
    let time = 0.004;
    let mut x = torque(0);
    of_command("actuator_lag", "0.004", move |k, _| {
        // the equation itself in small steps
        let n = 20_000;
        let mut sum = 0.0;
        for _ in 0..n {
            let middle = x + 0.5 * STEP / f64::from(n) * (torque(k) - x) / time;
            sum += middle / f64::from(n);
            x += STEP / f64::from(n) * (torque(k) - middle) / time;
        }
        sum
    });
}

#[test]
fn ripple_follows_the_angle() {
    of_command("torque_ripple", "0.3 -0.2 25", |k, q| {
        torque(k) * (1.0 + 0.3 * (25.0 * q).sin() - 0.2 * (25.0 * q).cos())
    });
}

/// The range limits what is commanded, so a lag starts from the limit, not from beyond it.
#[test]
fn commands_are_limited_before_they_lag() {
    let mut data = rotor(&numeric("actuator_lag", "m", "0.01"), "");
    data.ctrl_mut()[0] = 0.0;
    data.step().expect("step");
    let mut last = 0.0;
    for _ in 0..100 {
        data.ctrl_mut()[0] = 50.0;
        data.step().expect("step");
        assert_eq!(data.ctrl()[0], 50.0, "the caller's command stays");
        last = data.actuator_force()[0];
    }
    assert!((last - 2.0).abs() < 1e-3 && last < 2.0, "{last}");
}
