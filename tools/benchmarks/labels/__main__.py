"""How good the labels from shape alone are: per class, and by the registrations they make possible.

    python -m tools.benchmarks.labels DATA [--set verify.max_plan_hypotheses=0] [--pictures FOLDER] --out FILE.json

DATA is the folder of real data: `kitti/` with ground-truth labels of scans 0-2, predicted ones, and
`reference_pairs.json`, and `courtyard/`. Writes JSON, and the tables as FILE.md. The numbers of `GeometricLabelsConfig`
were chosen on those scans and pairs of KITTI. KISS-Matcher needs the extra `bench`.
"""

import argparse
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from segslam.config import load_config
from segslam.datasets import open_dataset
from tools.benchmarks.labels.courtyard import courtyard
from tools.benchmarks.labels.kitti import class_agreement, pairs_by_labels, speed


def tables(results: dict[str, Any]) -> str:
    """The figures as Markdown."""
    iou = results["class_iou"]
    names = list(iou["all"])
    lines = [f"| intersection over union | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    lines += [f"| {scans} | {' | '.join(f'{iou[scans][name]:.2f}' for name in names)} |" for scans in sorted(iou)]
    kitti = results["kitti"]
    lines += [
        "",
        f"| real pairs, {kitti['num_yaws']} yaws each | success | false | coarse mean (worst) | refined mean (worst) |",
        "|---|---|---|---|---|",
    ]
    lines += [_pairs_line(name, found) for name, found in kitti.items() if name.startswith(("shape", "a network"))]
    lines += [
        "",
        "| courtyard | method | success | false | CPU ms, median (p95) | wall ms |",
        "|---|---|---|---|---|---|",
    ]
    for band, methods in results["courtyard"].items():
        lines += [
            f"| {band} | {name} | {found['num_success']} of {found['num']} | {found['num_false_accepted']} "
            f"| {found['cpu_ms_median']} ({found['cpu_ms_p95']}) | {found['ms_median']} |"
            for name, found in methods.items()
        ]
    took = results["speed"]
    lines += [
        "",
        f"Labels for {took['num_points']:,} points: {took['thread_ms_median']} ms (p95 {took['thread_ms_p95']})",
    ]
    return "\n".join(lines) + "\n"


def _pairs_line(name: str, found: dict[str, Any]) -> str:
    errors = [
        f"{found[f'{kind}error_m_mean']:.3f} m {found[f'{kind}error_deg_mean']:.2f} deg "
        f"({found[f'{kind}error_m_max']:.3f} m {found[f'{kind}error_deg_max']:.2f} deg)"
        for kind in ("coarse_", "")
    ]
    success = f"{found['num_success']} of {found['num']}"
    return f"| {name} | {success} | {found['num_false_accepted']} | {' | '.join(errors)} |"


def _commit() -> str:
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--yaws", type=int, default=24)
    parser.add_argument("--pairs", type=int, default=60, help="of each band of distances in the courtyard")
    parser.add_argument(
        "--seed", type=int, default=0, help="of those pairs; 1 draws those that settings were chosen on"
    )
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of a success and a failure")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    first = open_dataset(options.data / "kitti", sequence="00", labels="none", frames="0:1")[0]
    results = {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} CPUs, {platform.python_version()}",
        "load_at_start": os.getloadavg()[0],
        "commit": _commit(),
        "seed": options.seed,
        "config": config.model_dump(mode="json"),
        "class_iou": class_agreement(options.data, config),
        "speed": speed(first.points, config),
        "courtyard": courtyard(
            options.data, config, num_pairs=options.pairs, seed=options.seed, pictures=options.pictures
        ),
        "kitti": pairs_by_labels(options.data, config, options.yaws),
    }
    options.out.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    options.out.with_suffix(".md").write_text(tables(results))
    print(tables(results))


if __name__ == "__main__":
    main()
