#!/usr/bin/env python3
"""Finds the finger's masses and inertias in xml/phantom.xml from the published inertia matrix.

Every entry of the 3x3 inertia matrix in motor coordinates (loops eliminated) is linear in the
bodies' second-moment matrices Q = integral of [r;1][r;1]' dm, and a rigid body is possible exactly
when its Q is positive semidefinite. So the smallest worst deviation from the published
matrix that rigid bodies can reach is a semidefinite program with one answer. Step 1 finds
that smallest worst deviation over the contact workspace; step 2 allows 0.4 % more of it and
minimises the worst deviation over the whole joint range; step 3 allows 2 % more of that and
minimises the sum of squares. Gravity torques are matched exactly. Bodies keep a given
thickness, stay inside ellipsoids of the robot's size and below the masses in CAPS.

Needs NumPy and cvxpy (with Clarabel). Prints the attributes to put into the model file;
scripts/check_model.py verifies them there.

    python3 scripts/fit_inertia.py
    python3 scripts/fit_inertia.py --floor      # what unrestricted rigid bodies could reach
"""
import argparse
import math

import cvxpy as cp
import numpy as np

K = np.array([1.798, 0.864, 0.486, 2.766, 0.308, 2.526, 0.652]) * 1e-3
GRAVITY2, GRAVITY3, G = 0.164, 0.094, 9.81
L1, L2, L3 = 0.215, 0.170, 0.0325
TIP_MASS, TIP_RADIUS, ROD_MASS, ROD_RADIUS = 0.006, 0.01, 0.004, 0.003
TURRET_INERTIA, ROTOR = 4e-5, 1e-5
CONTACT_SPACE, SHOULDER = (0.03, 0.11, 0.175, 0.295), 0.24
RANGE2, RANGE3 = np.radians([-25, 7]), np.radians([-30, 40])
BODIES = ("upper", "crank", "forearm")
CAPS = {"upper": 0.3, "crank": 0.35, "forearm": 0.06}        # kg
THICK = {"upper": 0.004, "crank": 0.005, "forearm": 0.003}   # least rms extent (m)
# Centre and half axes (m): the upper link and the crank each carry a motor as counterweight.
SHAPE = {"upper": ((0.05, 0, 0), (0.20, 0.07, 0.05)),
         "crank": ((0, 0, 0), (0.09, 0.06, 0.09)),
         "forearm": ((0, 0, -0.065), (0.009, 0.009, 0.12))}
SCALE = np.diag([0.05, 0.05, 0.05, 1.0])                     # for the solver's sake
PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]


def published(a, b):
    m12, m23 = K[4] * math.sin(a), -0.5 * K[3] * math.sin(a - b)
    m11 = K[0] + K[1] * math.cos(2 * a) + K[2] * math.cos(2 * b) + K[3] * math.cos(a) * math.sin(b)
    return np.array([[m11, m12, 0], [m12, K[5], m23], [0, m23, K[6]]])


def turn(t):
    """Rotation by t about -y and its derivative."""
    c, s = math.cos(t), math.sin(t)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), np.array([[-s, 0, -c], [0, 0, 0], [c, 0, -s]])


def jacobians(body, a, b):
    """d(world point)/d(th1, th2, th3) as 3x4 matrices acting on [r; 1] in the body's frame."""
    (ra, da), (rb, db) = turn(a), turn(b)
    rot, drot = (ra, da) if body in ("upper", "rod") else (rb, db)
    org, do2, do3 = np.zeros(3), np.zeros(3), np.zeros(3)
    if body == "rod":
        org, do3 = L3 * rb[:, 2], L3 * db[:, 2]
    if body == "forearm":  # frame at the elbow
        org, do2 = L1 * ra[:, 0], L1 * da[:, 0]
    z = np.zeros((3, 3))
    by2 = np.c_[drot if body in ("upper", "rod") else z, do2]
    by3 = np.c_[z if body in ("upper", "rod") else drot, do3]
    spin = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 0.0]])
    return spin @ np.c_[rot, org], by2, by3


def rod_and_tip():
    rod = np.zeros((4, 4))
    rod[3, 3], rod[0, 3], rod[3, 0] = ROD_MASS, ROD_MASS * L1 / 2, ROD_MASS * L1 / 2
    rod[0, 0] = ROD_MASS * L1 ** 2 / 3
    rod[1, 1] = rod[2, 2] = ROD_MASS * ROD_RADIUS ** 2 / 4
    r = np.array([0, 0, -L2, 1.0])
    tip = TIP_MASS * np.outer(r, r)
    tip[:3, :3] += np.eye(3) * TIP_MASS * TIP_RADIUS ** 2 / 5
    return rod, tip


def rows(grid, big):
    """Matrix and offset of the deviations (relative to `big`), linear in [Q..., armatures]."""
    rod, tip = rod_and_tip()
    a_rows, offsets = [], []
    for a, b in grid:
        want = published(a, b)
        jac = {body: jacobians(body, a, b) for body in BODIES + ("rod",)}
        for i, j in PAIRS:
            gram = {body: jac[body][i].T @ jac[body][j] for body in jac}
            gram = {body: (g + g.T) / 2 for body, g in gram.items()}
            arm = np.zeros(3)
            arm[i] = i == j
            a_rows.append(np.concatenate([gram[body].ravel() for body in BODIES] + [arm]) / big)
            fixed = np.sum(gram["rod"] * rod) + np.sum(gram["forearm"] * tip)
            offsets.append((fixed - want[i, j]) / big)
    return np.array(a_rows), np.array(offsets)


def grids(n=13):
    z0, z1, r0, r1 = CONTACT_SPACE
    contact = []
    for z in np.linspace(z0, z1, n) - SHOULDER:
        for r in np.linspace(r0, r1, n):
            phi = math.acos((r * r + z * z - L1 ** 2 - L2 ** 2) / (2 * L1 * L2))
            a = math.atan2(z, r) + math.atan2(L2 * math.sin(phi), L1 + L2 * math.cos(phi))
            contact.append((a, a - phi + math.pi / 2))
    whole = [(a, b) for a in np.linspace(*RANGE2, n) for b in np.linspace(*RANGE3, n)]
    return contact, whole


def solve(floor):
    contact, whole = grids()
    big_c = max(published(*p).max() for p in contact)
    big_w = max(published(*p).max() for p in whole)
    a_c, o_c = rows(contact, big_c)
    a_w, o_w = rows(whole, big_w)
    unit = 0.1
    var = {b: cp.Variable((4, 4), PSD=True) for b in BODIES}
    thick = {b: 0.0 if floor else THICK[b] ** 2 for b in BODIES}
    q = {b: unit * (SCALE @ var[b] @ SCALE + cp.multiply(var[b][3, 3], np.diag([thick[b]] * 3 + [0]))) for b in BODIES}
    arm, t_c, t_w = cp.Variable(3), cp.Variable(), cp.Variable()
    x = cp.hstack([cp.vec(q[b], order="C") for b in BODIES] + [arm * 1e-4])
    dev_c, dev_w = a_c @ x + o_c, a_w @ x + o_w
    cons = [cp.abs(100 * dev_c) <= t_c, cp.abs(100 * dev_w) <= t_w]
    if floor:
        cons.append(arm >= 0)
    else:
        cons.append(arm * 1e-4 >= np.array([TURRET_INERTIA + ROTOR, ROTOR, ROTOR]))
        rod, tip = rod_and_tip()
        first2 = q["upper"][0, 3] + (q["forearm"][3, 3] + TIP_MASS) * L1 + rod[0, 3]
        first3 = -(q["crank"][2, 3] + q["forearm"][2, 3] + tip[2, 3]) - ROD_MASS * L3
        cons += [100 * (G * first2 - GRAVITY2) == 0, 100 * (G * first3 - GRAVITY3) == 0]
        # Centres of mass on the links' axes; the only product of inertia is the upper link's (for k5).
        up, cr, fo = (var[b] for b in BODIES)
        cons += [up[2, :2] == 0, up[2, 3] == 0, up[1, 3] == 0]
        cons += [cr[0, 1:] == 0, cr[1, 2:] == 0, fo[0, 1:] == 0, fo[1, 2:] == 0]
        for b in BODIES:
            centre, axes = np.array(SHAPE[b][0]), 1 / np.array(SHAPE[b][1]) ** 2
            shape = np.block([[-np.diag(axes), (axes * centre)[:, None]],
                              [(axes * centre)[None], np.array([[1 - centre @ (axes * centre)]])]])
            cons += [100 * cp.sum(cp.multiply(shape, q[b])) >= 0, q[b][3, 3] <= CAPS[b]]

    def run(objective, extra):
        problem = cp.Problem(cp.Minimize(objective), cons + extra)
        problem.solve(solver=cp.CLARABEL)
        if problem.status not in ("optimal", "optimal_inaccurate"):
            raise SystemExit(f"no solution: {problem.status}")

    run(t_c, [])
    best_c = float(np.abs(100 * dev_c.value).max())
    print(f"smallest worst deviation, contact workspace: {best_c:.3f} % of {big_c:.4g}")
    if floor:
        run(t_w, [])
        print(f"smallest worst deviation, whole joint range: {np.abs(100 * dev_w.value).max():.3f} % of {big_w:.4g}")
        return
    cap_c = 1.004 * best_c
    run(t_w, [t_c <= cap_c])
    cap_w = 1.02 * float(np.abs(100 * dev_w.value).max())
    run(cp.sum_squares(100 * dev_c), [t_c <= cap_c, t_w <= cap_w])
    print(f"chosen: contact workspace {np.abs(100 * dev_c.value).max():.3f} %, whole range "
          f"{np.abs(100 * dev_w.value).max():.3f} % of {big_w:.4g}\n")
    for b in BODIES:
        val = q[b].value
        mass = val[3, 3]
        com = val[:3, 3] / mass
        second = val[:3, :3] - mass * np.outer(com, com)
        inertia = np.trace(second) * np.eye(3) - second
        if b == "forearm":  # the model's frame is at the end of the rear stub
            com = com - [0, 0, L3]
        com[np.abs(com) < 1e-6] = 0
        full = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        full = [0 if abs(v) < 1e-8 else v for v in full]
        text = " ".join(f"{v:.5g}" for v in full)
        print(f'{b}: <inertial pos="{com[0]:.6g} {com[1]:.6g} {com[2]:.6g}" mass="{mass:.5g}" fullinertia="{text}"/>')
    arms = arm.value * 1e-4 - [TURRET_INERTIA, 0, 0]
    print("armature turret, upper, crank: " + ", ".join(f"{v:.4g}" for v in arms))
    print(f"turret inertia about its axis: {TURRET_INERTIA:g}, rod {ROD_MASS} kg uniform, tip {TIP_MASS} kg")


if __name__ == "__main__":
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--floor", action="store_true", help="drop all restrictions except that bodies are possible")
    solve(ap.parse_args().floor)
