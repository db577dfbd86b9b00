"""Measure the error of a trajectory against ground truth, both in KITTI format, as `segslam eval` does.

python docs/examples/score_trajectory.py poses_kitti.txt kitti/poses/00.txt
"""

import sys
from pathlib import Path

from segslam.core.evaluation import UP, trajectory_metrics, upward_axis
from segslam.core.pose_files import read_poses

if len(sys.argv) != 3:
    sys.exit(__doc__)

estimate, reference = (read_poses(Path(file), format="kitti") for file in sys.argv[1:])
up = UP[upward_axis(reference.T_a_b) or "-y"]  # -y: in the files of KITTI the camera's y points down
figures = trajectory_metrics(estimate.T_a_b, reference.T_a_b, up=up)
for name, value in figures.items():
    print(f"{name:30} {value:.4f}")
