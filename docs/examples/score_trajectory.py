"""Measure the error of a trajectory against ground truth, both in KITTI format, as `segslam eval` does.

python docs/examples/score_trajectory.py poses_kitti.txt kitti/poses/00.txt
"""

import sys
from pathlib import Path

from segslam.evaluation import trajectory_metrics
from segslam.trajectory import read_poses

if len(sys.argv) != 3:
    sys.exit(__doc__)

estimate, reference = (read_poses(Path(file), format="kitti") for file in sys.argv[1:])
figures = trajectory_metrics(estimate.T_a_b, reference.T_a_b, up=(0.0, -1.0, 0.0))  # the camera's y points down
for name, value in figures.items():
    print(f"{name:30} {value:.4f}")
