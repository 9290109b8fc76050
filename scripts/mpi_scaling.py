#!/usr/bin/env python3
"""How training scales over processes: measured for a few, by a model for many.

    cargo build --release --features mpi --example scaling
    python3 scripts/mpi_scaling.py [--example target/release/examples/scaling] [--trajectories 600] [--cores 2]

Measures on one core what an iteration is made of, and between processes of this machine what a sum over all costs, then
prints seconds an iteration, speed-up and efficiency. With N trajectories on n processes, of which each takes m = N/n,

    T(n) = max over processes of rollouts  +  update: c + d m  +  sums: s(2) log2 n

where the slowest of n processes is taken to be mean + sigma sqrt(2 m log n) above the sum of its m rollouts (their times
vary, as contacts do), c and d are the constant part and that of a trajectory in the update, and s(2) is the measured time
of one sum of the bytes of an iteration between two processes of one machine. Between machines a sum takes longer: the last
column adds 50 microseconds and 1 ns a byte (10 Gbit Ethernet) for each doubling. More processes than trajectories wait.
"""
import argparse
import json
import math
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LATENCY_S, BYTE_S = 50e-6, 1e-9


def example(command):
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def sum_s(sums, size):
    """Seconds of one sum, between the measured lengths by a straight line."""
    rows = [(row["bytes"], row["seconds"]) for row in sums]
    for (b0, s0), (b1, s1) in zip(rows, rows[1:]):
        if size <= b1:
            return s0 + (s1 - s0) * (size - b0) / (b1 - b0)
    return rows[-1][1] * size / rows[-1][0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--example", default="target/release/examples/scaling")
    parser.add_argument("--mpirun", default="mpirun --allow-run-as-root --oversubscribe")
    parser.add_argument("--trajectories", type=int, default=600)
    parser.add_argument("--bytes", type=float, required=True, help="of an iteration, as `phantom train` prints them")
    options = parser.parse_args()
    program = str((ROOT / options.example).resolve())
    phases = example([program])
    sums = {n: example([*options.mpirun.split(), "-n", str(n), program])["sums"] for n in (2, 4)}
    for n, rows in sums.items():
        print(f"one sum between {n} processes, us: " + ", ".join(f"{r['bytes']} B {1e6 * r['seconds']:.0f}" for r in rows))
    print(json.dumps(phases, indent=1))
    total = options.trajectories

    def iteration(n, between_machines):
        own = math.ceil(total / n)
        rollouts = own * phases["rollout_s"] + phases["rollout_sigma_s"] * math.sqrt(2 * own * math.log(n))
        doublings = math.log2(n)
        one = sum_s(sums[2], options.bytes)
        if between_machines:
            one += LATENCY_S + BYTE_S * options.bytes
        return rollouts + phases["update_s"] + own * phases["update_s_per_trajectory"] + doublings * one

    print(f"\n{total} trajectories an iteration, {options.bytes:.0f} bytes\nprocesses  s/iteration  speed-up  efficiency   "
          "between machines: s  speed-up")
    first = iteration(1, False)
    for n in [2**k for k in range(11)]:
        if n > total:
            break
        here, far = iteration(n, False), iteration(n, True)
        print(f"{n:9d} {here:12.4f} {first / here:9.1f} {100 * first / here / n:9.0f} % {far:20.4f} {first / far:9.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
