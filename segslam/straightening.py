"""The end of a drive whose scans have angles left over: odometry turned back, closures found again on corrected scans.

Closures err by those angles too: on simulated 05, 06 and 08 their heights by 2 to 5 cm, which corrected scans leave at
one.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from segslam import refine
from segslam.beam_angles import corrected, sample_angles
from segslam.beside import both
from segslam.config import RefineConfig
from segslam.pose_graph import PoseGraph, angles_along, judge
from segslam.types import AngleSamples, DriftEvidence, LoopClosure, Points, Rejected, Vector

PointsOf = Callable[[int], Points]
"""The points of a keyframe, by id, in its own frame."""


def straighten(
    graph: PoseGraph,
    closures: Iterable[LoopClosure],
    samples: AngleSamples,
    points_of: PointsOf,
    *,
    config: RefineConfig,
) -> DriftEvidence:
    """Turn back in the graph what leftover angles bent, if stretches that are held out show that they did.

    `closures` are those of the graph. It takes effect with the next optimisation.
    """
    evidence = judge(samples)
    if evidence.chosen:
        graph.straighten(samples)
        angles_rad = angles_along(samples, graph.travel_m)
        graph.replace_closures(sharpened(closures, points_of, angles_rad, config=config))
    return evidence


def sample(
    points_of: PointsOf, T_odom_keyframes: Float[np.ndarray, "n 4 4"], travel_m: Vector, *, config: RefineConfig
) -> AngleSamples:
    """What pairs of scans along the drive tell of leftover angles."""

    def surface(keyframe_id: int) -> refine.Surface:
        return refine.prepare(refine.thin(points_of(keyframe_id), config=config), config=config)

    return sample_angles(surface, T_odom_keyframes, travel_m)


def sharpened(
    closures: Iterable[LoopClosure],
    points_of: PointsOf,
    angles_rad: Float[np.ndarray, "n 2"],
    *,
    config: RefineConfig,
) -> Iterator[LoopClosure]:
    """Each closure refined again from where it is, on scans rid of these angles; as it was where that fails."""

    def surface(keyframe_id: int) -> refine.Surface:
        thinned = refine.thin(points_of(keyframe_id), config=config)
        return refine.prepare(corrected(thinned, angles_rad[keyframe_id]), config=config)

    last_stage = config.model_copy(update={"correspondence_m": config.correspondence_m[-1:]})
    for closure in closures:
        source, target = both(surface, (closure.source_id,), (closure.target_id,))
        found = refine.refine(source, target, closure.T_target_source, config=last_stage)
        if isinstance(found, Rejected):
            yield closure
        else:
            yield replace(closure, T_target_source=found.T_target_source, information=found.information)
