"""How good the labels from shape alone are: per class, and by the registrations they make possible. Writes JSON.

    python tools/bench_labels.py DATA [--drive FOLDER:SEQUENCE ...] [--set segregator.dcvc_pitch_deg=2.5] --out FILE

DATA is the folder of real data: `kitti/` with ground-truth labels of scans 0-2 and `reference_pairs.json`, and
`courtyard/`. The numbers of `GeometricLabelsConfig` were chosen on those scans and pairs of KITTI; independent checks
are the courtyard, and drives in KITTI's format with exact poses, such as `segslam simulate` writes.
"""

import argparse
import json
import math
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from segslam import geometry, segregator
from segslam.config import Config, load_config
from segslam.datasets import open_dataset
from segslam.semantics import geometric_labels
from segslam.trajectory import Poses
from segslam.types import GROUND_LABELS, Description, Label, Points, Rejected, Transform

CLASSES = {
    "ground": GROUND_LABELS,
    "car": (Label.CAR, Label.MOVING_CAR),
    "building": (Label.BUILDING,),
    "vegetation": (Label.VEGETATION,),
    "trunk_or_pole": (Label.TRUNK, Label.POLE),
}
DRIVE_BANDS_M = ((3.0, 5.0), (8.0, 10.0), (10.0, 15.0))
DRIVE_MIN_GAP = 50
COURTYARD_BANDS_M = ((5.0, 10.0), (10.0, 15.0))
COURTYARD_MIN_GAP = 40
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0


def class_agreement(data: Path, config: Config) -> dict[str, float]:
    """Intersection over union of each class, over all points of the real scans 0-2 whose truth is known."""
    both, either = dict.fromkeys(CLASSES, 0), dict.fromkeys(CLASSES, 0)
    for scan in open_dataset(data / "kitti", sequence="00", frames="0:3"):
        known = scan.labels != Label.UNLABELLED
        labels, truth = geometric_labels(scan.points, config=config.geometric)[known], scan.labels[known]
        for name, members in CLASSES.items():
            ours, theirs = np.isin(labels, members), np.isin(truth, members)
            both[name] += int((ours & theirs).sum())
            either[name] += int((ours | theirs).sum())
    return {name: round(both[name] / either[name], 4) for name in CLASSES}


def speed(points: Points, config: Config, repeats: int = 21) -> dict[str, float]:
    """Milliseconds to label a scan, by the thread's own clock and by the wall's, and in sorts of as many numbers."""
    keys = np.random.default_rng(0).random(len(points))
    clocks: dict[str, list[float]] = {"thread": [], "wall": [], "sort": []}
    geometric_labels(points, config=config.geometric)
    for _ in range(repeats):
        wall, thread = time.perf_counter(), time.thread_time()
        geometric_labels(points, config=config.geometric)
        clocks["wall"].append(time.perf_counter() - wall)
        clocks["thread"].append(time.thread_time() - thread)
        thread = time.thread_time()
        np.sort(keys)
        clocks["sort"].append(time.thread_time() - thread)
    return {
        "num_points": len(points),
        "thread_ms_median": round(1e3 * float(np.median(clocks["thread"])), 2),
        "thread_ms_p95": round(1e3 * float(np.percentile(clocks["thread"], 95)), 2),
        "wall_ms_median": round(1e3 * float(np.median(clocks["wall"])), 2),
        "thread_in_sorts": round(float(np.median(clocks["thread"]) / np.median(clocks["sort"])), 2),
    }


def describe(points: Points, config: Config) -> Description:
    """The description of a scan by its labels from shape."""
    labels = geometric_labels(points, config=config.geometric)
    return segregator.describe(points, labels, config=config.segregator)


def attempt(source: Description, target: Description, T_true: Transform, config: Config) -> dict[str, Any]:
    """One registration: whether accepted, the error of its coarse pose, inliers, seconds of matching."""
    started = time.perf_counter()
    outcome = segregator.match(source, target, config=config.segregator)
    seconds = time.perf_counter() - started
    if isinstance(outcome, Rejected):
        return {"accepted": False, "success": False, "reason": outcome.reason.value, "seconds": seconds}
    T_error = outcome.T_target_source @ geometry.inverse(T_true)
    error_m, error_deg = geometry.distance(T_error), math.degrees(geometry.angle(T_error))
    return {
        "accepted": True,
        "success": error_m < SUCCESS_M and error_deg < SUCCESS_DEG,
        "error_m": error_m,
        "error_deg": error_deg,
        "inliers": outcome.num_inliers,
        "seconds": seconds,
    }


def summary(attempts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates over all attempts, errors over the successes."""
    good = [row for row in attempts if row["success"]]
    rates: dict[str, Any] = {
        "num": len(attempts),
        "success_percent": round(100 * len(good) / max(len(attempts), 1), 1),
        "num_rejected": sum(not row["accepted"] for row in attempts),
        "num_wrong": sum(row["accepted"] and not row["success"] for row in attempts),
        "match_ms_median": round(1e3 * float(np.median([row["seconds"] for row in attempts])), 1),
        "match_ms_p95": round(1e3 * float(np.percentile([row["seconds"] for row in attempts], 95)), 1),
    }
    if good:
        rates["mean_error_m"] = round(float(np.mean([row["error_m"] for row in good])), 3)
        rates["mean_error_deg"] = round(float(np.mean([row["error_deg"] for row in good])), 3)
        rates["least_inliers"] = min(row["inliers"] for row in good)
    return rates


def kitti_pairs(data: Path, config: Config, num_yaws: int) -> dict[str, Any]:
    """The reference pairs, the source turned by each yaw of a full circle."""
    rows = json.loads((data / "kitti" / "reference_pairs.json").read_text())
    dataset = open_dataset(data / "kitti", sequence="00", labels="none")
    scans = {scan.index: scan.points.astype(np.float64) for scan in dataset}
    targets = {row["target"]: describe(scans[row["target"]], config) for row in rows}
    turns = [geometry.transform(geometry.yaw(2 * math.pi * k / num_yaws), np.zeros(3)) for k in range(num_yaws)]
    attempts: dict[tuple[int, int], list[dict[str, Any]]] = {(row["source"], row["target"]): [] for row in rows}
    for source in sorted({row["source"] for row in rows}):
        for T_turned_source in turns:
            description = describe(geometry.apply(T_turned_source, scans[source]), config)
            for row in rows:
                if row["source"] == source:
                    T_true = np.array(row["T_target_source"]) @ geometry.inverse(T_turned_source)
                    outcome = attempt(description, targets[row["target"]], T_true, config)
                    attempts[source, row["target"]].append(outcome)
    return {
        "num_yaws": num_yaws,
        "pairs": {f"{source}->{target}": summary(done) for (source, target), done in attempts.items()},
        "all": summary([row for done in attempts.values() for row in done]),
    }


def random_pairs(
    T_world_lidar: Poses,
    points_of: Callable[[int], Points],
    bands_m: Sequence[tuple[float, float]],
    min_gap: int,
    *,
    config: Config,
    num_pairs: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """For each band of distances: pairs drawn from a recording, at least `min_gap` scans apart, the source turned."""
    first, second = np.triu_indices(len(T_world_lidar), min_gap)
    distance_m = np.linalg.norm(T_world_lidar[first, :3, 3] - T_world_lidar[second, :3, 3], axis=1)
    describe_once = cache(lambda row: describe(points_of(row), config))
    results = {}
    for low_m, high_m in bands_m:
        rows = np.flatnonzero((distance_m >= low_m) & (distance_m < high_m))
        attempts = []
        for row in rng.choice(rows, min(num_pairs, len(rows)), replace=False):
            source, target = int(first[row]), int(second[row])
            T_turned_source = geometry.transform(geometry.yaw(rng.uniform(0.0, 2 * math.pi)), np.zeros(3))
            description = describe(geometry.apply(T_turned_source, points_of(source)), config)
            T_target_source = geometry.inverse(T_world_lidar[target]) @ T_world_lidar[source]
            T_true = T_target_source @ geometry.inverse(T_turned_source)
            attempts.append(attempt(description, describe_once(target), T_true, config))
        if attempts:
            results[f"{low_m:.0f}-{high_m:.0f} m"] = summary(attempts)
    return results


def drive(name: str, **settings: Any) -> dict[str, Any]:
    """Random pairs of a drive `FOLDER:SEQUENCE` with a reference."""
    folder, _, sequence = name.partition(":")
    dataset = open_dataset(folder, sequence=sequence, labels="none")
    if dataset.reference is None:
        raise SystemExit(f"{folder}: sequence {sequence} has no poses; simulate one, or name one with ground truth")

    def points_of(row: int) -> Points:
        return dataset[row].points.astype(np.float64)

    return random_pairs(dataset.reference.T_world_lidar, points_of, DRIVE_BANDS_M, DRIVE_MIN_GAP, **settings)


def courtyard(data: Path, **settings: Any) -> dict[str, Any]:
    """Random pairs of the handheld recording."""
    poses = np.loadtxt(data / "courtyard" / "poses.txt").reshape(-1, 3, 4)
    T_world_lidar = np.tile(np.eye(4), (len(poses), 1, 1))
    T_world_lidar[:, :3] = poses

    def points_of(row: int) -> Points:
        file = data / "courtyard" / "velodyne" / f"{row:06d}.bin"
        return np.fromfile(file, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)

    return random_pairs(T_world_lidar, points_of, COURTYARD_BANDS_M, COURTYARD_MIN_GAP, **settings)


def _commit() -> str:
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--yaws", type=int, default=24)
    parser.add_argument("--drive", action="append", default=[], metavar="FOLDER:SEQUENCE")
    parser.add_argument("--pairs", type=int, default=60, help="of each band of distances in a drive or the courtyard")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    draw = {"config": config, "num_pairs": options.pairs}
    first = open_dataset(options.data / "kitti", sequence="00", labels="none", frames="0:1")[0]
    results = {
        "machine": f"{platform.processor() or platform.machine()}, Python {platform.python_version()}",
        "commit": _commit(),
        "seed": options.seed,
        "config": config.model_dump(mode="json", include={"geometric", "segregator"}),
        "class_iou": class_agreement(options.data, config),
        "speed": speed(first.points, config),
        "kitti": kitti_pairs(options.data, config, options.yaws),
        "courtyard": courtyard(options.data, **draw, rng=np.random.default_rng(options.seed)),
        "drives": {name: drive(name, **draw, rng=np.random.default_rng(options.seed)) for name in options.drive},
    }
    options.out.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    print(json.dumps({key: results[key] for key in ("class_iou", "speed", "kitti", "courtyard", "drives")}, indent=2))


if __name__ == "__main__":
    main()
