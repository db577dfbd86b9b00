"""Floor plans laid on one another: courts whose pose is known, and what they do not know."""

import math

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.types import Alignment, Label, Points, Registration, Transform
from segslam.registration.segregator.plan import CELL_M, HALF, MAX_COUNT, NUM_YAWS, FloorPlan, _plans, plan_hypotheses
from segslam.verification import register

UP = np.array([0.0, 0.0, 1.0])
HALF_STEP_RAD = math.pi / NUM_YAWS


def _court(points_per_metre: int = 8) -> Points:
    """Walls of a court of 18 x 26 m with a recess, of different heights; the sensor stands in a corner of it."""
    rng = np.random.default_rng(0)
    parts = []
    for (x0, y0), (x1, y1), top_m in (
        ((-4, -6), (14, -6), 3.0),
        ((14, -6), (14, 8), 6.0),
        ((14, 8), (9, 8), 6.0),
        ((9, 8), (9, 20), 4.0),
        ((9, 20), (-4, 20), 2.5),
        ((-4, 20), (-4, -6), 5.0),
    ):
        along = rng.uniform(0, 1, int(points_per_metre * math.hypot(x1 - x0, y1 - y0)))
        parts.append(
            np.column_stack([x0 + along * (x1 - x0), y0 + along * (y1 - y0), rng.uniform(-1.5, top_m, len(along))])
        )
    return np.concatenate(parts)


def test_a_cell_counts_its_points_up_to_a_limit() -> None:
    in_one, in_another = np.full((3, 3), 0.1), np.full((2 * MAX_COUNT, 3), 5.1)
    [plan] = _plans(np.concatenate([in_one, in_another]), np.zeros(1))
    expected = np.zeros_like(plan)
    expected[HALF, HALF] = 3
    expected[HALF + int(5.1 / CELL_M), HALF + int(5.1 / CELL_M)] = MAX_COUNT
    np.testing.assert_array_equal(plan, expected)


def _error(found: Registration, T_target_source: Transform) -> tuple[float, float]:
    difference = found.T_target_source @ geometry.inverse(T_target_source)
    return geometry.distance(difference), geometry.angle(difference)


@pytest.mark.parametrize("yaw_deg", range(0, 360, 37))
def test_a_court_is_found_again_from_elsewhere_at_any_yaw(yaw_deg: int) -> None:
    T_target_source = geometry.transform(geometry.yaw(math.radians(yaw_deg)), np.array([7.0, 9.0, 1.2]))
    source = geometry.apply(geometry.inverse(T_target_source), _court())
    (found,) = plan_hypotheses(FloorPlan(source, UP), FloorPlan(_court(), UP), num_poses=1)
    apart_m, apart_rad = _error(found, T_target_source)
    reach_m = np.linalg.norm(source, axis=1).max()
    assert apart_rad <= HALF_STEP_RAD + 1e-9
    assert apart_m < 2 * CELL_M + HALF_STEP_RAD * reach_m  # a cell in x and in y, and what the yaw left open
    assert found.num_inliers > 0.2 * len(source)  # random points, some two for each slice of a cell


def test_sensors_that_lean_are_righted_by_their_up() -> None:
    T_target_source = geometry.transform(geometry.yaw(2.0), np.array([-3.0, 8.0, 0.0]))
    leaning = [
        geometry.exp(geometry.tangent(rotation_rad=np.array(turn), translation_m=0.0))
        for turn in ([0.2, 0.1, 0.0], [-0.1, 0.25, 0.0])
    ]
    T_leaning = leaning[1] @ T_target_source @ geometry.inverse(leaning[0])
    source = geometry.apply(leaning[0] @ geometry.inverse(T_target_source), _court())
    target = geometry.apply(leaning[1], _court())
    plans = [FloorPlan(points, T[:3, :3] @ UP) for points, T in zip((source, target), leaning, strict=True)]
    (found,) = plan_hypotheses(*plans, num_poses=1)
    apart_m, apart_rad = _error(found, T_leaning)
    assert apart_m < 2.0
    assert apart_rad < math.radians(5.0)


def test_hypotheses_differ_and_the_best_comes_first() -> None:
    found = list(plan_hypotheses(FloorPlan(_court(), UP), FloorPlan(_court(), UP), num_poses=5))
    assert len(found) == 5
    assert _error(found[0], np.eye(4)) == pytest.approx((0.0, 0.0), abs=1e-6)
    for k, one in enumerate(found):
        for other in found[:k]:
            apart_m, apart_rad = _error(one, other.T_target_source)
            assert apart_m > 3 * CELL_M or apart_rad > 4 * HALF_STEP_RAD


def test_order_of_points_changes_nothing() -> None:
    court = _court()
    shuffled = np.random.default_rng(1).permutation(court)
    target = FloorPlan(court, UP)
    first, again = (next(plan_hypotheses(FloorPlan(points, UP), target, num_poses=1)) for points in (court, shuffled))
    np.testing.assert_array_equal(first.T_target_source, again.T_target_source)


def test_nothing_upright_gives_no_pose() -> None:
    assert list(plan_hypotheses(FloorPlan(np.empty((0, 3)), UP), FloorPlan(_court(), UP), num_poses=3)) == []
    far = _court() + np.array([200.0, 0.0, 0.0])
    assert list(plan_hypotheses(FloorPlan(_court(), UP), FloorPlan(far, UP), num_poses=3)) == []


@pytest.mark.parametrize(("num_plans", "aligned"), [(2, True), (0, False)])
def test_scans_that_share_nothing_but_walls_are_aligned_by_these(
    num_plans: int, aligned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("segslam.verification.trial.MAX_PLAN_HYPOTHESES", num_plans)
    config = load_config(overrides=["segregator.features=never"])
    ground = np.column_stack([column.ravel() for column in np.mgrid[-4:14:0.3, -6:20:0.3, -1.7:-1.6:1]])
    walls = _court(points_per_metre=60)
    labels = np.repeat(np.array([Label.ROAD, Label.BUILDING], np.uint8), [len(ground), len(walls)])
    target = np.concatenate([ground, walls])
    T_target_source = geometry.transform(geometry.yaw(2.5), np.array([5.0, 9.0, 0.0]))
    source = geometry.apply(geometry.inverse(T_target_source), target)
    found = register(source, target, source_labels=labels, target_labels=labels, config=config)
    assert isinstance(found, Alignment) == aligned
    if isinstance(found, Alignment):
        apart_m, apart_rad = _error(found.fine, T_target_source)
        assert apart_m < 0.02  # the clouds are the same but for the way they were downsampled
        assert apart_rad < math.radians(0.2)
