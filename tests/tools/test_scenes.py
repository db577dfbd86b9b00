"""Verification in scenes other than streets: no wrong pose is accepted, and nearly all correct ones are."""

import math
from functools import cache

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Alignment, Registration, Rejected
from segslam.labels import geometric_labels
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.verification import pair, register_prepared
from tools.benchmarks import scenes
from tools.benchmarks.scene_drives import driven
from tools.benchmarks.scene_models import SCENES, SENSORS, corridor, pose, scan_points
from tools.benchmarks.scene_models_more import MORE_SCENES

CONFIG = Config()
TARGET_X, SOURCE_X = 20.0, 25.0
WRONG = ("accepted_wrong", "false_accepted")


@cache
def _corridor_scan(x: float) -> PreparedScan:
    """64 beams with 2 cm of noise, 1 m above the floor of a corridor 2.4 m wide with a door every 3 m."""
    rng = np.random.default_rng(int(x))
    T_world_lidar = geometry.transform(np.eye(3), [x, 0.0, 1.0])
    points = scan_points(corridor(0, regular=True), "64", T_world_lidar, noise_m=0.02, rng=rng)
    return prepare_scan(points, geometric_labels(points), config=CONFIG)


def _from(T_target_source: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> Alignment | Rejected:
    """What becomes of one coarse pose, the only one that is tried."""
    coarse = Registration(T_target_source, 9, 9, 0.1, np.eye(6))
    monkeypatch.setattr(pair.Trial, "coarse_poses", lambda _: iter([coarse]))
    return register_prepared(_corridor_scan(SOURCE_X), _corridor_scan(TARGET_X), config=CONFIG)


@pytest.mark.parametrize("slid_m", [1.26, -1.26, 3.0, 8.7])
def test_a_pose_slid_along_a_corridor_is_not_accepted(slid_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    found = _from(geometry.transform(np.eye(3), [SOURCE_X - TARGET_X + slid_m, 0.0, 0.0]), monkeypatch)
    assert not _is_wrong(found), found


def test_a_pose_turned_round_in_a_corridor_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    for shift_m in (5.0, 5.5, 4.5):
        found = _from(geometry.transform(geometry.yaw(math.pi), [shift_m, 0.0, 0.0]), monkeypatch)
        assert not _is_wrong(found), (shift_m, found)


@pytest.mark.parametrize(
    ("scene", "sensor", "source", "target", "shift_m", "turn_deg"),
    [
        ("tunnel", "non-repeating", (2, 24, 1), (2, 94, 3), (-4.61, 0.05, 0.16), 0.0),
        ("tunnel", "non-repeating", (4, 108, 1), (4, 63, 3), (-1.26, -0.03, 0.07), 0.0),
        ("tunnel", "32", (6, 44, 0), (6, 104, 3), (1.72, -0.11, 0.04), 180.0),
        ("tunnel", "70 wide", (104, 133, 0), (4, 76, 2), (0.17, 0.26, 0.03), -4.9),
        ("corridor", "64", (2, 10, 1), (2, 83, 3), (-1.34, 0.16, -0.08), -170.9),
    ],
)
def test_two_places_of_which_a_part_has_the_same_shape_are_not_taken_for_one(
    scene: str,
    sensor: str,
    source: tuple[int, int, int],
    target: tuple[int, int, int],
    shift_m: tuple[float, float, float],
    turn_deg: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Scans by seed of the scene, row of its path and visit. The walls match anywhere, and here one niche does too."""
    coarse = Registration(geometry.transform(geometry.yaw(math.radians(turn_deg)), shift_m), 9, 9, 0.1, np.eye(6))
    monkeypatch.setattr(pair.Trial, "coarse_poses", lambda _: iter([coarse]))
    one, other = (
        scenes.Place(SCENES[scene](seed), sensor, 0.03, seed, CONFIG).prepared(row, visit)
        for seed, row, visit in (source, target)
    )
    found = register_prepared(one, other, config=CONFIG)
    assert isinstance(found, Rejected), found


def test_among_equal_cars_free_places_decide_which_pose_is_right() -> None:
    """Of a wrong pose between cars of two rows, the cars fit almost as well, but some stand where places were free."""
    lot = scenes.Place(SCENES["parking lot"](0), "32", 0.03, 0, CONFIG)
    T_target_source = geometry.inverse(lot.pose(126, 2)) @ lot.pose(113, 0)
    found = register_prepared(lot.prepared(113, 0), lot.prepared(126, 2), config=CONFIG)
    assert isinstance(found, Alignment), found
    assert geometry.distance(geometry.inverse(T_target_source) @ found.fine.T_target_source) < 0.1


@pytest.mark.parametrize(("source", "target"), [((71, 0), (15, 2)), ((22, 0), (76, 2))])
def test_noise_does_not_hide_that_the_doors_are_elsewhere(source: tuple[int, int], target: tuple[int, int]) -> None:
    """Two places of a corridor, seen with 10 cm of noise; poses of which the doors lay in walls were accepted."""
    place = scenes.Place(SCENES["corridor"](2), "64", 0.1, 2, CONFIG)
    found = register_prepared(place.prepared(*source), place.prepared(*target), config=CONFIG)
    assert isinstance(found, Rejected), found


@pytest.mark.parametrize("noise_m", [0.03, 0.1])
def test_one_side_of_a_place_is_not_enough_where_free_space_is_violated(noise_m: float) -> None:
    """The ends of a corridor, seen by 70 degrees of view: two walls and a door match, another door does not."""
    place = scenes.Place(SCENES["corridor"](2), "70 wide", noise_m, 2, CONFIG)
    found = register_prepared(place.prepared(15, 1), place.prepared(86, 2), config=CONFIG)
    assert isinstance(found, Rejected), found


def test_where_a_direction_is_badly_observed_little_free_space_may_be_violated() -> None:
    """Two places between equal cars: a third of the points match, and others lie where the view was free."""
    lot = scenes.Place(SCENES["parking lot"](5), "90 high", 0.03, 5, CONFIG)
    found = register_prepared(lot.prepared(72, 1), lot.prepared(195, 2), config=CONFIG)
    assert isinstance(found, Rejected), found


@pytest.mark.parametrize("name", SCENES)
def test_a_sensor_has_room_and_something_to_see_along_the_whole_path(name: str) -> None:
    scene = SCENES[name](5)
    for row in range(0, len(scene.path), 12):
        rng = np.random.default_rng(row)
        points = scan_points(scene, "16", pose(scene, row, rng), noise_m=0.0, rng=rng)
        ranges = np.linalg.norm(points, axis=1)
        assert len(points) > 3000, row
        assert ranges.min() > 0.5, row
        assert np.ptp(points, axis=0).min() > 1.0, row  # no direction without extent
    assert not np.array_equal(SCENES[name](6).mesh.vertices, scene.mesh.vertices)


def _is_wrong(found: Alignment | Rejected) -> bool:
    """Accepted, and not where the source stands."""
    if isinstance(found, Rejected):
        return False
    T = geometry.inverse(geometry.transform(np.eye(3), [SOURCE_X - TARGET_X, 0.0, 0.0])) @ found.fine.T_target_source
    return geometry.distance(T) > 0.5 or geometry.angle(T) > math.radians(2.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scene", "sensor", "noise_m", "kept"),
    [("corridor", "64", 0.03, 0.7), ("garage", "16", 0.01, 0.7), ("parking lot", "non-repeating", 0.03, 0.5)],
)
def test_no_wrong_pose_is_accepted_and_correct_ones_are_kept(
    scene: str, sensor: str, noise_m: float, kept: float
) -> None:
    _check(scene, sensor, noise_m, count=4, kept=kept)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [name for name in SCENES if name not in MORE_SCENES])
def test_every_scene_that_the_score_knows_holds_over_all_sensors(scene: str) -> None:
    """The page of benchmarks has the others, where it keeps fewer."""
    rows = [scenes.bench(scene, sensor, 0.03, count=8, seed=2, config=CONFIG) for sensor in SENSORS]
    total = {key: sum(int(str(row[key])) for row in rows) for key in ("overlapping", "kept", *WRONG)}
    assert sum(total[key] for key in WRONG) <= 1, rows
    assert total["kept"] >= 0.8 * total["overlapping"], rows


def _check(scene: str, sensor: str, noise_m: float, *, count: int, kept: float) -> None:
    row = scenes.bench(scene, sensor, noise_m, count=count, seed=2, config=CONFIG)
    assert row["false_accepted"] == 0, row
    assert row["accepted_wrong"] == 0, row
    assert row["kept"] >= kept * row["overlapping"], row


def test_a_drive_leads_through_a_scene_and_back() -> None:
    drive = driven("forest", "16", 3, 1)
    moved = geometry.inverse(drive.T_world_lidar[0]) @ drive.T_world_lidar[-1]
    assert geometry.distance(moved) < 0.5
    assert np.degrees(geometry.angle(moved)) > 170.0
    steps_m = np.linalg.norm(np.diff(drive.T_world_lidar[:, :3, 3], axis=0), axis=1)
    assert steps_m.max() < 0.5
    assert steps_m.sum() > 130.0
    assert len(drive.points_of(0)) > 5000
