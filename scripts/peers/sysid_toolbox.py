#!/usr/bin/env python3
"""The official toolbox `mujoco[sysid]` and `phantom sysid` on the same data, side by side.

    python3 -m venv .venv-peers && .venv-peers/bin/pip install "mujoco[sysid]==4.0.0" pytest
    .venv-peers/bin/python scripts/peers/sysid_toolbox.py [--phantom target/release/phantom] [--repetitions 5]

The problem is the toolbox's own: the armatures of an arm of five joints, 2 s at 2 ms, all started at 0.01. Its model is
read from its tests, with the integrator set to Euler, as MuJoCo 2.2 has no `implicitfast`. Two times each, taken in turn:
of the estimator alone (the toolbox's `optimize`; `seconds.estimate` of sysid.json), and of the whole program from files to
files, with intervals and a report (the toolbox's without videos). Exit code 0: same optimum, 1: not.
"""
import argparse
import csv
import json
import logging
import subprocess
import sys
import tempfile
import time
from pathlib import Path

try:
    import mujoco
    import numpy as np
    from mujoco import rollout, sysid
    from mujoco.sysid.tests.test_integration import ARM_XML, JOINT_NAMES, TRUE_ARMATURE
except ImportError as missing:
    print(f"{missing}: see the head of this file for what to install", file=sys.stderr)
    sys.exit(2)

ROOT = Path(__file__).resolve().parent.parent.parent
START, TOLERANCE = 0.01, 1e-4


def torques(t):
    """Torques at times t, one column a joint: those of the toolbox's test."""
    columns = [(5, 0.5, 0), (4, 0.7, 0.5), (3, 0.4, 1), (2, 0.9, 1.5), (1, 0.6, 2)]
    return np.column_stack([a * np.sin(2 * np.pi * f * t + p) for a, f, p in columns])


def simulate(spec):
    """Times, torques, states and sensors of 2 s from rest."""
    model = spec.compile()
    data = mujoco.MjData(model)
    t = np.arange(1000) * model.opt.timestep
    ctrl = torques(t)
    start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    state, sensor = rollout.rollout(model, data, start, ctrl[:-1])
    return model, t, ctrl, start, state[0], sensor[0]


def toolbox(spec, run, folder=None):
    """Seconds of the optimiser, and what it found; with `folder`, results and report are written there."""
    model, t, ctrl, start, state, sensor = run
    parameters = sysid.ParameterDict()
    for name in JOINT_NAMES:
        def write(s, p, name=name):
            s.joint(name).armature = p.value[0]
        parameters.add(sysid.Parameter(name, nominal=TRUE_ARMATURE[name], min_value=1e-3, max_value=1.0, modifier=write))
        parameters[name].value[:] = START
    measured = sysid.TimeSeries.from_names(state[:, 0], sensor, model)
    sequence = sysid.ModelSequences("arm", spec, "run", start, sysid.TimeSeries(t, ctrl), measured)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    began = time.perf_counter()
    found, result = sysid.optimize(initial_params=parameters, residual_fn=residual, optimizer="mujoco")
    seconds = time.perf_counter() - began
    if folder:
        sysid.save_results(folder, [sequence], parameters, found, result, residual)
        sysid.default_report([sequence], parameters, found, residual, result, save_path=folder, generate_videos=False)
    return seconds, [float(found[name].value[0]) for name in JOINT_NAMES]


def whole_toolbox(folder):
    """What the child process does: read the files, identify, write."""
    spec = mujoco.MjSpec.from_file(str(folder / "arm.xml"))
    table = np.loadtxt(folder / "run.csv", delimiter=",", skiprows=1)
    model = spec.compile()
    start = sysid.create_initial_state(model, table[0, 1:6], table[0, 6:11], np.zeros(0))
    states = table[1:, :11]
    toolbox(spec, (model, table[:, 0], table[:, 11:], start, states, states[:, 1:]), folder / "toolbox")


def phantom(program, folder, method):
    rules = [f'[[parameter]]\nelement = "joint/{n}"\nattribute = "armature"\nlower = 1e-3\nupper = 1.0\nstart = {START}\n'
             for n in JOINT_NAMES]
    (folder / "p.toml").write_text('command = "held"\n' + "".join(rules) + '[[channel]]\nname = "*"\nnoise_sigma = 1e-6\n')
    command = [program, "sysid", "--model", "arm.xml", "--parameters", "p.toml", "run.csv", "--json", "--ensemble", "1", *method]
    began = time.perf_counter()
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    elapsed = time.perf_counter() - began
    if result.returncode not in (0, 1):
        sys.exit(f"phantom: {result.stderr}")
    document = json.loads(result.stdout)
    return elapsed, document["seconds"]["estimate"], [p["value"] for p in document["result"]["parameters"]]


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--phantom", default=str(ROOT / "target" / "release" / "phantom"))
    arguments.add_argument("--repetitions", type=int, default=5)
    arguments.add_argument("--whole-toolbox", type=Path, metavar="DIR", help=argparse.SUPPRESS)
    options = arguments.parse_args()
    logging.disable(logging.INFO)
    if options.whole_toolbox:
        whole_toolbox(options.whole_toolbox)
        return 0
    program = str(Path(options.phantom).resolve())
    xml = ARM_XML.replace("implicitfast", "Euler")
    spec = mujoco.MjSpec.from_string(xml)
    run = simulate(spec)
    model, t, ctrl, _, state, _ = run
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "arm.xml").write_text(xml)
        sensors = [f"{j}_{kind}" for kind in ("pos", "vel") for j in JOINT_NAMES]
        with open(folder / "run.csv", "w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(["time", *sensors, *(f"act{i + 1}" for i in range(5))])
            states = np.vstack([np.zeros(2 * model.nv), state[:, 1:1 + 2 * model.nv]])
            table.writerows([repr(float(v)) for v in (a, *b, *c)] for a, b, c in zip(t, states, ctrl))
        truth = np.array([TRUE_ARMATURE[n] for n in JOINT_NAMES])

        def theirs():
            began = time.perf_counter()
            subprocess.run([sys.executable, __file__, "--whole-toolbox", name], check=True, capture_output=True)
            whole = time.perf_counter() - began
            return whole, *toolbox(spec, run)

        shooting = ["--method", "shooting", "--window", "inf", "--hold-states"]
        methods = {
            "mujoco[sysid]": theirs,
            "phantom, joint": lambda: phantom(program, folder, []),
            "phantom, shooting": lambda: phantom(program, folder, shooting),
        }
        times, same = {m: [] for m in methods}, True
        for _ in range(options.repetitions):  # in turn: a busy machine slows all of them
            for method, solve in methods.items():
                whole, estimate, values = solve()
                times[method].append((estimate, whole))
                worst = float(np.abs(np.array(values) - truth).max())
                same &= worst < TOLERANCE
        least = {m: np.min(pairs, axis=0) for m, pairs in times.items()}
        print(f"{'':18} {'estimator':>12} {'':>8} {'whole program':>14}")
        for method, pair in least.items():
            ratio = least["mujoco[sysid]"] / pair
            print(f"{method:18} {pair[0]:10.3f} s {ratio[0]:7.2f}x {pair[1]:12.3f} s {ratio[1]:7.2f}x")
        print(f"same optimum within {TOLERANCE}: {'yes' if same else 'no'}; worst of the last {worst:.1e}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
