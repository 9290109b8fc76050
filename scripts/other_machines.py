#!/usr/bin/env python3
"""Machines of other kinds than this repository's, with a law or several hidden, made by MuJoCo's Python package and searched.

    .venv-crosscheck/bin/python scripts/other_machines.py OUT [CASE ...]

For every case (all when none is named) OUT/CASE gets a model, a parameter file and recordings as tables. The machine
differs from the model in some masses and dampings, moves in steps of 0.1 to 0.2 ms under commands held for a sample,
and is read at its own rate with noise. `phantom gap` is then run on them, and a line printed: what was hidden, the
answer, held-out rollouts of 1 s before and after. Cases are named MACHINE-HIDDEN; --list prints them.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
# m or rad per second over which dry friction changes its sign
SMOOTH = 2e-3


def dry(level, v, smooth=SMOOTH):
    return -np.asarray(level) * np.tanh(v / smooth)


def together(*laws):
    """Several laws with their places, as one."""
    return (lambda d: sum(np.asarray(law(d)) for law, _ in laws), [place for _, places in laws for place in places])


def sines(rng, amplitudes, hz, n):
    """Sums of `n` sines between two frequencies, one sum an amplitude."""
    shape = (len(amplitudes), n)
    w = 2 * np.pi * np.exp(rng.uniform(*np.log(hz), shape))
    phase = rng.uniform(0, 2 * np.pi, shape)
    return lambda t: np.asarray(amplitudes) / np.sqrt(n) * np.sin(w * t + phase).sum(axis=1)


def record(xml, seconds, rate, step, start, control, force):
    """Positions and commands of a machine, a row a sample."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = step
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    inner = round(1 / rate / step)
    assert abs(inner * rate * step - 1) < 1e-9, "a sample is a whole number of steps"
    rows = []
    for k in range(round(seconds * rate)):
        if control is not None:
            data.ctrl[:] = control(k / rate, data)
        rows.append(np.concatenate([[k / rate], data.qpos, data.ctrl]))
        for _ in range(inner):
            data.qfrc_applied[:] = force(data)
            mujoco.mj_step(model, data)
    return np.array(rows)


def document(name, step, tree, motors, sensors):
    """The text of a machine: `motors` and `sensors` are pairs of a name and its joint."""
    each = lambda kind, pairs: "".join(f'<{kind} name="{own}" joint="{joint}"/>' for own, joint in pairs)
    return f"""<mujoco model="{name}">
  <compiler angle="radian"/>
  <option timestep="{step}"/>
  <worldbody>
    {tree}
  </worldbody>
  <actuator>{each("motor", motors)}</actuator>
  <sensor>{each("jointpos", sensors)}</sensor>
</mujoco>"""


def link(name, at, centre, mass, inertia, joint, inner=""):
    """A body with a joint, and what hangs on it. `inertia` is diagonal, in kg m²; `joint` its attributes."""
    return f"""<body name="{name}" pos="{at}">
      <inertial pos="{centre}" mass="{mass}" diaginertia="{" ".join(str(i) for i in inertia)}"/>
      <joint {joint}/>
      {inner}
    </body>"""


class Pendulum:
    """Swings by itself, released at five angles."""

    readings, motors, rate, step, seconds, trials, noise = ["angle"], [], 200, 2e-4, 12, 5, [5e-4]
    parameters = [("joint/pivot", "damping", 0.5, None), ("body/rod", "ipos", 0.02, [2])]
    hidden = {
        "none": (lambda d: 0, []),
        "dry": (lambda d: dry(0.01, d.qvel), [("coulomb_friction", "pivot")]),
        "air": (lambda d: -0.002 * np.abs(d.qvel) * d.qvel, [("quadratic_drag", "pivot")]),
        "spring": (lambda d: -0.08 * d.qpos, [("joint_spring", "pivot")]),
    }
    hidden["worn"] = together(hidden["dry"], hidden["air"])

    def xml(self, machine):
        mass, damping = (0.32, 0.0012) if machine else (0.3, 0.001)
        inertia = 0.0133 * mass, 0.0133 * mass, 0.0003 * mass
        joint = f'name="pivot" axis="0 1 0" damping="{damping}"'
        rod = link("rod", "0 0 0", "0 0 -0.18", mass, inertia, joint)
        return document("pendulum", 0.001, rod, [], [("angle", "pivot")])

    def trial(self, rng, i):
        return [[1.2, -2.0, 0.7, -1.5, 1.7][i]], None


class Cart:
    """A pole on a cart that a force pulls about, at 100 Hz."""

    readings, motors, rate, step, seconds, trials, noise = ["x", "theta"], ["push"], 100, 2e-4, 10, 4, [1e-4, 1e-3]
    parameters = [("body/*", "mass", 0.1, None), ("joint/*", "damping", 0.5, None)]
    hidden = {
        "none": (lambda d: 0, []),
        "dry": (lambda d: [dry(0.8, d.qvel[0]), 0], [("coulomb_friction", "slide")]),
        "offset": (lambda d: [0.3, 0], [("torque_offset", "slide")]),
    }
    hidden["worn"] = together(hidden["dry"], (lambda d: [-2 * d.qpos[0], 0], [("joint_spring", "slide")]))

    def xml(self, machine):
        m_cart, m_pole, rail, hinge = (0.82, 0.21, 1.1, 0.0011) if machine else (0.8, 0.2, 1.0, 0.001)
        joint = f'name="hinge" axis="0 1 0" damping="{hinge}"'
        pole = link("pole", "0 0 0", "0 0 -0.25", m_pole, (0.02 * m_pole, 0.02 * m_pole, 0.0005 * m_pole), joint)
        joint = f'name="slide" type="slide" axis="1 0 0" damping="{rail}"'
        cart = link("cart", "0 0 0", "0 0 0", m_cart, (0.01, 0.01, 0.01), joint, pole)
        return document("cart", 0.002, cart, [("push", "slide")], [("x", "slide"), ("theta", "hinge")])

    def trial(self, rng, i):
        wanted = sines(rng, [0.25], (0.1, 1.5), 8)
        return [0, 0.3 * rng.normal()], lambda t, d: 30 * (wanted(t) - d.qpos[0]) - 3 * d.qvel[0]


class Furuta:
    """A pendulum on a driven arm, both read by encoders of 2048 counts."""

    readings, motors, rate, step, seconds, trials = ["arm_pos", "pendulum_pos"], ["motor"], 500, 2e-4, 8, 4
    noise, counts = [0, 0], 2048
    parameters = [("body/pendulum", "mass", 0.1, None), ("joint/*", "damping", 0.5, None)]
    hidden = {
        "none": (lambda d: 0, []),
        "cable": (lambda d: [-0.004 * d.qpos[0], 0], [("joint_spring", "arm")]),
        "dry": (lambda d: [dry(0.0025, d.qvel[0], 0.05), 0], [("coulomb_friction", "arm")]),
    }
    hidden["worn"] = together(
        (
            lambda d: [dry(0.0025 + 0.002 * np.exp(-((d.qvel[0] / 0.4) ** 2)), d.qvel[0], 0.05), 0],
            [("coulomb_friction", "arm"), ("stribeck_friction", "arm")],
        ),
        hidden["cable"],
    )

    def xml(self, machine):
        mass, d_arm, d_pendulum = (0.025, 0.0004, 3e-5) if machine else (0.024, 0.0005, 2.5e-5)
        inertia = 1.375e-3 * mass, 1.375e-3 * mass, 4e-5 * mass
        joint = f'name="pendulum" axis="1 0 0" damping="{d_pendulum}"'
        pendulum = link("pendulum", "0.085 0 0", "0 0 -0.065", mass, inertia, joint)
        joint = f'name="arm" axis="0 0 1" damping="{d_arm}"'
        arm = link("arm", "0 0 0", "0.04 0 0", 0.095, (5e-6, 6e-5, 6e-5), joint, pendulum)
        sensors = [("arm_pos", "arm"), ("pendulum_pos", "pendulum")]
        return document("furuta", 0.001, arm, [("motor", "arm")], sensors)

    def trial(self, rng, i):
        wanted = sines(rng, [0.9], (0.2, 2.5), 8)
        return [0, 0], lambda t, d: 0.03 * (wanted(t) - d.qpos[0]) - 0.0012 * d.qvel[0]


class Arm:
    """Six joints at 250 Hz, which follow sums of sines."""

    readings, motors = [f"q{i}" for i in range(1, 7)], [f"m{i}" for i in range(1, 7)]
    rate, step, seconds, trials, noise = 250, 2e-4, 8, 3, [2e-5] * 6
    parameters = [("body/link*", "mass", 0.1, None), ("joint/*", "damping", 0.5, None)]
    levels = np.array([2.0, 3.0, 1.5, 0.5, 0.4, 0.2])
    hidden = {
        "none": (lambda d: 0, []),
        "dry": (lambda d: dry(Arm.levels, d.qvel, 5e-3), [("coulomb_friction", f"j{i}") for i in range(1, 7)]),
        "gain": (lambda d: [0, 0, -0.12 * d.ctrl[2], 0, 0, 0], [("torque_gain", "m3")]),
    }
    hidden["worn"] = together(hidden["dry"], hidden["gain"])
    lengths, masses = [0.12, 0.3, 0.28, 0.1, 0.09, 0.06], [3.0, 4.5, 2.8, 1.3, 1.0, 0.4]
    axes = ["0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1"]
    dampings, armatures = [0.8, 0.8, 0.5, 0.2, 0.2, 0.1], [0.4, 0.4, 0.25, 0.08, 0.08, 0.04]

    def xml(self, machine):
        rng = np.random.default_rng(7)
        factor = 1 + machine * np.repeat([0.05, 0.2], 6) * rng.normal(size=12)
        tree = ""
        for i in reversed(range(6)):
            length, mass = self.lengths[i], self.masses[i] * factor[i]
            side, along = mass * (length**2 / 12 + 4e-4), 1e-3 * mass
            at, centre = f"0 0 {self.lengths[i - 1] if i else 0}", f"0 0.01 {length / 2}"
            damping, armature = self.dampings[i] * factor[6 + i], self.armatures[i]
            joint = f'name="j{i + 1}" axis="{self.axes[i]}" damping="{damping}" armature="{armature}"'
            tree = link(f"link{i + 1}", at, centre, mass, (side, side, along), joint, tree)
        joints = [f"j{i}" for i in range(1, 7)]
        return document("arm", 0.002, tree, list(zip(self.motors, joints)), list(zip(self.readings, joints)))

    def trial(self, rng, i):
        wanted = sines(rng, [0.5, 0.35, 0.5, 0.6, 0.6, 0.8], (0.1, 1.0), 5)
        stiff, damped = np.array([600, 900, 500, 120, 100, 40]), np.array([60, 80, 40, 8, 7, 3])
        return wanted(0), lambda t, d: stiff * (wanted(t) - d.qpos) - damped * d.qvel


class DoublePendulum:
    """Two links that swing by themselves, seen by a camera at 400 Hz."""

    readings, motors, rate, step, seconds, trials = ["a1", "a2"], [], 400, 1.25e-4, 6, 4
    noise = [5e-4, 5e-4]
    parameters = [("body/upper", "mass", 0.2, None)]
    hidden = {
        "none": (lambda d: 0, []),
        "viscous": (lambda d: -np.array([8e-4, 3e-4]) * d.qvel, [("viscous_friction", "j1"), ("viscous_friction", "j2")]),
        "dry": (lambda d: dry([2e-3, 1e-3], d.qvel), [("coulomb_friction", "j1"), ("coulomb_friction", "j2")]),
    }
    hidden["worn"] = together(hidden["dry"], hidden["viscous"])

    def xml(self, machine):
        m_upper, m_lower = (0.11 if machine else 0.1), 0.08
        along = 1e-5
        inertia = 2.1e-3 * m_lower, 2.1e-3 * m_lower, along
        lower = link("lower", "0 0 -0.18", "0 0 -0.08", m_lower, inertia, 'name="j2" axis="0 1 0"')
        inertia = 2.7e-3 * m_upper, 2.7e-3 * m_upper, along
        upper = link("upper", "0 0 0", "0 0 -0.09", m_upper, inertia, 'name="j1" axis="0 1 0"', lower)
        return document("double", 0.0005, upper, [], [("a1", "j1"), ("a2", "j2")])

    def trial(self, rng, i):
        return [(1.5, 0.3), (-1.0, 1.2), (2.2, -0.6), (-1.8, 0.9)][i], None


class Bare:
    """Two driven joints at 200 Hz whose model has masses and rotors, no friction."""

    readings, motors, rate, step, seconds, trials = ["q1", "q2"], ["m1", "m2"], 200, 2e-4, 6, 4
    noise = [1e-4, 1e-4]
    parameters = [("body/*", "mass", 0.1, None)]
    hidden = {
        "viscous": (lambda d: -np.array([0.15, 0.08]) * d.qvel, [("viscous_friction", "j1"), ("viscous_friction", "j2")]),
    }
    hidden["both"] = together(
        hidden["viscous"],
        (lambda d: dry([0.25, 0.12], d.qvel), [("coulomb_friction", "j1"), ("coulomb_friction", "j2")]),
    )

    def xml(self, machine):
        a, b = (1.248, 0.76) if machine else (1.2, 0.8)
        joint = 'name="j2" axis="0 1 0" armature="0.01"'
        lower = link("l2", "0 0 -0.3", "0 0 -0.12", b, (0.0075 * b, 0.0075 * b, 0.0005), joint)
        joint = 'name="j1" axis="0 1 0" armature="0.02"'
        upper = link("l1", "0 0 0", "0 0 -0.15", a, (0.01 * a, 0.01 * a, 0.001), joint, lower)
        motors, sensors = [("m1", "j1"), ("m2", "j2")], [("q1", "j1"), ("q2", "j2")]
        return document("bare", 0.00025, upper, motors, sensors)

    def trial(self, rng, i):
        wanted = sines(rng, [0.7, 0.8], (0.1, 1.2), 6)
        return wanted(0), lambda t, d: np.array([30, 15]) * (wanted(t) - d.qpos) - np.array([2, 1]) * d.qvel


MACHINES = {
    "pendulum": Pendulum(),
    "cart": Cart(),
    "furuta": Furuta(),
    "arm": Arm(),
    "double": DoublePendulum(),
    "bare": Bare(),
}


def make(machine, force, folder, seed):
    """Writes model, parameters and recordings; the last recording is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(machine.xml(False))
    rules = ""
    for element, attribute, sigma, components in machine.parameters:
        rules += f'[[parameter]]\nelement = "{element}"\nattribute = "{attribute}"\nprior_sigma = {sigma}\n'
        rules += f"components = {components}\n" if components else ""
    (folder / "parameters.toml").write_text(rules)
    rng = np.random.default_rng(seed)
    files = []
    for i in range(machine.trials):
        start, control = machine.trial(rng, i)
        rows = record(machine.xml(True), machine.seconds, machine.rate, machine.step, start, control, force)
        n = len(machine.readings)
        rows[:, 1 : 1 + n] += np.asarray(machine.noise) * rng.normal(size=(len(rows), n))
        if counts := getattr(machine, "counts", None):
            count = 2 * np.pi / counts
            rows[:, 1 : 1 + n] = count * np.round(rows[:, 1 : 1 + n] / count)
        files.append(folder / f"trial_{i}.csv")
        header = ",".join(["time", *machine.readings, *machine.motors])
        np.savetxt(files[-1], rows, "%.9g", ",", header=header, comments="")
    return files


def main():
    cases = [f"{m}-{h}" for m, machine in MACHINES.items() for h in machine.hidden]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("case", nargs="*", metavar="CASE")
    parser.add_argument("--list", action="store_true", help="print the cases")
    parser.add_argument("--seed", type=int, default=0, help="of noise and motions [0]")
    parser.add_argument("--phantom", default=str(ROOT / "scripts" / "phantom"), help="program [scripts/phantom]")
    args = parser.parse_args()
    if args.list:
        print("\n".join(cases))
        return 0
    if args.out is None:
        parser.error("a folder is needed")
    if unknown := [case for case in args.case if case not in cases]:
        parser.error(f"no case is named {', '.join(unknown)}; there are: {', '.join(cases)}")
    right = 0
    wanted = args.case or cases
    for case in wanted:
        kind, hidden = case.split("-")
        machine = MACHINES[kind]
        force, truth = machine.hidden[hidden]
        folder = args.out / case
        files = make(machine, force, folder, args.seed)
        command = [args.phantom, "gap", "--model", folder / "model.xml", "--parameters", folder / "parameters.toml"]
        command += ["--train", *files[:-1], "--holdout", files[-1], "--out", folder / "gap", "--json"]
        began = time.monotonic()
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        if run.returncode not in (0, 1):
            print(f"{case}: {run.stderr.strip()}")
            continue
        answer = json.loads((folder / "gap" / "gap.json").read_text())
        found = [(e["name"], e["where"]) for e in answer["effects"]]
        same = sorted(found) == sorted(truth)
        right += same
        said = ", ".join(f"{name} at {at}" for name, at in found)
        ends = [r for r in answer["gap"]["rollout"] if r["horizon_s"] == 1.0]
        shrunk = ", ".join(f"{r['before']:.3g} to {r['after']:.2g} {r['unit']}" for r in ends)
        seconds = time.monotonic() - began
        print(f"{case}: {'right' if same else 'WRONG'}, {answer['verdict']}: {said}; {shrunk}; {seconds:.0f} s", flush=True)
    print(f"{right} of {len(wanted)} right")
    return 0 if right == len(wanted) else 1


if __name__ == "__main__":
    sys.exit(main())
