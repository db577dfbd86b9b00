import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import KeyframeConfig
from segslam.core.types import Keyframe, Label
from segslam.keyframes import CloudStore, KeyframeSelector, downsample_keyframe

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
