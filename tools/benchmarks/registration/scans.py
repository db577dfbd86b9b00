"""Scans for the benchmark of registration: real ones (KITTI, a courtyard), simulated ones with exact poses."""

import hashlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

from segslam.bench.experiments.job import open_once
from segslam.bench.experiments.pairs import MIN_GAP, ScanVariant, Trial, read_pairs
from segslam.bench.simulation.sensor import drive_sweeps
from segslam.bench.simulation.tracks import read_drive
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SimulationConfig, WorldConfig
from segslam.core import geometry
from segslam.core.types import Labels, Points, Scan, Transform
from segslam.labels import geometric_labels
from segslam.scans.kitti import read_returns
from tools.benchmarks import real_pairs
from tools.benchmarks.registration.label_errors import LabelErrorConfig, network_like

Labelled = tuple[Points, Labels]

WORLDS = {
    "usual": WorldConfig(),
    "hard": WorldConfig(cars=3, trees=4, lamps=1.5, signs=1.5, equal_tree_rows=True, parked_cars_gone=0.7),
}
"""Hard: sparse streets, rows of equal trees, most parked cars gone by the second visit; labels as a network's."""
LISTED_M = {(8, 10): "8to10", (10, 15): "10to15"}
"""Bands of distance that the paper has lists for."""
BANDS_M = (*LISTED_M, (15, 20), (20, 30))


class SimulatedPlace:
    """Scans at the real poses of a KITTI sequence, levelled, in one generated world; cached in `cache`."""

    def __init__(self, data: Path, sequence: str, world: str, *, seed: int, cache: Path) -> None:
        self.name = f"{sequence} {world}"
        self._lists, self._prefix = data / "pairs", f"kitti{sequence}_"
        self._seed, self._hard = seed, world == "hard"
        self._config = SimulationConfig(world=WORLDS[world])
        digest = hashlib.sha256(self._config.model_dump_json().encode()).hexdigest()[:8]
        self._folder = cache / f"{sequence}-{world}-{seed}-{digest}"
        drive = read_drive(data / "kitti" / "poses" / f"{sequence}.txt", sequence=sequence)
        self.T_world_lidar, self._time_s = drive.T_world_lidar, drive.time_s

    def pair(self, source: int, target: int) -> Trial:
        T_target_source = geometry.inverse(self.T_world_lidar[target]) @ self.T_world_lidar[source]
        return Trial(self.name, ScanVariant(source), ScanVariant(target), T_target_source)

    def pairs(self, band_m: tuple[int, int], count: int) -> list[Trial]:
        """Up to `count` pairs of the paper's list for the band; where it has none, pairs cut by its protocol.

        Fewer are the first of more, so that scans made once serve again.
        """
        rng = np.random.default_rng([self._seed, 6, *band_m])
        candidates = self._listed(band_m) if band_m in LISTED_M else self._cut(band_m)
        rows = rng.permutation(len(candidates))[:count]
        return [self.pair(int(source), int(target)) for source, target in candidates[rows]]

    def scan(self, index: int) -> Labelled:
        """Points (float32) and labels: the true ones, in a hard world those of a network."""
        file = self._folder / f"{index:06d}.npz"
        if not file.is_file():
            self._folder.mkdir(parents=True, exist_ok=True)
            points, labels = self._simulated(index)
            np.savez(file, points=points, labels=labels)
        stored = np.load(file)
        return stored["points"], stored["labels"]

    def _listed(self, band_m: tuple[int, int]) -> np.ndarray:
        return read_pairs(self._lists / f"{self._prefix}{LISTED_M[band_m]}.txt").pairs

    def _cut(self, band_m: tuple[int, int]) -> np.ndarray:
        at = self.T_world_lidar[:, :2, 3]
        early, late = np.triu_indices(len(at), MIN_GAP)
        apart_m = np.linalg.norm(at[early] - at[late], axis=1)
        within = (apart_m >= band_m[0]) & (apart_m < band_m[1])
        return np.column_stack([early[within], late[within]])

    @cached_property
    def _world(self) -> World:
        return World(self.T_world_lidar, self._time_s, config=self._config.world, seed=self._seed)

    def _simulated(self, index: int) -> Labelled:
        drive, sensor = (self.T_world_lidar, self._time_s), self._config.sensor
        (swept,) = drive_sweeps(self._world, *drive, config=sensor, seed=self._seed, only={index})
        rng = np.random.default_rng([self._seed, 5, index])
        wrong = LabelErrorConfig() if self._hard else LabelErrorConfig(regions=0, bleeding=0.0, lost=0.0)
        return swept.points.astype(np.float32), network_like(swept.points, swept.labels, config=wrong, rng=rng)


def real_scan(data: Path, index: int, *, labels: str = "none") -> Scan:
    """A scan of KITTI 00, corrected. With labels of a network (`predicted_labels`) where there are any."""
    dataset, row_of_scan = open_once(real_pairs.kitti(data, labels))
    return dataset[row_of_scan[index]]


def kitti_pose(data: Path, source: int, target: int) -> Transform:
    """T_target_source from KITTI's ground truth of 00; errors up to 1.6 m, larger between distant scans."""
    dataset, row_of_scan = open_once(real_pairs.kitti(data, "none"))
    assert dataset.reference is not None
    T_world_lidar = dataset.reference.T_world_lidar
    return geometry.inverse(T_world_lidar[row_of_scan[target]]) @ T_world_lidar[row_of_scan[source]]


def real_indices(data: Path) -> list[int]:
    """The real scans of KITTI 00 that there are."""
    return sorted(open_once(real_pairs.kitti(data, "none"))[1])


def courtyard_points(data: Path, index: int) -> Points:
    """A scan of the handheld recording, which has no labels."""
    return read_returns(data / "courtyard" / "velodyne" / f"{index:06d}.bin")[:, :3]


def by_shape(points_of: Callable[[int], Points]) -> Callable[[int], Labelled]:
    """The same scans with geometric labels."""

    def scan(index: int) -> Labelled:
        points = points_of(index)
        return points, geometric_labels(points)

    return scan
