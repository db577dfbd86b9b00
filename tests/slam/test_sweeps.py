"""A drive through a walled yard by a spinning sensor that turns, whose points are not moved to one time."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.packed_drives import opened
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.points import voxel_first
from segslam.core.types import Motion, MotionState, Trajectory
from segslam.slam.adjustment.sweeps import (
    Correction,
    Sweep,
    Velocities,
    common_sweep,
    corrections_of,
    measure_sweep,
    swept,
    velocities_of,
)

CONFIG = Config().refine
NUM, STEP_M, INTERVAL_S = 36, 2.0, 0.2
TURNS_RAD = np.radians(8.0 * np.sin(np.arange(NUM)))
T_TRUE = np.array(
    [
        geometry.transform(geometry.yaw(turn), [STEP_M * (number - NUM / 2), 0.0, 0.0])
        for number, turn in enumerate(TURNS_RAD.tolist())
    ]
)
STILL = [Motion(MotionState.CONFIRMED)] * NUM


def drive(motions: list[Motion] = STILL) -> Velocities:
    stamp_ns = (1e9 * INTERVAL_S * np.arange(NUM)).astype(np.int64)
    return velocities_of(Trajectory(np.arange(NUM), stamp_ns, T_TRUE), np.arange(NUM), motions)


@cache
def points(keyframe_id: int, seconds: float, from_deg: float = 180.0) -> np.ndarray:
    """As measured in a sweep of this duration, which turns to the left."""
    T_lidar_yard = geometry.transform(geometry.yaw(-float(TURNS_RAD[keyframe_id])), 0.0)
    exact = geometry.apply(T_lidar_yard, seen(float(T_TRUE[keyframe_id, 0, 3]), seed=keyframe_id))
    made = exact - seconds * swept(exact, drive().per_second[keyframe_id], from_deg)
    return made[voxel_first(made, 0.25)].astype(np.float32)


def measured(seconds: float, from_deg: float = 180.0, velocities: Velocities | None = None) -> Sweep | None:
    return measure_sweep(
        lambda keyframe_id: points(keyframe_id, seconds, from_deg),
        T_TRUE,
        np.zeros(NUM, np.int64),
        velocities or drive(),
        config=CONFIG,
    )


@pytest.mark.long
@pytest.mark.parametrize(("seconds", "from_deg"), [(-0.1, 180.0), pytest.param(0.05, 90.0, marks=pytest.mark.long)])
def test_the_duration_and_the_side_of_a_sweep_are_measured(seconds: float, from_deg: float) -> None:
    found = measured(seconds, from_deg)
    assert found is not None
    assert found.from_deg == from_deg
    assert found.seconds == pytest.approx(seconds, abs=max(0.005, 3.0 * found.sigma_s))
    assert found.sigma_s < 0.005


def test_scans_at_one_time_have_no_sweep() -> None:
    assert measured(0.0) is None


@pytest.mark.long
def test_a_sensor_that_stands_and_a_short_drive_show_no_sweep() -> None:
    assert measured(-0.1, velocities=Velocities(np.zeros((NUM, 6)), INTERVAL_S)) is None
    few = Velocities(drive().per_second[:12], INTERVAL_S)
    raw = [points(number, -0.1) for number in range(12)]
    assert measure_sweep(raw.__getitem__, T_TRUE[:12], np.zeros(12, np.int64), few, config=CONFIG) is None


def test_pairs_across_a_break_show_no_sweep() -> None:
    def unread(keyframe_id: int) -> np.ndarray:
        raise AssertionError(f"keyframe {keyframe_id} was read")

    assert measure_sweep(unread, T_TRUE, np.arange(NUM), drive(), config=CONFIG) is None


@pytest.mark.long
def test_no_sweep_is_longer_than_the_time_between_scans() -> None:
    assert measured(-0.1, velocities=Velocities(drive().per_second, 0.06)) is None


def test_corrected_points_are_those_at_the_middle_of_the_sweep() -> None:
    velocity = geometry.tangent(rotation_rad=[0.0, 0.0, 0.5], translation_m=[8.0, 0.0, 0.0])
    ahead, left, right = (np.array([point], np.float32) for point in ([20.0, 0, 0], [0, 20.0, 0], [0, -20.0, 0]))
    clockwise = Correction(0.0, Sweep(-0.1, 0.001, 180.0), velocity)
    np.testing.assert_allclose(clockwise(ahead), ahead, atol=1e-6)
    moved = clockwise(left)
    assert moved.dtype == np.float32
    # a quarter of the sweep, 25 ms, before its middle: 0.2 m behind, and turned by 0.0125 rad to the right
    np.testing.assert_allclose(moved[0], [-0.2 + 20.0 * 0.0125, 20.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(clockwise(right)[0], [0.2 + 20.0 * 0.0125, -20.0, 0.0], atol=1e-3)
    np.testing.assert_array_equal(Correction()(left), left)


def test_velocities_do_not_reach_across_breaks() -> None:
    rows = np.array([0, 3, 4, NUM - 1])
    T = np.array([geometry.transform(np.eye(3), [2.0 * number, 0.0, 0.0]) for number in range(NUM)])
    T[4:, 1, 3] += 50.0
    stamp_ns = (1e9 * INTERVAL_S * np.arange(NUM)).astype(np.int64)
    motions = [Motion(MotionState.BROKEN if number == 4 else MotionState.CONFIRMED) for number in range(NUM)]
    found = velocities_of(Trajectory(np.arange(NUM), stamp_ns, T), rows, motions)
    np.testing.assert_allclose(found.per_second[:, 3:], np.tile([10.0, 0.0, 0.0], (4, 1)), atol=1e-9)
    assert found.interval_s == pytest.approx(INTERVAL_S)
    alone = velocities_of(Trajectory(rows[:1], stamp_ns[:1], T[:1]), rows[:1], motions[:1])
    assert not alone.per_second.any()
    assert alone.interval_s == 0.0


def test_drives_have_a_common_sweep_if_all_have_the_same() -> None:
    one, other = Sweep(-0.10, 0.001, 180.0), Sweep(-0.13, 0.002, 180.0)
    both = common_sweep([one, other])
    assert both is not None
    assert both.seconds == pytest.approx(-0.106)
    assert both.from_deg == 180.0
    assert common_sweep([one, None]) is None
    assert common_sweep([one, Sweep(-0.1, 0.001, 90.0)]) is None
    assert common_sweep([one, Sweep(0.1, 0.001, 180.0)]) is None
    assert common_sweep([]) is None
    assert len(corrections_of(0.1, one, drive())) == NUM


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("drive", "expected_s"), [("kitti_00_drive", -0.1036), ("nclt", None)])
def test_scans_of_kitti_are_sweeps_of_its_sensor_and_those_of_nclt_are_compensated(
    data_dir: Path, tmp_path: Path, drive: str, expected_s: float | None
) -> None:
    """KITTI's stamps are 0.1036 s apart; the scans of NCLT were compensated by those who published them."""
    scans = opened(data_dir, drive, tmp_path)
    assert scans.reference is not None
    truth = scans.reference
    rows = np.arange(len(truth))
    velocities = velocities_of(truth, rows, [Motion(MotionState.CONFIRMED)] * len(rows))
    found = measure_sweep(lambda row: scans[row].points, truth.T_world_lidar, 0 * rows, velocities, config=CONFIG)
    assert (found and found.seconds) == (expected_s and pytest.approx(expected_s, abs=0.004))
    assert found is None or found.from_deg == 180.0
