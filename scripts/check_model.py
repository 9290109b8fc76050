#!/usr/bin/env python3
"""Checks xml/phantom.xml and prints, in Markdown, what its settings cost.

 1. inertia matrix and gravity in motor coordinates (loops eliminated) against the published ones,
 2. joint limits: highest tip position; random starts: clearances and closed loops,
 3. accelerations of the soft loops against exactly eliminated loops,
 4. energy drift in free motion, without contact and damping,
 5. step time, penetration, loop gap and trajectories in contact for solver settings and
    steps, against a converged solver with a step of 0.05 ms.

Exits with status 1 when a limit (listed at the end of the output) is exceeded. Step times
are printed, not judged. Needs the `mujoco` package (2.2.2 or newer) and NumPy.

    python3 scripts/check_model.py                # everything, about 2 minutes
    python3 scripts/check_model.py --quick        # without the comparison of settings
"""
import argparse
import math
import sys
import time
import xml.etree.ElementTree as ET

import mujoco
import numpy as np

import hand_policy as hand

# Published coefficients (kg m^2; N m), in the order of docs/model.md.
K = np.array([1.798, 0.864, 0.486, 2.766, 0.308, 2.526, 0.652]) * 1e-3
GRAVITY = (0.164, 0.094)
L1, L2 = 0.215, 0.170
# Where a tip can push the object: height above the table, distance from the turret axis (m).
CONTACT_SPACE = (0.03, 0.11, 0.175, 0.295)
SHOULDER = 0.24

LIMITS = {
    "inertia, contact workspace (% of largest entry)": 3.0,
    "inertia, whole joint range (% of largest entry)": 11.0,
    "gravity (% of largest coefficient)": 0.5,
    "least peak force of a tip at the object's side (N, at least)": 8.5,
    "highest tip centre inside the joint limits (m)": 0.15,
    "start: least gap tip-object (m, at least)": 0.005,
    "start: least gap tip-table (m, at least)": 0.005,
    "start: least gap tip-tip (m, at least)": 0.005,
    "soft loops: median error of acceleration (%)": 1.0,
    "energy drift at 0.5 ms (%)": 5.0,
    "hand policy, mean distance (cm)": 0.5,
    "loop gap in contact at 0.5 ms (mm)": 0.1,
    "loop gap in contact at 2 ms (mm)": 0.2,
    "object path at 0.5 ms against reference (rms, mm)": 0.3,
    "object path at 2 ms against reference (rms, mm)": 1.0,
    "engine warnings": 0,
    "peak torques: crossed loops or warnings": 0,
}


class Report:
    def __init__(self):
        self.failed = []
        self.rows = []

    def check(self, name, value):
        limit = LIMITS[name]
        ok = value >= limit if "at least" in name else value <= limit
        self.rows.append((name, value, limit, ok))
        if not ok:
            self.failed.append(name)

    def print(self):
        print("\n## Limits\n\n| quantity | value | limit | |\n|---|---|---|---|")
        for name, value, limit, ok in self.rows:
            print(f"| {name} | {value:.4g} | {limit:g} | {'ok' if ok else 'EXCEEDED'} |")


def published(a, b):
    m23 = -0.5 * K[3] * math.sin(a - b)
    m11 = K[0] + K[1] * math.cos(2 * a) + K[2] * math.cos(2 * b) + K[3] * math.cos(a) * math.sin(b)
    m12 = K[4] * math.sin(a)
    return np.array([[m11, m12, 0.0], [m12, K[5], m23], [0.0, m23, K[6]]])


def motor_angles(x, z):
    """th2, th3 that put the tip x forward and z above the shoulder, or None."""
    c = (x * x + z * z - L1 * L1 - L2 * L2) / (2 * L1 * L2)
    if abs(c) >= 1:
        return None
    phi = math.acos(c)
    a = math.atan2(z, x) + math.atan2(L2 * math.sin(phi), L1 + L2 * math.cos(phi))
    return a, a - phi + math.pi / 2


def mass_matrix(m, d):
    """Dense inertia matrix, by a call that every version of the engine has."""
    full, column = np.zeros((m.nv, m.nv)), np.zeros(m.nv)
    for i, unit in enumerate(np.eye(m.nv)):
        mujoco.mj_mulM(m, d, column, unit)
        full[i] = column
    return full


def reduced(m, d, finger, motor):
    """Inertia matrix and gravity torque in motor coordinates, loops eliminated."""
    hand.set_finger(m, d, finger, motor)
    d.qvel[:] = 0
    mujoco.mj_forward(m, d)
    full = mass_matrix(m, d)
    s = slice(5 * finger, 5 * finger + 5)
    jac = hand.loop_jacobian(m)
    return jac.T @ full[s, s] @ jac, jac.T @ d.qfrc_bias[s]


def check_inertia(m, report):
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    z0, z1, r0, r1 = CONTACT_SPACE
    contact = [motor_angles(r, z - SHOULDER) for z in np.linspace(z0, z1, 25) for r in np.linspace(r0, r1, 25)]
    rng = m.jnt_range
    whole = [(a, b) for a in np.linspace(*rng[1], 25) for b in np.linspace(*rng[2], 25)]
    print("\n## Inertia in motor coordinates\n")
    print("Deviation from the published matrix, in % of its largest entry on the same grid.\n")
    print("| grid | largest entry (kg m²) | M11 | M12 | M13 | M22 | M23 | M33 | worst at (θ2, θ3) in degrees |")
    print("|---|---|---|---|---|---|---|---|---|")
    for label, grid in (("contact workspace", contact), ("whole joint range", whole)):
        worst, where, dev = 0, None, np.zeros((3, 3))
        big = max(published(a, b).max() for a, b in grid)
        grav = 0
        for n, (a, b) in enumerate(grid):
            mat, g = reduced(m, d, n % 3, [0.2 * math.sin(n), a, b])
            e = np.abs(mat - published(a, b)) / big * 100
            dev = np.maximum(dev, e)
            if e.max() > worst:
                worst, where = e.max(), (math.degrees(a), math.degrees(b))
            want = np.array([0, GRAVITY[0] * math.cos(a), GRAVITY[1] * math.sin(b)])
            grav = max(grav, np.abs(g - want).max() / GRAVITY[0] * 100)
        cells = " | ".join(f"{dev[i, j]:.2f}" for i in range(3) for j in range(i, 3))
        print(f"| {label} | {big:.3e} | {cells} | ({where[0]:.1f}, {where[1]:.1f}) |")
        report.check(f"inertia, {label} (% of largest entry)", worst)
    report.check("gravity (% of largest coefficient)", grav)


def check_ranges(m, report):
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    top = 0
    for a in np.linspace(*m.jnt_range[1], 41):
        for b in np.linspace(*m.jnt_range[2], 41):
            top = max(top, SHOULDER + L1 * math.sin(a) - L2 * math.cos(b))
    report.check("highest tip centre inside the joint limits (m)", top)
    low, high = hand.start_range(m)
    rng = np.random.default_rng(0)
    obj = m.geom_size[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_GEOM, "object")]
    tip = m.geom_size[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_GEOM, "p0_tip")][0]
    gap = np.full(3, np.inf)
    for n in range(3000):
        motor = rng.uniform(low, high)
        if n % 2:  # corners of the box
            motor = np.where(rng.random(9) < 0.5, low, high)
        for i in range(3):
            hand.set_finger(m, d, i, motor[3 * i:3 * i + 3])
        lim = m.jnt_limited[:15].astype(bool)
        q = d.qpos[:15]
        if np.any((q < m.jnt_range[:15, 0])[lim]) or np.any((q > m.jnt_range[:15, 1])[lim]):
            gap[:] = -1
        mujoco.mj_kinematics(m, d)
        p = [hand.tip_pos(m, d, i) for i in range(3)]
        for i in range(3):
            side = math.hypot(p[i][0], p[i][1]) - obj[0]
            above = p[i][2] - 2 * obj[1]
            gap[0] = min(gap[0], (side if above < 0 else math.hypot(max(side, 0), above)) - tip)
            gap[1] = min(gap[1], p[i][2] - tip)
            gap[2] = min(gap[2], np.linalg.norm(p[i] - p[i - 1]) - 2 * tip)
    for g, what in zip(gap, ("object", "table", "tip")):
        report.check(f"start: least gap tip-{what} (m, at least)", g)


def check_force(m, report):
    """Largest force every direction allows at the tip, gravity carried as well, at the object's side."""
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    worst = np.inf
    for i in range(3):
        base = m.body_pos[mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_base")]
        motor = hand.solve_tip(m, d, i, base / np.linalg.norm(base) * 0.065 + [0, 0, 0.07])
        _, gravity = reduced(m, d, i, motor)
        jac = hand.reduced_jacobian(m, d, i)
        room = m.actuator_ctrlrange[3 * i:3 * i + 3, 1] - np.abs(gravity)
        worst = min(worst, (room / np.linalg.norm(jac, axis=0)).min())
    report.check("least peak force of a tip at the object's side (N, at least)", worst)


def check_acceleration(m, report):
    d = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    low, high = hand.start_range(m)
    jac = hand.loop_jacobian(m)
    err = []
    for _ in range(100):
        mujoco.mj_resetDataKeyframe(m, d, 0)
        motor = rng.uniform(low, high)
        for i in range(3):
            hand.set_finger(m, d, i, motor[3 * i:3 * i + 3])
            d.qvel[5 * i:5 * i + 5] = jac @ rng.normal(size=3)
        d.ctrl[:] = rng.normal(size=9) * 0.3
        mujoco.mj_forward(m, d)
        full = mass_matrix(m, d)
        for i in range(3):
            s = slice(5 * i, 5 * i + 5)
            force = jac.T @ (d.qfrc_actuator[s] + d.qfrc_passive[s] - d.qfrc_bias[s])
            want = np.linalg.solve(jac.T @ full[s, s] @ jac, force)
            err.append(100 * np.linalg.norm(d.qacc[s][:3] - want) / np.linalg.norm(want))
    print(f"\n## Soft loops\n\nError of the fingers' accelerations against exactly eliminated loops: "
          f"median {np.median(err):.3f} %, worst {np.max(err):.3f} % of {len(err)} random states.")
    report.check("soft loops: median error of acceleration (%)", np.median(err))


def energy_drift(m, dt, seconds=0.5):
    """Largest change of the fingers' energy in free swing, relative to their peak kinetic energy."""
    damping, flags = m.dof_damping.copy(), m.opt.disableflags
    m.dof_damping[:] = 0
    m.opt.timestep = dt
    m.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    m.opt.enableflags = int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    body = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, "object")
    mass, g = m.body_mass[body], -m.opt.gravity[2]
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    jac = hand.loop_jacobian(m)
    for i in range(3):
        hand.set_finger(m, d, i, [0.0, 0.05, -0.3])
        d.qvel[5 * i:5 * i + 5] = jac @ [0.5 * (i + 1), 0.5, -0.5]
    total, kinetic = [], []
    for _ in range(int(round(seconds / dt))):
        mujoco.mj_forward(m, d)
        total.append(sum(d.energy) - mass * (0.5 * d.qvel[17] ** 2 + g * d.qpos[17]))
        kinetic.append(d.energy[1] - 0.5 * mass * d.qvel[17] ** 2)
        mujoco.mj_step(m, d)
    m.dof_damping[:] = damping
    m.opt.disableflags, m.opt.enableflags = flags, 0
    return 100 * np.abs(np.array(total) - total[0]).max() / max(kinetic)


def loop_gap(m, d):
    """Distance between the end of the upper link and the elbow of the forearm, worst finger."""
    worst = 0
    for i in range(3):
        up = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_upper")
        fore = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_forearm")
        a = d.xpos[up] + d.xmat[up].reshape(3, 3) @ [L1, 0, 0]
        b = d.xpos[fore] - d.xmat[fore].reshape(3, 3) @ [0, 0, 0.0325]
        worst = max(worst, np.linalg.norm(a - b))
    return worst


def iterations(d):
    return int(np.max(d.solver_iter if hasattr(d, "solver_iter") else d.solver_niter))


def count_warnings(d):
    number = getattr(d.warning, "number", None)
    return int(np.sum(number)) if number is not None else sum(w.number for w in d.warning)


def contact_run(m, policy, seconds, noise=0.05):
    """The hand policy on the spiral, actions held 4 ms, torque noise held 12 ms (same for every step)."""
    dt = m.opt.timestep
    rng = np.random.default_rng(0)
    kicks = rng.normal(size=(1 + int(seconds / 0.012), 9)) * noise
    d = mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, d, 0)
    mujoco.mj_forward(m, d)
    hold = int(round(0.004 / dt))
    gain, const = policy
    states, path, goal = [], [], []
    gap = pen = press = iters = rows = 0
    steps = int(round(seconds / dt))
    for s in range(steps):
        if s % hold == 0:
            t = s // hold * 0.004
            d.mocap_pos[0][:2] = hand.spiral(t)
            d.ctrl[:] = gain @ hand.observe(d) + const + kicks[s // hold // 3]
        mujoco.mj_step(m, d)
        iters += iterations(d)
        rows += d.nefc
        if s % hold == hold - 1:
            if len(path) % 5 == 4:
                states.append([v.copy() for v in (d.qpos, d.qvel, d.ctrl, d.qacc_warmstart)])
            path.append(d.qpos[15:18].copy())
            goal.append(d.mocap_pos[0][:2].copy())
            gap = max(gap, loop_gap(m, d))
            if d.ncon:
                depth = -np.min(d.contact.dist[:d.ncon]) if hasattr(d.contact, "dist") else \
                    -min(d.contact[c].dist for c in range(d.ncon))
                pen = max(pen, depth)
                press = press if d.time < 0.5 else max(press, depth)
    path, goal = np.array(path), np.array(goal)
    return {"states": states, "gap": 1e3 * gap, "pen": 1e3 * pen, "press": 1e3 * press,
            "path": path, "iters": iters / steps, "rows": rows / steps,
            "distance": 100 * np.linalg.norm(path[:, :2] - goal, axis=1).mean(),
            "warnings": count_warnings(d)}


def step_times(models, states, rounds=5):
    """Microseconds of one mj_step from each state, fastest of `rounds`, median over states; models take turns."""
    data = [mujoco.MjData(m) for m in models]
    best = np.full((len(models), len(states)), np.inf)
    clock = time.perf_counter
    for _ in range(rounds):
        for n, (qpos, qvel, ctrl, warm) in enumerate(states):
            for k, (m, d) in enumerate(zip(models, data)):
                for _ in range(2):  # the first one warms the caches
                    d.qpos[:], d.qvel[:], d.ctrl[:], d.qacc_warmstart[:] = qpos, qvel, ctrl, warm
                    t0 = clock()
                    mujoco.mj_step(m, d)
                    t1 = clock()
                best[k, n] = min(best[k, n], t1 - t0)
    return 1e6 * np.median(best, axis=1)


def variant(file, closure="tendon", masks=False, impedance=None, condim=None, lossy=None, **option):
    """The model with some settings changed."""
    root = ET.parse(file).getroot()
    for key, value in option.items():
        root.find("option").set(key, str(value))
    if masks:
        root.find("default/geom").set("conaffinity", "0")
        for g in root.iter("geom"):
            name = g.get("name", "")
            if name == "table":
                g.set("conaffinity", "3")
            elif name == "object":
                g.set("contype", "2")
                g.set("conaffinity", "1")
            elif name.endswith("_tip"):
                g.set("contype", "1")
                g.set("conaffinity", "1")
            if name == "table" or name.endswith("_tip"):
                g.set("friction", "0.2 0.005 0.0001" if name == "table" else "0.9 0.005 0.0001")
                g.set("priority", "1" if name == "table" else "2")
            if name == "object" or name == "table" or name.endswith("_tip"):
                g.set("solref", "0.01 1")
        root.remove(root.find("contact"))
    if impedance:
        root.find("default/equality").set("solimp", f"{impedance} {impedance}")
    if condim:
        root.find("default/pair").set("condim", str(condim))
    if lossy:
        for j in root.find("default").iter("joint"):
            if j.get("damping"):
                j.set("frictionloss", str(lossy))
    if closure == "connect":
        root.remove(root.find("tendon"))
        eq = root.find("equality")
        for e in list(eq):
            eq.remove(e)
        for i in range(3):
            ET.SubElement(eq, "connect", body1=f"p{i}_upper", body2=f"p{i}_forearm", anchor="0.215 0 0")
    size = root.find("size")
    size.set("njmax", "120")
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


VARIANTS = [
    ("as shipped, 0.5 ms", {}),
    ("as shipped, 1 ms", {"timestep": 0.001}),
    ("as shipped, 2 ms", {"timestep": 0.002}),
    ("as shipped, 4 ms", {"timestep": 0.004}),
    ("Newton, 100 iterations, 1e-14", {"iterations": 100, "tolerance": 1e-14}),
    ("Newton, 3 iterations", {"iterations": 3}),
    ("Newton, elliptic cone", {"cone": "elliptic"}),
    ("Newton, sparse Jacobian", {"jacobian": "sparse"}),
    ("CG, 10 iterations", {"solver": "CG", "iterations": 10}),
    ("CG, 100 iterations", {"solver": "CG", "iterations": 100}),
    ("CG, 10 iterations, elliptic", {"solver": "CG", "iterations": 10, "cone": "elliptic"}),
    ("PGS, 10 iterations", {"solver": "PGS", "iterations": 10}),
    ("PGS, 50 iterations", {"solver": "PGS", "iterations": 50}),
    ("loops by connect", {"closure": "connect"}),
    ("loops by connect, 2 ms", {"closure": "connect", "timestep": 0.002}),
    ("loop impedance 0.99", {"impedance": 0.99}),
    ("loop impedance 0.9", {"impedance": 0.9}),
    ("collision by geom masks", {"masks": True}),
    ("condim 4", {"condim": 4}),
    ("frictionloss 2 mN m on motors", {"lossy": 0.002}),
]


def check_contact(file, policy, report, seconds, quick):
    ref = {}
    for cone in ("pyramidal",) if quick else ("pyramidal", "elliptic"):
        m = variant(file, timestep=5e-5, iterations=100, tolerance=1e-14, cone=cone)
        ref[cone] = contact_run(m, policy, seconds)
    print(f"\n## In contact\n\nHand policy on the first {seconds:g} s of the spiral, 0.05 N m of torque noise; path of "
          "the object against the reference (Newton, 1e-14, 0.05 ms, same cone); step times on this machine, "
          "all settings from the same states in contact with the warm start of 0.5 ms steps (in use, settings with more iterations cost more).\n")
    print("| setting | step (µs) | iterations | rows | penetration, first impact / later (mm) | loop gap (mm) | path rms / max (mm) "
          "| mean distance (cm) |\n|---|---|---|---|---|---|---|---|")

    def row(name, r, cone, us=math.nan):
        diff = np.linalg.norm(r["path"] - ref[cone]["path"], axis=1) * 1e3
        rms = math.sqrt(float((diff ** 2).mean()))
        print(f"| {name} | {'' if math.isnan(us) else f'{us:.1f}'} | {r['iters']:.1f} | {r['rows']:.1f} | {r['pen']:.2f} / {r['press']:.2f} | {r['gap']:.4f} | "
              f"{rms:.3f} / {diff.max():.3f} | {r['distance']:.3f} |", flush=True)
        return rms

    for cone, r in ref.items():
        row(f"reference, {cone}", r, cone if quick else "pyramidal")
    warnings = 0
    variants = VARIANTS[:4] if quick else VARIANTS
    runs = [contact_run(variant(file, **change), policy, seconds) for _, change in variants]
    cost = step_times([variant(file, **change) for _, change in variants], runs[0]["states"])
    for (name, change), r, us in zip(variants, runs, cost):
        rms = row(name, r, change.get("cone", "pyramidal"), us)
        for key, label in (("as shipped, 0.5 ms", "0.5 ms"), ("as shipped, 2 ms", "2 ms")):
            if name == key:
                report.check(f"loop gap in contact at {label} (mm)", r["gap"])
                report.check(f"object path at {label} against reference (rms, mm)", rms)
        if name.startswith("as shipped"):
            warnings += r["warnings"]
    report.check("engine warnings", warnings)


def check_peak(file, report, seconds=1.0, seeds=6):
    """Random peak torques, held 20 ms: fingers are thrown into their limits, the table and each other."""
    print("\n## Peak torques\n\nRandom torques of both signs at the motors' limits, held 20 ms, "
          f"{seeds} runs of {seconds:g} s; a loop counts as crossed when its rod is 0.2 rad or more off.\n")
    print("| loops, step | crossed loops | most rows (njmax) | most contacts (nconmax) | stack (nstack) | iterations, worst "
          "| warnings |\n|---|---|---|---|---|---|---|")
    rod = hand.loop_maps(mujoco.MjModel.from_xml_path(file))[0]
    for closure, dt in (("tendon", 0.0005), ("tendon", 0.002), ("tendon", 0.004), ("connect", 0.0005), ("connect", 0.002),
                        ("connect", 0.004)):
        m = variant(file, closure=closure, timestep=dt)
        low, high = hand.start_range(m)
        crossed = rows = contacts = stack = iters = warnings = 0
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            d = mujoco.MjData(m)
            mujoco.mj_resetDataKeyframe(m, d, 0)
            motor = rng.uniform(low, high)
            for i in range(3):
                hand.set_finger(m, d, i, motor[3 * i:3 * i + 3])
            for s in range(int(seconds / dt)):
                if s % int(round(0.02 / dt)) == 0:
                    d.ctrl[:] = rng.choice([-1, 1], 9) * m.actuator_ctrlrange[:, 1]
                mujoco.mj_step(m, d)
                rows, contacts = max(rows, d.nefc), max(contacts, d.ncon)
                iters = max(iters, iterations(d))
            stack = max(stack, int(getattr(d, "maxuse_stack", 0)))
            warnings += count_warnings(d)
            for i in range(3):
                q = d.qpos[5 * i:5 * i + 5]
                crossed += abs(q[3] - rod @ [q[1], q[2], 1]) > 0.2
        print(f"| {closure}, {1e3 * dt:g} ms | {crossed} of {3 * seeds} | {rows} | {contacts} | {stack} | {iters} | {warnings} |", flush=True)
        if closure == "tendon":
            report.check("peak torques: crossed loops or warnings", crossed + warnings)


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--model", default=hand.MODEL)
    ap.add_argument("--quick", action="store_true", help="only the shipped settings, 1 s of contact")
    args = ap.parse_args()
    report = Report()
    if hasattr(mujoco, "set_mju_user_warning"):  # some settings diverge on purpose; no log file for that
        mujoco.set_mju_user_warning(lambda text: None)
    m = mujoco.MjModel.from_xml_path(args.model)
    d = mujoco.MjData(m)
    t0 = time.perf_counter()
    for _ in range(200):
        mujoco.mj_resetData(m, d)
    reset = (time.perf_counter() - t0) / 200 * 1e6
    print(f"MuJoCo {mujoco.__version__}: nq {m.nq}, nv {m.nv}, nu {m.nu}, sensors {m.nsensordata}; "
          f"mjData {d.nbuffer / 1024:.0f} KiB, reset {reset:.1f} µs")
    check_inertia(m, report)
    check_ranges(m, report)
    check_force(m, report)
    check_acceleration(m, report)
    print("\n## Energy drift\n\nFree swing of all fingers for 0.5 s, no contact, limits or damping; worst change of "
          "energy in % of the peak kinetic energy:\n\n| step (ms) | as shipped | 100 iterations, 1e-14 |\n|---|---|---|")
    for dt in (5e-5, 5e-4, 1e-3, 2e-3, 4e-3):
        drift = energy_drift(m, dt)
        kept = m.opt.iterations, m.opt.tolerance
        m.opt.iterations, m.opt.tolerance = 100, 1e-14
        print(f"| {1e3 * dt:g} | {drift:.3f} | {energy_drift(m, dt):.3f} |")
        m.opt.iterations, m.opt.tolerance = kept
        if dt == 5e-4:
            report.check("energy drift at 0.5 ms (%)", drift)
    m = mujoco.MjModel.from_xml_path(args.model)
    policy = hand.build_policy(m)
    dist, torque, _ = hand.rollout(m, *policy)
    print(f"\n## Hand-made policy\n\nSpiral, nominal bases, control at 0.5 ms: mean distance {100 * dist.mean():.3f} cm, "
          f"worst {100 * dist.max():.3f} cm, rms torque {torque:.3f} N m.")
    report.check("hand policy, mean distance (cm)", 100 * dist.mean())
    check_contact(args.model, policy, report, 1.0 if args.quick else 4.0, args.quick)
    check_peak(args.model, report, seeds=2 if args.quick else 6)
    report.print()
    if report.failed:
        print("\nfailed: " + "; ".join(report.failed), file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
