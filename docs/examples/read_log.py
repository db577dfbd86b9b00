"""Read the log of a run: outcomes of its loop candidates, and the cloud of one keyframe in the world.

python docs/examples/read_log.py RUN
"""

import sys
from collections import Counter
from pathlib import Path

from segslam.core import geometry
from segslam.core.types import Rejected
from segslam.output.log import read_log

if len(sys.argv) != 2:
    sys.exit(__doc__)

log = read_log(Path(sys.argv[1]) / "log.mcap")
outcomes = Counter[str]()
keyframes = []
for step in log.steps():
    for attempt in step.attempts:
        outcome = attempt.outcome
        outcomes[outcome.reason.value if isinstance(outcome, Rejected) else "accepted"] += 1
    if step.keyframe is not None:
        keyframes.append(step.keyframe)
print(dict(outcomes))

result = log.result()
if result is None:
    sys.exit("the run did not finish")
estimate, trajectory = result
last = keyframes[-1]
points = geometry.apply(estimate.T_world_keyframe[last.id], last.points)
print(f"{len(trajectory)} scans; keyframe {last.id} has {len(points)} points around {points.mean(axis=0).round(1)}")
