#!/usr/bin/env python3
"""A hand-made affine policy that tracks the evaluation spiral.

It shows that the model and the task are solvable by the class of policies that
`phantom train` searches:

    action = K @ [15 joint positions, 15 joint velocities, object xyz, goal xyz] + k

Each finger pulls its tip towards a point inside the object with a spring and
a damper, adds a force along (goal - object), and maps the sum to motor torques
with the transposed tip Jacobian of ONE nominal pose (constant, hence affine).
The constant k also carries the gravity torque of that pose.

Needs the `mujoco` Python package (2.2.2 or newer) and NumPy.

    python3 scripts/hand_policy.py                    # 10 rollouts, base noise 0.5 cm
    python3 scripts/hand_policy.py --noise 0 --json hand_policy.json
"""
import argparse
import json
import math
import os

import mujoco
import numpy as np

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
MODEL = os.path.join(ROOT, "xml", "phantom.xml")
MOTORS = ("turret", "upper", "crank")

# Gains: spring towards the object (N/m), damper (N s/m), goal force (N/m),
# depth of the spring's rest point below the object's surface (m), tip height (m).
GAINS = {"spring": 60.0, "damp": 2.0, "goal": 400.0, "depth": 0.02, "height": 0.07}


def spiral(t):
    """Goal (x, y) at time t: out to 4 cm in 2 s with one turn, then one circle in 2 s."""
    r = 0.04 * min(t / 2.0, 1.0)
    return r * math.cos(math.pi * t), r * math.sin(math.pi * t)


def loop_maps(m):
    """(a, b, c) of rod and forearm joint = a*upper + b*crank + c, from the model file."""
    out = []
    for name in ("loop_rod", "loop_forearm"):
        i = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, name)
        adr = m.numeric_adr[i]
        out.append(np.array(m.numeric_data[adr:adr + 3]))
    return out


def set_finger(m, d, i, motor):
    """Put finger i at motor coordinates (turret, upper, crank); passive joints follow."""
    rod, fore = loop_maps(m)
    v = np.array([motor[1], motor[2], 1.0])
    d.qpos[5 * i:5 * i + 5] = [motor[0], motor[1], motor[2], rod @ v, fore @ v]


def reduced_jacobian(m, d, i):
    """3x3 Jacobian of tip i with respect to its motor coordinates, loops eliminated."""
    site = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, f"p{i}_tip")
    jac = np.zeros((3, m.nv))
    mujoco.mj_jacSite(m, d, jac, None, site)
    return jac[:, 5 * i:5 * i + 5] @ loop_jacobian(m)


def loop_jacobian(m):
    """d(five joints)/d(turret, upper, crank)."""
    rod, fore = loop_maps(m)
    return np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1],
                     [0, rod[0], rod[1]], [0, fore[0], fore[1]]])


def tip_pos(m, d, i):
    return d.site_xpos[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, f"p{i}_tip")].copy()


def solve_tip(m, d, i, target):
    """Motor coordinates that bring tip i to `target` (Newton's method)."""
    motor = np.zeros(3)
    for _ in range(50):
        set_finger(m, d, i, motor)
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        err = target - tip_pos(m, d, i)
        motor += np.linalg.solve(reduced_jacobian(m, d, i), np.clip(err, -0.03, 0.03))
    if np.linalg.norm(err) > 1e-9:
        raise RuntimeError(f"finger {i} cannot reach {target}")
    return motor


def build_policy(m, gains=None):
    """Return K (9x36) and k (9) for model m with its bases where they are."""
    g = dict(GAINS, **(gains or {}))
    d = mujoco.MjData(m)
    mujoco.mj_resetData(m, d)
    radius = m.geom_size[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_GEOM, "object")][0]
    K, k = np.zeros((9, 36)), np.zeros(9)
    for i in range(3):
        base = m.body_pos[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_base")]
        tip_r = m.geom_size[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_GEOM, f"p{i}_tip")][0]
        u = np.array([base[0], base[1], 0.0]) / np.hypot(base[0], base[1])
        touch = u * (radius + tip_r) + [0, 0, g["height"]]
        motor = solve_tip(m, d, i, touch)
        d.qvel[:] = 0
        mujoco.mj_forward(m, d)
        jac = reduced_jacobian(m, d, i)
        gravity = loop_jacobian(m).T @ d.qfrc_bias[5 * i:5 * i + 5]
        # desired force f = spring*(object + inner - tip) - damp*tip' + goal*(goal - object)
        inner = u * (radius + tip_r - g["depth"])
        rows = slice(3 * i, 3 * i + 3)
        cols = slice(5 * i, 5 * i + 3)
        vcols = slice(15 + 5 * i, 15 + 5 * i + 3)
        obj, goal = slice(30, 32), slice(33, 35)
        K[rows, cols] = -g["spring"] * jac.T @ jac
        K[rows, vcols] = -g["damp"] * jac.T @ jac
        K[rows, obj] = (g["spring"] - g["goal"]) * jac.T[:, :2]
        K[rows, goal] = g["goal"] * jac.T[:, :2]
        const = g["spring"] * (inner + [0, 0, g["height"]] - touch + jac @ motor)
        k[rows] = jac.T @ const + gravity
    return K, k


def observe(d):
    """36 numbers in the order of the sensors, then the goal."""
    return np.concatenate([d.sensordata[:33], d.mocap_pos[0]])


def rollout(m, K, k, goal_fn=spiral, seconds=4.0, hold=1, motor=None, on_step=None):
    """Distance object-goal per physics step (m), rms torque (N m); `hold` steps per action."""
    d = mujoco.MjData(m)
    mujoco.mj_resetData(m, d)
    key = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_KEY, "home")
    d.qpos[:] = m.key_qpos[key]
    if motor is not None:
        for i in range(3):
            set_finger(m, d, i, motor[3 * i:3 * i + 3])
    z = d.mocap_pos[0][2]
    d.mocap_pos[0] = [*goal_fn(0.0), z]
    mujoco.mj_forward(m, d)
    steps = int(round(seconds / m.opt.timestep))
    dist, torque2 = np.zeros(steps), 0.0
    for s in range(steps):
        if s % hold == 0:
            d.mocap_pos[0] = [*goal_fn(d.time), z]
            d.ctrl[:] = K @ observe(d) + k
        mujoco.mj_step(m, d)
        torque2 += float(np.mean(np.square(d.actuator_force)))
        dist[s] = math.hypot(*(d.qpos[15:17] - d.mocap_pos[0][:2]))
        if on_step is not None:
            on_step(d)
    return dist, math.sqrt(torque2 / steps), d


def start_range(m):
    out = []
    for name in ("start_low", "start_high"):
        i = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, name)
        out.append(np.array(m.numeric_data[m.numeric_adr[i]:m.numeric_adr[i] + 9]))
    return out


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--model", default=MODEL)
    ap.add_argument("--rollouts", type=int, default=10)
    ap.add_argument("--noise", type=float, default=0.005, help="std of the base positions in x and y (m)")
    ap.add_argument("--mass", type=float, help="object mass (kg)")
    ap.add_argument("--timestep", type=float, default=0.0005)
    ap.add_argument("--hold", type=int, default=1, help="physics steps per action")
    ap.add_argument("--seed", type=int, default=0)
    ap.add_argument("--gain", action="append", default=[], metavar="NAME=VALUE", help=f"override one of {GAINS}")
    ap.add_argument("--json", help="write policy and results to this file")
    a = ap.parse_args()
    gains = {x.split("=")[0]: float(x.split("=")[1]) for x in a.gain}
    m = mujoco.MjModel.from_xml_path(a.model)
    m.opt.timestep = a.timestep
    K, k = build_policy(m, gains)
    if a.mass:
        b = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, "object")
        m.body_inertia[b] *= a.mass / m.body_mass[b]
        m.body_mass[b] = a.mass
    nominal = m.body_pos.copy()
    rng = np.random.default_rng(a.seed)
    low, high = start_range(m)
    means = []
    for r in range(a.rollouts):
        m.body_pos[:] = nominal
        for i in range(3):
            b = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_base")
            m.body_pos[b, :2] += rng.normal(0, 1, 2) * a.noise
        dist, torque, d = rollout(m, K, k, hold=a.hold, motor=rng.uniform(low, high))
        means.append(100 * float(dist.mean()))
        warn = int(np.sum(d.warning.number))
        print(f"rollout {r}: mean distance {means[-1]:.3f} cm, worst {100 * dist.max():.2f} cm, "
              f"rms torque {torque:.3f} N m, object z {d.qpos[17]:.4f} m, warnings {warn}")
    print(f"mean {np.mean(means):.3f} cm, std {np.std(means):.3f} cm over {a.rollouts} rollouts")
    if a.json:
        with open(a.json, "w", encoding="utf-8") as f:
            json.dump({"K": K.tolist(), "k": k.tolist(), "mean_distance_cm": float(np.mean(means)),
                       "std_cm": float(np.std(means)), "rollouts": means}, f)


if __name__ == "__main__":
    main()
