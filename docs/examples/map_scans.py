"""Map the scans of a folder, examine each step, and write the trajectory.

python docs/examples/map_scans.py FOLDER poses.txt
"""

import sys

import segslam
from segslam.core.types import LoopClosure

if len(sys.argv) != 3:
    sys.exit(__doc__)

folder, out = sys.argv[1:]
slam = segslam.Slam(segslam.load_config(overrides=["keyframes.distance_m=1.5"]))
for scan in segslam.open_dataset(folder):
    try:
        step = slam.process(scan)
    except segslam.BadScan as error:
        print(f"skipped: {error}")
        continue
    for attempt in step.attempts:
        if isinstance(attempt.outcome, LoopClosure):
            print(f"scan {scan.index} closes a loop: overlap {attempt.outcome.alignment.overlap:.2f}")
result = slam.finish()
result.to_tum(out)
print(f"{len(result.trajectory)} poses in {out}")
