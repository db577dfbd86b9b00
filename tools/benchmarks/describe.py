"""What a description costs and how well it repeats: time, size, and clusters that two scans agree on. Writes JSON.

    python -m tools.benchmarks.describe DATA [--set segregator.foot_classes=[] ...] --out FILE

DATA is the folder of real data: `kitti/` with predicted labels of scans 0, 20, 30 and 4413 and `reference_pairs.json`,
and `courtyard/`, which gets its labels from shape and has few clusters. Times are of the process, which other
processes disturb less than the wall's; the time Open3D takes for the features alone stands beside them.
"""

import argparse
import dataclasses
import json
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from segslam import geometry
from segslam.config import Config, SegregatorConfig, load_config
from segslam.datasets import open_dataset
from segslam.points import voxel_means
from segslam.segregator import describe
from segslam.semantics import geometric_labels
from segslam.types import Description, Label, Labels, Points

PREDICTED = (0, 20, 30, 4413)
COURTYARD = (0, 25, 50, 75)
REPEATS = 21
NEAR_M = (0.2, 0.4)
Scans = dict[int, tuple[Points, Labels]]


def kitti_scans(data: Path) -> Scans:
    dataset = open_dataset(data / "kitti", sequence="00", labels="predicted_labels")
    return {scan.index: (scan.points, scan.labels) for scan in dataset if scan.index in PREDICTED}


def courtyard_scans(data: Path, config: Config) -> Scans:
    scans = {}
    for index in COURTYARD:
        file = data / "courtyard" / "velodyne" / f"{index:06d}.bin"
        points = np.fromfile(file, np.float32).reshape(-1, 4)[:, :3]
        scans[index] = (points, geometric_labels(points, config=config.geometric))
    return scans


def milliseconds(work: Callable[[], object]) -> dict[str, float]:
    """Median and 95th percentile of the process's time."""
    work()
    seconds = []
    for _ in range(REPEATS):
        started = time.process_time()
        work()
        seconds.append(time.process_time() - started)
    return {"median_ms": round(1e3 * float(np.median(seconds)), 1), "p95_ms": round(1e3 * _p95(seconds), 1)}


def open3d_features(points: Points, labels: Labels, config: SegregatorConfig) -> None:
    """Voxels, normals and FPFH of the same classes at the same scale."""
    for label in config.feature_classes:
        cloud = o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(voxel_means(points[labels == label], config.feature_voxel_m))
        )
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(config.normal_radius_m))
        o3d.pipelines.registration.compute_fpfh_feature(
            cloud, o3d.geometry.KDTreeSearchParamRadius(config.feature_radius_m)
        )


def cost(scans: Scans, config: SegregatorConfig) -> dict[int, dict[str, Any]]:
    """Of each scan: what its description holds and takes, as configured and with features always."""
    always = config.model_copy(update={"features": "always"})
    results = {}
    for index, scan in scans.items():
        described = describe(*scan, config=config)
        results[index] = {
            "num_points": len(scan[0]),
            "num_clusters": len(described.means),
            "num_features": len(described.feature_points),
            "kilobytes": round(num_bytes(described) / 1e3, 1),
            "kilobytes_with_features": round(num_bytes(describe(*scan, config=always)) / 1e3, 1),
            "describe": milliseconds(lambda scan=scan: describe(*scan, config=config)),
            "describe_with_features": milliseconds(lambda scan=scan: describe(*scan, config=always)),
            "open3d_features": milliseconds(lambda scan=scan: open3d_features(*scan, config)),
        }
    return results


def num_bytes(description: Description) -> int:
    return sum(getattr(description, field.name).nbytes for field in dataclasses.fields(description))


def repeatability(data: Path, scans: Scans, config: SegregatorConfig) -> dict[str, dict[str, float]]:
    """By class: clusters a scan, and how many lie near one of the class in the other scan, over the reference pairs."""
    described = {index: describe(*scan, config=config) for index, scan in scans.items()}
    rows = json.loads((data / "kitti" / "reference_pairs.json").read_text())
    pairs = [row for row in rows if row["source"] in scans and row["target"] in scans]
    counts: dict[str, np.ndarray] = {}
    for row in pairs:
        source, target = described[row["source"]], described[row["target"]]
        moved = geometry.apply(np.array(row["T_target_source"]), source.means)
        for label in np.unique(source.classes):
            nearest = _nearest(moved[source.classes == label], target.means[target.classes == label])
            found = np.array([len(nearest), *((nearest < near_m).sum() for near_m in NEAR_M)])
            counts[Label(label).name.lower()] = counts.get(Label(label).name.lower(), 0) + found
    names = ("clusters", *(f"within_{near_m}_m" for near_m in NEAR_M))
    return {
        label: dict(zip(names, (found / len(pairs)).round(2).tolist(), strict=True)) for label, found in counts.items()
    }


def _nearest(points: Points, others: Points) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1, initial=np.inf)


def _p95(seconds: list[float]) -> float:
    return float(np.percentile(seconds, 95))


def _commit() -> str:
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(options.config, options.set)
    kitti = kitti_scans(options.data)
    results = {
        "machine": f"{platform.processor() or platform.machine()}, Python {platform.python_version()}",
        "commit": _commit(),
        "config": config.segregator.model_dump(mode="json"),
        "repeatability": repeatability(options.data, kitti, config.segregator),
        "kitti": cost(kitti, config.segregator),
        "courtyard": cost(courtyard_scans(options.data, config), config.segregator),
    }
    options.out.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    print(json.dumps({key: results[key] for key in ("repeatability", "kitti", "courtyard")}, indent=2))


if __name__ == "__main__":
    main()
