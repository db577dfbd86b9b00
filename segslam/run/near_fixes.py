"""Loops that position fixes propose: keyframes that are near each other on the globe and far apart along the drive."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from segslam.candidates.proximity import MIN_GAP_M
from segslam.core.config import ProximityConfig
from segslam.core.trajectory import travelled_m
from segslam.core.types import LoopClosure, SegslamError, Vector
from segslam.output.finished import read_run
from segslam.output.folder import folder_of
from segslam.output.georeferenced import FILE, read_globe
from segslam.slam.loop_edits import Pair


def pairs_near_fixes(run_or_log: Path) -> frozenset[Pair]:
    """Loops of a georeferenced run that were not tried. Raises SegslamError if it has no place on the globe."""
    run = read_run(folder_of(run_or_log))
    globe = read_globe(run.folder)
    if globe is None:
        raise SegslamError(f"{run.folder / FILE}: missing; `segslam georeference` the run first")
    rows, attempts = run.result.keyframe_rows, run.result.attempts
    loops = [(one.outcome.source_id, one.outcome.target_id) for one in attempts if isinstance(one.outcome, LoopClosure)]
    tried = {(one.candidate.source_id, one.candidate.target_id) for one in attempts}
    travel_m = travelled_m(run.result.odometry.T_world_lidar)[rows]
    return pairs_near(globe.T_enu_lidar[rows, :2, 3], travel_m, loops, tried, config=run.config.proximity)


def pairs_near(
    east_north_m: Float[np.ndarray, "n 2"],
    travel_m: Vector,
    loops: Collection[Pair],
    tried: Collection[Pair],
    *,
    config: ProximityConfig,
) -> frozenset[Pair]:
    """For keyframes `min_gap_m` apart the nearest older one within `base_radius_m`, the radius without drift.

    None where a loop joins the two places already, and no pair that was tried.
    """
    tree, pairs, last_m = cKDTree(east_north_m), set[Pair](), -np.inf
    ends_m = travel_m[np.array(list(loops), np.int64).reshape(-1, 2)]
    for newer, place in enumerate(east_north_m):
        near = np.array(tree.query_ball_point(place, config.base_radius_m), np.int64)
        near = near[travel_m[near] <= travel_m[newer] - config.min_travel_m]
        if not len(near) or travel_m[newer] - last_m < MIN_GAP_M:
            continue
        older = int(near[np.linalg.norm(east_north_m[near] - place, axis=1).argmin()])
        is_joined = (np.abs(ends_m - travel_m[[newer, older]]) < MIN_GAP_M + config.base_radius_m).all(axis=1)
        if not is_joined.any() and (newer, older) not in tried:
            pairs.add((newer, older))
            last_m = travel_m[newer]
    return frozenset(pairs)
