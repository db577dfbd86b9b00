"""A drive of faults: live runs and mapped folders, with files damaged, processes killed and disks full at random.

python -m tools.benchmarks.faults SCANS --out DIR                  ten minutes; SCANS: a folder of scans
python -m tools.benchmarks.faults SCANS --out DIR --seconds 60     shorter

At the end, every scan is accounted for (mapped, skipped with a reason, dropped), each log reads, and each interrupted
run was resumed or replayed. Figures go to DIR/bench.json; the exit status is 1 if something is wrong.
"""

import json
import random
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from segslam.scans import open_dataset
from tools.benchmarks import common
from tools.benchmarks.faults.episodes import EPISODES, Outcome

MOST_POINTS = 8000
"""Chosen: points of a scan, so that a run with a fault takes seconds."""


def main() -> None:
    parser = common.parser(__doc__, "faults")
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--every", type=float, default=0.5, help="seconds between two scans of a live run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=EPISODES)
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True)
    dataset = open_dataset(chosen.data, labels="none", vertical_angle_deg=0.0)
    scans = []
    for row in range(min(len(dataset), 40)):
        points = dataset[row].points
        some = points[:: 1 + len(points) // MOST_POINTS]
        scans.append(np.column_stack([some, np.zeros(len(some))]).astype(np.float32))
    rng, end = random.Random(chosen.seed), monotonic() + chosen.seconds
    outcomes: list[Outcome] = []
    kinds = [chosen.only] if chosen.only else [kind for kind in EPISODES if kind != "topic" or find_spec("rclpy")]
    while not outcomes or monotonic() < end:
        kind = kinds[len(outcomes) % len(kinds)]
        folder = chosen.out / f"{len(outcomes):03d}-{kind}"
        folder.mkdir()
        outcomes.append(EPISODES[kind](scans, folder, rng, chosen.every))
        print(f"{folder.name}: {outcomes[-1]}", file=sys.stderr, flush=True)
    figures = summary(outcomes)
    if find_spec("rclpy") is None:
        figures["skipped"] = "topics that stop: rclpy is not installed"
    common.write_report(chosen.out / "bench.json", figures)
    print(json.dumps(figures, indent=2))
    sys.exit(1 if figures["problems"] or figures["num_unaccounted"] else 0)


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """The figures of all episodes."""
    faults: Counter[str] = sum((outcome.faults for outcome in outcomes), Counter())
    return {
        "num_runs": len(outcomes),
        "num_scans": sum(outcome.num_scans for outcome in outcomes),
        "num_faults": sum(faults.values()),
        "faults": dict(faults.most_common()),
        "num_unaccounted": sum(outcome.num_unaccounted for outcome in outcomes),
        "problems": [problem for outcome in outcomes for problem in outcome.problems],
    }


if __name__ == "__main__":
    main()
