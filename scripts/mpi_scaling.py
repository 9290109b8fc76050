#!/usr/bin/env python3
"""How training scales over processes, by a model whose parameters are measured.

    cargo build --release --features mpi --example scaling
    target/release/examples/scaling > phases.json
    mpirun -n 2 target/release/examples/scaling > sums.json
    mpi_scaling.py phases.json sums.json --bytes 1630000 [--trajectories 200]

BYTES is what a process sends in an iteration, `message_bytes` of metrics.csv of a run on two processes. With N trajectories
on n processes, of which each takes m = N/n,

    T(n) = m r + sigma sqrt(2 m ln n)  +  c + d m  +  s log2 n

where r and sigma are mean and spread of a rollout's time (the second term is the slowest of n processes), c and d the constant
part and that of a trajectory in the update (a line through the measured `updates`), s the time of one sum of BYTES between two
processes of one machine. Between machines a sum is taken to last 50 microseconds and 1 ns a byte (10 Gbit Ethernet) longer.
"""
import argparse
import json
import math

LATENCY_S, BYTE_S = 50e-6, 1e-9


def sum_s(sums, size):
    """Seconds of one sum, between the measured lengths by a straight line."""
    rows = [(row["bytes"], row["seconds"]) for row in sums]
    for (b0, s0), (b1, s1) in zip(rows, rows[1:]):
        if size <= b1:
            return s0 + (s1 - s0) * (size - b0) / (b1 - b0)
    return rows[-1][1] * size / rows[-1][0]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("phases", type=argparse.FileType(), help="of the example on one process")
    parser.add_argument("sums", type=argparse.FileType(), help="of the example on two processes")
    parser.add_argument("--bytes", type=float, required=True)
    parser.add_argument("--trajectories", type=int, default=200)
    options = parser.parse_args()
    phases, total = json.load(options.phases), options.trajectories
    one = sum_s(json.load(options.sums)["sums"], options.bytes)

    def iteration(n, further):
        own = math.ceil(total / n)
        rollouts = own * phases["rollout_s"] + phases["rollout_sigma_s"] * math.sqrt(2 * own * math.log(n))
        update = phases["update_s"] + own * phases["update_s_per_trajectory"]
        return rollouts + update + math.log2(n) * (one + further)

    further = LATENCY_S + BYTE_S * options.bytes
    first = iteration(1, 0.0)
    print("processes  one machine: s  speed-up  several: s  speed-up  efficiency")
    for n in (2**k for k in range(11)):
        if n > total:
            break
        here, far = iteration(n, 0.0), iteration(n, further)
        print(f"{n:9d} {here:15.4f} {first / here:9.1f} {far:11.4f} {first / far:9.1f} {100 * first / far / n:9.0f} %")


if __name__ == "__main__":
    main()
