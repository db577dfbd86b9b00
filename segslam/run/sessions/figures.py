"""Figures of `metrics.json` that only runs of several sessions have."""

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from segslam.core.errors import brief
from segslam.core.trajectory import travelled_m
from segslam.core.types import REJECTED_WEIGHT, SegslamError
from segslam.slam.slam import SlamResult


class Part(NamedTuple):
    """A session in a merged run."""

    first_keyframe: int
    num_scans: int


def parts_in(text: str) -> list[Part]:
    """The sessions in the options of a log; none if it is not of merged runs. Raises SegslamError if it is damaged."""
    try:
        return [Part(int(row["first_keyframe"]), int(row["num_scans"])) for row in json.loads(text or "[]")]
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise SegslamError(f"sessions of the log: {brief(text)} cannot be read; merge the runs again") from error


def figures_of(sessions: Sequence[Part], result: SlamResult) -> dict[str, Any]:
    """The figures of a merged run, and its length without the way from one session to the next.

    A session may be a merged run itself, whose own sessions begin with such motions.
    """
    first_ids = [session.first_keyframe for session in sessions[1:]]
    between = [
        weight
        for ids, weight in result.estimate.closure_weights.items()
        if len(set(np.searchsorted(first_ids, ids, side="right").tolist())) > 1
    ]
    ends = np.cumsum([session.num_scans for session in sessions])
    begun = np.unique([*ends[:-1], *result.begun]).astype(np.int64)
    T_world_lidar = result.trajectory.T_world_lidar
    return {
        "num_sessions": len(sessions),
        "length_m": float(travelled_m(T_world_lidar, begun)[-1]),
        "num_loops_between": len(between),
        "num_loops_between_switched_off": sum(weight < REJECTED_WEIGHT for weight in between),
    }
