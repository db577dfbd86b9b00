"""Worlds made by hand, symmetries, and real scans against their ground truth."""

import numpy as np
import pytest

from segslam.core.geometry import yaw
from segslam.core.types import GROUND_LABELS, Label
from segslam.labels import geometric, geometric_labels
from segslam.scans import open_dataset

SENSOR_HEIGHT_M = 1.7
BAND_M = (0.7, 2.3)
"""Heights of the points that are judged: well within the band of the labels."""


def _sheet(origin, along, up, *, step_m=0.08):
    """Points of a rectangle spanned by two edges from a corner."""
    along, up = np.asarray(along, float), np.asarray(up, float)
    u = np.arange(0.0, 1.0, step_m / np.linalg.norm(along))
    v = np.arange(0.0, 1.0, step_m / np.linalg.norm(up))
    a, b = np.meshgrid(u, v)
    return np.asarray(origin, float) + a.reshape(-1, 1) * along + b.reshape(-1, 1) * up


def _post(x, y, height_m=2.5):
    return np.vstack([_sheet([x, y, 0], side, [0, 0, height_m]) for side in ([0.1, 0, 0], [0, 0.1, 0])])


def _tree(x, y):
    """(trunk, crown): a post under a ball of leaves whose lower side is 2 m high."""
    crown = np.random.default_rng(2).normal(size=(3000, 3))
    crown *= 1.5 / np.linalg.norm(crown, axis=1, keepdims=True)
    return _post(x, y, 2.0), crown + np.array([x, y, 3.5])


def _world():
    """Points (sensor at the origin), and the label each ought to have."""
    trunk, crown = _tree(10.0, 9.0)
    bush = np.random.default_rng(1).uniform([-6, -4, 0.0], [-5, -3, 1.9], (600, 3))
    parts = (
        (Label.ROAD, _sheet([-20, -20, 0], [40, 0, 0], [0, 40, 0], step_m=0.2)),
        (Label.POLE, _post(6, 4)),
        (Label.POLE, trunk),
        (Label.VEGETATION, crown),
        (Label.TRUNK, bush),
        (
            Label.CAR,
            np.vstack([_sheet([-8, 3, 0], [4, 0, 0], [0, 0, 1.5]), _sheet([-4, 3, 0], [0, 1.7, 0], [0, 0, 1.5])]),
        ),
        (Label.BUILDING, _sheet([-15, -12, 0], [25, 0, 0], [0, 0, 5])),
    )
    points = np.vstack([part for _, part in parts])
    return points - [0, 0, SENSOR_HEIGHT_M], np.repeat([int(label) for label, _ in parts], [len(p) for _, p in parts])


def _shares(labels, truth, points):
    """Share of the points of each class that got it; of things on the ground, points within BAND_M."""
    height_m = points[:, 2] + SENSOR_HEIGHT_M
    judged = (truth == Label.ROAD) | (height_m > BAND_M[0]) & ((height_m < BAND_M[1]) | (truth == Label.VEGETATION))
    return {Label(c).name: float((labels[judged & (truth == c)] == c).mean()) for c in np.unique(truth)}


@pytest.mark.parametrize("yaw_deg", [0, 17, 45, 90, 200])
def test_the_objects_of_a_small_world_are_classified_from_any_side(yaw_deg):
    points, truth = _world()
    turned = points @ yaw(np.radians(yaw_deg)).T
    shares = _shares(geometric_labels(turned), truth, points)
    assert min(shares.values()) > 0.9, shares


def test_a_tilted_sensor_gives_the_same_labels():
    points, truth = _world()
    c, s = np.cos(0.3), np.sin(0.3)
    leaning = points @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T
    shares = _shares(geometric_labels(leaning), truth, points)
    assert min(shares.values()) > 0.9, shares


@pytest.mark.parametrize("mount_m", [0.5, 1.2, 3.0])
def test_the_sensor_may_be_mounted_at_any_height(mount_m):
    points, truth = _world()
    labels = geometric_labels(points + np.array([0, 0, SENSOR_HEIGHT_M - mount_m]))
    shares = _shares(labels, truth, points)
    assert min(shares.values()) > 0.9, shares


def test_permuting_the_points_permutes_the_labels():
    points, _ = _world()
    order = np.random.default_rng(3).permutation(len(points))
    labels = geometric_labels(points)
    np.testing.assert_array_equal(geometric_labels(points[order]), labels[order])


def test_of_many_poles_the_most_seen_are_kept(monkeypatch):
    posts = [_post(6.0 + 2 * k, y, height_m) for k in range(5) for y, height_m in ((4.0, 2.5), (-4.0, 1.5))]
    points = np.vstack([_world()[0][:40_000], *(post - [0, 0, SENSOR_HEIGHT_M] for post in posts)])
    monkeypatch.setattr(geometric, "MAX_THINGS", 5)
    poles = points[geometric_labels(points) == Label.POLE]
    assert {int(np.sign(y)) for y in poles[:, 1]} == {1}  # the taller row


@pytest.mark.parametrize("num_points", [0, 1, 2, 9, 50])
def test_tiny_clouds_get_labels(num_points):
    points = np.random.default_rng(num_points).normal(size=(num_points, 3)) * 5
    assert geometric_labels(points).shape == (num_points,)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e6])
def test_points_that_are_not_finite_or_far_stay_unlabelled(value):
    points, _ = _world()
    labels = geometric_labels(np.vstack([points, np.full((5, 3), value)]))
    assert not labels[-5:].any()
    np.testing.assert_array_equal(labels[:-5], geometric_labels(points))


@pytest.mark.parametrize(
    "points",
    [np.ones((1000, 3)), np.zeros((1000, 3)), np.linspace([-5, -5, -2], [5, 5, 2], 1000), np.full((7, 3), np.nan)],
    ids=["one place", "the origin", "a line", "nan"],
)
def test_degenerate_clouds_get_labels(points):
    assert geometric_labels(points).shape == (len(points),)


def test_single_precision_gives_the_same_labels():
    points = _world()[0].astype(np.float32)
    labels = geometric_labels(points.astype(np.float64))
    np.testing.assert_array_equal(geometric_labels(points), labels)


def _iou(labels, truth, classes):
    ours, theirs = np.isin(labels, classes), np.isin(truth, classes)
    return (ours & theirs).sum() / (ours | theirs).sum()


@pytest.mark.data
def test_real_scans_agree_with_their_ground_truth(data_dir):
    scans = list(open_dataset(data_dir / "kitti", sequence="00", frames="0:3"))
    labels = np.concatenate([geometric_labels(scan.points) for scan in scans])
    truth = np.concatenate([scan.labels for scan in scans])
    known = truth != Label.UNLABELLED
    floors = {  # measured 0.92, 0.83, 0.68, 0.64, 0.52
        GROUND_LABELS: 0.88,
        (Label.CAR, Label.MOVING_CAR): 0.7,
        (Label.BUILDING,): 0.55,
        (Label.VEGETATION,): 0.55,
        (Label.TRUNK, Label.POLE): 0.4,
    }
    for classes, floor in floors.items():
        assert _iou(labels[known], truth[known], classes) > floor, classes


@pytest.mark.data
def test_turning_a_real_scan_changes_few_labels(real_pairs):
    points = real_pairs.points(0)
    labels = geometric_labels(points)
    for yaw_deg, share in ((90, 0.001), (30, 0.07)):  # measured 0.0000 and 0.041: grids do not turn with the points
        turned = geometric_labels(points @ yaw(np.radians(yaw_deg)).T)
        assert (turned != labels).mean() < share
