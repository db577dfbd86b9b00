"""A yard seen by beams that point too low, and real scans read with and without the correction of KITTI."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.yards import seen

from segslam.candidates.proximity import BREAK_TRAVEL_M
from segslam.core import geometry
from segslam.core.config import RefineConfig, SensorCalibrationConfig
from segslam.core.geometry import raise_beams
from segslam.core.points import voxel_first, within_range
from segslam.core.trajectory import lidar_from_camera, read_poses
from segslam.odometry.calibration import (
    BIAS_DEG,
    MIN_PAIRED,
    MIN_PAIRS,
    VerticalAngle,
    angle_shown,
    leaving_none,
    measure_vertical_angle,
    register_with_angle,
    vertical_angle_advice,
)
from segslam.registration import refinement
from segslam.scans.kitti import read_calibration, read_returns

CONFIG = RefineConfig()
LOW_DEG = 0.2


def surface(points: np.ndarray) -> refinement.LightSurface:
    return refinement.LightSurface(refinement.downsample(points.astype(np.float32), config=CONFIG))


@cache
def points_at(x_m: float) -> np.ndarray:
    return refinement.downsample(seen(x_m, low_deg=LOW_DEG, seed=1000 + int(x_m)).astype(np.float32), config=CONFIG)


def poses_at(places_m: np.ndarray) -> np.ndarray:
    return np.array([geometry.transform(np.eye(3), [x_m, 0.0, 0.0]) for x_m in places_m]).reshape(-1, 4, 4)


def measured(places_m: np.ndarray) -> VerticalAngle | None:
    """Along the middle line of the yard, from place to place."""
    travel_m = np.abs(np.diff(places_m, prepend=places_m[:1])).cumsum()
    return measure_vertical_angle(lambda i: points_at(float(places_m[i])), poses_at(places_m), travel_m, config=CONFIG)


@pytest.mark.parametrize("low_deg", [-0.3, 0.0, 0.1, 0.4])
def test_the_angle_and_the_pose_are_found_together(low_deg: float) -> None:
    pitch_deg, way_m = 0.2, 12.0
    source = surface(seen(way_m / 2, low_deg=low_deg, pitch_deg=pitch_deg, seed=1))
    target = surface(seen(-way_m / 2, low_deg=low_deg))
    found = register_with_angle(source, target, geometry.transform(np.eye(3), [way_m + 0.2, 0.1, 0.05]))
    assert found is not None
    assert np.degrees(found.angle_rad) == pytest.approx(low_deg, abs=0.02)
    assert np.degrees(geometry.log(found.T_target_source)[1]) == pytest.approx(pitch_deg, abs=0.02)
    np.testing.assert_allclose(found.T_target_source[:3, 3], [way_m, 0.0, 0.0], atol=0.01)


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["forward", "backward"])
def test_a_drive_shows_the_angle_whichever_way_it_goes(direction: float) -> None:
    found = measured(direction * np.arange(-30.0, 31.0, 2.0))
    assert found is not None
    assert found.num_pairs >= MIN_PAIRS
    assert found.angle_deg == pytest.approx(LOW_DEG, abs=0.03)
    assert found.sigma_deg < 0.06
    assert found.is_significant


@pytest.mark.parametrize("num", [0, 1, 2])
def test_a_drive_shorter_than_a_pair_gives_no_angle(num: int) -> None:
    assert measured(2.0 * np.arange(num)) is None


def test_a_standing_sensor_gives_no_angle_however_long_its_jitter_grows() -> None:
    places_m = 0.3 * np.tile([0.0, 1.0], 60)
    assert measured(places_m) is None


def test_keyframes_farther_apart_than_a_pair_give_no_angle() -> None:
    assert measured(50.0 * np.arange(40)) is None


def test_a_drive_with_a_break_shows_the_angle_too() -> None:
    places_m = np.arange(-44.0, 45.0, 2.0)
    travel_m = places_m + 44.0 + np.where(places_m > 0.0, BREAK_TRAVEL_M, 0.0)
    found = measure_vertical_angle(lambda i: points_at(float(places_m[i])), poses_at(places_m), travel_m, config=CONFIG)
    assert found is not None
    assert found.angle_deg == pytest.approx(LOW_DEG, abs=0.04)


def test_the_angle_is_the_correction_that_leaves_none_whatever_the_first_one_was() -> None:
    """Although submaps of distorted scans show a part of it."""
    places_m = np.arange(-30.0, 31.0, 2.0)
    drive = lambda i: points_at(float(places_m[i])), poses_at(places_m), places_m + 30.0
    shown = [angle_shown(*drive, deg, config=CONFIG) for deg in (0.0, 0.1, LOW_DEG, 0.3)]
    medians_deg = [one.median_deg for one in shown if one is not None]
    assert len(medians_deg) == 4
    assert 0.9 * LOW_DEG > medians_deg[0] > medians_deg[1] > 0.0 > medians_deg[3]
    assert abs(medians_deg[2]) < 0.02
    for correction_deg in (0.1, 0.3):
        angle = leaving_none(shown[0], correction_deg, *drive, config=CONFIG)
        assert angle is not None
        assert angle.angle_deg == pytest.approx(LOW_DEG, abs=0.03)
        assert angle.shown == shown[0]
    assert leaving_none(shown[1], 0.1, *drive, config=CONFIG) is None, "a correction without effect"


def test_a_small_angle_is_as_uncertain_as_a_large_one() -> None:
    places_m = np.arange(-30.0, 31.0, 2.0)
    travel_m, poses = places_m + 30.0, poses_at(places_m)
    small = measure_vertical_angle(
        lambda i: raise_beams(points_at(float(places_m[i])), LOW_DEG), poses, travel_m, config=CONFIG
    )
    assert small is not None
    assert abs(small.angle_deg) < 0.02
    assert small.sigma_deg >= BIAS_DEG
    assert small.correction_deg == 0.0


def test_a_gap_in_the_drive_is_passed_over() -> None:
    places_m = np.concatenate([np.arange(-30.0, 0.0, 2.0), np.arange(15.0, 45.0, 2.0)])
    found = measured(places_m)
    assert found is None or found.angle_deg == pytest.approx(LOW_DEG, abs=0.03)


def test_too_few_points_give_no_angle() -> None:
    many = surface(seen(0.0, low_deg=0.1))
    few = surface(seen(0.0, low_deg=0.1)[: MIN_PAIRED // 2])
    assert register_with_angle(few, many, np.eye(4)) is None
    assert register_with_angle(many, few, np.eye(4)) is None


def test_scans_that_do_not_overlap_give_no_angle() -> None:
    far = geometry.transform(np.eye(3), [0.0, 0.0, 50.0])
    assert register_with_angle(surface(seen(0.0, low_deg=0.1)), surface(seen(5.0, low_deg=0.1)), far) is None


def test_scans_of_one_place_do_not_determine_the_angle() -> None:
    found = register_with_angle(surface(seen(0.0, low_deg=0.2, seed=1)), surface(seen(0.0, low_deg=0.2)), np.eye(4))
    assert found is None or np.degrees(found.sigma_rad) > 0.05


@pytest.mark.parametrize(
    ("metrics", "applied_deg", "expected"),
    [
        ({}, None, ""),
        ({"vertical_deg": 0.12, "vertical_sigma_deg": 0.05}, None, ""),
        ({"vertical_deg": 0.15, "vertical_sigma_deg": 0.07}, None, ""),
        (
            {"vertical_deg": 0.15, "vertical_sigma_deg": 0.03},
            None,
            "beams point 0.15 +- 0.03 degrees low; map again with --set sensor.vertical_angle_deg=0.15",
        ),
        (
            {"vertical_deg": -0.1, "vertical_sigma_deg": 0.02},
            0.205,
            "beams point 0.10 +- 0.02 degrees high; map again with --set sensor.vertical_angle_deg=0.10",
        ),
        (
            {"vertical_deg": 0.14, "vertical_sigma_deg": 0.03, "vertical_correction_deg": 0.14},
            None,
            "beams point 0.14 +- 0.03 degrees low; the adjustment and the map are corrected by it",
        ),
    ],
)
def test_only_a_significant_angle_is_reported_with_the_setting_that_corrects_it(
    metrics: dict[str, float], applied_deg: float | None, expected: str
) -> None:
    assert vertical_angle_advice(metrics, SensorCalibrationConfig(vertical_angle_deg=applied_deg)) == expected


@pytest.mark.data
@pytest.mark.parametrize(("target", "source"), [(0, 10), (10, 20), (20, 30)])
def test_the_angle_that_readers_of_kitti_correct_is_found_in_its_scans(
    data_dir: Path, target: int, source: int
) -> None:
    """One pair of real scans determines it to about 0.05 degrees, with and without the correction."""
    folder = data_dir / "kitti" / "sequences" / "00"
    T_camera_lidar = read_calibration(folder / "calib.txt")
    poses = lidar_from_camera(read_poses(data_dir / "kitti" / "poses" / "00.txt").T_a_b, T_camera_lidar)
    raw = [read_returns(folder / "velodyne" / f"{i:06d}.bin")[:, :3].astype(float) for i in (target, source)]
    found_deg = []
    for scans in (raw, [raise_beams(scan, 0.205) for scan in raw]):
        near = [scan[within_range(scan, 3.0, 100.0)] for scan in scans]
        clouds = [surface(scan[voxel_first(scan, 0.2)]) for scan in near]
        found = register_with_angle(clouds[1], clouds[0], geometry.inverse(poses[target]) @ poses[source])
        assert found is not None
        found_deg.append(np.degrees(found.angle_rad))
    assert found_deg[0] - found_deg[1] == pytest.approx(0.205, abs=0.05)
    assert found_deg[1] == pytest.approx(0.0, abs=0.1)
