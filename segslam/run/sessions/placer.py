"""Places the keyframes of a drive in an existing map: the first without initial guess, then by tracking.

A location without initial guess is accepted if it is consistent, by odometry, with a second one or with the last
placement. From then on each keyframe is registered with the nearest keyframes of the map, starting at the pose that
odometry predicts, and verified. If that fails for some metres, or after a break of the odometry, the place is searched
again without initial guess.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import islice

import numpy as np

from segslam.candidates.places import OTHER_PLACE_M, SAME_PLACE_M
from segslam.candidates.proximity import MAX_CANDIDATES
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import LoopCandidate, Placement, Rejected, RejectReason, Transform
from segslam.graph import AnchoredGraph
from segslam.graph.chains import far_from_prior
from segslam.graph.motions import PLACE_M
from segslam.keyframes import Submaps
from segslam.registration import refinement
from segslam.registration.prepared import Observed
from segslam.run.locator import Locator
from segslam.slam.recognition import spread
from segslam.slam.slam_result import TRUSTED_M
from segslam.verification.patches import agreement
from segslam.verification.trial import MAX_COARSE_FINE_M, Found, judged

NUM_PREPARED = 64


class Placer:
    """Replaces the loop closer in a drive that is localised; the calls come in the same order."""

    def __init__(self, config: Config, locator: Locator, graph: AnchoredGraph, submaps: Submaps) -> None:
        """`submaps` provides the keyframes of the drive, which are in the graph."""
        self._config, self._locator, self._graph, self._submaps = config, locator, graph, submaps
        self._T_world_map = locator.session.T_world_keyframe
        self._map_seen: Callable[[int], Observed] = lru_cache(NUM_PREPARED)(locator.submaps.observed)
        self._last: Placement | None = None
        """The newest placed keyframe."""
        self._found: list[Placement] = []
        """Locations that are not yet confirmed."""
        self._searched_m = -np.inf

    def place(self, keyframe_id: int, watch: Stopwatch) -> tuple[tuple[Placement, ...], Rejected | None]:
        """Placements of a keyframe and possibly earlier ones; or the reason why this keyframe is not placed."""
        travel_m = self._graph.travel_m
        why = Rejected(RejectReason.NO_PLACE, "not found yet")
        since_m = np.inf if self._last is None else travel_m[keyframe_id] - travel_m[self._last.keyframe_id]
        if self._last is not None and self._is_tracked(self._last.keyframe_id, keyframe_id):
            tracked = self._tracked(keyframe_id, watch)
            if isinstance(tracked, Placement):
                return self._taken((tracked,)), None
            why = tracked
        if since_m < TRUSTED_M or travel_m[keyframe_id] - self._searched_m < SAME_PLACE_M:
            return (), why
        self._searched_m = travel_m[keyframe_id]
        with watch("locate"):
            submap = self._submaps.submap(keyframe_id)
            found = self._locator.locate(submap.points, submap.labels)
        if isinstance(found, Rejected):
            return (), found
        fine, target_id = found.alignment.fine, found.keyframe_id
        place = Placement(keyframe_id, target_id, found.T_world_lidar, fine.information, found.alignment, is_found=True)
        return self._confirmed(place)

    def _tracked(self, keyframe_id: int, watch: Stopwatch) -> Placement | Rejected:
        """The keyframe registered with the nearest ones of the map, starting at the odometry's prediction."""
        assert self._last is not None
        T_world_predicted = self._last.T_world_keyframe @ self._motion(self._last.keyframe_id, keyframe_id)
        apart_m = np.linalg.norm(self._T_world_map[:, :3, 3] - T_world_predicted[:3, 3], axis=1)
        outcome: Placement | Rejected = Rejected(RejectReason.NO_PLACE, f"{apart_m.min():.0f} m from the map")
        with watch("prepare"):
            own = self._submaps.observed(keyframe_id)
        near = np.argsort(apart_m)[: np.count_nonzero(apart_m <= OTHER_PLACE_M)].tolist()
        for target_id in islice(spread(near, self._T_world_map.__getitem__, SAME_PLACE_M), MAX_CANDIDATES):
            outcome = self._registered(keyframe_id, own, target_id, T_world_predicted, watch)
            if isinstance(outcome, Placement):
                break
        return outcome

    def _registered(
        self, keyframe_id: int, own: Observed, target_id: int, T_world_predicted: Transform, watch: Stopwatch
    ) -> Placement | Rejected:
        with watch("prepare"):
            target = self._map_seen(target_id)
        T_world_target = self._T_world_map[target_id]
        T_target_predicted = geometry.inverse(T_world_target) @ T_world_predicted
        with watch("refine"):
            fine = refinement.refine(
                own.surface, target.surface, T_target_predicted, config=self._config.refine, must_converge=False
            )
        if isinstance(fine, Rejected):
            return fine
        moved_m = geometry.distance(geometry.inverse(T_target_predicted) @ fine.T_target_source)
        if moved_m > MAX_COARSE_FINE_M:
            return Rejected(RejectReason.REFINEMENT_DIVERGED, f"moved {moved_m:.2f} m > {MAX_COARSE_FINE_M} m")
        T_world_keyframe = T_world_target @ fine.T_target_source
        assert self._last is not None
        contradiction = self._contradiction(self._last, keyframe_id, T_world_keyframe)
        if contradiction is not None:
            return contradiction
        with watch("verify"):
            found = agreement(own, target, fine.T_target_source)
        coarse = replace(fine, T_target_source=T_target_predicted, num_inliers=0, num_correspondences=0)
        alignment = judged(Found(coarse, fine, found), None, config=self._config)
        if isinstance(alignment, Rejected):
            return alignment
        return Placement(keyframe_id, target_id, T_world_keyframe, fine.information, alignment, is_found=False)

    def _confirmed(self, found: Placement) -> tuple[tuple[Placement, ...], Rejected | None]:
        """The location with an earlier one that is consistent with it; it waits if there is none."""
        if self._last is not None and self._agree(self._last, found, np.inf):
            return self._taken((found,)), None
        for earlier in reversed(self._found):
            if self._agree(earlier, found, PLACE_M):
                return self._taken((earlier, found)), None
        self._found.append(found)
        return (), Rejected(RejectReason.UNCONFIRMED, "found, but not yet confirmed by another keyframe")

    def _agree(self, earlier: Placement, later: Placement, within_m: float) -> bool:
        """True if odometry leads from one location to the other, over less than this travel."""
        if not self._is_tracked(earlier.keyframe_id, later.keyframe_id):
            return False
        travel_m = self._graph.travel_m
        if travel_m[later.keyframe_id] - travel_m[earlier.keyframe_id] >= within_m:
            return False
        return self._contradiction(earlier, later.keyframe_id, later.T_world_keyframe) is None

    def _is_tracked(self, earlier_id: int, later_id: int) -> bool:
        """True if no break separates two keyframes."""
        return bool(self._graph.num_breaks[earlier_id] == self._graph.num_breaks[later_id])

    def _contradiction(self, earlier: Placement, keyframe_id: int, T_world_keyframe: Transform) -> Rejected | None:
        """Rejects a pose that contradicts an earlier placement and the odometry since."""
        T_earlier_later = self._motion(earlier.keyframe_id, keyframe_id)
        (covariance,) = self._graph.covariances(keyframe_id, np.array([earlier.keyframe_id]))
        moved_m = geometry.distance(T_earlier_later)
        prior = LoopCandidate(keyframe_id, earlier.keyframe_id, T_earlier_later, moved_m, covariance)
        T_earlier_found = geometry.inverse(earlier.T_world_keyframe) @ T_world_keyframe
        return far_from_prior(T_earlier_found, prior, self._config.graph)

    def _taken(self, placements: tuple[Placement, ...]) -> tuple[Placement, ...]:
        for placement in placements:
            self._graph.place(placement)
        self._last, self._found = placements[-1], []
        return placements

    def _motion(self, earlier_id: int, later_id: int) -> Transform:
        return geometry.inverse(self._submaps.T_odom[earlier_id]) @ self._submaps.T_odom[later_id]
