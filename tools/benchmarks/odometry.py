"""Odometry alone, without checks and loops: error and time of KISS-ICP by voxel size, and of small_gicp's voxel map.

    python -m tools.benchmarks.odometry SCANS [--sequence 06] [--frames 0:300] [--voxels 1,1.5,2] [--out odometry.json]

Times are those of one thread, as processor time, so that other work on the machine changes them little.
"""

from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import small_gicp

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.evaluation import trajectory_metrics
from segslam.core.types import Points, SegslamError, Transform
from segslam.odometry.aligner import KissAligner
from segslam.odometry.kiss import kiss_config
from segslam.odometry.sweep import deskew_scan
from segslam.scans import Dataset, open_dataset
from tools.benchmarks import common

GICP_VOXEL_M, THINNED_M, REACH_M = 1.0, 0.25, 2.0
"""Voxels of the Gaussians, voxels of the scans, and largest distance of correspondences: small_gicp's own example, with
a wider reach for fast motions."""


Align = Callable[[Points, Transform], Transform]
"""Points of a sweep, and its probable motion since the last -> T_odom_lidar of the sweep."""


class VoxelMap:
    """Scan to a map of Gaussians (VGICP), predicted by the last motion."""

    def __init__(self) -> None:
        self._map = small_gicp.GaussianVoxelMap(GICP_VOXEL_M)
        self._T_odom_lidar = np.eye(4)

    def align(self, points: Points, T_last_predicted: Transform) -> Transform:
        """T_odom_lidar of the next sweep; the map gets its points."""
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=THINNED_M, num_threads=1)
        if len(self._map):
            T_odom_predicted = self._T_odom_lidar @ T_last_predicted
            found = small_gicp.align(
                self._map, cloud, T_odom_predicted, max_correspondence_distance=REACH_M, max_iterations=30
            )
            self._T_odom_lidar = np.array(found.T_target_source)
        self._map.insert(cloud, self._T_odom_lidar)
        return self._T_odom_lidar


def measured(name: str, align: Align, scans: Dataset, config: OdometryConfig) -> common.Row:
    """A row of the table. Raises SegslamError if the true poses are unknown."""
    if scans.reference is None:
        raise SegslamError(f"{scans.name}: has no true poses; give a data set with poses.txt")
    poses, times_ms = [np.eye(4)], list[float]()
    for row in range(len(scans)):
        T_last_lidar = geometry.inverse(poses[-2]) @ poses[-1] if len(poses) > 1 else np.eye(4)
        points, _, _ = deskew_scan(scans[row], T_last_lidar, config)
        started = process_time()
        poses.append(align(points, T_last_lidar))
        times_ms.append(1000 * (process_time() - started))
    errors = trajectory_metrics(np.stack(poses[1:]), scans.reference.T_world_lidar)
    return {
        "odometry": name,
        "ate_m": round(errors["ate_m"], 3),
        "median_ms": round(float(np.median(times_ms)), 1),
        "p95_ms": round(float(np.percentile(times_ms, 95)), 1),
    }


def main() -> None:
    parser = common.parser(__doc__, "odometry")
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence", default=None)
    parser.add_argument("--frames", default=None)
    parser.add_argument("--voxels", default="1,1.5,2", help="voxel sizes of KISS-ICP (m)")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    choose = {} if options.sequence is None else {"sequence": options.sequence}
    scans = open_dataset(options.data, frames=options.frames, labels="none", **choose)
    config = OdometryConfig(max_num_threads=1)
    aligners: dict[str, Align] = {
        f"KISS-ICP, {size} m": KissAligner(kiss_config(config.model_copy(update={"voxel_size_m": float(size)}))).align
        for size in options.voxels.split(",")
    }
    aligners["small_gicp VGICP"] = VoxelMap().align
    rows = [measured(name, align, scans, config) for name, align in aligners.items()]
    print(common.markdown(f"{options.data.name}, {len(scans)} scans", rows))
    if options.out:
        common.write_report(options.out, {"rows": rows})


if __name__ == "__main__":
    main()
