"""Closures found again on scans that are known better, where samples say that the odometry was bent."""

import numpy as np
from yards import seen

from segslam import geometry, refine
from segslam.config import GraphConfig, RefineConfig
from segslam.pose_graph import PoseGraph
from segslam.straightening import sample, sharpened, straighten
from segslam.types import Alignment, AngleSamples, LoopClosure, Registration

CONFIG = RefineConfig()
LOW_DEG, LEFT_DEG = 0.4, 0.3
WAY_M = 6.0
T_TRUE = geometry.transform(geometry.yaw(np.pi), [WAY_M, 0.0, 0.0])
"""The second scan in the first: met from the other side."""


def points_of(keyframe_id: int) -> np.ndarray:
    """The first two keyframes see the yard; all others nothing."""
    if keyframe_id > 1:
        return np.zeros((0, 3), dtype=np.float32)
    x_m = (keyframe_id - 0.5) * WAY_M
    points = seen(x_m, low_deg=LOW_DEG, left_deg=LEFT_DEG, is_reversed=keyframe_id == 1, seed=keyframe_id)
    return points.astype(np.float32)


def found(source_id: int = 1) -> LoopClosure:
    """As refined on the scans as they are, or the true motion if the source sees nothing."""
    fine = Registration(T_TRUE, 0, 0, 0.0, 1e4 * np.eye(6))
    if source_id == 1:
        source, target = (refine.prepare(refine.thin(points_of(i), config=CONFIG), config=CONFIG) for i in (1, 0))
        refined = refine.refine(source, target, T_TRUE, config=CONFIG)
        assert isinstance(refined, Registration)
        fine = refined
    return LoopClosure(source_id, 0, fine.T_target_source, fine.information, Alignment(fine, fine, 1.0, 0.0, 0.0))


def error(closure: LoopClosure) -> np.ndarray:
    return geometry.log(geometry.inverse(T_TRUE) @ closure.T_target_source)


def drive(num: int = 2) -> tuple[PoseGraph, np.ndarray]:
    poses = np.array([geometry.transform(np.eye(3), [10.0 * i, 0.0, 0.0]) for i in range(num)])
    graph = PoseGraph(GraphConfig())
    for i, T_odom_keyframe in enumerate(poses):
        graph.add_keyframe(i, T_odom_keyframe, 10.0 * i)
    return graph, poses


def test_a_closure_on_corrected_scans_is_nearer_to_the_truth() -> None:
    before = found()
    angles_rad = np.radians(np.tile([LOW_DEG, LEFT_DEG], (2, 1)))
    (after,) = sharpened([before], points_of, angles_rad, config=CONFIG)
    assert np.linalg.norm(error(before)[3:]) > 0.03, "else there is nothing to sharpen"
    assert np.linalg.norm(error(after)[3:]) < 0.01
    assert np.degrees(np.linalg.norm(error(after)[:3])) < 0.02
    assert (after.source_id, after.target_id, after.alignment) == (1, 0, before.alignment)


def test_a_closure_that_cannot_be_refined_again_stays_as_it_was() -> None:
    before = found(source_id=2)
    (after,) = sharpened([before], points_of, np.zeros((3, 2)), config=CONFIG)
    assert after is before


def test_a_drive_that_tells_too_little_is_left_as_it_is() -> None:
    graph, poses = drive()
    graph.add_closure(found())
    told = sample(points_of, poses, graph.travel_m, config=CONFIG)
    evidence = straighten(graph, [found()], told, points_of, config=CONFIG)
    assert not evidence.chosen
    graph.finish()
    untouched, _ = drive()
    untouched.add_closure(found())
    untouched.finish()
    np.testing.assert_array_equal(graph.T_world_keyframes, untouched.T_world_keyframes)


def test_a_drive_that_was_bent_is_straightened_with_its_closures() -> None:
    num = 60
    angle_rad = np.radians(np.tile([LOW_DEG, LEFT_DEG], (num, 1)))
    noise = np.random.default_rng(0).normal(size=(num, 2))
    told = AngleSamples(
        10.0 * np.arange(num), angle_rad + np.radians(0.05) * noise, angle_rad / 45.0 * (1 + 0.1 * noise)
    )
    graph, _ = drive(num)
    graph.add_closure(found())
    weights = graph.finish().closure_weights
    assert straighten(graph, [found()], told, points_of, config=CONFIG).chosen
    estimate = graph.finish()
    assert estimate.closure_weights.keys() == weights.keys()
    assert graph.T_world_keyframes[-1, 2, 3] > 10.0, "turned up, for the odometry turned down"
    assert graph.T_world_keyframes[-1, 1, 3] < -10.0, "turned right"
