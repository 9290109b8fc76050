#!/usr/bin/env python3
"""Learning curves of one or several runs as a PNG: reward and distance against steps and seconds.

    python3 -m venv .venv-plots
    .venv-plots/bin/pip install -r scripts/requirements-plots.txt
    .venv-plots/bin/python scripts/plot_learning.py runs/seed-* --out learning.png

Each run is a thin line; with several runs, the thick line is their mean over the range that all of them
cover. Distance is that of the evaluations (eval_distance_cm) where a run has any, and that of the training
trajectories (object_distance_cm) otherwise.
"""
import argparse
import csv
import math
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

PAPER_CM = 2.1
REWARD, DISTANCE, INK = "#2563a8", "#b4471f", "#333333"
X_AXES = (("physics_steps", 1e-6, "physics steps (millions)"), ("seconds", 1.0, "wall-clock seconds"))


def read_run(folder):
    """The columns of a run as arrays; empty cells are NaN."""
    path = Path(folder) / "metrics.csv"
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        columns = {
            name: np.array([float(row[name]) if row[name] else math.nan for row in rows])
            for name in (rows[0] if rows else ())
        }
    except OSError as error:
        sys.exit(f"plot_learning.py: cannot read {path}: {error.strerror}")
    except (TypeError, ValueError) as error:
        sys.exit(f"plot_learning.py: {path}: {error}")
    if not rows:
        sys.exit(f"plot_learning.py: {path} has no rows")
    for name in ("physics_steps", "seconds", "reward"):
        if name not in columns:
            sys.exit(f"plot_learning.py: {path} has no column {name}")
    return columns


def distance_column(runs):
    """The distance to show: evaluations if every run has some, else training trajectories."""
    for name in ("eval_distance_cm", "object_distance_cm"):
        if all(np.isfinite(run.get(name, math.nan)).any() for run in runs):
            return name
    sys.exit("plot_learning.py: some run has neither eval_distance_cm nor object_distance_cm")


def curves(runs, x_name, y_name):
    """One (x, y) pair of arrays a run, points without value left out."""
    pairs = []
    for run in runs:
        there = np.isfinite(run[x_name]) & np.isfinite(run[y_name])
        pairs.append((run[x_name][there], run[y_name][there]))
    return [(x, y) for x, y in pairs if len(x)]


def mean_curve(pairs):
    """Mean over runs, interpolated on the range that all of them cover."""
    low, high = max(x[0] for x, _ in pairs), min(x[-1] for x, _ in pairs)
    if not low < high:
        return None
    grid = np.linspace(low, high, 400)
    return grid, np.mean([np.interp(grid, x, y) for x, y in pairs], axis=0)


def draw(axis, runs, x, y_name, colour):
    """One panel."""
    x_name, scale, _ = x
    pairs = curves(runs, x_name, y_name)
    single = len(pairs) == 1
    for xs, ys in pairs:
        axis.plot(xs * scale, ys, color=colour, lw=1.8 if single else 0.8, alpha=1 if single else 0.45)
    mean = None if single or not pairs else mean_curve(pairs)
    if mean is not None:
        axis.plot(mean[0] * scale, mean[1], color=colour, lw=2.2)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="run folders")
    parser.add_argument("--out", default="learning.png", help="the picture (default: %(default)s)")
    args = parser.parse_args()
    runs = [read_run(folder) for folder in args.runs]
    distance = distance_column(runs)

    plt.rcParams.update({
        "font.size": 9, "axes.edgecolor": INK, "axes.labelcolor": INK, "text.color": INK,
        "xtick.color": INK, "ytick.color": INK, "axes.spines.top": False, "axes.spines.right": False,
        "axes.grid": True, "grid.color": "#e6e6e6", "grid.linewidth": 0.8,
    })
    figure, axes = plt.subplots(2, 2, figsize=(8, 5), sharex="col", sharey="row", layout="constrained")
    for column, x in enumerate(X_AXES):
        draw(axes[0, column], runs, x, "reward", REWARD)
        draw(axes[1, column], runs, x, distance, DISTANCE)
        axes[1, column].axhline(PAPER_CM, color=INK, lw=1, ls="--")
        axes[1, column].set_xlabel(x[2])
        axes[1, column].set_xlim(left=0)
    axes[1, 1].annotate(f"paper, simulation: {PAPER_CM} cm", (1, PAPER_CM), (0, 3), va="bottom", ha="right",
                        xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=8)
    axes[1, 0].set_ylim(bottom=0)
    axes[0, 0].set_ylabel("mean reward a step")
    kind = "evaluation" if distance == "eval_distance_cm" else "training"
    axes[1, 0].set_ylabel(f"object to target, {kind} (cm)")
    if len(runs) > 1:
        handles = [plt.Line2D([], [], color=INK, lw=0.8, alpha=0.45), plt.Line2D([], [], color=INK, lw=2.2)]
        axes[0, 1].legend(handles, ["one seed", f"mean of {len(runs)}"], frameon=False, loc="lower right")
    try:
        figure.savefig(args.out, dpi=150)
    except (OSError, ValueError) as error:
        sys.exit(f"plot_learning.py: cannot write {args.out}: {error}")


if __name__ == "__main__":
    main()
