"""Runs of `segslam map` as drives: keyframes, true poses and closures from the log, without scans."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.evaluation import loop_metrics
from segslam.core.types import Keyframe, LoopClosure, Points, SegslamError
from segslam.output.log import read_log
from tools.benchmarks.back_end.drives import Drive, exact_closure

REACH_M = 6.0
SPACING_M = 6.0
REVISIT_M = 50.0


@dataclass(frozen=True, eq=False)
class Recorded(Drive):
    """A drive that was mapped, with the closures that were found."""

    keyframes: list[Keyframe]
    closures: list[LoopClosure]

    def points_of(self, keyframe_id: int) -> Points:
        """Points of a keyframe, in its frame."""
        return self.keyframes[keyframe_id].points

    def loops(self) -> dict[str, float]:
        """False closures, and the recall of revisits."""
        pairs = np.array([(loop.source_id, loop.target_id) for loop in self.closures], dtype=int).reshape(-1, 2)
        found = np.array([loop.T_target_source for loop in self.closures]).reshape(-1, 4, 4)
        return {"closures": len(pairs), **loop_metrics(found, pairs, self.truth)}


def read_recorded(run: Path) -> Recorded:
    """Raises SegslamError for a run without true poses."""
    log = read_log(run / "log.mcap")
    reference = log.reference()
    if reference is None:
        raise SegslamError(f"{run}: the log contains no true poses; give a run of data with ground truth")
    row_of_scan = {int(scan): row for row, scan in enumerate(reference.scan_index)}
    steps = list(log.steps())
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    outcomes = [attempt.outcome for step in steps for attempt in step.attempts]
    return Recorded(
        truth=reference.T_world_lidar[[row_of_scan[keyframe.scan_index] for keyframe in keyframes]],
        odometry=np.array([keyframe.T_odom_keyframe for keyframe in keyframes]),
        travel_m=np.array([keyframe.travel_m for keyframe in keyframes]),
        keyframes=keyframes,
        closures=[outcome for outcome in outcomes if isinstance(outcome, LoopClosure)],
    )


def exact_everywhere(drive: Drive) -> list[LoopClosure]:
    """True closures to the nearest older keyframe, for all keyframes with one within reach."""
    closures, last_m = [], -np.inf
    for source, travel_m in enumerate(drive.travel_m):
        old = np.flatnonzero(drive.travel_m < travel_m - REVISIT_M)
        apart_m = np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1)
        if len(old) and apart_m.min() <= REACH_M and travel_m - last_m >= SPACING_M:
            target, last_m = int(old[apart_m.argmin()]), travel_m
            closures.append(exact_closure(source, target, geometry.inverse(drive.truth[target]) @ drive.truth[source]))
    return closures
