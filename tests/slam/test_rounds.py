"""A drive along a walled yard, whose odometry bends."""

import os
import threading
from collections.abc import Iterable, Iterator
from functools import cache, partial

import numpy as np
import pytest
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.points import voxel_first
from segslam.core.processes import Progress
from segslam.core.types import Alignment, LoopClosure, Registration
from segslam.graph import Edge, PoseGraph
from segslam.graph.levenberg_marquardt import Unsolvable
from segslam.slam.adjustment import rounds
from segslam.slam.adjustment.known import Known
from segslam.slam.adjustment.rounds import Adjusted, adjust
from segslam.slam.adjustment.sweeps import Correction, Velocities
from segslam.slam.adjustment.vertical_angle import VerticalAngle

STEP_M = 2.0
NUM = 40
CONFIG = Config()
TRUE_M = np.arange(NUM) * STEP_M - NUM * STEP_M / 2
STILL = Velocities(np.zeros((NUM, 6)), 0.1)
T_TRUE = np.array([geometry.transform(np.eye(3), [x_m, 0.0, 0.0]) for x_m in TRUE_M])


@cache
def points(keyframe_id: int, low_deg: float = 0.0) -> np.ndarray:
    made = seen(float(TRUE_M[keyframe_id]), low_deg=low_deg, seed=keyframe_id).astype(np.float32)
    return made[voxel_first(made, 0.25)]


def graph(*, pitch_deg: float = 0.02) -> PoseGraph:
    """Each motion of the odometry is pitched a little, so that the drive bends upwards."""
    bend = geometry.exp(geometry.tangent(rotation_rad=[0.0, np.radians(-pitch_deg), 0.0], translation_m=0.0))
    T_step = geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0]) @ bend
    made, T_odom = PoseGraph(CONFIG.graph), np.eye(4)
    for keyframe_id in range(NUM):
        made.add_keyframe(keyframe_id, T_odom, STEP_M * keyframe_id)
        T_odom = T_odom @ T_step
    return made


@cache
def straightened() -> tuple[PoseGraph, Adjusted | None]:
    """The adjusted graph of the bent drive; only read."""
    made = graph()
    return made, adjust(made, made.finish(), points, STILL, config=CONFIG)


def error_m(made: PoseGraph) -> float:
    """Of the last keyframe, seen from the first."""
    T_first_last = geometry.inverse(made.T_world_keyframes[0]) @ made.T_world_keyframes[-1]
    return geometry.distance(geometry.inverse(T_TRUE[0]) @ T_TRUE[-1] @ geometry.inverse(T_first_last))


@pytest.mark.long
def test_submaps_straighten_a_bent_drive_and_its_surfaces_become_thinner() -> None:
    before = error_m(graph())
    made, found = straightened()
    assert found is not None
    assert error_m(made) < 0.4 * before
    assert found.record.is_complete
    assert found.record.correction_deg == 0.0
    assert found.record.thickness_m is not None
    assert found.record.thickness_before_m is not None
    assert found.record.thickness_m < found.record.thickness_before_m
    np.testing.assert_array_equal(found.after.T_world_keyframe[NUM - 1], made.T_world_keyframes[-1])


@pytest.mark.long
def test_low_beams_are_measured_and_do_not_bend_the_drive() -> None:
    made = graph(pitch_deg=0.0)
    found = adjust(made, made.finish(), lambda keyframe_id: points(keyframe_id, 0.2), STILL, config=CONFIG)
    assert found is not None
    assert found.record.correction_deg == pytest.approx(0.2, abs=0.03)
    assert error_m(made) < 0.05


@pytest.mark.long
def test_an_adjustment_after_which_surfaces_are_thicker_is_dropped(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = graph()
    before = made.finish()
    poses = made.T_world_keyframes.copy()
    monkeypatch.setattr(rounds, "is_thicker", lambda *_: True)
    assert adjust(made, before, points, STILL, config=CONFIG) is None
    np.testing.assert_array_equal(made.T_world_keyframes, poses)
    assert "surfaces of the map were thinner before the adjustment" in caplog.text


@pytest.mark.long
def test_the_adjustment_is_the_same_on_any_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # those of pytest do not matter here
    again = graph()
    adjust(again, again.finish(), points, STILL, config=CONFIG)
    np.testing.assert_array_equal(again.T_world_keyframes, straightened()[0].T_world_keyframes)


@pytest.mark.slow
def test_one_wrong_loop_left_in_does_no_more_harm_than_without_the_adjustment() -> None:
    T_wrong = geometry.inverse(T_TRUE[0]) @ T_TRUE[-1] @ geometry.transform(np.eye(3), [0.0, 2.5, 0.0])
    information = np.eye(6) * 1e4
    fine = Registration(T_wrong, 1000, 800, 0.05, information)
    closure = LoopClosure(NUM - 1, 0, T_wrong, information, Alignment(fine, fine, 0.8, 0.05, 0.0))
    errors = []
    for minutes in (0.0, 60.0):
        made = graph(pitch_deg=0.005)
        made.add_closure(closure)
        config = CONFIG.model_copy(update={"adjustment": CONFIG.adjustment.model_copy(update={"max_minutes": minutes})})
        adjust(made, made.finish(), points, STILL, config=config)
        errors.append(error_m(made))
    assert errors[1] <= 1.02 * errors[0]


def test_no_time_leaves_the_graph_unchanged() -> None:
    made = graph()
    before = made.finish()
    off = CONFIG.model_copy(update={"adjustment": CONFIG.adjustment.model_copy(update={"max_minutes": 0.0})})
    T_before = made.T_world_keyframes.copy()
    assert adjust(made, before, points, STILL, config=off) is None
    np.testing.assert_array_equal(made.T_world_keyframes, T_before)


def test_keyframes_without_points_are_not_adjusted() -> None:
    made = graph()
    assert adjust(made, made.finish(), lambda _: np.empty((0, 3), np.float32), STILL, config=CONFIG) is None


def noting(titles: list[str]) -> Progress:
    """Progress that notes its titles."""

    def shown(items: Iterable[object], total: int, title: str) -> Iterator[object]:
        titles.append(title)
        yield from items

    return shown


@pytest.mark.parametrize(("angle", "title"), [(None, "refine 1/1"), (VerticalAngle(0.2, 0.01, 40), "refine 1/2")])
def test_a_second_round_is_announced_only_if_an_angle_is_corrected(
    angle: VerticalAngle | None, title: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[str] = []
    monkeypatch.setattr(rounds, "measure_vertical_angle", lambda *_, **__: angle)
    made = graph()
    adjust(made, made.finish(), lambda _: np.empty((0, 3), np.float32), STILL, config=CONFIG, progress=noting(titles))
    assert titles == [title]


@pytest.mark.long
def test_the_angle_of_several_drives_is_that_of_their_own_adjustments(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second round does not measure it either."""

    def refuse(*_: object, **__: object) -> None:
        pytest.fail("measured again")

    monkeypatch.setattr(rounds, "measure_vertical_angle", refuse)
    made, titles = graph(), list[str]()
    known = Known(T_TRUE, [Correction(0.2)] * NUM, VerticalAngle(0.2, 0.01, 40))
    low = partial(points, low_deg=0.2)
    found = adjust(made, made.finish(), low, STILL, config=CONFIG, known=known, progress=noting(titles))
    assert found is not None
    assert titles == ["refine 1/2", "refine 2/2"]
    assert found.record.vertical_deg == 0.2


def test_a_graph_that_cannot_be_solved_with_the_submaps_stays_as_it_is(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unsolvable(*_: object, **__: object) -> None:
        raise Unsolvable("indefinite")

    made = graph()
    before = made.finish()
    monkeypatch.setattr(made, "adjust", unsolvable)
    assert adjust(made, before, points, STILL, config=CONFIG) is None
    assert "the whole map is not adjusted: indefinite" in caplog.text


def test_an_adjustment_is_dropped_to_the_last_final_optimisation() -> None:
    made = graph()
    made.finish()
    measured = [Edge(one, one + 5, geometry.inverse(T_TRUE[one]) @ T_TRUE[one + 5], 1e6 * np.eye(6)) for one in (0, 5)]
    made.adjust(measured)
    registration = Registration(geometry.inverse(T_TRUE[0]) @ T_TRUE[30], 9, 9, 0.01, 1e6 * np.eye(6))
    made.add_closure(LoopClosure.of(30, 0, Alignment(registration, registration, 0.9, 0.1, 0.0)))
    made.finish()
    last = made.T_world_keyframes.copy()
    made.adjust(measured)
    made.drop_adjustment()
    np.testing.assert_array_equal(made.T_world_keyframes, last)


@pytest.mark.long
def test_pairs_along_a_drive_are_of_one_pass_however_long_they_are() -> None:
    made = graph()
    config = CONFIG.model_copy(update={"proximity": CONFIG.proximity.model_copy(update={"min_travel_m": STEP_M})})
    found = adjust(made, made.finish(), points, STILL, config=config)
    assert found is not None
    assert found.record.num_between_passes == 0
