#!/usr/bin/env python3
"""TRPO and ARS of Stable-Baselines3-contrib, with linear policies, on the task of `phantom train`.

    python3.10 -m venv .venv-peers && .venv-peers/bin/pip install numpy==1.23.5 mujoco==2.2.2 torch==1.12.1 sb3-contrib==2.0.0
    OMP_NUM_THREADS=1 .venv-peers/bin/python scripts/peers/sb3.py trpo --cpu-seconds 120 --seed 0
    OMP_NUM_THREADS=1 .venv-peers/bin/python scripts/peers/sb3.py ars --cpu-seconds 120 --seed 0

Their own defaults but for: a linear policy, observations normalised by running statistics (as their zoo does), 10,000
samples an update of TRPO, and a first standard deviation as phantom's (0.22 N m).
"""
import argparse
import sys

from push_env import HORIZON, LOG_SIGMA, N_ACTION, N_OBSERVATION, Budget, Push, np, report

try:
    import gymnasium
    import torch
    from sb3_contrib import ARS, TRPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
except ImportError as missing:
    print(f"{missing}: see the head of this file for what to install", file=sys.stderr)
    sys.exit(2)


class Env(gymnasium.Env):
    """The task with actions from -1 to 1, shares of the largest torque."""

    def __init__(self, seed):
        self.push, self.t = Push(seed), 0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (N_OBSERVATION,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1, 1, (N_ACTION,), np.float32)

    def reset(self, *, seed=None, options=None):
        del seed, options
        self.t = 0
        return self.push.reset(), {}

    def step(self, action):
        observation, reward = self.push.step(action * self.push.limit)
        self.t += 1
        broke = self.push.broke()
        return observation, 0.0 if broke else reward, broke, self.t >= HORIZON, {}


class Spent(Exception):
    """The CPU time is spent."""


class Stop(BaseCallback):
    """Ends training when the CPU time is spent: ARS does not look at what its callback returns."""

    def __init__(self, budget, policy):
        super().__init__()
        self.budget, self.policy, self.steps = budget, policy, 0

    def _on_step(self):
        self.steps = self.num_timesteps
        if self.budget.spent(self.policy):
            raise Spent
        return True


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=["trpo", "ars"])
    Budget.add_options(parser)
    a = parser.parse_args()
    torch.set_num_threads(1)
    envs = VecNormalize(DummyVecEnv([lambda: Env(a.seed + 1000)]), norm_obs=True, norm_reward=False)
    limit = envs.venv.envs[0].push.limit
    if a.algorithm == "trpo":
        start = LOG_SIGMA - float(np.log(limit.mean()))
        settings = {"net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": start}
        model = TRPO("MlpPolicy", envs, n_steps=80 * HORIZON, batch_size=500, policy_kwargs=settings, seed=a.seed, device="cpu")
    else:
        model = ARS("LinearPolicy", envs, seed=a.seed, device="cpu")

    def policy(s):
        action, _ = model.predict(envs.normalize_obs(s), deterministic=True)
        return action * limit

    budget = Budget(a)
    stop = Stop(budget, policy)
    try:
        model.learn(10**9, callback=stop)
    except Spent:
        pass
    cm = budget.evaluate(policy)
    report(f"SB3-contrib {a.algorithm.upper()}, seed {a.seed}", stop.steps, budget, cm)


if __name__ == "__main__":
    main()
