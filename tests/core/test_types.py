"""Records in use: what is true of them, and how they show themselves."""

import numpy as np
import pytest

from segslam.core.types import Alignment, LoopClosure, Registration, Rejected, RejectReason, Scan, Trajectory

REGISTRATION = Registration(np.eye(4), 100, 12, 0.10500000000000001, np.eye(6))
ALIGNMENT = Alignment(REGISTRATION, REGISTRATION, 0.62, 0.1, 0.01)
CLOSURE = LoopClosure(5, 2, np.eye(4), np.eye(6), ALIGNMENT)


def test_a_rejection_raises_where_its_truth_is_tested() -> None:
    rejected = Rejected(RejectReason.LOW_OVERLAP, "0.1 < 0.2")
    assert not rejected.ok
    for careless in (lambda: not rejected, lambda: rejected or ALIGNMENT, lambda: 1 if rejected else 2):
        with pytest.raises(TypeError, match="isinstance"):
            careless()
    assert all(found.ok for found in (REGISTRATION, ALIGNMENT, CLOSURE))


@pytest.mark.parametrize(
    "record",
    [
        ALIGNMENT,
        CLOSURE,
        Scan(np.zeros((1000, 3), np.float32), 0, 0),
        Trajectory(np.arange(900), np.arange(900), np.tile(np.eye(4), (900, 1, 1))),
    ],
)
def test_records_show_themselves_in_one_short_line(record: object) -> None:
    assert len(repr(record)) < 700
    assert "\n" not in repr(record)


def test_a_representation_has_the_pose_and_the_figures() -> None:
    assert repr(REGISTRATION) == (
        "Registration(T_target_source=<0.00 0.00 0.00 m, turned 0.0 deg>, num_correspondences=100, num_inliers=12, "
        "rms_m=0.105, information=<float64 (6, 6)>, num_edges=0)"
    )
