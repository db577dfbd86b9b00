"""What is known of drives that are adjusted together, after each was adjusted on its own.

The submaps of a drive are built from its own poses. They do not change when further drives are added, and the alignment
of two of them depends on the initial guess only. The guess is rounded, so that an alignment can be kept and used again
where the poses of the drives, all together, moved a little.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.trajectory import Poses
from segslam.core.types import Transform, Vector
from segslam.slam.adjustment.alignment import Alignment, PointsOf
from segslam.slam.adjustment.submaps import Aligned, aligned_by, surfaces_of
from segslam.slam.adjustment.sweeps import Correction, Sweep, corrected_by
from segslam.slam.adjustment.vertical_angle import VerticalAngle

Guess = tuple[int, ...]
"""A rounded initial guess: rotation vector and translation, in whole steps."""
STEP_RAD, STEP_M = 0.01, 0.25
"""Chosen: steps of the initial guess. In a simulated town, alignments from rounded guesses differ by 3 mm at most from
those of exact guesses, and 3 of 77 guesses were rounded differently after a drive was added."""
Compute = Callable[[], Alignment | None]
Kept = Callable[[int, int, Guess, Compute], Alignment | None]
"""The alignment of a target and a source from a rounded guess: kept from earlier, or computed by the last argument."""


def nothing_kept(target_id: int, source_id: int, guess: Guess, compute: Compute) -> Alignment | None:
    """Computes every alignment."""
    return compute()


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known of all keyframes from the adjustment of their own drives."""

    T_own_keyframe: Poses
    """Poses, each in the world of its own drive."""
    corrections: Sequence[Correction]
    """Of the points of each keyframe."""
    angle: VerticalAngle | None
    """Vertical angle of the scans of all drives together; None if it was measured in no drive."""
    sweep: Sweep | None = None
    """Sweep of the scans of all drives together; None if not all have one, or not the same."""
    kept: Kept = nothing_kept

    def aligned(self, points_of: PointsOf, motion_variance: Vector, *, config: RefineConfig) -> Aligned:
        """Aligns submaps that are built by the poses of their own drives, from rounded initial guesses."""
        corrected = corrected_by(self.corrections, points_of)
        align = aligned_by(surfaces_of(corrected, self.T_own_keyframe, motion_variance, config=config))

        def aligned(target_id: int, source_id: int, T_target_source: Transform) -> Alignment | None:
            guess = rounded(T_target_source)
            compute = partial(align, target_id, source_id, transform_of(guess))
            return self.kept(target_id, source_id, guess, compute)

        return aligned


def rounded(T: Transform) -> Guess:
    """The initial guess in whole steps."""
    values = np.concatenate([geometry.log(T)[:3] / STEP_RAD, T[:3, 3] / STEP_M])
    return tuple(np.round(values).astype(int).tolist())


def transform_of(guess: Guess) -> Transform:
    """The transform of a rounded initial guess."""
    turned = geometry.exp(geometry.tangent(rotation_rad=STEP_RAD * np.array(guess[:3]), translation_m=0.0))
    return geometry.transform(turned[:3, :3], STEP_M * np.array(guess[3:]))
