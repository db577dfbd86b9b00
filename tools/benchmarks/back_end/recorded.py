"""Runs of `segslam map` as drives: keyframes, true poses and closures from the log, without scans."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.evaluation import loop_metrics
from segslam.core.types import Keyframe, LoopClosure, Points, SegslamError
from segslam.graph.closure_pairs import adjoints
from segslam.graph.noise import DEGREES_OF_FREEDOM, closure_information, odometry_information
from segslam.output.log import read_log
from tools.benchmarks.back_end.drives import CONFIG, Drive, exact_closure

REACH_M = 6.0
SPACING_M = 6.0
REVISIT_M = 50.0
LENGTHS = (1, 10, 100)
"""Lengths of chains in keyframes."""


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


def odometry_calibration(drive: Drive) -> dict[str, float | None]:
    """Mean chi-square of odometry chains of each length; None if the drive is shorter."""
    summed = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(_carried(drive), axis=0)])
    back = adjoints(np.linalg.inv(drive.odometry))
    found: dict[str, float | None] = {}
    for length in LENGTHS:
        chi2 = [
            _chi2(
                geometry.inverse(drive.odometry[start]) @ drive.odometry[start + length],
                geometry.inverse(drive.truth[start]) @ drive.truth[start + length],
                np.linalg.inv(back[start + length] @ (summed[start + length] - summed[start]) @ back[start + length].T),
            )
            for start in range(len(drive.truth) - length)
        ]
        found[f"chain_{length}"] = float(np.mean(chi2)) if chi2 else None
    return found


def closure_calibration(drive: Drive, closures: Iterable[LoopClosure]) -> float | None:
    """Mean chi-square of closures with the weights of the graph; None without closures."""
    chi2 = [
        _chi2(
            loop.T_target_source,
            geometry.inverse(drive.truth[loop.target_id]) @ drive.truth[loop.source_id],
            closure_information(loop.information),
        )
        for loop in closures
    ]
    return float(np.mean(chi2)) if chi2 else None


def _carried(drive: Drive) -> np.ndarray:
    """(n - 1, 6, 6) covariances of the edges in the odometry's frame."""
    motions = np.linalg.inv(drive.odometry[:-1]) @ drive.odometry[1:]
    information = [
        odometry_information(way_m, T_a_b, CONFIG.graph)
        for way_m, T_a_b in zip(np.diff(drive.travel_m), motions, strict=True)
    ]
    turns = adjoints(drive.odometry[1:])
    return turns @ np.linalg.inv(np.array(information)) @ turns.transpose(0, 2, 1)


def _chi2(T_found: np.ndarray, T_true: np.ndarray, information: np.ndarray) -> float:
    error = geometry.log(geometry.inverse(T_true) @ T_found)
    return float(error @ information @ error) / DEGREES_OF_FREEDOM
