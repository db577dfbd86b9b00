"""Pairs of submaps of a real drive (NCLT): 11 sparse scans merged around a keyframe, revisited in reverse.

    python -m tools.benchmarks.submaps DATA [--pairs 45] [--negatives 45] [--seed 0] [--set verify.max_false_share=0.01]

DATA is the folder of real data with `nclt/`. Right is below 0.5 m and 2 degrees of the optimised poses.
Verification was tuned with seed 5; report other seeds.
"""

from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.types import Alignment, Points, Transform
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.scans import open_dataset
from segslam.verification import register_prepared
from tools.benchmarks import common

NUM_BESIDE = 5
"""Scans before and after the middle one."""
MIN_GAP = 100
"""Keyframes between the two of a pair."""
NEAR_M, FAR_M = 20.0, 100.0


class Submaps:
    """Scans of a drive, gathered by its odometry."""

    def __init__(self, folder: Path, config: Config) -> None:
        self._scans = open_dataset(folder)
        self._config = config
        self.T_world_lidar = poses_of(folder / "poses.txt")[: len(self._scans)]
        self._T_odom_lidar = poses_of(folder / "lio.txt")
        self.prepared = cache(self._prepare)
        self._points = cache(self._read)

    def pairs(self, count: int, rng: np.random.Generator, *, near: bool) -> list[tuple[int, int]]:
        """Drawn among all that lie within NEAR_M of each other, or beyond FAR_M."""
        at = self.T_world_lidar[:, :3, 3]
        apart = np.linalg.norm(at[:, None] - at, axis=-1)
        late = np.arange(len(at))[:, None] - np.arange(len(at)) > MIN_GAP
        return common.draw_pairs(late & (apart < NEAR_M if near else apart > FAR_M), count, rng)

    def error(self, source: int, target: int, T_target_source: Transform) -> Transform:
        """The pose of the source by the registration in that by the optimised poses."""
        T_true = geometry.inverse(self.T_world_lidar[target]) @ self.T_world_lidar[source]
        return geometry.inverse(T_true) @ T_target_source

    def _read(self, index: int) -> Points:
        return self._scans[index].points

    def cloud(self, index: int) -> Points:
        """The scans around one, in its frame."""
        T_here_odom = geometry.inverse(self._T_odom_lidar[index])
        beside = range(max(0, index - NUM_BESIDE), min(len(self._scans), index + NUM_BESIDE + 1))
        points = np.concatenate([geometry.apply(T_here_odom @ self._T_odom_lidar[k], self._points(k)) for k in beside])
        return points.astype(np.float32)

    def _prepare(self, index: int) -> PreparedScan:
        points = self.cloud(index)
        labels = geometric_labels(points)
        return prepare_scan(points, labels, config=self._config, seen_from_here=self._points(index))


def poses_of(file: Path) -> np.ndarray:
    """(n, 4, 4) from rows of 3 x 4."""
    rows = np.loadtxt(file).reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return poses


def run(submaps: Submaps, pairs: list[tuple[int, int]], config: Config) -> Counter[str]:
    """Outcomes: right, wrong, or the reason of the rejection."""
    outcomes: Counter[str] = Counter()
    for source, target in pairs:
        found = register_prepared(submaps.prepared(source), submaps.prepared(target), config=config)
        if isinstance(found, Alignment):
            T_error = submaps.error(source, target, found.fine.T_target_source)
            outcomes["right" if common.is_right(T_error) else "wrong"] += 1
        else:
            outcomes[found.reason.value] += 1
    return outcomes


def main() -> None:
    parser = common.parser(__doc__, "submaps")
    parser.add_argument("data", type=Path)
    parser.add_argument("--pairs", type=int, default=45)
    parser.add_argument("--negatives", type=int, default=45)
    parser.add_argument("--seed", type=int, default=0)
    common.add_settings(parser)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    submaps = Submaps(options.data / "nclt", config)
    rng = np.random.default_rng(options.seed)
    for name, count, near in (("true", options.pairs, True), ("false", options.negatives, False)):
        outcomes = run(submaps, submaps.pairs(count, rng, near=near), config)
        print(f"{name} pairs: {outcomes.total()}: {dict(outcomes)}", flush=True)


if __name__ == "__main__":
    main()
