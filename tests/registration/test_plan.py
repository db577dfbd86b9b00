"""Floor plans laid on one another: courts whose pose is known, and what they do not know."""

import math

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.types import Alignment, Direction, Label, Points, Registration, Transform
from segslam.registration.segregator.plan import (
    CELL_M,
    HALF,
    MAX_COUNT,
    NUM_YAWS,
    SAME_CELLS,
    FloorPlan,
    plan_hypotheses,
)
from segslam.verification import register

UP = np.array([0.0, 0.0, 1.0])
HALF_STEP_RAD = math.pi / NUM_YAWS


COURT = (
    ((-4, -6), (14, -6), 3.0),
    ((14, -6), (14, 8), 6.0),
    ((14, 8), (9, 8), 6.0),
    ((9, 8), (9, 20), 4.0),
    ((9, 20), (-4, 20), 2.5),
    ((-4, 20), (-4, -6), 5.0),
)
"""Ends and height of each wall of a court of 18 x 26 m with a recess; the sensor stands in a corner of it."""
Walls = tuple[Points, Points]
"""Points, and their normals."""


def _walls(
    ends: tuple[tuple[tuple[float, float], tuple[float, float], float], ...], points_per_metre: int = 8
) -> Walls:
    rng = np.random.default_rng(0)
    points, normals = [], []
    for (x0, y0), (x1, y1), top_m in ends:
        length_m = math.hypot(x1 - x0, y1 - y0)
        along = rng.uniform(0, 1, int(points_per_metre * length_m))
        points.append(
            np.column_stack([x0 + along * (x1 - x0), y0 + along * (y1 - y0), rng.uniform(-1.5, top_m, len(along))])
        )
        normals.append(np.tile([(y0 - y1) / length_m, (x1 - x0) / length_m, 0.0], (len(along), 1)))
    return np.concatenate(points), np.concatenate(normals)


def _court() -> Walls:
    return _walls(COURT)


def _seen_from(T_here: Transform, walls: Walls) -> Walls:
    """The walls in another frame."""
    R = T_here[:3, :3].T
    return geometry.apply(geometry.inverse(T_here), walls[0]), walls[1] @ R.T


def _plan(walls: Walls, up: Direction = UP) -> FloorPlan:
    return FloorPlan(*walls, up)


def test_a_cell_counts_its_points_up_to_a_limit_and_sums_directions_of_their_normals() -> None:
    in_one, in_another = np.full((3, 3), 0.1), np.full((2 * MAX_COUNT, 3), 5.1)
    normals = np.repeat([[1.0, 0.0, 0.0], [math.sqrt(0.5), math.sqrt(0.5), 0.0]], [3, 2 * MAX_COUNT], axis=0)
    plan = FloorPlan(np.concatenate([in_one, in_another]), normals, UP)
    expected = np.zeros((3, *plan.at(np.zeros(1)).shape[2:]))
    there = HALF + int(5.1 / CELL_M)
    expected[:, HALF, HALF] = 3.0, 3.0, 0.0
    expected[:, there, there] = MAX_COUNT, 0.0, MAX_COUNT
    np.testing.assert_allclose(plan.at(np.zeros(1))[:, 0], expected, atol=1e-5)
    turned = plan.at(np.array([math.pi / 2.0]))[:, 0]  # a wall seen from the other side is the same wall
    np.testing.assert_allclose(turned[:, HALF - 1, HALF], [3.0, -3.0, 0.0], atol=1e-5)


def _error(found: Registration, T_target_source: Transform) -> tuple[float, float]:
    difference = found.T_target_source @ geometry.inverse(T_target_source)
    return geometry.distance(difference), geometry.angle(difference)


@pytest.mark.parametrize("yaw_deg", range(0, 360, 37))
def test_a_court_is_found_again_from_elsewhere_at_any_yaw(yaw_deg: int) -> None:
    T_target_source = geometry.transform(geometry.yaw(math.radians(yaw_deg)), np.array([7.0, 9.0, 1.2]))
    source = _seen_from(T_target_source, _court())
    (found,) = plan_hypotheses(_plan(source), _plan(_court()), num_poses=1)
    apart_m, apart_rad = _error(found, T_target_source)
    reach_m = np.linalg.norm(source[0], axis=1).max()
    assert apart_rad <= HALF_STEP_RAD + 1e-9
    assert apart_m < 2 * CELL_M + HALF_STEP_RAD * reach_m  # a cell in x and in y, and what the yaw left open
    assert found.num_inliers > 0.2 * len(source[0])  # random points, some two for each slice of a cell


def test_sensors_that_lean_are_righted_by_their_up() -> None:
    T_target_source = geometry.transform(geometry.yaw(2.0), np.array([-3.0, 8.0, 0.0]))
    leaning = [
        geometry.exp(geometry.tangent(rotation_rad=np.array(turn), translation_m=0.0))
        for turn in ([0.2, 0.1, 0.0], [-0.1, 0.25, 0.0])
    ]
    T_leaning = leaning[1] @ T_target_source @ geometry.inverse(leaning[0])
    source = _seen_from(T_target_source @ geometry.inverse(leaning[0]), _court())
    target = _seen_from(geometry.inverse(leaning[1]), _court())
    plans = [_plan(walls, T[:3, :3] @ UP) for walls, T in zip((source, target), leaning, strict=True)]
    (found,) = plan_hypotheses(*plans, num_poses=1)
    apart_m, apart_rad = _error(found, T_leaning)
    assert apart_m < 2.0
    assert apart_rad < math.radians(5.0)


def test_hypotheses_differ_and_the_best_comes_first() -> None:
    found = list(plan_hypotheses(_plan(_court()), _plan(_court()), num_poses=5))
    assert len(found) == 5
    assert _error(found[0], np.eye(4)) == pytest.approx((0.0, 0.0), abs=1e-6)
    for k, one in enumerate(found):
        for other in found[:k]:
            apart_m, apart_rad = _error(one, other.T_target_source)
            assert apart_m > SAME_CELLS * CELL_M or apart_rad > 4 * HALF_STEP_RAD


def test_order_of_points_changes_nothing() -> None:
    court = _court()
    order = np.random.default_rng(1).permutation(len(court[0]))
    shuffled = court[0][order], court[1][order]
    first, again = (next(plan_hypotheses(_plan(walls), _plan(court), num_poses=1)) for walls in (court, shuffled))
    np.testing.assert_array_equal(first.T_target_source, again.T_target_source)


def test_nothing_upright_gives_no_pose() -> None:
    nothing = np.empty((0, 3)), np.empty((0, 3))
    assert list(plan_hypotheses(_plan(nothing), _plan(_court()), num_poses=3)) == []
    far = _court()[0] + np.array([200.0, 0.0, 0.0]), _court()[1]
    assert list(plan_hypotheses(_plan(_court()), _plan(far), num_poses=3)) == []


@pytest.mark.parametrize("yaw_deg", range(0, 360, 75))
def test_scans_far_from_each_other_are_aligned_by_the_part_that_both_see(yaw_deg: int) -> None:
    rng = np.random.default_rng(2)
    corners = np.cumsum(rng.uniform(4.0, 12.0, 12)) - 40.0
    sides = rng.uniform(7.0, 14.0, (2, 12)) * [[1.0], [-1.0]]
    facades = [
        ((x, y), (x + rng.uniform(3.0, 6.0), y), 4.0) for side in sides for x, y in zip(corners, side, strict=True)
    ]
    gables = [((x, y), (x, 1.4 * y), 4.0) for side in sides for x, y in zip(corners, side, strict=True)]
    street = _walls((*facades, *gables))
    T_target_source = geometry.transform(geometry.yaw(math.radians(yaw_deg)), np.array([30.0, 1.0, 0.0]))

    def seen(T_here: Transform) -> Walls:
        points, normals = _seen_from(T_here, street)
        is_seen = np.linalg.norm(points, axis=1) < 35.0
        return points[is_seen], normals[is_seen]

    found = next(plan_hypotheses(_plan(seen(T_target_source)), _plan(seen(np.eye(4))), num_poses=1))
    apart_m, apart_rad = _error(found, T_target_source)
    assert apart_m < 2.5
    assert apart_rad <= HALF_STEP_RAD + 1e-9


def test_surroundings_that_are_dense_everywhere_show_no_pose() -> None:
    def seen(T_here: Transform, seed: int) -> Walls:
        """Two walls, and bushes around the sensor, which are others from each place."""
        rng = np.random.default_rng(seed)
        bushes = rng.uniform([-15.0, -15.0, -1.5], [15.0, 15.0, 1.5], (4000, 3))
        directions = rng.normal(size=bushes.shape)
        points, normals = _seen_from(T_here, _walls((((10, 0), (34, 0), 4.0), ((34, 0), (34, 16), 4.0)), 20))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.concatenate([points, bushes]), np.concatenate([normals, directions])

    T_target_source = geometry.transform(geometry.yaw(1.0), np.array([26.0, -4.0, 0.0]))
    found = next(plan_hypotheses(_plan(seen(T_target_source, 1)), _plan(seen(np.eye(4), 2)), num_poses=1))
    apart_m, apart_rad = _error(found, T_target_source)
    assert apart_m < 2.5
    assert apart_rad <= HALF_STEP_RAD + 1e-9


def test_surfaces_of_other_directions_agree_less_than_fewer_of_the_same() -> None:
    def pair_at(x: float, normal: tuple[float, float, float], number: int) -> Walls:
        """Two blocks, 10 m apart along x."""
        rng = np.random.default_rng(3)
        block = rng.uniform([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], (number, 3))
        points = np.concatenate([block + np.array([along, 5.0, 0.0]) for along in (x, x + 10.0)])
        return points, np.tile(normal, (len(points), 1))

    same, other = pair_at(-15.0, (1.0, 0.0, 0.0), 60), pair_at(8.0, (0.0, 1.0, 0.0), 80)
    target = np.concatenate([same[0], other[0]]), np.concatenate([same[1], other[1]])
    found = next(plan_hypotheses(_plan(pair_at(0.0, (1.0, 0.0, 0.0), 60)), _plan(target), num_poses=1))
    np.testing.assert_allclose(found.T_target_source[:2, 3], [-15.0, 0.0], atol=CELL_M)


def test_walls_far_from_both_scans_align_them() -> None:
    walls = _walls((((-38, -30), (-38, 20), 5.0), ((-30, 40), (25, 40), 5.0), ((39, -10), (39, 30), 5.0)))
    T_target_source = geometry.transform(geometry.yaw(2.0), np.array([3.0, -4.0, 0.0]))
    found = next(plan_hypotheses(_plan(_seen_from(T_target_source, walls)), _plan(walls), num_poses=1))
    apart_m, apart_rad = _error(found, T_target_source)
    assert apart_m < 2.5
    assert apart_rad <= HALF_STEP_RAD + 1e-9


@pytest.mark.parametrize(("num_plans", "aligned"), [(2, True), (0, False)])
def test_scans_that_share_nothing_but_walls_are_aligned_by_these(
    num_plans: int, aligned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("segslam.verification.trial.MAX_PLAN_HYPOTHESES", num_plans)
    config = load_config(overrides=["segregator.features=never"])
    ground = np.column_stack([column.ravel() for column in np.mgrid[-4:14:0.3, -6:20:0.3, -1.7:-1.6:1]])
    walls, _ = _walls(COURT, points_per_metre=60)
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
