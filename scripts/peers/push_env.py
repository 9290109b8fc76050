"""The pushing task of `phantom train` for the peers in this folder: same model, reward, starts, step and horizon.

Python loops over the official `mujoco` package, one step a call, as the peers do it.
"""
import math
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT / "scripts"))

try:
    import mujoco
    import numpy as np
    from hand_policy import set_finger, spiral, start_range
except ImportError as missing:
    print(f"{missing}: see the head of this script for what to install", file=sys.stderr)
    sys.exit(2)

N_OBSERVATION, N_ACTION = 36, 9
TIMESTEP, HOLD, HORIZON = 0.004, 2, 125
BASE_SIGMA, GOAL_RADIUS = 0.005, 0.06
LOG_SIGMA = -1.5  # of the first policy, log N m: phantom's


class Push:
    """Observations of 36 numbers, torques of 9 in N m."""

    def __init__(self, seed, timestep=TIMESTEP, hold=HOLD):
        self.m = mujoco.MjModel.from_xml_path(str(ROOT / "xml" / "phantom.xml"))
        self.m.opt.timestep = timestep
        self.d = mujoco.MjData(self.m)
        self.hold = hold
        self.rng = np.random.default_rng(seed)
        self.bases = [mujoco.mj_name2id(self.m, mujoco.mjtObj.mjOBJ_BODY, f"p{i}_base") for i in range(3)]
        self.tips = [mujoco.mj_name2id(self.m, mujoco.mjtObj.mjOBJ_SITE, f"p{i}_tip") for i in range(3)]
        self.object = mujoco.mj_name2id(self.m, mujoco.mjtObj.mjOBJ_GEOM, "object")
        self.nominal = self.m.body_pos.copy()
        self.low, self.high = start_range(self.m)
        self.limit = self.m.actuator_ctrlrange[:, 1].copy()

    def touching(self):
        return any(self.object in (c.geom1, c.geom2) and c.exclude == 0 and self.finger(c)
                   for c in self.d.contact[:self.d.ncon])

    def finger(self, contact):
        other = contact.geom1 if contact.geom2 == self.object else contact.geom2
        return self.m.geom_bodyid[other] not in (0, self.m.geom_bodyid[self.object])

    def reset(self):
        """New bases, joints that do not touch the object, and a goal in the disc."""
        self.m.body_pos[:] = self.nominal
        for base in self.bases:
            self.m.body_pos[base, :2] += BASE_SIGMA * self.rng.normal(size=2)
        while True:
            mujoco.mj_resetData(self.m, self.d)
            motor = self.rng.uniform(self.low, self.high)
            for i in range(3):
                set_finger(self.m, self.d, i, motor[3 * i:3 * i + 3])
            radius, angle = GOAL_RADIUS * math.sqrt(self.rng.uniform()), self.rng.uniform(0, 2 * math.pi)
            self.d.mocap_pos[0, :2] = radius * math.cos(angle), radius * math.sin(angle)
            mujoco.mj_forward(self.m, self.d)
            if not self.touching():
                return self.observe()

    def observe(self):
        return np.concatenate([self.d.qpos[:15], self.d.qvel[:15], self.d.qpos[15:18], self.d.mocap_pos[0]])

    def step(self, torque):
        """Observation and reward after one control step."""
        self.d.ctrl[:] = torque
        mujoco.mj_step(self.m, self.d, self.hold)
        place, goal = self.d.qpos[15:18], self.d.mocap_pos[0]
        tips = np.linalg.norm(self.d.site_xpos[self.tips] - place, axis=1).sum()
        effort = np.square(self.d.actuator_force).sum()
        return self.observe(), 1 - 3 * math.hypot(*(place - goal)[:2]) - tips - 0.1 * effort

    def broke(self):
        return bool(np.any(self.d.warning.number)) or not np.all(np.isfinite(self.d.qpos))


def spiral_cm(policy, rollouts=10, seed=1):
    """Mean distance from the spiral's target at 2 kHz, cm; `policy` maps an observation to torques."""
    env, means = Push(seed, timestep=0.0005, hold=1), []
    for _ in range(rollouts):
        env.reset()
        distances = []
        for k in range(8000):
            env.d.mocap_pos[0, :2] = spiral(k * 0.0005)
            env.step(policy(env.observe()))
            distances.append(100 * math.hypot(*(env.d.qpos[15:17] - env.d.mocap_pos[0, :2])))
        means.append(np.mean(distances))
    return float(np.mean(means))


class Budget:
    """CPU seconds of this process, less those of evaluations; or until the object follows the spiral well enough."""

    def __init__(self, options):
        self.options, self.begin, self.apart = options, time.process_time(), 0.0
        self.next, self.reached = options.every, False

    @staticmethod
    def add_options(parser):
        parser.add_argument("--cpu-seconds", type=float, default=120, help="at most [120]")
        parser.add_argument("--until-cm", type=float, default=0.0, help="end when the spiral is followed so closely [never]")
        parser.add_argument("--every", type=float, default=float("inf"), help="CPU seconds between evaluations [one, at the end]")
        parser.add_argument("--seed", type=int, default=0)

    def used(self):
        return time.process_time() - self.begin - self.apart

    def spent(self, policy):
        if self.used() >= self.next:
            self.next += self.options.every
            cm = self.evaluate(policy)
            self.reached = cm <= self.options.until_cm
            print(f"{self.used():.0f} CPU s: spiral {cm:.2f} cm", file=sys.stderr, flush=True)
        return self.reached or self.used() >= self.options.cpu_seconds

    def evaluate(self, policy):
        begin = time.process_time()
        cm = spiral_cm(policy)
        self.apart += time.process_time() - begin
        return cm


def report(name, steps, budget, cm):
    """One line of the table."""
    used = budget.used()
    print(f"{name}: {steps} policy steps in {used:.0f} CPU s: {steps / used:.0f} policy steps/s, "
          f"{HOLD * steps / used:.0f} physics steps/s; spiral {cm:.2f} cm", flush=True)
