"""A yard seen by beams that point too low and an encoder out of centre, and real scans read with 0.205 degrees more."""

from pathlib import Path

import numpy as np
import pytest
from yards import seen

from segslam import geometry, refine
from segslam.beam_angles import LEAST_PAIRED, OFFSET_RAD, raising, register, sample_angles, swinging
from segslam.config import RefineConfig
from segslam.datasets.kitti import correct_vertical_angle, read_calibration, read_returns
from segslam.points import voxel_first, within_range
from segslam.trajectory import lidar_from_camera, read_poses

CONFIG = RefineConfig()


def surface(points: np.ndarray) -> refine.Surface:
    return refine.prepare(refine.thin(points.astype(np.float32), config=CONFIG), config=CONFIG)


@pytest.mark.parametrize(("low_deg", "left_deg"), [(-0.3, 0.0), (0.0, 0.0), (0.1, -0.1), (0.4, 0.0), (0.0, 0.3)])
def test_the_angles_and_the_pose_are_found_together(low_deg: float, left_deg: float) -> None:
    pitch_deg, way_m = 0.2, 12.0
    source = surface(seen(way_m / 2, low_deg=low_deg, left_deg=left_deg, pitch_deg=pitch_deg, seed=1))
    target = surface(seen(-way_m / 2, low_deg=low_deg, left_deg=left_deg))
    found = register(source, target, geometry.transform(np.eye(3), [way_m + 0.2, 0.1, 0.05]))
    assert found is not None
    T_target_source, angle_rad = found
    assert np.degrees(angle_rad) == pytest.approx([low_deg, left_deg], abs=0.02)
    pitched = geometry.log(T_target_source)[1]
    assert np.degrees(pitched) == pytest.approx(pitch_deg, abs=0.02)
    np.testing.assert_allclose(T_target_source[:3, 3], [way_m, 0.0, 0.0], atol=0.01)


def test_a_raised_point_keeps_its_range_and_azimuth() -> None:
    points = np.random.default_rng(0).normal(scale=20.0, size=(50, 3))
    moved = points + 1e-6 * raising(points)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(points, axis=1), atol=1e-9)
    np.testing.assert_allclose(np.arctan2(moved[:, 1], moved[:, 0]), np.arctan2(points[:, 1], points[:, 0]), atol=1e-12)


def test_a_swung_point_keeps_its_range_and_height_and_turns_by_how_far_ahead_it_is() -> None:
    points = np.random.default_rng(0).normal(scale=20.0, size=(50, 3))
    moved = points + 1e-6 * swinging(points)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(points, axis=1), atol=1e-9)
    np.testing.assert_allclose(moved[:, 2], points[:, 2])
    np.testing.assert_allclose(azimuth - np.arctan2(moved[:, 1], moved[:, 0]), 1e-6 * np.cos(azimuth), atol=1e-11)


def test_raising_is_what_readers_of_kitti_do() -> None:
    points = np.random.default_rng(0).normal(scale=20.0, size=(50, 3))
    expected = points + np.radians(0.205) * raising(points)
    np.testing.assert_allclose(correct_vertical_angle(points), expected, atol=2e-3)  # 0.205 degrees squared, at 100 m


def test_too_few_points_tell_nothing() -> None:
    many = surface(seen(0.0, low_deg=0.1))
    few = surface(seen(0.0, low_deg=0.1)[: LEAST_PAIRED // 2])
    assert register(few, many, np.eye(4)) is None
    assert register(many, few, np.eye(4)) is None


def test_scans_that_do_not_meet_tell_nothing() -> None:
    far = geometry.transform(np.eye(3), [0.0, 0.0, 50.0])
    assert register(surface(seen(0.0, low_deg=0.1)), surface(seen(5.0, low_deg=0.1)), far) is None


def test_samples_say_how_much_too_far_down_and_left_the_odometry_turned() -> None:
    travel_m = np.arange(0.0, 61.0, 10.0)
    turned_rad_per_m = np.array([1e-4, -2e-4])
    T_odom = np.array(
        [
            geometry.exp(geometry.tangent(rotation_rad=[0, *turned_rad_per_m * way], translation_m=[way, 0, 0]))
            for way in travel_m
        ]
    )
    samples = sample_angles(lambda i: surface(seen(travel_m[i] - 30.0, low_deg=0.2, seed=i)), T_odom, travel_m)
    np.testing.assert_allclose(samples.travel_m, [10.0, 20.0, 30.0, 40.0])
    expected_deg = [0.2 - np.degrees(OFFSET_RAD), 0.0]
    np.testing.assert_allclose(np.degrees(samples.angle_rad), np.tile(expected_deg, (4, 1)), atol=0.03)
    np.testing.assert_allclose(samples.excess_rad_per_m, np.tile(turned_rad_per_m, (4, 1)), atol=3e-5)


@pytest.mark.parametrize("num", [1, 2])
def test_a_drive_shorter_than_a_pair_has_no_samples(num: int) -> None:
    poses, travel_m = np.tile(np.eye(4), (num, 1, 1)), np.arange(float(num))
    samples = sample_angles(lambda _: surface(seen(0.0, low_deg=0.0)), poses, travel_m)
    assert len(samples.travel_m) == 0


@pytest.mark.data
@pytest.mark.parametrize(("target", "source"), [(0, 10), (10, 20), (20, 30)])
def test_the_angle_that_readers_of_kitti_add_is_found_in_its_scans(data_dir: Path, target: int, source: int) -> None:
    """One pair of real scans knows it to some 0.05 degrees, and what errs is largely the same with and without."""
    folder = data_dir / "kitti" / "sequences" / "00"
    T_camera_lidar = read_calibration(folder / "calib.txt")
    poses = lidar_from_camera(read_poses(data_dir / "kitti" / "poses" / "00.txt").T_a_b, T_camera_lidar)
    raw = [read_returns(folder / "velodyne" / f"{i:06d}.bin")[:, :3].astype(float) for i in (target, source)]
    found_deg = []
    for scans in (raw, [correct_vertical_angle(scan) for scan in raw]):
        near = [scan[within_range(scan, 3.0, 100.0)] for scan in scans]
        clouds = [surface(scan[voxel_first(scan, 0.2)]) for scan in near]
        found = register(clouds[1], clouds[0], geometry.inverse(poses[target]) @ poses[source])
        assert found is not None
        found_deg.append(np.degrees(found[1][0]))
    assert found_deg[0] - found_deg[1] == pytest.approx(0.205, abs=0.05)
    assert found_deg[1] == pytest.approx(0.0, abs=0.1)
