#!/usr/bin/env python3
"""Natural policy gradient in NumPy with the settings that mjrl publishes, on the task of `phantom train`.

    python3.10 -m venv .venv-peers && .venv-peers/bin/pip install numpy==1.23.5 mujoco==2.2.2
    OPENBLAS_NUM_THREADS=1 .venv-peers/bin/python scripts/peers/npg_mjrl.py --cpu-seconds 120 --seed 0

White noise, GAE with γ 0.995 and λ 0.97, whitened advantages, exact Fisher matrix with damping 1e-4 solved by 10
iterations of conjugate gradients, step of δ = 2 KL = 0.1, quadratic value function fitted after the step with ridge 1e-3 on
the sums. Two settings are phantom's, as mjrl's would hardly learn here: the first standard deviation (0.22 N m, not
1), and the start states. For an affine policy the products with the Fisher matrix have a closed form, so that this is
faster than mjrl's own, which differentiates twice.
"""
import argparse
import sys

from push_env import HORIZON, LOG_SIGMA, N_ACTION, N_OBSERVATION, Budget, Push, np, report

DISCOUNT, LAMBDA, DELTA, DAMPING, RIDGE = 0.995, 0.97, 0.1, 1e-4, 1e-3
UPPER = np.triu_indices(N_OBSERVATION)


def rollout(env, weights, log_sigma, rng):
    s, states, actions, rewards = env.reset(), [], [], []
    for _ in range(HORIZON):
        action = weights @ np.append(s, 1.0) + np.exp(log_sigma) * rng.normal(size=N_ACTION)
        states.append(s)
        actions.append(action)
        s, reward = env.step(action)
        if env.broke():
            return None
        rewards.append(reward)
    return np.array(states), np.array(actions), np.array(rewards)


def features(states):
    o = np.clip(states, -10, 10) / 10
    t = np.arange(len(o))[:, None] / 1000
    products = o[:, UPPER[0]] * o[:, UPPER[1]]
    return np.hstack([o, products, np.ones_like(t), t, t**2, t**3, t**4])


def discounted(x, factor):
    out, total = np.empty_like(x), 0.0
    for i in range(len(x) - 1, -1, -1):
        total = x[i] + factor * total
        out[i] = total
    return out


def conjugate_gradients(product, b, iterations=10):
    x, r, p = np.zeros_like(b), b.copy(), b.copy()
    rr = r @ r
    for _ in range(iterations):
        z = product(p)
        v = rr / (p @ z)
        x += v * p
        r -= v * z
        new = r @ r
        if new < 1e-10:
            break
        p, rr = r + new / rr * p, new
    return x


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    Budget.add_options(parser)
    parser.add_argument("--trajectories", type=int, default=80, help="an update (80 are 10,000 samples)")
    a = parser.parse_args()
    rng, env = np.random.default_rng(a.seed), Push(a.seed + 1000)
    weights = 0.01 * rng.normal(size=(N_ACTION, N_OBSERVATION + 1))
    log_sigma, value, steps = np.full(N_ACTION, LOG_SIGMA), None, 0
    budget = Budget(a)

    def policy(s):
        return weights @ np.append(s, 1.0)

    while not budget.spent(policy):
        paths = [rollout(env, weights, log_sigma, rng) for _ in range(a.trajectories)]
        steps += a.trajectories * HORIZON
        paths = [p for p in paths if p is not None]
        designs = [features(s) for s, _, _ in paths]
        advantages = []
        for (_, _, rewards), design in zip(paths, designs):
            v = np.zeros(HORIZON) if value is None else design @ value
            following = np.append(v[1:], v[-1])  # the last visited state at the end, as mjrl has it
            advantages.append(discounted(rewards + DISCOUNT * following - v, DISCOUNT * LAMBDA))
        advantage = np.concatenate(advantages)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
        phi = np.hstack([np.concatenate([p[0] for p in paths]), np.ones((len(advantage), 1))])
        z = (np.concatenate([p[1] for p in paths]) - phi @ weights.T) / np.exp(log_sigma)
        n = len(phi)
        gradient = np.concatenate([
            ((advantage[:, None] * z / np.exp(log_sigma)).T @ phi / n).ravel(),
            advantage @ (z * z - 1) / n,
        ])
        second, inverse = phi.T @ phi / n, np.exp(-2 * log_sigma)[:, None]

        def product(x):
            w = x[:weights.size].reshape(weights.shape)
            return np.concatenate([(inverse * (w @ second)).ravel(), 2 * x[weights.size:]]) + DAMPING * x

        step = conjugate_gradients(product, gradient)
        step *= np.sqrt(abs(DELTA / (gradient @ step + 1e-20)))
        weights = weights + step[:weights.size].reshape(weights.shape)
        log_sigma = np.maximum(log_sigma + step[weights.size:], -3)
        design = np.concatenate(designs)
        returns = np.concatenate([discounted(p[2], DISCOUNT) for p in paths])
        gram = design.T @ design + RIDGE * np.eye(design.shape[1])
        value = np.linalg.lstsq(gram, design.T @ returns, rcond=None)[0]
        if sys.stderr.isatty():
            print(f"\r{budget.used():.0f} s  reward {np.mean([p[2].mean() for p in paths]):.3f}", end="", file=sys.stderr)
    cm = budget.evaluate(policy)
    report(f"NumPy NPG, mjrl's settings, seed {a.seed}", steps, budget, cm)


if __name__ == "__main__":
    main()
