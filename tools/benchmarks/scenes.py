"""Verification in scenes other than streets: scenes x sensors x noise, pairs of one place and pairs of two places.

    python -m tools.benchmarks.scenes --out FILE.json [--pairs 200] [--scenes corridor,garage] [--sensors 16,64]
        [--noise 0.01,0.03,0.1] [--seed 0]

Each true pair is two scans of one place, each false pair two scans of different places, both with the prior that a run
would have: for false pairs a prior that puts the places beside each other. Default settings. Prints a row for each
combination: false acceptances, true pairs with an overlap above 0.4 at the true pose, and how many of them are kept.
Settings were chosen on even seeds and on seed 1; report others.
"""

import math
import time
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.types import LoopCandidate, Points, Transform
from segslam.graph.chains import prior_gate
from segslam.keyframes import downsample_keyframe
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import register_prepared
from segslam.verification.patches import agreement
from segslam.verification.trial import Gate, anywhere
from tools.benchmarks import common
from tools.benchmarks.scene_models import SCENES, SENSORS, Scene, pose, scan_points

DRIFT_M, DRIFT_DEG, HEIGHT_M = 1.5, 3.0, 0.3
"""Standard deviations of the prior."""
ELSEWHERE = 100
"""Added to the seed of a scene: another one of its kind."""


class Task(NamedTuple):
    """Two scans to register, and what is known about their pose."""

    part: str
    sensor: str
    source: PreparedScan
    target: PreparedScan
    T_target_source: Transform | None
    """None for scans of different worlds."""
    is_true: bool
    """True if the scans show the same place."""
    gate: Gate = anywhere
    tolerance: tuple[float, float] = common.RIGHT
    """m, degrees within which a pose is right."""

    @property
    def overlap(self) -> float:
        """At the true pose; 0 for scans of different places."""
        if not self.is_true or self.T_target_source is None:
            return 0.0
        return agreement(self.source, self.target, self.T_target_source).overlap


class Place:
    """Scans of a scene by one sensor, each prepared once."""

    def __init__(self, scene: Scene, sensor: str, noise_m: float, seed: int, config: Config) -> None:
        self.scene = scene
        self._sensor, self._noise_m, self._seed, self._config = sensor, noise_m, seed, config
        self.prepared = cache(self._prepare)

    def pose(self, row: int, visit: int) -> Transform:
        return pose(self.scene, row, np.random.default_rng([self._seed, row, visit]), turned=visit % 2 == 1)

    def _prepare(self, row: int, visit: int) -> PreparedScan:
        rng = np.random.default_rng([self._seed, row, visit, 1])
        points = scan_points(self.scene, self._sensor, self.pose(row, visit), noise_m=self._noise_m, rng=rng)
        return prepared_keyframe(points, self._config)


def prepared_keyframe(points: Points, config: Config) -> PreparedScan:
    """A scan labelled by shape, downsampled and prepared like the keyframe of a run."""
    classes = tuple(config.segregator.cluster_min_points)
    labels = geometric_labels(points)
    points, labels, _ = downsample_keyframe(points, labels, config=config.keyframes, whole_classes=classes)
    return prepare_scan(points, labels, config=config)


def tasks(name: str, sensor: str, noise_m: float, *, count: int, seed: int, config: Config) -> Iterator[Task]:
    """`count` true pairs of a scene, then as many false ones, half of them of the scene and another one of its kind."""
    rng = np.random.default_rng([seed, 9])
    here, elsewhere = (Place(SCENES[name](other), sensor, noise_m, other, config) for other in (seed, seed + ELSEWHERE))

    def task(place: Place, source: int, target: int, *, is_true: bool) -> Task:
        first, second = int(rng.integers(2)), int(rng.integers(2)) + 2
        T_true = geometry.inverse(here.pose(target, second)) @ place.pose(source, first)
        T_near = T_true if is_true else _beside(here.scene, source, target, rng, is_same=place is here)
        gate = _gate(_drifted(T_near, rng), config)
        scans = place.prepared(source, first), here.prepared(target, second)
        return Task(name, sensor, *scans, T_true if place is here else None, is_true, gate)

    for source, target in common.draw_pairs(_pairs(here.scene, are_true=True), count, rng):
        yield task(here, source, target, is_true=True)
    for number, (source, target) in enumerate(common.draw_pairs(_pairs(here.scene, are_true=False), count, rng)):
        place = here if number % 2 else elsewhere
        yield task(place, source % len(place.scene.path), target, is_true=False)


def _pairs(scene: Scene, *, are_true: bool) -> np.ndarray:
    """Which rows of the path are within reach of each other on one level; or at other levels, or far apart."""
    steps = scene.path[:, None, :3] - scene.path[:, :3]
    climb = np.abs(steps[..., 2])
    if are_true:
        return (np.linalg.norm(steps, axis=-1) < scene.max_shift_m) & (climb < 0.5)
    return (np.linalg.norm(steps[..., :2], axis=-1) > 2.5 * scene.max_shift_m) | (climb > 1.0)


def _gate(T_prior: Transform, config: Config) -> Gate:
    """The gate of a run whose odometry errs as much as it tolerates."""
    sigmas = np.array([*np.radians([DRIFT_DEG] * 3), DRIFT_M, DRIFT_M, HEIGHT_M]) / config.graph.error_allowance
    return prior_gate(LoopCandidate(1, 0, T_prior, geometry.distance(T_prior), np.diag(sigmas**2)), config)


def _drifted(T_target_source: Transform, rng: np.random.Generator) -> Transform:
    """A pose as odometry would give it after a loop."""
    drift = rng.normal(scale=[DRIFT_M, DRIFT_M, HEIGHT_M])
    turn = geometry.yaw(math.radians(rng.normal(scale=DRIFT_DEG)))
    return geometry.transform(np.eye(3), drift) @ T_target_source @ geometry.transform(turn, 0.0)


def _beside(scene: Scene, source: int, target: int, rng: np.random.Generator, *, is_same: bool) -> Transform:
    """A pose near the target's, as if the places of a false pair lay side by side; storeys of one scene keep theirs."""
    T_near = geometry.transform(geometry.yaw(rng.choice([0.0, np.pi])), [*rng.uniform(-4.0, 4.0, 2), 0.0])
    if is_same:
        T_near[2, 3] = scene.path[source, 2] - scene.path[target, 2]
    return T_near


def bench(name: str, sensor: str, noise_m: float, *, count: int, seed: int, config: Config) -> dict[str, object]:
    """A row of the table."""
    started = time.perf_counter()
    true, overlapping, false = Counter[str](), Counter[str](), Counter[str]()
    for task in tasks(name, sensor, noise_m, count=count, seed=seed, config=config):
        found = register_prepared(task.source, task.target, config=config, gate=task.gate)
        verdict = common.verdict(found, task.T_target_source)
        (true if task.is_true else false)[verdict] += 1
        if task.overlap > 0.4:
            overlapping[verdict] += 1
    return {
        **{"scene": name, "sensor": sensor, "noise_m": noise_m},
        **{"overlapping": overlapping.total(), "kept": overlapping["right"], "lost": _reasons(overlapping)},
        **{"accepted_wrong": true["wrong"], "false_accepted": false["wrong"], "rejected": _reasons(false)},
        "seconds": round(time.perf_counter() - started, 1),
    }


def _reasons(verdicts: Counter[str]) -> dict[str, int]:
    return {verdict: number for verdict, number in verdicts.items() if verdict not in ("right", "wrong")}


def main() -> None:
    parser = common.parser(__doc__, "scenes")
    parser.add_argument("--pairs", type=int, default=200, help="true ones, and as many false ones")
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--sensors", default=",".join(SENSORS))
    parser.add_argument("--noise", default="0.01,0.03,0.1")
    parser.add_argument("--seed", type=int, default=1)
    common.add_settings(parser)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    rows = []
    for name in options.scenes.split(","):
        for sensor in options.sensors.split(","):
            for noise_m in map(float, options.noise.split(",")):
                row = bench(name, sensor, noise_m, count=options.pairs, seed=options.seed, config=config)
                rows.append(row)
                print(" | ".join(str(value) for value in row.values()), flush=True)
                common.write_report(options.out, {"seed": options.seed, "rows": rows})
    total = {
        key: sum(int(str(row[key])) for row in rows)
        for key in ("overlapping", "kept", "accepted_wrong", "false_accepted")
    }
    print(total)


if __name__ == "__main__":
    main()
