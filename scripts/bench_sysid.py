#!/usr/bin/env python3
"""Time and memory of `phantom sysid` on recordings of the whole Phantom system of different lengths.

    python3 scripts/bench_sysid.py [--seconds 0.5 1 2 4 8] [--phantom target/release/phantom]

Records multi-sines of the rig `paper` (seed 3), identifies the 54 parameters of parameters/phantom.toml from each, and
prints a table: seconds by the clock and of all cores, most memory, iterations, and CPU seconds for a second recorded and an
iteration, which stay the same if cost is linear in the length.
"""
import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def measured(command):
    """Runs it; seconds by the clock, CPU seconds, MB."""
    begin = time.perf_counter()
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 1):
        raise SystemExit(f"{' '.join(map(str, command))}: failed")
    return time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[0.5, 1, 2, 4, 8])
    parser.add_argument("--phantom", type=Path, default=ROOT / "target" / "release" / "phantom")
    options = parser.parse_args()
    phantom = str(options.phantom.resolve())
    print("recorded, s   clock, s   CPU, s   MB    iterations   status      CPU s per s and iteration")
    with tempfile.TemporaryDirectory() as folder:
        for seconds in options.seconds:
            log, out = f"{folder}/{seconds}.mcap", f"{folder}/{seconds}"
            measured([phantom, "record", "--rig", "rigs/paper.toml", "--seed", "3", "--behaviour", "multi_sine",
                      "--seconds", str(seconds), "--out", log, "--truth", f"{out}.toml"])
            clock, cpu, memory = measured([phantom, "sysid", "--parameters", "parameters/phantom.toml", log,
                                           "--out", out, "--ensemble", "1"])
            result = json.loads(Path(out, "sysid.json").read_text(encoding="utf-8"))["result"]
            n = len(result["history"])
            print(f"{seconds:11g} {clock:10.1f} {cpu:8.1f} {memory:6.0f} {n:10d}   {result['status']:10} "
                  f"{cpu / seconds / n:10.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
