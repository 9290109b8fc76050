#!/usr/bin/env python3
"""Compare reading a recording of 60 s, 60 channels, 2 kHz with reading the same numbers from NPZ in Python.

    bench_recording.py [--phantom target/release/phantom]

Prints seconds, the ratio to NPZ, and peak memory; exit code 1 if a target is missed (1 s, 300 MB).
"""
import argparse
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np

import read_recording

TARGET_S, TARGET_MB = 1.0, 300.0


def seconds_to_load(path):
    """Best of three of loading every array."""
    best = float("inf")
    for _ in range(3):
        begin = time.perf_counter()
        with np.load(path) as arrays:
            for name in arrays.files:
                arrays[name]
        best = min(best, time.perf_counter() - begin)
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--phantom", default="target/release/phantom", help="the program")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log, figures = pathlib.Path(folder, "log.mcap"), pathlib.Path(folder, "figures.json")
        command = [args.phantom, "bench", "--recording", str(log), "--json", str(figures)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        figures = json.loads(figures.read_text())
        begin = time.perf_counter()
        found = read_recording.streams(log)
        python_s = time.perf_counter() - begin
        arrays = {name: np.array(rows, dtype=float) for name, (_, _, _, rows) in found.items()}
        arrays |= {f"{name}/time": np.array(times) for name, (_, _, times, _) in found.items()}
        plain, packed = pathlib.Path(folder, "plain.npz"), pathlib.Path(folder, "packed.npz")
        np.savez(plain, **arrays)
        np.savez_compressed(packed, **arrays)
        plain_s, packed_s = seconds_to_load(plain), seconds_to_load(packed)
        sizes = [path.stat().st_size / 1e6 for path in (plain, packed)]
    read_s, peak_mb = figures["read_s"], figures["read_peak_mb"]
    print(f"phantom        {read_s:7.3f} s  {figures['file_mb']:6.1f} MB  peak {peak_mb:.0f} MB")
    print(f"npz, plain     {plain_s:7.3f} s  {sizes[0]:6.1f} MB  ratio {read_s / plain_s:.2f}")
    print(f"npz, packed    {packed_s:7.3f} s  {sizes[1]:6.1f} MB  ratio {read_s / packed_s:.2f}")
    print(f"mcap in Python {python_s:7.3f} s  {figures['file_mb']:6.1f} MB  ratio {read_s / python_s:.3f}")
    return int(read_s > TARGET_S or peak_mb > TARGET_MB)


if __name__ == "__main__":
    sys.exit(main())
