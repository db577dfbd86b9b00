"""Pairs of scans of a real drive by their distance: how many are registered without an initial guess.

    python -m tools.benchmarks.distances SCANS [--submaps] [--pairs 20] [--seed 0] [--out distances.json]

SCANS is a folder of scans with `poses.txt` (LiDAR to world, in KITTI format). Pairs are drawn among all scans of the
drive, those that follow each other, too. `--submaps` merges each scan with the five before and after it by the
odometry in `lio.txt`. Right is below 2 m and 5 degrees of the poses, which on KITTI are off by up to 1.6 m.
"""

import json
from collections import Counter
from functools import cache
from itertools import pairwise
from pathlib import Path
from time import process_time

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.pose_files import read_poses
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.scans import open_dataset
from segslam.verification import register_prepared
from tools.benchmarks import common
from tools.benchmarks.submaps import Submaps

EDGES_M = (2.0, 8.0, 14.0, 20.0, 26.0, 32.0, 38.0)
"""Of the bands of distances."""
TOLERANCE = 2.0, 5.0


def run_benchmark() -> None:
    """Print a row for each band of distances, and write all to a file."""
    options = common.parser(__doc__, "distances")
    options.add_argument("scans", type=Path)
    options.add_argument("--submaps", action="store_true")
    options.add_argument("--pairs", type=int, default=20)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", type=Path, default=Path("distances.json"))
    given = options.parse_args()
    config, scans = Config(), open_dataset(given.scans)
    T_world = read_poses(given.scans / "poses.txt").T_a_b[: len(scans)]

    @cache
    def single(index: int) -> PreparedScan:
        points = scans[index].points
        return prepare_scan(points, geometric_labels(points), config=config)

    prepared = Submaps(given.scans, config).prepared if given.submaps else single
    apart_m = np.linalg.norm(T_world[:, None, :3, 3] - T_world[:, :3, 3], axis=-1)
    is_later = np.tri(len(T_world), k=-1, dtype=bool)
    rows: list[common.Row] = []
    for near_m, far_m in pairwise(EDGES_M):
        is_within = is_later & (apart_m >= near_m) & (apart_m < far_m)
        counts, seconds = Counter[str](), 0.0
        for source, target in common.draw_pairs(is_within, given.pairs, np.random.default_rng(given.seed)):
            pair = prepared(source), prepared(target)
            began = process_time()
            found = register_prepared(*pair, config=config)
            seconds += process_time() - began
            T_true = geometry.inverse(T_world[target]) @ T_world[source]
            counts[common.verdict(found, T_true, TOLERANCE)] += 1
        total, right, wrong = counts.total(), counts["right"], counts["wrong"]
        row = {"from_m": near_m, "to_m": far_m, "pairs": total, "right": right, "wrong": wrong}
        rows.append(row | {"seconds": round(seconds / max(total, 1), 3)})
        print(json.dumps(rows[-1]), flush=True)
    common.write_report(given.out, {"rows": rows})


if __name__ == "__main__":
    run_benchmark()
