"""Noise floor of a run: the agreement of neighbouring keyframes, whose relative pose is known from odometry.

Pairs of neighbours are registered along the drive, starting at the first loop candidate. Their agreement depends on
sensor and place: residual of distorted sweeps, overlap of sparse scans, moving objects in free space.
"""

from collections.abc import Callable

import numpy as np

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Rejected, Transform
from segslam.registration import refinement
from segslam.registration.prepared import Observed
from segslam.verification import gates

NUM_FIRST = 5
"""Chosen: pairs registered before the first loop, spread over the drive so far."""
EVERY, NUM_LAST = 25, 20
"""Chosen: keyframes until the next pair, and number of last pairs in the median."""
MIN_PAIRS = 3
"""Chosen: with fewer pairs, the default floor is used."""
MIN_OVERLAP, MAX_RESIDUAL_RATIO = 0.4, 1.0
"""Chosen: pairs outside these limits are dropped, as after a slip of the odometry. Correct pairs have 0.78 to 0.96,
0.40 to 0.89."""


class NeighbourNoise:
    """Measures the noise floor of a run; the same calls in the same order give the same floors."""

    def __init__(
        self,
        seen: Callable[[int], Observed],
        T_odom_keyframe: Callable[[int], Transform],
        lag: Callable[[int], int] = lambda keyframe_id: 1,
        *,
        config: Config,
    ) -> None:
        """Surfaces and odometry poses by keyframe id; `lag`: keyframes between a keyframe and its neighbour."""
        self._seen, self._T_odom_keyframe, self._config = seen, T_odom_keyframe, config
        self._lag = lag
        self._found: list[gates.Agreement] = []
        self._last_id: int | None = None

    def at(self, keyframe_id: int) -> gates.NoiseFloor:
        """The floor when this keyframe is the newest; registers further pairs when they are due."""
        if self._last_id is None:
            ids = np.unique(np.linspace(min(1, keyframe_id), keyframe_id, NUM_FIRST).astype(int))
        elif keyframe_id - self._last_id >= EVERY:
            ids = np.array([keyframe_id])
        else:
            ids = np.empty(0, dtype=int)
        for newer_id in ids.tolist():
            self._last_id = keyframe_id
            self._align(newer_id)
        last = self._found[-NUM_LAST:]
        if len(last) < MIN_PAIRS:
            return gates.SINGLE_PAIR
        return gates.NoiseFloor(
            overlap=float(np.median([found.overlap for found in last])),
            residual_ratio=float(np.median([found.residual_ratio for found in last])),
            free_space_violation=float(np.median([found.free_space_violation for found in last])),
        )

    def _align(self, newer_id: int) -> None:
        """Registers a keyframe with its neighbour, and stores their agreement."""
        older_id = newer_id - self._lag(newer_id)
        if older_id < 0:
            return
        source, target = self._seen(newer_id), self._seen(older_id)
        T_target_source = geometry.inverse(self._T_odom_keyframe(older_id)) @ self._T_odom_keyframe(newer_id)
        fine = refinement.refine(source[0], target[0], T_target_source, config=self._config.refine)
        if isinstance(fine, Rejected):
            return
        found = gates.agreement(source, target, fine.T_target_source, config=self._config.verify)
        if found.overlap >= MIN_OVERLAP and found.residual_ratio <= MAX_RESIDUAL_RATIO:
            self._found.append(found)
