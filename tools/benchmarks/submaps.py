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
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import Poses
from segslam.core.types import Points
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
        self.T_world_lidar = read_poses(folder / "poses.txt").T_a_b[: len(self._scans)]
        self._T_odom_lidar = read_poses(folder / "lio.txt").T_a_b
        self.prepared = cache(self._prepare)
        self._points = cache(lambda index: self._scans[index].points)

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


def drive_pairs(
    T_world_lidar: Poses, count: int, rng: np.random.Generator, *, near: bool, gap: int = MIN_GAP
) -> list[tuple[int, int]]:
    """Drawn among all scans more than `gap` apart that lie within NEAR_M of each other, or beyond FAR_M."""
    at = T_world_lidar[:, :3, 3]
    apart = np.linalg.norm(at[:, None] - at, axis=-1)
    late = np.arange(len(at))[:, None] - np.arange(len(at)) > gap
    return common.draw_pairs(late & (apart < NEAR_M if near else apart > FAR_M), count, rng)


def run(submaps: Submaps, pairs: list[tuple[int, int]], config: Config) -> Counter[str]:
    """Outcomes: right, wrong, or the reason of the rejection."""
    outcomes: Counter[str] = Counter()
    for source, target in pairs:
        found = register_prepared(submaps.prepared(source), submaps.prepared(target), config=config)
        T_true = geometry.inverse(submaps.T_world_lidar[target]) @ submaps.T_world_lidar[source]
        outcomes[common.verdict(found, T_true)] += 1
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
        outcomes = run(submaps, drive_pairs(submaps.T_world_lidar, count, rng, near=near), config)
        print(f"{name} pairs: {outcomes.total()}: {dict(outcomes)}", flush=True)


if __name__ == "__main__":
    main()
