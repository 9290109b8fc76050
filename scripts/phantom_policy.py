"""Evaluates the policies that phantom writes (policy_best.json, policy_last.json) in plain Python.

    from phantom_policy import evaluate_policy, load_policy
    policy = load_policy("runs/first/policy_best.json")
    torque = evaluate_policy(policy, observation)     # mean action, N m

The file is a JSON object. The action is W s + b, with no noise; during training a normal number times
exp(log_sigma) is added to it.

    format               "phantom-affine-gaussian-1"
    n_observation        length of s
    n_action             length of the action
    weights              n_action rows of n_observation + 1 numbers one after the other, b last in each row
    log_sigma            n_action numbers
    observation_names    what s holds, in order (may be empty)
    action_names         what the action holds, in order (may be empty)

Needs nothing but the standard library.
"""
import json
import math
import os

FORMAT = "phantom-affine-gaussian-1"


def load_policy(path):
    """The policy in the file `path`; ValueError says what is wrong with it."""
    with open(path, encoding="utf-8") as file:
        try:
            policy = json.load(file)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)} is not JSON: {error}") from None
    try:
        check_policy(policy)
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None
    return policy


def check_policy(policy):
    """Raises ValueError unless `policy` is a policy with finite numbers and lengths that belong together."""
    if not isinstance(policy, dict) or policy.get("format") != FORMAT:
        raise ValueError(f"it is not of the format {FORMAT}")
    n, m = policy.get("n_observation"), policy.get("n_action")
    if not all(isinstance(size, int) and size > 0 for size in (n, m)):
        raise ValueError("`n_observation` and `n_action` have to be positive integers")
    for name, length in (("weights", m * (n + 1)), ("log_sigma", m)):
        values = policy.get(name)
        if not isinstance(values, list) or len(values) != length:
            raise ValueError(f"`{name}` has to be a list of {length} numbers")
        if not all(isinstance(x, (int, float)) and math.isfinite(x) for x in values):
            raise ValueError(f"`{name}` holds something other than finite numbers")


def evaluate_policy(policy, observation):
    """Mean action for `observation`: a list of floats.

    `policy` is what load_policy returned, or the path of a file.
    """
    if not isinstance(policy, dict):
        policy = load_policy(policy)
    n = policy["n_observation"]
    if len(observation) != n:
        raise ValueError(f"the observation has {len(observation)} numbers, the policy takes {n}")
    weights, action = policy["weights"], []
    for start in range(0, len(weights), n + 1):
        row = weights[start:start + n + 1]
        action.append(sum(w * float(s) for w, s in zip(row, observation)) + row[n])
    return action
