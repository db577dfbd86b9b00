"""The University of Michigan North Campus dataset (Carlevaris-Bianco et al., IJRR 2016): its folder of one day.

kiss_icp's reader finds the scans with true poses and these poses. Its points wrap from 63.84 m on, because it reads
numbers without sign as numbers with one, and it gives no stamps to its users.
"""

from pathlib import Path

import numpy as np
from kiss_icp.datasets.nclt import NCLTDataset

from segslam.core.types import Vector
from segslam.scans.dataset import Cloud

HIT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
SCALE_M, OFFSET_M = 0.005, -100.0
"""Those of the dataset's own `read_vel_sync.py`."""


class NcltDay(NCLTDataset):
    """The scans of `velodyne_sync/` within the time of the true poses, which are in `../ground_truth/`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.scan_files: list[Path] = [folder / "velodyne_sync" / name for name in self.scan_files]

    def __getitem__(self, index: int) -> Cloud:
        """The points with z up. Raises ValueError for a truncated file."""
        hits = np.frombuffer(self.scan_files[index].read_bytes(), HIT)
        points = SCALE_M * np.column_stack([hits["x"], hits["y"], hits["z"]]) + OFFSET_M
        return Cloud(points * [1.0, -1.0, -1.0], intensities=hits["intensity"].astype(np.float32))

    def get_frames_timestamps(self) -> Vector:
        """(n,) seconds since 1970."""
        return 1e-6 * self.timestamps
