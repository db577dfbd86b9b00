"""Adjustment of several drives with what is known from their own adjustments."""

import numpy as np
import pytest
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.points import voxel_first
from segslam.core.types import Transform
from segslam.graph import PoseGraph
from segslam.slam.adjustment.alignment import Alignment
from segslam.slam.adjustment.known import STEP_M, STEP_RAD, Compute, Guess, Known, rounded, transform_of
from segslam.slam.adjustment.rounds import adjust
from segslam.slam.adjustment.sweeps import Correction, Velocities
from segslam.slam.adjustment.vertical_angle import VerticalAngle

RNG = np.random.default_rng(2)
NUM, STEP = 24, 2.0
X_M = np.arange(NUM) * STEP - NUM * STEP / 2
STILL = Velocities(np.zeros((NUM, 6)), 0.1)
T_TRUE = np.array([geometry.transform(np.eye(3), [x_m, 0.0, 0.0]) for x_m in X_M])


def _points(keyframe_id: int) -> np.ndarray:
    made = seen(float(X_M[keyframe_id]), low_deg=0.0, seed=keyframe_id).astype(np.float32)
    return made[voxel_first(made, 0.25)]


def _graph(bend_deg: float) -> PoseGraph:
    turn = geometry.exp(geometry.tangent(rotation_rad=[0.0, np.radians(-bend_deg), 0.0], translation_m=0.0))
    made, T_odom = PoseGraph(Config().graph), np.eye(4)
    for keyframe_id in range(NUM):
        made.add_keyframe(keyframe_id, T_odom, STEP * keyframe_id)
        T_odom = T_odom @ geometry.transform(np.eye(3), [STEP, 0.0, 0.0]) @ turn
    return made


def test_a_rounded_guess_is_at_most_half_a_step_away() -> None:
    for _ in range(50):
        T = geometry.exp(RNG.normal(size=6) * [0.02, 0.02, 1.5, 5.0, 5.0, 0.5])
        T_rounded = transform_of(rounded(T))
        assert rounded(T_rounded) == rounded(T)
        assert np.abs(T_rounded[:3, 3] - T[:3, 3]).max() <= STEP_M / 2
        assert geometry.angle(geometry.inverse(T_rounded) @ T) <= np.sqrt(3) * STEP_RAD / 2 + 1e-9


@pytest.mark.slow
def test_kept_alignments_are_used_again_and_give_the_same_poses() -> None:
    kept: dict[tuple[int, int, Guess], Alignment | None] = {}
    num_computed = []

    def keep(target_id: int, source_id: int, guess: Guess, compute: Compute) -> Alignment | None:
        key = (target_id, source_id, guess)
        if key not in kept:
            num_computed.append(key)
            kept[key] = compute()
        return kept[key]

    found: list[np.ndarray] = []
    for bend_deg in (0.02, 0.02, 0.021):
        made, before = _graph(bend_deg), len(num_computed)
        known = Known(T_TRUE, [Correction()] * NUM, None, None, keep)
        result = adjust(made, made.finish(), _points, STILL, config=Config(), known=known)
        assert result is not None
        assert result.record.vertical_deg is None, "it is not measured again"
        found.append(made.T_world_keyframes.copy())
        if len(found) == 1:
            assert len(num_computed) >= 17, "pairs 5 and 10 keyframes apart"
        else:
            assert len(num_computed) - before <= (0 if len(found) == 2 else 5)
    np.testing.assert_array_equal(found[0], found[1])
    T_first_last = geometry.inverse(found[0][0]) @ found[0][-1]
    drift_m = geometry.distance(geometry.inverse(T_TRUE[0]) @ T_TRUE[-1] @ geometry.inverse(T_first_last))
    assert drift_m < 0.1


def test_submaps_are_built_by_the_poses_of_the_drives_and_with_their_corrections() -> None:
    seen_guesses: list[Transform] = []
    angle = VerticalAngle(0.2, 0.03, 8)

    def exact(target_id: int, source_id: int, guess: Guess, compute: Compute) -> Alignment | None:
        seen_guesses.append(transform_of(guess))
        return compute()

    sources = []
    for correction_deg in (0.0, 0.2):
        known = Known(T_TRUE, [Correction(correction_deg)] * NUM, angle, None, exact)
        aligned = known.aligned(_points, STEP * np.arange(NUM), config=Config().refine)
        found = aligned(4, 9, geometry.inverse(T_TRUE[4]) @ T_TRUE[9])
        assert found is not None
        sources.append(found)
    assert len(seen_guesses) == 2
    truth = geometry.inverse(T_TRUE[4]) @ T_TRUE[9]
    assert geometry.distance(geometry.inverse(truth) @ sources[0].T_target_source) < 0.03
    assert not np.array_equal(sources[0].T_target_source, sources[1].T_target_source)
