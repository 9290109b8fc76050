#!/usr/bin/env python3
"""How often the intervals of `phantom sysid` hold the truth of machines of the rig `paper`.

    python3 scripts/coverage_rig.py --machines 100 --out coverage [--phantom target/release/phantom]

One finger of xml/phantom.xml, free of contact, 20 parameters. For every seed a machine is drawn, recorded
(`phantom record`: multi_sine, chirp, reversals, postures) and identified; each true value is looked up in the sealed
file, and counted as inside its 95 % interval or not. The rig is rigs/paper.toml with one finger and with everything that
is estimated drawn from the prior that the estimator is told, so that coverage means something for every parameter;
what the recordings say little of is counted apart (label `prior`). Results go to OUT/machine-*.json and are not
computed again: the script can be stopped, and run again with more machines. --jobs at once, each on one thread.

Exit code 0: overall coverage 90 to 97 %; 1: outside; 2: something failed.
"""
import argparse
import concurrent.futures
import json
import math
import os
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FINGER = "p1"
BEHAVIOURS = ("multi_sine", "chirp", "reversals", "postures")

# element, attribute, component, spread of the rig and of the prior (log: of the logarithm), scale
PARAMETERS = (
    [(f"joint/{FINGER}_{j}", "damping", None, 0.25, "log") for j in ("turret", "upper", "crank")]
    + [(f"joint/{FINGER}_{j}", "armature", None, 0.3, "log") for j in ("turret", "upper", "crank")]
    + [(f"body/{FINGER}_{b}", "mass", None, 0.05, "log") for b in ("upper", "crank", "forearm")]
    + [(f"body/{FINGER}_upper", "ipos", 0, 2e-4, "linear"), (f"body/{FINGER}_crank", "ipos", 2, 2e-4, "linear"),
       (f"body/{FINGER}_forearm", "ipos", 2, 5e-4, "linear")]
    + [(f"body/{FINGER}_forearm", "pos", 0, 1e-3, "linear"), (f"body/{FINGER}_tip", "pos", 2, 1e-3, "linear")]
    + [(f"actuator/{FINGER}_m{i}", "gear", 0, 0.02, "log") for i in (1, 2, 3)]
)
BIASES = [f"{FINGER}_{j}" for j in ("turret", "upper", "crank")]
BIAS_SIGMA = 0.002


def one_finger():
    """xml/phantom.xml without the other fingers and the object."""
    tree = ET.parse(ROOT / "xml" / "phantom.xml")
    root = tree.getroot()
    other = re.compile(r"p[0-9]_|object|goal")

    def named(element):
        return [v for k, v in element.attrib.items() if k not in ("class", "material")]

    def prune(parent):
        for child in list(parent):
            strange = any(other.match(v) and not v.startswith(FINGER) for v in named(child))
            joints = child.findall("joint") if parent.tag == "tendon" else []
            if strange or any(not j.get("joint").startswith(FINGER) for j in joints):
                parent.remove(child)
            elif child.tag not in ("default", "asset"):
                prune(child)

    prune(root)
    for section in ("keyframe", "contact"):
        for element in root.findall(section):
            root.remove(element)
    # start_low and start_high hold for each finger; what is made for three is not used here
    return ET.tostring(root, encoding="unicode")


def rule(element, attribute, component, spread, scale):
    kind = "log_normal" if scale == "log" else "normal"
    components = "" if component is None else f"components = [{component}]\n"
    return (f'[[randomise]]\nelement = "{element}"\nattribute = "{attribute}"\n{components}'
            f"distribution = {{ {kind} = {spread} }}\n\n")


def write_inputs(folder):
    """Model, rig and parameter file."""
    (folder / "finger.xml").write_text(one_finger(), encoding="utf-8")
    paper = (ROOT / "rigs" / "paper.toml").read_text(encoding="utf-8")
    head = paper[:paper.index("[[randomise]]")]
    head = re.sub(r'(?m)^model = .*$', 'model = "finger.xml"', head)
    head = head[:head.rindex("#")] if head.rstrip().endswith("mm") else head
    (folder / "rig.toml").write_text(head + "\n" + "".join(rule(*p) for p in PARAMETERS), encoding="utf-8")
    rules = []
    for element, attribute, component, spread, _ in PARAMETERS:
        components = "" if component is None else f"components = [{component}]\n"
        rules.append(f'[[parameter]]\nelement = "{element}"\nattribute = "{attribute}"\n{components}'
                     f"prior_sigma = {spread}\n\n")
    for joint in BIASES:
        rules.append(f'[[parameter]]\nelement = "channel/{joint}_pos"\nattribute = "bias"\n'
                     f"prior_sigma = {BIAS_SIGMA}\n\n")
    rules.append('[[channel]]\nname = "*_vel"\nignore = true\n')
    (folder / "parameters.toml").write_text("".join(rules), encoding="utf-8")


def run(command, folder):
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False,
                            env={**os.environ, "RAYON_NUM_THREADS": "1"})
    if result.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {result.stderr}")
    return result.stdout


def address(name):
    """`joint/a damping[0]` and `joint/a damping` are the same number."""
    return re.sub(r"^(joint/\S+ \w+)\[0\]$", r"\1", name)


def truths(path):
    """True values by the addresses of the estimates."""
    table = {}
    for p in tomllib.loads(path.read_text(encoding="utf-8"))["parameter"]:
        if p["attribute"] == "encoder_bias":
            table["channel/" + p["element"].split("/")[1] + "_pos bias"] = p["value"]
        else:
            table[address(f'{p["element"]} {p["attribute"]}')] = p["value"]
    return table


def machine(seed, options):
    """Records, identifies and scores one machine."""
    done = options.out / f"machine-{seed}.json"
    if done.exists():
        return json.loads(done.read_text(encoding="utf-8"))
    folder = options.out / f"work-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    write_inputs(folder)
    for behaviour in BEHAVIOURS:
        run([options.phantom, "record", "--rig", "rig.toml", "--seed", str(seed), "--behaviour", behaviour, "--seconds",
             str(options.seconds), "--out", f"{behaviour}.mcap", "--truth", "truth.toml"], folder)
    output = run([options.phantom, "sysid", "--model", "finger.xml", "--parameters", "parameters.toml",
                  "--timestep", str(options.timestep), "--ensemble", "1", "--out", "sysid", "--json",
                  *(f"{b}.mcap" for b in BEHAVIOURS)], folder)
    result = json.loads(output)["result"]
    true = truths(folder / "truth.toml")
    rows = []
    for p in result["parameters"]:
        truth, interval = true[address(p["name"])], p["interval"]
        sigma, value = p["x_sigma"], p["value"]
        error = math.log(value / truth) if p["scale"] == "log" else value - truth
        rows.append({"name": p["name"], "truth": truth, "value": value, "interval": interval, "label": p["label"],
                     "inside": interval is not None and interval[0] <= truth <= interval[1],
                     "z": error / sigma if sigma else None})
    document = {"seed": seed, "status": result["status"], "level": result["level"], "parameters": rows}
    done.write_text(json.dumps(document, indent=1), encoding="utf-8")
    for file in sorted(folder.rglob("*"), reverse=True):
        file.unlink() if file.is_file() else file.rmdir()
    folder.rmdir()
    return document


def share(rows):
    inside = sum(r["inside"] for r in rows)
    return f"{inside:5d} of {len(rows):5d}  {100 * inside / max(len(rows), 1):5.1f} %"


def report(machines):
    names = [p["name"] for p in machines[0]["parameters"]]
    print(f"{len(machines)} machines; " + ", ".join(
        f"{status}: {sum(m['status'] == status for m in machines)}" for status in sorted({m["status"] for m in machines})))
    for i, name in enumerate(names):
        rows = [m["parameters"][i] for m in machines]
        z = [r["z"] for r in rows if r["z"] is not None]
        mean = sum(z) / len(z)
        rms = math.sqrt(sum(v * v for v in z) / len(z))
        labels = sum(r["label"] == "identified" for r in rows)
        print(f"{name:32} inside {share(rows)}   error {rms:4.2f} sigma, mean {mean:+5.2f}   identified {labels}")
    rows = [p for m in machines for p in m["parameters"]]
    print(f"{'all':32} inside {share(rows)}")
    print(f"{'labelled identified':32} inside {share([r for r in rows if r['label'] == 'identified'])}")
    outside = sorted((sum(not p["inside"] for p in m["parameters"]) for m in machines), reverse=True)
    print("outside per machine, most first:", *outside[:20])
    return sum(r["inside"] for r in rows) / len(rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seconds", type=float, default=1.5, help="length of each recording")
    parser.add_argument("--timestep", type=float, default=0.002)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--phantom", default=str(ROOT / "target" / "release" / "phantom"))
    options = parser.parse_args()
    options.out = options.out.resolve()
    options.phantom = str(Path(options.phantom).resolve())
    options.out.mkdir(parents=True, exist_ok=True)
    machines, failed = [], 0
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        seeds = range(options.first, options.first + options.machines)
        for future in concurrent.futures.as_completed(pool.submit(machine, s, options) for s in seeds):
            try:
                machines.append(future.result())
            except RuntimeError as error:
                print(error, file=sys.stderr)
                failed += 1
    if not machines:
        return 2
    covered = report(sorted(machines, key=lambda m: m["seed"]))
    return 2 if failed else int(not 0.90 <= covered <= 0.97)


if __name__ == "__main__":
    sys.exit(main())
