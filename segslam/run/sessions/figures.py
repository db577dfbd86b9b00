"""Figures of `metrics.json` that only runs of several sessions have."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from segslam.core.trajectory import travelled_m
from segslam.core.types import REJECTED_WEIGHT
from segslam.slam.slam import SlamResult


def figures_of(sessions: Sequence[Mapping[str, Any]], result: SlamResult) -> dict[str, Any]:
    """The figures of a merged run, and its length without the way from one session to the next.

    `sessions`: what the log has of each: `num_scans`, and `first_keyframe`, the id of its first keyframe.
    """
    first_ids = [session["first_keyframe"] for session in sessions[1:]]
    between = [
        weight
        for ids, weight in result.estimate.closure_weights.items()
        if len(set(np.searchsorted(first_ids, ids, side="right").tolist())) > 1
    ]
    ends = np.cumsum([session["num_scans"] for session in sessions])
    drives = np.split(result.trajectory.T_world_lidar, ends[:-1])
    return {
        "num_sessions": len(sessions),
        "length_m": sum(float(travelled_m(drive)[-1]) for drive in drives if len(drive)),
        "num_loops_between": len(between),
        "num_loops_between_switched_off": sum(weight < REJECTED_WEIGHT for weight in between),
    }
