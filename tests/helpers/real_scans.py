"""Real scans as their files hold them: no vertical-angle correction, labels as the authors' network predicted them."""

from pathlib import Path

import numpy as np

PREDICTED = (0, 20, 30, 4413)
"""Scans of KITTI 00 with predicted labels."""


def raw_scan(data_dir: Path, index: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float32 points and (n,) uint8 learning ids."""
    sequence = data_dir / "kitti" / "sequences" / "00"
    points = np.fromfile(sequence / "velodyne" / f"{index:06d}.bin", np.float32).reshape(-1, 4)[:, :3]
    labels = np.fromfile(sequence / "predicted_labels" / f"{index:06d}.label", np.uint32)
    return points, (labels + 1).astype(np.uint8)
