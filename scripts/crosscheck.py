#!/usr/bin/env python3
"""Checks phantom against the official mujoco package and NumPy, from a record of inputs and results.

    scripts/crosscheck.py                      builds and runs the recorder (cargo), then compares
    scripts/crosscheck.py --recorder BIN       runs a recorder that is built already
    scripts/crosscheck.py --record FILE        compares a record that is there already

What is computed again, from the inputs of the record alone:

  model         numbers of the compiled models, read through phantom's accessors
  one step      each physics step from the recorded state before it: state, contacts, sensors
  trajectory    the whole simulation from its start under the recorded controls
  halves        that mj_step makes the same trajectory as the mj_step2, mj_step1 of rollouts
  inverse       mj_inverse at states on the way
  supplements   the same with a model that has one of every kind, by phantom_supplement.py
  task          observations by joint name, rewards and distances by their formulas
  policy        mean actions, by phantom_policy.py
  update        value fits, advantages, gradient, natural gradient, step, KL, for both Fisher matrices, for white noise,
                for the worst trajectories alone

An error is a difference divided by the largest magnitude in its column (physics) or quantity (all else). A line of
the table gives how many numbers were compared, median, 99 % quantile and worst of their errors, the tolerance, and
the verdict on the worst. With another version of mujoco than phantom's, the verdict on physics is on the median.

Exit code: 0 all within tolerance, 1 some mismatch (or --self-test failed), 2 the check could not be made.
"""
import argparse
import copy
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

try:
    import mujoco
    import numpy as np
except ImportError as missing:
    sys.stderr.write(f"crosscheck.py: {missing}: run it with a Python that has mujoco and numpy\n")
    sys.exit(2)

from phantom_policy import check_policy, evaluate_policy
from phantom_supplement import Supplement

ROOT = Path(__file__).resolve().parent.parent
FORMAT = "phantom-crosscheck-1"
# Physics with the same version is expected to give the same bits. With another one the median error is judged: models
# and solvers were changed between versions, and contact makes small differences grow.
TOLERANCES = {  # (same version, another version)
    "model": (1e-14, 1e-9),
    "one step": (1e-12, 1e-2),
    "sensors": (1e-12, 1e-2),
    "contacts": (0.0, 0.0),
    "trajectory": (1e-12, 1e-1),
    "halves": (1e-12, 1e-1),
    "inverse": (1e-12, 1e-2),
}


class Unusable(Exception):
    """The check cannot be made; the message is one sentence."""


class Comparison:
    """The table: one line a quantity."""

    def __init__(self, same_version):
        self.same_version = same_version
        self.lines = []

    def physics(self, kind, quantity, errors):
        """A line of what mujoco computed, to be judged by its version."""
        same, another = TOLERANCES[kind]
        if self.same_version:
            self.errors(quantity, errors, same)
        else:
            self.errors(quantity, errors, another, by_median=True)

    def errors(self, quantity, errors, tolerance, by_median=False):
        errors = np.abs(np.asarray(errors, dtype=float)).ravel()
        # what is not a number has to count as wrong
        worst = float(np.max(errors)) if errors.size and np.all(np.isfinite(errors)) else math.inf
        quantiles = np.quantile(errors, [0.5, 0.99]) if math.isfinite(worst) else [math.nan, math.nan]
        judged = quantiles[0] if by_median else worst
        self.lines.append((quantity, errors.size, *quantiles, worst, tolerance, bool(judged <= tolerance)))

    def arrays(self, quantity, recorded, derived, tolerance, by_column=False):
        recorded, derived = np.asarray(recorded, dtype=float), np.asarray(derived, dtype=float)
        if recorded.shape != derived.shape or recorded.size == 0:
            self.errors(f"{quantity} {recorded.shape}, {derived.shape}", [math.inf], tolerance)
            return
        self.errors(quantity, np.abs(recorded - derived) / scale(derived, by_column), tolerance)

    def mismatches(self):
        return [line[0] for line in self.lines if not line[-1]]

    def show(self):
        width = max(len(line[0]) for line in self.lines)
        print(f"{'quantity':{width}}  {'count':>7}  {'q50':>8}  {'q99':>8}  {'worst':>8}  {'tolerance':>9}")
        for quantity, count, q50, q99, worst, tolerance, ok in self.lines:
            verdict = "ok" if ok else "MISMATCH"
            print(f"{quantity:{width}}  {count:7d}  {q50:8.1e}  {q99:8.1e}  {worst:8.1e}  {tolerance:9.0e}  {verdict}")


def scale(values, by_column):
    """Largest magnitude; with `by_column` of each column, but at least a thousandth of the largest of all."""
    largest = np.max(np.abs(values))
    if by_column and values.ndim == 2:
        return np.maximum(np.max(np.abs(values), axis=0), 1e-3 * largest) + np.finfo(float).tiny
    return largest + np.finfo(float).tiny


# ---------------------------------------------------------------------------------------------- physics

STATE = ("qpos", "qvel", "act", "qacc_warmstart")


def load_model(case, table=None):
    """The model of a physics case, as it was drawn; compares what was compiled if there is a table."""
    try:
        model = mujoco.MjModel.from_xml_path(str(ROOT / case["model"]))
    except ValueError as error:
        raise Unusable(f"mujoco cannot load {case['model']}: {error}") from None
    if table is not None:
        errors = []
        for name, values in case["constants"].items():
            if not hasattr(model, name):
                if table.same_version:
                    errors.append(math.inf)
                continue
            mine, theirs = np.ravel(getattr(model, name)), np.asarray(values)
            if mine.shape == theirs.shape:
                errors.extend(np.abs(mine - theirs) / scale(mine, False))
            elif table.same_version:
                errors.append(math.inf)
        table.physics("model", f"{case['name']}: model", errors)
    for name, values in case["changed"].items():
        array = getattr(model, name)
        array[...] = np.reshape(values, array.shape)
    model.opt.timestep = case["timestep_s"]
    return model


def set_state(data, state):
    for name in (*STATE, "mocap_pos", "mocap_quat"):
        if name in state and len(state[name]):
            array = getattr(data, name)
            array[...] = np.reshape(state[name], array.shape)
    data.time = state.get("time", 0.0)


def simulate(model, run, advance, restart):
    """Columns of `run` computed anew, and the steps they belong to.

    With `restart` each step begins in the recorded state before it. mj_step1 normalises quaternions in place, and
    doing so a second time may change the last digit; the solver, which stops when the next iteration gains little,
    makes 1e-5 of that now and then. Such steps are left out.
    """
    data, machine = mujoco.MjData(model), Supplement(model)
    columns, steps = {name: [] for name in (*STATE, "sensordata", "ncon", "memory")}, []
    before = run["start"]
    fixed = {name: before[name] for name in ("mocap_pos", "mocap_quat")}
    for t, ctrl in enumerate(run["ctrl"]):
        if t == 0 or restart:
            set_state(data, {**fixed, **before})
            machine.memory[:] = before["memory"]
            before = {name: run[name][t] for name in (*STATE, "memory")}
            if advance == "halves":
                given = np.array(data.qpos)
                machine.step1(data)
                if t > 0 and not np.array_equal(given, data.qpos):
                    continue
        steps.append(t)
        data.ctrl[:] = ctrl
        if advance == "halves":
            machine.step2(data)
            machine.step1(data)
        else:
            machine.step(data)
        columns["memory"].append(np.array(machine.memory))
        for name in (*STATE, "sensordata"):
            columns[name].append(np.array(getattr(data, name)))
        columns["ncon"].append(data.ncon)
    return {name: np.array(column) for name, column in columns.items()}, steps


def errors_of(recorded, derived, names):
    """Errors of the columns `names` of what `simulate` returned."""
    derived, steps = derived
    errors = []
    for name in names:
        theirs = np.asarray(recorded[name], dtype=float)
        if theirs.size:
            errors.append(np.ravel(np.abs(theirs[steps] - derived[name]) / scale(theirs, True)))
    return np.concatenate(errors)


def compare_physics(case, table):
    """One model: its numbers, its simulations, its inverse dynamics."""
    name, model = case["name"], load_model(case, table)
    for run in case["runs"]:
        advance = run["advance"]
        label = name if "," in name else f"{name}, {'mj_step' if advance == 'step' else advance}"
        single = simulate(model, run, advance, restart=True)
        table.physics("one step", f"{label}: one step", errors_of(run, single, (*STATE, "memory")))
        table.physics("sensors", f"{label}: sensors", errors_of(run, single, ["sensordata"]))
        contacts = np.subtract(np.take(run["ncon"], single[1]), single[0]["ncon"])
        table.physics("contacts", f"{label}: contacts", contacts)
        whole = simulate(model, run, advance, restart=False)
        names = ("qpos", "qvel", "act", "sensordata")
        table.physics("trajectory", f"{label}: trajectory", errors_of(run, whole, names))
        if advance == "halves":
            stepped = simulate(model, run, "step", restart=False)
            table.physics("halves", f"{label} = mj_step", errors_of(run, stepped, ("qpos", "qvel", "act")))
    data, machine, forces = mujoco.MjData(model), Supplement(model), []
    for point in case["inverse"]:
        set_state(data, point["state"])
        machine.memory[:] = point["state"]["memory"]
        data.ctrl[:] = point["state"]["ctrl"]
        data.qacc[:] = point["qacc"]
        machine.inverse(data)
        forces.append(np.array(data.qfrc_inverse))
    recorded = np.array([point["qfrc_inverse"] for point in case["inverse"]])
    table.physics("inverse", f"{name}: inverse", np.abs(recorded - forces) / scale(recorded, True))


# ------------------------------------------------------------------------------------------ pushing task

def identify(model, kind, name):
    number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if number < 0:
        raise Unusable(f"the model has no {kind} {name}")
    return number


def observe(model, data, name):
    """One observation by its name: p0_crank_pos, p0_crank_vel, object_x, goal_y."""
    element, part = name.rsplit("_", 1)
    if part in ("pos", "vel"):
        joint = identify(model, "joint", element)
        return data.qpos[model.jnt_qposadr[joint]] if part == "pos" else data.qvel[model.jnt_dofadr[joint]]
    return data.xpos[identify(model, "body", element)]["xyz".index(part)]


def reward_of(config, tips, body, goal, torque):
    """1 - 3 |O - G| - sum of |f - O| - 0.1 a.a, with the weights of `config`; a: what the motors give."""
    axes = 3 if config["tip_distance"] == "space" else 2
    reach = sum(np.linalg.norm(tip[:axes] - body[:axes]) for tip in tips)
    return (1 - config["goal_weight"] * np.linalg.norm(body[:2] - goal[:2]) - config["tip_weight"] * reach
            - config["torque_weight"] * float(np.dot(torque, torque)))


def compare_pushing(record, table):
    """Observations, rewards, distances and mean actions at the states of one simulation."""
    pushing = record["pushing"]
    case = next(case for case in record["physics"] if case["name"] == pushing["physics"])
    model = load_model(case)
    data = mujoco.MjData(model)
    tip_sites = [identify(model, "site", f"p{finger}_tip") for finger in range(3)]
    body, goal = identify(model, "body", "object"), identify(model, "body", "goal")
    check_policy(pushing["policy"])
    samples, observations, rewards, distances, actions = pushing["samples"], [], [], [], []
    for sample in samples:
        set_state(data, sample)
        mujoco.mj_kinematics(model, data)
        observations.append([observe(model, data, name) for name in pushing["observation_names"]])
        tips = [data.site_xpos[site] for site in tip_sites]
        torque = np.clip(sample["action"], *model.actuator_ctrlrange.T)
        rewards.append([reward_of(config, tips, data.xpos[body], data.xpos[goal], torque)
                        for config in pushing["configs"]])
        distances.append(np.linalg.norm((data.xpos[body] - data.xpos[goal])[:2]))
        actions.append(evaluate_policy(pushing["policy"], sample["observation"]))

    def column(name):
        return [sample[name] for sample in samples]

    table.arrays("task: observations", column("observation"), observations, 1e-12, True)
    table.arrays("task: rewards", column("rewards"), rewards, 1e-12, True)
    table.arrays("task: distances", column("distance_m"), distances, 1e-12)
    table.arrays("policy: mean actions", column("mean"), actions, 1e-12)


# ------------------------------------------------------------------------------------------------ update

def value_features(states, times):
    """All monomials of degree 0, 1 and 2 of each row of `states`, and the powers 1 to 4 of `times`."""
    rows, columns = np.tril_indices(states.shape[1])
    powers = np.power.outer(times, np.arange(1, 5))
    return np.hstack([np.ones((len(states), 1)), states, states[:, rows] * states[:, columns], powers])


class ValueFunction:
    """Quadratic in standardised observations, which are clipped at 4 standard deviations."""

    def __init__(self, mean, inverse_scale, weights):
        self.mean, self.inverse_scale, self.weights = (np.asarray(x) for x in (mean, inverse_scale, weights))

    def features(self, observations, times):
        used = self.inverse_scale != 0
        standard = (observations[:, used] - self.mean[used]) * self.inverse_scale[used]
        return value_features(np.clip(standard, -4, 4), times)

    def __call__(self, observations, times):
        if not self.weights.size:
            return np.zeros(len(observations))
        return self.features(observations, times) @ self.weights

    @classmethod
    def fitted(cls, shape, observations, times, targets, ridge):
        """Ridge regression as least squares on a system with one more row for each weight that is shrunk."""
        features = shape.features(observations, times)
        shrink = math.sqrt(ridge * len(targets)) * np.eye(features.shape[1])[1:]
        q, r = np.linalg.qr(np.vstack([features, shrink]))
        weights = np.linalg.solve(r, q.T @ np.concatenate([targets, np.zeros(len(shrink))]))
        return cls(shape.mean, shape.inverse_scale, weights)


def spread(inputs):
    """Mean and standard deviation; 0 marks an input that takes no part.

    That is one which is constant but for rounding, or of which a regression on the inputs before it explains all but
    a hundredth of the variance.
    """
    mean, deviation = inputs.mean(axis=0), np.zeros(inputs.shape[1])
    for i in range(inputs.shape[1]):
        variance, before = inputs[:, i].var(), (inputs - mean)[:, :i][:, deviation[:i] > 0]
        if variance > 1e-12 * (1 + mean[i] ** 2):
            left = inputs[:, i] - mean[i]
            left = left - before @ np.linalg.lstsq(before, left, rcond=None)[0]
            deviation[i] = math.sqrt(variance) if np.mean(left ** 2) >= 0.01 * variance else 0
    return mean, deviation


def robust_moments(values, clip):
    """Mean and standard deviation of values limited to mean +- clip deviations, from limits that agree with them."""
    low, high, deviation = -np.inf, np.inf, np.inf
    for _ in range(50):
        limited = np.clip(values, low, high)
        mean, before, deviation = limited.mean(), deviation, limited.std()
        low, high = mean - clip * deviation, mean + clip * deviation
        if deviation >= 0.999 * before:
            break
    return mean, deviation


class Batch:
    """The usable trajectories of an update, as arrays over trajectory, time, component."""

    def __init__(self, update):
        # their indices among all, the broken ones counted: these say who is even and who is odd
        self.index = np.array([i for i, t in enumerate(update["trajectories"]) if not t["diverged"]])
        used = [update["trajectories"][i] for i in self.index]
        n, m = update["policy"]["n_observation"], update["policy"]["n_action"]
        self.horizon, self.n, self.m = update["horizon"], n, m
        self.rewards = np.array([t["rewards"] for t in used])
        self.count, self.length = self.rewards.shape
        self.observations = np.array([t["observations"] for t in used]).reshape(self.count, self.length, n)
        self.noise = np.array([t["noise"] for t in used]).reshape(self.count, self.length, m)
        self.actions = np.array([t["actions"] for t in used]).reshape(self.noise.shape)
        # what the value function sees: the observation and more, the state after the last step included
        self.inputs = np.array([t["value_inputs"] for t in used]).reshape(self.count, self.length + 1, -1)
        self.times = np.arange(self.length + 1) / self.horizon

    def worst(self, share):
        """The share of the batch with the lowest mean reward, at least one trajectory."""
        mean = self.rewards.mean(axis=1)
        count = max(1, math.floor(share * self.count + 0.5))
        chosen = mean <= np.sort(mean)[count - 1]
        part = copy.copy(self)
        for name in ("index", "rewards", "observations", "noise", "actions", "inputs"):
            setattr(part, name, getattr(self, name)[chosen])
        part.count = len(part.index)
        return part

    def values(self, function, index):
        """V along trajectory `index`, the state after its last action included."""
        return function(self.inputs[index], self.times)


def fit_values(batch, previous, config):
    """Value functions from all, odd and even trajectories; with explained variance and size of the first."""
    # return: rewards to come, discounted, and the previous value of where the trajectory was cut off
    length, discount = batch.length, config["discount"]
    targets = np.empty((batch.count, length))
    for i in range(batch.count):
        end = batch.values(previous, i)[-1]
        for t in range(length):
            ahead = np.arange(length - t)
            targets[i, t] = np.sum(discount ** ahead * batch.rewards[i, t:]) + discount ** (length - t) * end
    middle, width = robust_moments(targets, max(config["advantage_clip"], 3))
    limit = width * max(config["advantage_clip"], 3)
    targets = np.clip(targets, middle - limit, middle + limit)
    mean, deviation = spread(batch.inputs.reshape(-1, batch.inputs.shape[2]))
    with np.errstate(divide="ignore"):
        shape = ValueFunction(mean, np.where(deviation > 0, 1 / deviation, 0), [])
    stride = config["value_stride"]
    picked = [(i, t) for i, k in enumerate(batch.index) for t in range(k // 2 % stride, length, stride)]
    fits = []
    for choice in (lambda i: True, lambda i: i % 2 == 1, lambda i: i % 2 == 0):
        index = tuple(np.array([pair for pair in picked if choice(batch.index[pair[0]])]).T)
        sample = batch.inputs[index], batch.times[index[1]], targets[index]
        fits.append(ValueFunction.fitted(shape, *sample, config["value_ridge"]))
        if len(fits) == 1:
            residual = sample[2] - fits[0](*sample[:2])
            explained = 1 - np.mean(residual ** 2) / np.var(sample[2])
    return fits, explained, len(picked)


def advantages_of(batch, value_of, config):
    """Every advantage from its definition: temporal differences ahead, weighted by powers of discount x lambda."""
    decay = config["discount"] * config["gae_lambda"]
    advantages = np.zeros((batch.count, batch.length))
    for i in range(batch.count):
        values = batch.values(value_of(i), i)
        surprise = batch.rewards[i] + config["discount"] * values[1:] - values[:-1]
        for t in range(batch.length):
            for ahead in range(batch.length - t):
                advantages[i, t] += decay ** ahead * surprise[t + ahead]
    return advantages


def score_features(batch, rho):
    """psi of every sample: phi = (s, 1) at the start, later (phi - rho * phi before) / sqrt(1 - rho^2).

    Given the past, the deviation e from the mean action is e = rho * e before + sigma sqrt(1 - rho^2) z. Moving the
    weights by dW moves the mean of the action by dW phi and, through the deviation before, by -rho dW (phi before).
    """
    phi = np.concatenate([batch.observations, np.ones((batch.count, batch.length, 1))], axis=2)
    psi = phi.copy()
    psi[:, 1:] = (phi[:, 1:] - rho * phi[:, :-1]) / math.sqrt(1 - rho ** 2)
    return psi.reshape(-1, batch.n + 1)


def regressed(psi):
    """Of each feature but the last: its regression on the last, and the deviation of what is left (0: constant)."""
    last = np.mean(psi[:, -1] ** 2)
    slope = psi[:, :-1].T @ psi[:, -1] / len(psi) / last
    variance = np.mean((psi[:, :-1] - np.outer(psi[:, -1], slope)) ** 2, axis=0)
    return slope, np.sqrt(np.where(variance > 1e-12 * (1 + slope ** 2) * last, variance, 0.0)), last


def damped_fisher(batch, psi, sigma, scores, config):
    """The metric in the coordinates of the parameters, and which parameters are to move.

    Damping d is defined for features freed of their part along the last one and brought to deviation 1: F~ + d I
    (2 d I for log sigma, where F~ has 2 on its diagonal). With x~ = (x - m l) / s and l~ = l / r for the last feature
    l, psi~ = T psi, weights transform by T^-T, so that d I becomes
    d T^-1 T^-T = d (diag(s^2, 0) + r^2 (m, 1)(m, 1)^T) for each action, divided by its sigma^2. Weights of constant
    observations do not move: their rows are left out.
    """
    slope, deviation, last = regressed(psi)
    middle = np.append(slope, 1.0)
    damping = config["fisher_damping"] * (np.diag(np.append(deviation ** 2, 0.0)) + last * np.outer(middle, middle))
    n_weight = batch.m * (batch.n + 1)
    fisher = np.zeros((n_weight + batch.m,) * 2)
    fisher[n_weight:, n_weight:] = 2 * config["fisher_damping"] * np.eye(batch.m)
    if config["fisher"] == "exact":
        fisher[:n_weight, :n_weight] = np.kron(np.diag(sigma ** -2), psi.T @ psi / len(psi) + damping)
        fisher[n_weight:, n_weight:] += 2 * np.eye(batch.m)
    else:
        fisher[:n_weight, :n_weight] = np.kron(np.diag(sigma ** -2), damping)
        fisher += scores.T @ scores / len(scores)
    moves = np.append(np.tile(np.append(deviation > 0, True), batch.m), np.ones(batch.m, dtype=bool))
    return fisher, moves


def divergence(batch, psi, old, new):
    """Mean over the batch of KL(old || new) of one action given the past, one diagonal Gaussian after the other."""
    n_weight = batch.m * (batch.n + 1)

    def split(theta):
        return psi @ theta[:n_weight].reshape(batch.m, -1).T, np.exp(theta[n_weight:])

    (mean, sigma), (new_mean, new_sigma) = split(old), split(new)
    each = np.log(new_sigma / sigma) + (sigma ** 2 + (mean - new_mean) ** 2) / (2 * new_sigma ** 2) - 0.5
    return each.sum(axis=1).mean()


def cosines(batch, psi, sigma, first, second, column_sets):
    """Of the angles between two steps, in the change of mean action that some columns make, spread over the batch."""
    free = psi[:, :-1] - np.outer(psi[:, -1], regressed(psi)[0])
    n_weight = batch.m * (batch.n + 1)
    found = []
    for columns in column_sets:
        a, b = (free[:, columns] @ x[:n_weight].reshape(batch.m, -1)[:, columns].T / sigma for x in (first, second))
        found.append(np.sum(a * b) / math.sqrt(np.sum(a * a) * np.sum(b * b)))
    return found


def actions_of(batch, policy, rho):
    """Actions from observations and noise: mean and a deviation that remembers the last one."""
    theta = np.array(policy["weights"]).reshape(batch.m, -1)
    sigma = np.exp(policy["log_sigma"])
    actions, deviation = np.empty_like(batch.noise), 0.0
    for t in range(batch.length):
        fresh = 1.0 if t == 0 else math.sqrt(1 - rho ** 2)
        deviation = rho * deviation + fresh * sigma * batch.noise[:, t]
        actions[:, t] = batch.observations[:, t] @ theta[:, :-1].T + theta[:, -1] + deviation
    return actions


def compare_update(update, table, cases=None):
    """The learning steps of the record's cases."""
    whole, previous = Batch(update), ValueFunction(**update["previous"])
    theta = np.array(update["policy"]["weights"] + update["policy"]["log_sigma"])
    n_weight = whole.m * (whole.n + 1)
    sigma = np.exp(theta[n_weight:])
    rolled = update["cases"][0]["config"]["noise_correlation"]
    table.arrays("batch: actions", whole.actions, actions_of(whole, update["policy"], rolled), 1e-12)
    table.arrays("batch: value inputs", whole.inputs[:, :-1, :whole.n], whole.observations, 0.0)
    known_fits = {}
    for number, case in enumerate(update["cases"][:cases]):
        config = case["config"]
        label = f"update {number + 1} ({config['fisher']}, {config['value_from']})"
        batch = whole.worst(config["epopt_epsilon"])
        z = batch.noise.reshape(-1, batch.m)
        psi = score_features(batch, config["noise_correlation"])
        scores = np.hstack([((z / sigma)[:, :, None] * psi[:, None, :]).reshape(len(psi), -1), z ** 2 - 1])

        key = tuple(config[name] for name in ("discount", "value_stride", "value_ridge", "advantage_clip"))
        if key not in known_fits:
            known_fits[key] = fit_values(whole, previous, config)
        fits, explained, n_sample = known_fits[key]
        values = [[whole.values(fit, i) for i in range(len(case["values"][0]))] for fit in fits]
        table.arrays(f"{label}: values", case["values"], values, 1e-8)
        table.arrays(f"{label}: fit", [case["explained_variance"], case["value_samples"] / n_sample],
                     [explained, 1], 1e-9)

        crossed = config["value_from"] == "crossed"
        raw = advantages_of(batch, lambda i: fits[1 + batch.index[i] % 2] if crossed else previous, config)
        limit = config["advantage_clip"]
        middle, width = robust_moments(raw, max(limit, 3))
        normal = (raw - middle) / width
        advantages = np.clip(normal, -limit, limit)
        table.arrays(f"{label}: advantages", case["advantages"], advantages, 1e-8)
        table.arrays(f"{label}: advantage sigma", [case["advantage_sigma"]], [width], 1e-8)
        table.errors(f"{label}: clipped share", case["clipped_share"] - np.mean(np.abs(normal) > limit), 1e-12)

        # of even and odd trajectories apart, both divided by the size of the whole batch
        parity = np.repeat(batch.index % 2, batch.length)
        halves = [(advantages.ravel() * (parity == half)) @ scores / len(scores) for half in (0, 1)]
        gradient = halves[0] + halves[1]
        table.arrays(f"{label}: gradient", case["gradient"], gradient, 1e-8)
        fisher, moves = damped_fisher(batch, psi, sigma, scores, config)
        natural = np.zeros((2, len(theta)))
        natural[:, moves] = np.linalg.solve(fisher[np.ix_(moves, moves)], np.array(halves)[:, moves].T).T
        direction = natural[0] + natural[1]
        norm2 = gradient[moves] @ direction[moves]
        table.arrays(f"{label}: natural gradient", case["natural_gradient"], direction, 1e-8)
        table.arrays(f"{label}: g F^-1 g", [case["gradient_norm2"]], [norm2], 1e-8)

        column_sets = [list(range(batch.n))] + [list(range(first, end)) for _, first, end in update["groups"]]
        found = cosines(batch, psi, sigma, *natural, column_sets)
        table.errors(f"{label}: half cosines",
                     np.subtract([case["half_cosine"], *case["group_cosines"]], found), 1e-8)

        # log sigma is raised to its floor before and after; halved while twice the promised divergence is exceeded
        def raised(parameters):
            floor = np.full(len(parameters), -np.inf)
            floor[n_weight:] = config["log_sigma_floor"]
            return np.maximum(parameters, floor)

        delta, start = config["step_size_delta"], raised(theta)
        length, kl = math.sqrt(delta / norm2), math.inf
        while kl > delta:
            stepped = raised(start + length * direction)
            kl, length = divergence(batch, psi, start, stepped), length / 2
        kl = divergence(batch, psi, theta, stepped)
        table.arrays(f"{label}: parameters", case["theta"], stepped, 1e-8)
        table.arrays(f"{label}: change", np.subtract(case["theta"], theta), stepped - theta, 1e-8)
        table.arrays(f"{label}: KL", [case["kl_predicted"], case["kl_measured"]], [delta / 2, kl], 1e-8)


# ------------------------------------------------------------------------------------------ the whole of it

def compare(record, same_version):
    table = Comparison(same_version)
    for case in record["physics"]:
        compare_physics(case, table)
    compare_pushing(record, table)
    compare_update(record["update"], table)
    return table


def self_test(record, same_version):
    """Changes one number of the record at a time, by a hundred-thousandth, and expects a mismatch for each.

    Returns how many changes went unnoticed. With another version of mujoco no such change of physics can be noticed.
    """
    def physics(changed, table):
        compare_physics(changed["physics"][0], table)

    def update(changed, table):
        compare_update(changed["update"], table, cases=1)

    spots = [
        (physics, ("physics", 0, "runs", 0, "qpos", 150, 0)),
        (physics, ("physics", 0, "runs", 1, "sensordata", 20, 1)),
        (physics, ("physics", 0, "runs", 1, "ctrl", 20, 0)),
        (physics, ("physics", 0, "inverse", 3, "qfrc_inverse", 0)),
        (physics, ("physics", 0, "constants", "body_mass", 1)),
        (compare_pushing, ("pushing", "samples", 7, "rewards", 1)),
        (compare_pushing, ("pushing", "samples", 7, "mean", 2)),
        (compare_pushing, ("pushing", "samples", 7, "qpos", 3)),
        (update, ("update", "trajectories", 3, "rewards", 20)),
        (update, ("update", "cases", 0, "advantages", 5, 10)),
        (update, ("update", "cases", 0, "gradient", 17)),
        (update, ("update", "cases", 0, "theta", 100)),
    ]
    unseen = 0
    for check, path in spots:
        if check is physics and not same_version:
            continue
        changed = copy.deepcopy(record)
        place = changed
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] += 1e-5 * (1 + abs(place[path[-1]]))
        table = Comparison(same_version)
        check(changed, table)
        seen = table.mismatches()
        unseen += not seen
        print(f"self-test: {'/'.join(map(str, path))}: {'seen in ' + seen[0] if seen else 'NOT SEEN'}")
    return unseen


def make_record(recorder, seed):
    """Runs the recorder, through cargo if none is given."""
    cargo = ["cargo", "run", "--release", "--locked", "--quiet", "--example", "crosscheck", "--"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.json"
        command = [recorder] if recorder else cargo
        command = [*command, "--root", str(ROOT), "--out", str(path), "--seed", str(seed)]
        try:
            done = subprocess.run(command, cwd=None if recorder else ROOT, check=False)
        except OSError as error:
            raise Unusable(f"cannot run {command[0]}: {error.strerror}") from None
        if done.returncode != 0:
            raise Unusable(f"the recorder {command[0]} ended with exit code {done.returncode}")
        return read_record(path)


def read_record(path):
    try:
        record = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise Unusable(f"cannot read {path}: {error.strerror}") from None
    except ValueError as error:
        raise Unusable(f"{path} is not JSON: {error}") from None
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise Unusable(f"{path} is not a record of the format {FORMAT}")
    return record


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--record", metavar="FILE", help="a record made before")
    source.add_argument("--recorder", metavar="BIN", help="the built example `crosscheck`")
    parser.add_argument("--seed", type=int, default=1, help="seed of a new record (default: %(default)s)")
    parser.add_argument("--self-test", action="store_true", help="then see whether wrong numbers are noticed")
    arguments = parser.parse_args()
    try:
        record = read_record(arguments.record) if arguments.record else make_record(arguments.recorder, arguments.seed)
        theirs = ".".join(record["mujoco"])
        same_version = mujoco.__version__ == theirs
        note = "" if same_version else ": another version, physics is judged by medians"
        print(f"phantom with MuJoCo {theirs}, Python with mujoco {mujoco.__version__}, numpy {np.__version__}{note}")
        table = compare(record, same_version)
        table.show()
        unseen = self_test(record, same_version) if arguments.self_test else 0
    except Unusable as error:
        sys.stderr.write(f"crosscheck.py: {error}\n")
        return 2
    except (KeyError, IndexError, TypeError, ValueError) as error:
        sys.stderr.write(f"crosscheck.py: the record has not the expected content: {type(error).__name__} {error}\n")
        return 2
    mismatches = table.mismatches()
    if mismatches:
        print(f"{len(mismatches)} of {len(table.lines)} quantities do not match, the first is {mismatches[0]}")
    else:
        print(f"all {len(table.lines)} quantities match")
    return 1 if mismatches or unseen else 0


if __name__ == "__main__":
    sys.exit(main())
