"""Motions that the scans do not constrain: in one direction, as in a tunnel, or, at a break, in none.

In a tunnel the motion is predicted from the last confirmed one. The speed at the entrance is known; its change inside
is not. The error of the position is therefore proportional to the distance through the tunnel, and so is its standard
deviation: the variances of the motions, which the pose graph adds up, grow from one to the next. Closures that span the
tunnel then correct its end most, as a steady braking or acceleration would.
"""

from collections.abc import Sequence

import numpy as np

from segslam import geometry
from segslam.types import Direction, Information, Motion, MotionState, Transform

BREAK_SIGMA_M, BREAK_SIGMA_RAD = 30.0, np.radians(60.0)
"""Standard deviations of an unsupported motion: the sensor may have been carried to any place nearby."""

SIGMA_SHARE = 0.7
"""Chosen: standard deviation of the predicted distance in the direction that is not constrained, as a share of it."""
LEAST_SIGMA_M = 0.1
"""Chosen: least standard deviation of one such motion along the open direction."""
OTHER_SIGMA_M, OTHER_SIGMA_RAD = 0.05, np.radians(0.2)
"""Chosen: standard deviations of such a motion in the other directions."""
END_SIGMA_M, END_SIGMA_RAD = 0.3, np.radians(2.0)
"""Chosen: the same where the scene changes at the ends of a tunnel, and the prediction alone continues."""


class Unconstrained:
    """The last confirmed motion, and the distance since then along the direction that is not constrained."""

    def __init__(self) -> None:
        self.T_steady: Transform = np.eye(4)
        """The last confirmed motion, per interval of the sensor."""
        self.direction: Direction | None = None
        """The direction that the last scan did not constrain, in its frame; None if it constrained all."""
        self._distance_m = 0.0

    def note_observed(self, T_motion: Transform) -> None:
        """Note a motion that the scans showed, per interval of the sensor."""
        self.T_steady, self.direction, self._distance_m = T_motion, None, 0.0

    def note_predicted(self, distance_m: float, direction: Direction | None, *, is_registered: bool) -> Information:
        """Information of a motion of `distance_m` predicted along `direction`; if None, along that of the scan before.

        `is_registered`: True if the scans showed the other directions.
        """
        along = self.direction if direction is None else direction
        assert along is not None, "a motion is predicted in a tunnel, or at its end"
        before_m, self._distance_m = self._distance_m, self._distance_m + distance_m
        variance = max(SIGMA_SHARE**2 * (self._distance_m**2 - before_m**2), LEAST_SIGMA_M**2)
        self.direction = direction
        rotation_rad, translation_m = (
            (OTHER_SIGMA_RAD, OTHER_SIGMA_M) if is_registered else (END_SIGMA_RAD, END_SIGMA_M)
        )
        covariance = np.diag(geometry.tangent(rotation_rad=rotation_rad, translation_m=translation_m) ** 2)
        covariance[3:, 3:] += variance * np.outer(along, along)
        return np.linalg.inv(covariance)

    def restore(self, T_motion: Transform, distance_m: float, direction: Direction | None) -> None:
        """Continue after a stop with the last motion, and the travel predicted since the last observed motion."""
        self.T_steady, self._distance_m, self.direction = T_motion, distance_m, direction


def moved_along(direction: Direction, T_odom_lidar: Transform, T_odom_along: Transform) -> Transform:
    """A pose, with its position along a direction in its own frame replaced by that of another pose."""
    apart = (geometry.inverse(T_odom_lidar) @ T_odom_along)[:3, 3]
    return T_odom_lidar @ geometry.transform(np.eye(3), direction * (direction @ apart))


def unknown_information() -> Information:
    """The information of a motion that no scan supports."""
    return np.diag(geometry.tangent(rotation_rad=BREAK_SIGMA_RAD, translation_m=BREAK_SIGMA_M) ** -2.0)


def is_predicted(motion: Motion) -> bool:
    """True if a motion was predicted in a tunnel."""
    return motion.state is MotionState.BROKEN and motion.information is not None and not motion.is_break


def information_of(motions: Sequence[Motion]) -> Information | None:
    """Information of successive motions together; None if none has an information of its own.

    Their covariances are added: the motions between two keyframes are too short for their lever arms to matter.
    """
    own = [motion.information for motion in motions if motion.information is not None]
    return np.linalg.inv(sum(np.linalg.inv(information) for information in own)) if own else None
