"""Loops found by place recognition only: the odometry error exceeds any search radius."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.drives import drifting, round_drive

from segslam.candidates.proximity import LEAST_PROBABILITY
from segslam.core import geometry
from segslam.core.config import OdometryConfig, load_config
from segslam.core.threads import Stopwatch
from segslam.core.types import (
    Alignment,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Motion,
    MotionState,
    Registration,
    Rejected,
    RejectReason,
    Scan,
    Trajectory,
    Transform,
)
from segslam.graph import PoseGraph
from segslam.odometry.sweep import GivenOdometry, OdometryResult
from segslam.registration.prepared import PreparedScan
from segslam.slam import far_loops, loops
from segslam.slam.loop_edits import NO_EDITS
from segslam.slam.loops import LoopCloser
from segslam.slam.recognition import Recognised
from segslam.slam.slam import Slam
from segslam.slam.slam_result import SlamResult
from segslam.verification import register_prepared

PLAIN = ("health.check=false", "adjustment.max_minutes=0")
"""Loops alone."""
FAR_DEG = 1.0
"""20 m off after a round of 113 m."""


def mapped(turn_deg: float, *settings: str) -> SlamResult:
    """The drive with an odometry that turns too far, by so much in each step of 2.2 m."""
    return mapped_and_tried(turn_deg, *settings)[0]


@cache
def mapped_and_tried(turn_deg: float, *settings: str, tries_loops: bool = True) -> tuple[SlamResult, list[LoopAttempt]]:
    """The same with the attempts as they came; without `tries_loops` they come at the end only."""
    config = load_config(None, [*PLAIN, *settings])
    odometry = drifting(round_drive()[1], turn_deg=turn_deg)
    slam = Slam(config, odometry=GivenOdometry(odometry, config.odometry))
    tried: list[LoopAttempt] = []
    for scan in round_drive()[0]:
        tried += slam.close_loops(slam.track(scan), tries_loops=tries_loops).attempts
    return slam.finish(), tried


@pytest.mark.slow
def test_keyframes_that_were_skipped_are_searched_by_appearance_at_the_end() -> None:
    result, tried = mapped_and_tried(FAR_DEG, tries_loops=False)
    assert tried == []
    assert len(result.closures()) >= 3
    assert result.errors(round_drive()[1])["ate_m"] < 0.6


@pytest.mark.long
def test_each_pair_has_the_last_of_its_outcomes() -> None:
    result, tried = mapped_and_tried(FAR_DEG)
    pairs = [(one.candidate.source_id, one.candidate.target_id) for one in result.attempts]
    assert len(pairs) == len(set(pairs)) < len(tried)
    closed = {(one.source_id, one.target_id) for one in result.closures()}
    waited = {
        (one.candidate.source_id, one.candidate.target_id)
        for one in tried
        if isinstance(one.outcome, Rejected) and one.outcome.reason is RejectReason.UNCONFIRMED
    }
    assert closed & waited
    late = result.attempts[len(result.attempts) - result.num_late_attempts :]
    assert {(one.candidate.source_id, one.candidate.target_id) for one in late} <= set(pairs)


@pytest.mark.long
def test_a_drive_whose_odometry_is_far_off_closes_by_place_recognition() -> None:
    truth = round_drive()[1]
    blind = mapped(FAR_DEG, "retrieval.enabled=false")
    assert not blind.closures()
    result = mapped(FAR_DEG)
    assert blind.errors(truth)["ate_m"] > 5.0
    assert result.errors(truth)["ate_m"] < 0.4
    assert len(result.closures()) >= 4
    assert min(result.estimate.closure_weights.values()) > 0.5
    for closure in result.closures():
        rows = result.keyframe_rows[[closure.target_id, closure.source_id]]
        T_true = np.linalg.inv(truth.T_world_lidar[rows[0]]) @ truth.T_world_lidar[rows[1]]
        assert np.linalg.norm(closure.T_target_source[:3, 3] - T_true[:3, 3]) < 0.3


def test_one_keyframe_alone_closes_no_far_loop() -> None:
    _, tried = mapped_and_tried(FAR_DEG)
    outcomes = [attempt.outcome for attempt in tried if attempt.candidate.near_probability < LEAST_PROBABILITY]
    first_closure = next(k for k, outcome in enumerate(outcomes) if isinstance(outcome, LoopClosure))
    unconfirmed = [
        outcome
        for outcome in outcomes[:first_closure]
        if not isinstance(outcome, LoopClosure) and outcome.reason is RejectReason.UNCONFIRMED
    ]
    assert len(unconfirmed) >= 2


@pytest.mark.long
def test_a_drive_whose_odometry_is_good_closes_by_proximity_as_before() -> None:
    before, after = mapped(0.15, "retrieval.enabled=false"), mapped(0.15)
    pairs = [[(closure.source_id, closure.target_id) for closure in run.closures()] for run in (before, after)]
    assert pairs[0] == pairs[1]
    assert pairs[0]
    np.testing.assert_array_equal(before.trajectory.T_world_lidar, after.trajectory.T_world_lidar)


@pytest.mark.long
@pytest.mark.parametrize(("probability", "least", "most"), [(0.9995, 0, 0), (0.99, 2, 4)])
def test_a_near_loop_that_is_less_probable_than_the_user_accepts_waits_for_two_others(
    probability: float, least: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(*clouds: PreparedScan, **given: Any) -> Alignment | Rejected:
        found = register_prepared(*clouds, **given)
        return found if isinstance(found, Rejected) else replace(found, probability=probability)

    monkeypatch.setattr("segslam.slam.loops.register_prepared", judged)
    config = load_config(None, [*PLAIN, "retrieval.enabled=false"])
    slam = Slam(config, odometry=GivenOdometry(round_drive()[1], config.odometry))
    tried = [attempt.outcome for scan in round_drive()[0] for attempt in slam.process(scan).attempts]
    first = next(k for k, one in enumerate(tried) if isinstance(one, LoopClosure))
    waited = [one for one in tried[:first] if isinstance(one, Rejected) and one.reason is RejectReason.UNCONFIRMED]
    assert least <= len(waited) <= most, "they wait until the keyframes spread over 5 m"


class Carried(GivenOdometry):
    """Odometry of a sensor that is carried elsewhere before one scan; that motion is unknown."""

    def __init__(self, trajectory: Trajectory, config: OdometryConfig, *, first_after: int) -> None:
        super().__init__(trajectory, config)
        self._first_after = first_after

    def register(self, scan: Scan, *, gap: float = 1.0) -> OdometryResult:
        found = super().register(scan, gap=gap)
        if scan.index != self._first_after:
            return found
        return replace(found, motion=Motion(MotionState.BROKEN, information=1e-3 * np.eye(6)))


BEFORE, AFTER = 30, 55
"""The sensor is carried from one scan to the other, which is in the second round, near scan 4 of the first."""


@cache
def carried() -> tuple[SlamResult, list[LoopAttempt]]:
    """The drive of a sensor that is carried."""
    scans, truth = round_drive()
    before, after = BEFORE, AFTER
    kept = [*range(before), *range(after, len(scans))]
    odometry = drifting(truth)
    T_odom = odometry.T_world_lidar.copy()
    T_odom[after:] = T_odom[before - 1] @ geometry.inverse(T_odom[after]) @ T_odom[after:]
    config = load_config(None, [*PLAIN])
    given = Carried(replace(odometry, T_world_lidar=T_odom), config.odometry, first_after=after)
    slam = Slam(config, odometry=given)
    tried = [attempt for number in kept for attempt in slam.process(scans[number]).attempts]
    return slam.finish(), tried


@pytest.mark.long
def test_a_sensor_that_was_carried_to_an_older_place_is_found_there() -> None:
    (result, _), truth = carried(), round_drive()[1]
    assert [motion.is_break for motion in result.motions].index(True) == BEFORE
    assert len(result.closures()) >= 3
    off_m = np.linalg.norm(result.trajectory.T_world_lidar[BEFORE:, :3, 3] - _from_first(truth)[AFTER:], axis=1)
    assert off_m.max() < 1.0


def test_a_loop_across_a_break_waits_for_two_others() -> None:
    result, tried = carried()
    across = [
        attempt.outcome
        for attempt in tried
        if result.keyframe_rows[attempt.candidate.source_id]
        >= BEFORE
        > result.keyframe_rows[attempt.candidate.target_id]
    ]
    first_closure = next(k for k, outcome in enumerate(across) if isinstance(outcome, LoopClosure))
    waited = [outcome.reason for outcome in across[:first_closure] if isinstance(outcome, Rejected)]
    assert waited.count(RejectReason.UNCONFIRMED) >= 2
    assert all(isinstance(outcome, LoopClosure) for outcome in across[first_closure : first_closure + 3])


def _from_first(truth: Trajectory) -> np.ndarray:
    """(n, 3) positions in the frame of the first scan."""
    return (geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar)[:, :3, 3]


@pytest.mark.long
def test_a_loop_that_waits_after_the_search_by_distance_is_not_tried_by_appearance_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A second lap of 1.6 km, 13 m beside the first by the odometry; every registration is right."""
    corners_m, side_m, step_m = np.array([[0, 0], [400, 0], [400, 400], [0, 400]]), 400.0, 2.0

    def true_pose(number: int) -> Transform:
        side, along_m = divmod(step_m * number % (4 * side_m), side_m)
        turn = geometry.yaw(0.5 * np.pi * side)
        return geometry.transform(turn, [*(corners_m[int(side)] + along_m * turn[:2, 0]), 0.0])

    def alignment(source: int, target: int, gate: Any) -> Alignment | Rejected:
        T_target_source = geometry.inverse(true_pose(target)) @ true_pose(source)
        information = np.diag([1e6] * 3 + [1e4] * 3)
        found = Registration(T_target_source, 100, 100, 0.01, information)
        excluded = gate(T_target_source, slack_m=0.0)
        return Alignment(found, found, 0.9, 0.05, 0.0, probability=0.99) if excluded is None else excluded

    def recognised(scan: Any, places: Any, *_: Any, gate: Any, **__: Any) -> Recognised | Rejected:
        found = alignment(scan, places[0].place_id, gate(places[0].place_id))
        return found if isinstance(found, Rejected) else Recognised(places[0].place_id, np.eye(4), found)

    monkeypatch.setattr(loops, "register_prepared", lambda source, target, gate, **_: alignment(source, target, gate))
    monkeypatch.setattr(loops, "at_once", lambda *calls: tuple(call() for call in calls))
    monkeypatch.setattr(far_loops, "recognise", recognised)
    config = load_config(None)
    graph = PoseGraph(config.graph)
    no_points = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    closer = LoopCloser(config, graph, lambda _: no_points, lambda _: no_points[1], NO_EDITS, is_known=False)
    monkeypatch.setattr(closer, "_prepared", lambda number: number)
    monkeypatch.setattr(closer._far, "_prepared", lambda number: number)
    rng = np.random.default_rng(1)
    seen = [rng.integers(0, 255, 24 * 60, dtype=np.uint8).tobytes() for _ in range(800)]
    closed: list[tuple[int, int]] = []
    for number in range(803):
        T_odom = geometry.transform(np.eye(3), [0.0, 13.0 * number / 800, 0.0]) @ true_pose(number)
        graph.add_keyframe(number, T_odom, step_m * number)
        closer.add(T_odom, labelled_by_shape=False, recorded=seen[number % 800])
        attempts = closer.attempt(number, Stopwatch())
        closed += [one.candidate.pair for one in attempts if isinstance(one.outcome, LoopClosure)]
    assert len(closed) >= 3
    assert len(closed) == len(set(closed))


@pytest.mark.parametrize(("height_m", "is_tried"), [(0.5, True), (3.0, False)])
def test_a_place_that_looks_the_same_on_another_storey_is_not_tried(height_m: float, is_tried: bool) -> None:
    """The second round of 120 m is 13 m beside the first by the odometry."""
    config = load_config(None)
    graph = PoseGraph(config.graph)
    no_points = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    closer = LoopCloser(config, graph, lambda _: no_points, lambda _: no_points[1], NO_EDITS, is_known=False)
    rng = np.random.default_rng(1)
    seen = [rng.integers(0, 255, 24 * 60, dtype=np.uint8).tobytes() for _ in range(60)]
    for number in range(90):
        angle = 2.0 * np.pi * number / 60
        at = [19.0 * np.cos(angle), 19.0 * np.sin(angle) + 13.0 * (number >= 60), height_m * (number >= 60)]
        T_odom = geometry.transform(geometry.yaw(angle), at)
        graph.add_keyframe(number, T_odom, 2.0 * number)
        closer.add(T_odom, labelled_by_shape=False, recorded=seen[number % 60])
    loop = closer._far._loop(89, closer._far._signatures[89])
    assert (loop is not None) is is_tried
    assert loop is None or loop.candidate.target_id == 29


@pytest.mark.parametrize("is_near", [True, False])
def test_of_known_drives_scans_are_described_only_for_loops_that_are_not_near_the_known_pose(
    is_near: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose = Registration(np.eye(4), 100, 100, 0.01, np.eye(6))
    rejected = Rejected(RejectReason.FAR_FROM_PRIOR, "far")
    monkeypatch.setattr(
        loops, "register_near", lambda *_, **__: Alignment(pose, pose, 1, 0, 0) if is_near else rejected
    )
    monkeypatch.setattr(loops, "register_prepared", lambda *_, **__: rejected)
    config = load_config(None)
    no_points = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    closer = LoopCloser(
        config, PoseGraph(config.graph), lambda _: no_points, lambda _: no_points[1], NO_EDITS, is_known=True
    )
    described: list[int] = []
    monkeypatch.setattr(closer, "_observed", lambda number: number)
    monkeypatch.setattr(closer, "_prepared", described.append)
    (attempt,) = closer._attempts(LoopCandidate(9, 2, np.eye(4), 0.0, np.eye(6)), Stopwatch())
    assert isinstance(attempt.outcome, LoopClosure) == is_near
    assert sorted(described) == ([] if is_near else [2, 9])
