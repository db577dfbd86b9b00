"""A yard seen by beams that point too low, and real scans read with and without the correction of KITTI."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.packed_drives import opened
from helpers.yards import seen

from segslam.core import geometry
from segslam.core.config import RefineConfig, SensorCalibrationConfig
from segslam.core.geometry import raise_beams
from segslam.graph.graph import BREAK_LENGTH_M
from segslam.registration import refinement
from segslam.slam.adjustment import vertical_angle
from segslam.slam.adjustment.alignment import MIN_PAIRS, Shown
from segslam.slam.adjustment.vertical_angle import (
    BIAS_DEG,
    VerticalAngle,
    measure_vertical_angle,
    vertical_angle_advice,
)

CONFIG = RefineConfig()
LOW_DEG = 0.2


@cache
def points_at(x_m: float) -> np.ndarray:
    return refinement.downsample(seen(x_m, low_deg=LOW_DEG, seed=1000 + int(x_m)).astype(np.float32), config=CONFIG)


def poses_at(places_m: np.ndarray) -> np.ndarray:
    return np.array([geometry.transform(np.eye(3), [x_m, 0.0, 0.0]) for x_m in places_m]).reshape(-1, 4, 4)


def measured(places_m: np.ndarray) -> VerticalAngle | None:
    """Along the middle line of the yard, from place to place."""
    travel_m = np.abs(np.diff(places_m, prepend=places_m[:1])).cumsum()
    return measure_vertical_angle(lambda i: points_at(float(places_m[i])), poses_at(places_m), travel_m, config=CONFIG)


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


@pytest.mark.long
def test_a_drive_with_a_break_shows_the_angle_too() -> None:
    places_m = np.arange(-44.0, 45.0, 2.0)
    travel_m = places_m + 44.0 + np.where(places_m > 0.0, BREAK_LENGTH_M, 0.0)
    found = measure_vertical_angle(
        lambda i: points_at(float(places_m[i])),
        poses_at(places_m),
        travel_m,
        config=CONFIG,
        motion_variance=np.where(places_m == 2.0, 900.0, 0.0),
    )
    assert found is not None
    assert found.angle_deg == pytest.approx(LOW_DEG, abs=0.04)


@pytest.mark.long
@pytest.mark.parametrize("near_deg", [0.12, 0.3])
def test_the_angle_does_not_depend_on_one_measured_before(near_deg: float) -> None:
    places_m = np.arange(-30.0, 31.0, 2.0)
    drive = lambda i: points_at(float(places_m[i])), poses_at(places_m), places_m + 30.0
    first = measure_vertical_angle(*drive, config=CONFIG)
    assert first is not None
    found = measure_vertical_angle(*drive, config=CONFIG, near=replace(first, angle_deg=near_deg))
    assert found is not None
    assert found.angle_deg == pytest.approx(LOW_DEG, abs=0.04)


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


def measured_with(
    monkeypatch: pytest.MonkeyPatch, *left: tuple[float, float], near: VerticalAngle | None = None
) -> VerticalAngle | None:
    """The angle if pairs show these angles and errors, without a correction and with the ones that are tried."""
    shown_deg = iter(left)
    one = np.ones(1)
    monkeypatch.setattr(
        vertical_angle,
        "shown",
        lambda *_: Shown(*(one * value for value in next(shown_deg)), gain=one, num_pairs=17),
    )
    places_m = np.arange(-30.0, 31.0, 2.0)
    drive = lambda i: points_at(float(places_m[i])), poses_at(places_m), places_m + 30.0
    return measure_vertical_angle(*drive, config=CONFIG, near=near)


def test_an_angle_that_few_pairs_hardly_show_is_not_significant(monkeypatch: pytest.MonkeyPatch) -> None:
    """What 17 pairs show within 20 m of a campus, without a correction and with one: less than two deviations."""
    found = measured_with(monkeypatch, (-0.113, 0.061), (-0.047, 0.042))
    assert found is not None
    assert found.angle_deg == pytest.approx(-0.387, abs=0.01)
    assert not found.is_significant


def test_an_angle_beyond_what_pairs_can_show_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values of 70 degrees of view in a simulated warehouse: 5.8 degrees, which moves points 20 m away by 2 m."""
    assert measured_with(monkeypatch, (1.03, 0.10), (0.66, 0.11)) is None
    assert measured_with(monkeypatch, (0.6, 0.02), (0.0, 0.02)) is not None


def test_a_better_measurement_keeps_the_share_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values of KITTI 00. A second share, of two corrections near each other, would be that of their errors."""
    first = measured_with(monkeypatch, (0.075, 0.002), (0.018, 0.002))
    assert first is not None
    assert first.share == pytest.approx(0.38)
    assert first.angle_deg == pytest.approx(0.197, abs=0.001)
    found = measured_with(monkeypatch, (-0.0095, 0.002), near=first)
    assert found is not None
    assert found.angle_deg == pytest.approx(0.197 - 0.025, abs=0.001)
    assert found.sigma_deg == pytest.approx(np.hypot(0.002 / 0.38, BIAS_DEG))
    assert found.share == first.share


@pytest.mark.long
def test_a_gap_in_the_drive_is_passed_over() -> None:
    places_m = np.concatenate([np.arange(-30.0, 0.0, 2.0), np.arange(15.0, 45.0, 2.0)])
    found = measured(places_m)
    assert found is None or found.angle_deg == pytest.approx(LOW_DEG, abs=0.03)


def test_empty_scans_give_no_angle() -> None:
    places_m = np.arange(-30.0, 31.0, 2.0)
    empty = np.empty((0, 3), np.float32)
    assert measure_vertical_angle(lambda _: empty, poses_at(places_m), places_m + 30.0, config=CONFIG) is None


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
@pytest.mark.slow
@pytest.mark.parametrize("applied_deg", [0.0, 0.205])
def test_the_angle_that_readers_of_kitti_correct_is_found_in_its_scans(
    data_dir: Path, tmp_path: Path, applied_deg: float
) -> None:
    scans = opened(data_dir, "kitti_00_drive", tmp_path)
    assert scans.reference is not None
    poses = scans.reference.T_world_lidar
    travel_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1).cumsum()
    found = measure_vertical_angle(lambda i: raise_beams(scans[i].points, applied_deg), poses, travel_m, config=CONFIG)
    assert found is not None
    assert found.angle_deg == pytest.approx(0.205 - applied_deg, abs=0.03)
