"""Map the scans of a folder, look at each step, and keep the trajectory.

python docs/examples/map_scans.py FOLDER poses.txt
"""

import sys
from pathlib import Path

import segslam
from segslam.trajectory import write_tum
from segslam.types import LoopClosure

folder, out = sys.argv[1:]
slam = segslam.Slam(segslam.load_config(overrides=["keyframes.distance_m=1.5"]))
for scan in segslam.open_dataset(folder):
    step = slam.process(scan)
    for attempt in step.attempts:
        if isinstance(attempt.outcome, LoopClosure):
            print(f"scan {scan.index} closes a loop: overlap {attempt.outcome.alignment.overlap:.2f}")
result = slam.finish()
write_tum(Path(out), result.trajectory.stamp_ns, result.trajectory.T_world_lidar)
print(f"{len(result.trajectory)} poses in {out}")
