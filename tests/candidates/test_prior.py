import numpy as np
import pytest

from segslam.candidates.prior import PRIOR_GATE, far_from_prior
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import LoopCandidate, Rejected, RejectReason

CONFIG = Config()


def _outcome(
    T_prior_pose: np.ndarray, *, chain_m: float = 100.0, slack_m: float = 0.0, R_world_target: np.ndarray | None = None
) -> Rejected | None:
    prior = geometry.transform(geometry.yaw(0.7), [5.0, -3.0, 0.2])
    candidate = LoopCandidate(1, 0, prior, 5.0, search_radius_m=7.5, chain_m=chain_m)
    R = np.eye(3) if R_world_target is None else R_world_target
    return far_from_prior(prior @ T_prior_pose, candidate, R, slack_m=slack_m)


def _moved(*shift_m: float) -> np.ndarray:
    return geometry.transform(np.eye(3), shift_m)


def _turned(degrees: float) -> np.ndarray:
    return geometry.transform(geometry.yaw(np.radians(degrees)), 0.0)


def _is_rejected_for(name: str, outcome: Rejected | None) -> bool:
    return outcome is not None and outcome.reason is RejectReason.FAR_FROM_PRIOR and outcome.detail.startswith(name)


def test_a_pose_near_the_prior_passes() -> None:
    assert _outcome(np.eye(4)) is None
    assert _outcome(_moved(3.0, 2.0, 0.5) @ _turned(10.0)) is None


def test_a_pose_turned_round_is_rejected_for_its_rotation() -> None:
    for degrees in (180.0, -90.0, 20.0):
        assert _is_rejected_for("rotation", _outcome(_turned(degrees))), degrees


def test_a_longer_chain_allows_a_larger_turn_and_never_more_than_all() -> None:
    assert _outcome(_turned(25.0), chain_m=600.0) is None
    assert _outcome(_turned(179.0), chain_m=1e6) is None


def test_the_storey_above_is_rejected_for_its_height() -> None:
    """A chain of 150 m lets heights drift by 2.2 m."""
    assert _outcome(_moved(0.0, 0.0, 2.0), chain_m=150.0) is None
    assert _is_rejected_for("height", _outcome(_moved(0.0, 0.0, 3.0), chain_m=150.0))
    assert _is_rejected_for("height", _outcome(_moved(0.0, 0.0, -3.0), chain_m=150.0))


def test_heights_are_the_worlds_whatever_the_attitude_of_the_target() -> None:
    """A target whose x axis points up: a shift along x is one of height."""
    R_world_target = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    prior = geometry.transform(np.eye(3), 0.0)
    candidate = LoopCandidate(1, 0, prior, 0.0, search_radius_m=7.5, chain_m=100.0)
    judged = [
        far_from_prior(_moved(*shift), candidate, R_world_target, slack_m=0.0)
        for shift in ([3.0, 0.0, 0.0], [0.0, 0.0, 3.0])
    ]
    assert _is_rejected_for("height", judged[0])
    assert judged[1] is None


@pytest.mark.parametrize("shift_m", [11.0, 12.0])
def test_a_pose_beyond_the_search_radius_and_its_slack_is_rejected_for_its_distance(shift_m: float) -> None:
    allowed_m = PRIOR_GATE * 7.5  # 11.25
    assert _is_rejected_for("distance", _outcome(_moved(shift_m, 0.0, 0.0))) is (shift_m > allowed_m)
    assert _outcome(_moved(shift_m, 0.0, 0.0), slack_m=2.0) is None
