import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config, KeyframeConfig
from segslam.core.types import Keyframe, Label
from segslam.keyframes import CloudStore, KeyframeSelector, Submaps, downsample_keyframe

CONFIG = KeyframeConfig(distance_m=2.0)


def _at(x: float, yaw_deg: float = 0.0) -> np.ndarray:
    return geometry.transform(geometry.yaw(np.radians(yaw_deg)), [x, 0.0, 0.0])


def test_the_first_scan_is_a_keyframe_wherever_it_is() -> None:
    assert KeyframeSelector(CONFIG).update(_at(17.0))


def test_a_keyframe_comes_once_the_last_is_far_enough_away() -> None:
    selector = KeyframeSelector(CONFIG)
    cut = [x for x in range(8) if selector.update(_at(0.75 * x))]
    assert cut == [0, 3, 6], "2.25 and 4.5 m: the distance counts from the last keyframe, not in steps of 2 m"


def test_turning_on_the_spot_cuts_keyframes() -> None:
    selector = KeyframeSelector(CONFIG)
    cut = [yaw for yaw in range(0, 61, 15) if selector.update(_at(0.0, yaw))]
    assert cut == [0, 30, 60]
    assert selector.travel_m == 0.0


def test_travel_is_the_length_of_the_path_through_every_scan() -> None:
    selector = KeyframeSelector(CONFIG)
    for x in (5.0, 6.0, 5.0, 9.0):
        selector.update(_at(x))
    assert selector.travel_m == pytest.approx(6.0)


def test_a_standing_sensor_that_jitters_cuts_no_keyframe() -> None:
    selector = KeyframeSelector(CONFIG)
    cut = [selector.update(_at(0.05 * (-1) ** i)) for i in range(200)]
    assert sum(cut) == 1
    assert selector.travel_m > 10.0, "else the test would not tell distance from path"


def test_the_first_scan_after_a_break_is_a_keyframe_and_the_path_has_its_real_length() -> None:
    selector = KeyframeSelector(CONFIG)
    selector.update(_at(0.0))
    assert not selector.update(_at(0.1))
    assert selector.update(_at(0.3), after_break=True)
    assert selector.travel_m == pytest.approx(0.3)


def test_a_submap_has_the_neighbours_whose_pose_is_known_to_a_voxel() -> None:
    """Five scans of a thin ring of points a metre apart; the standard deviation of the third motion is 0.6 m."""
    ring = np.column_stack([np.cos(np.arange(400)), np.sin(np.arange(400)), np.zeros(400)]).astype(np.float32) * 10.0
    store = CloudStore(CONFIG.resolution_m)
    variance = np.array([0.0, 0.01, 0.01, 0.36, 0.01])
    submaps = Submaps(Config(), store.cloud, lambda points: np.zeros(len(points), np.uint8), lambda: variance)
    for row in range(5):
        store.keep(Keyframe(row, row, 0, _at(float(row)), float(row), ring, np.zeros(400, np.uint8)))
        submaps.add(_at(float(row)), labelled_by_shape=False)
    assert [len(submaps.gathered(row).points) // 400 for row in range(5)] == [3, 3, 3, 2, 2]
    variance[3] = 0.01
    assert len(submaps.gathered(2).points) == 5 * 400


@pytest.mark.parametrize("reach_m", [90.0, 400.0], ids=["two bytes a number", "four bytes"])
def test_a_cloud_is_given_as_it_was_kept(reach_m: float) -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 20, 5_000).astype(np.uint8)
    points, labels, _ = downsample_keyframe(
        rng.uniform(-reach_m, reach_m, (5_000, 3)), labels, config=CONFIG, whole_classes=(Label.CAR, Label.TRUNK)
    )
    store = CloudStore(CONFIG.resolution_m)
    for keyframe_id in (0, 1):
        store.keep(Keyframe(keyframe_id, 0, 0, np.eye(4), 0.0, points[keyframe_id:], labels[keyframe_id:]))
    kept_points, kept_labels = store.cloud(1)
    np.testing.assert_array_equal(kept_points, points[1:])
    assert kept_points.dtype == np.float32
    np.testing.assert_array_equal(kept_labels, labels[1:])
