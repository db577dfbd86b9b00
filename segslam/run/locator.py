"""Localisation of single scans in a finished run, without initial guess."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from segslam.candidates import PlaceCandidate, Places, PlaceSignature, signature_of, signatures_around
from segslam.core.config import Config
from segslam.core.errors import SegslamError, brief
from segslam.core.points import within_range
from segslam.core.threads import at_once
from segslam.core.types import Alignment, Found, Labels, Points, Rejected, RejectReason, Transform, as_labels, as_points
from segslam.core.whole_files import expanded
from segslam.graph import PoseGraph
from segslam.keyframes import Submaps, downsample_keyframe
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.run.sessions.recorded import Session, read_session
from segslam.slam.recognition import MAX_PLACES, recognise

NUM_PREPARED = 256
"""Number of keyframes prepared for alignment in memory, about 2 MB each."""
NUM_FIRST = 3
"""Chosen: number of places tried before views from points around the sensor are tried as well."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Located(Found):
    """The pose of a scan in a run."""

    T_world_lidar: Transform
    """Pose of the scan in the world of the run."""
    keyframe_id: int
    """Keyframe with which the scan was registered."""
    alignment: Alignment
    """Pose of the scan in that keyframe."""
    seconds: float

    @property
    def inliers(self) -> int:
        """Number of inliers of the coarse pose."""
        return self.alignment.coarse.num_inliers

    @property
    def overlap(self) -> float:
        """Share of the standing points of one cloud that lie on the other; the smaller of both directions."""
        return self.alignment.overlap


class Locator:
    """Locates scans among the keyframes of a finished run, which is not changed."""

    def __init__(self, session: Session, config: Config | None = None) -> None:
        """`session`: the run; `config`: settings, by default its own. Signatures that it does not have are computed."""
        if not isinstance(session, Session):
            raise SegslamError(f"Locator: {brief(str(session))} is not a Session; for a run: Locator.from_run(FOLDER)")
        self.session = session
        self.config = config or session.run.config
        self.submaps = submaps_of(session, self.config)
        self.prepared: Callable[[int], PreparedScan] = lru_cache(NUM_PREPARED)(self.submaps.prepared)
        """A keyframe by its id, prepared for alignment."""
        self.signatures = [self.submaps.signature(keyframe.id, keyframe.place) for keyframe in session.keyframes]
        self.places = Places()
        for keyframe_id, signature in enumerate(self.signatures):
            self.places.add(keyframe_id, signature)

    @classmethod
    def from_run(cls, folder: str | Path) -> "Locator":
        """The locator of a run folder. Raises SegslamError, naming the file, if it is damaged or did not finish."""
        return cls(read_session(expanded(folder)))

    def locate(
        self, points: ArrayLike, labels: ArrayLike | None = None, *, max_places: int = MAX_PLACES
    ) -> Located | Rejected:
        """The pose of a scan, or the reason why it was not found. `points`: rows of x, y, z in the sensor's frame (m).

        `labels`: learning ids, one per point; without labels, geometric labels are computed. At most `max_places`, the
        most similar ones, are tried; if more than `NUM_FIRST`, also for views from points around the sensor. Raises
        SegslamError for arrays of another shape, and for a number of places that is none.
        """
        if not isinstance(max_places, int | np.integer) or max_places < 0:
            raise SegslamError(f"max_places={max_places}: give a number of places, such as {MAX_PLACES}")
        started = perf_counter()
        config = self.config
        near = as_points(points)
        known = as_labels(labels, near)
        usable = within_range(near, config.odometry.min_range_m, config.odometry.max_range_m)
        near = near.compress(usable, axis=0)
        classes = geometric_labels(near) if known is None else known[usable]
        kept, kept_labels, _ = downsample_keyframe(
            near, classes, config=config.keyframes, whole_classes=tuple(config.segregator.cluster_min_points)
        )
        scan, (own, candidates) = at_once(
            lambda: prepare_scan(kept, kept_labels, config=config), lambda: self._candidates(kept, kept_labels)
        )
        T_world_place = self.session.T_world_keyframe.__getitem__
        recognised = partial(recognise, scan, places=self.prepared, T_world_place=T_world_place, config=config)
        found = recognised(candidates, max_places=min(max_places, NUM_FIRST))
        if isinstance(found, Rejected) and found.reason != RejectReason.AMBIGUOUS and max_places > NUM_FIRST:
            around = signatures_around(kept, kept_labels)
            found = recognised(self.places.shortlist_around((own, *around)), max_places=max_places)
        if isinstance(found, Rejected):
            return found
        return Located(found.T_world_lidar, found.place_id, found.alignment, perf_counter() - started)

    def _candidates(self, points: Points, labels: Labels) -> tuple[PlaceSignature, tuple[PlaceCandidate, ...]]:
        """Signature of a scan, and the most similar places; the first of them is prepared."""
        own = signature_of(points, labels)
        candidates = self.places.shortlist(own)
        if candidates:
            self.prepared(candidates[0].place_id)
        return own, candidates


def submaps_of(session: Session, config: Config) -> Submaps:
    """The submaps of a run by these settings; sparse keyframes are merged with their neighbours."""
    graph = PoseGraph(config.graph)
    submaps = Submaps(config, session.cloud_of, geometric_labels, lambda: graph.motion_variance)
    informations = session.run.result.keyframe_informations()
    for keyframe, information in zip(session.keyframes, informations, strict=True):
        graph.add_keyframe(keyframe.id, keyframe.T_odom_keyframe, keyframe.travel_m, information=information)
        submaps.add(keyframe.T_odom_keyframe, labelled_by_shape=bool(keyframe.labelled_by_shape))
    return submaps


def locate(run: str | Path, points: ArrayLike, labels: ArrayLike | None = None) -> Located | Rejected:
    """Locate a scan in the run of a folder. For several scans, create a `Locator` once, because it reads the run."""
    return Locator.from_run(run).locate(points, labels)
