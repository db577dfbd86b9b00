"""What the patches of two scans show at a pose."""

import math

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import Config
from segslam.registration.prepared import Observed, prepare_observed
from segslam.verification.patches import BINS, KINDS, agreement, counts_at, first_look, patches_of

CONFIG = Config()


def _room(seed: int, length_m: float = 16.0) -> Observed:
    """A scan from the middle of a room 8 m wide, with a pillar on one side; 1 cm of noise."""
    rng = np.random.default_rng(seed)
    side, end, ground = (rng.uniform(-1.0, 1.0, size=(4000, 3)) for _ in range(3))
    side *= [length_m / 2, 1.0, 1.5]
    side[:, 1] = np.sign(side[:, 1]) * 4.0
    end *= [1.0, 4.0, 1.5]
    end[:, 0] = np.sign(end[:, 0]) * length_m / 2
    ground *= [length_m / 2, 4.0, 0.0]
    pillar = rng.uniform(-1.0, 1.0, size=(800, 3)) * [0.6, 0.6, 1.5]
    nearest = np.abs(pillar[:, :2]).argmax(axis=1)
    rows = np.arange(len(pillar))
    pillar[rows, nearest] = np.sign(pillar[rows, nearest]) * 0.6
    points = np.concatenate([side, end, ground - np.array([0.0, 0.0, 1.5]), pillar + np.array([3.0, 2.0, 0.0])])
    points += rng.normal(scale=0.01, size=points.shape)
    return prepare_observed(points.astype(np.float32), np.zeros(len(points), np.uint8), config=CONFIG)


def _shares(T_target_source: np.ndarray) -> dict[str, float]:
    """Shares of the patches, near and far, by what they show."""
    counts = agreement(_room(1), _room(2), T_target_source).counts
    return dict(zip(KINDS, counts.reshape(2, -1).sum(axis=0) / counts.sum(), strict=True))


def test_at_the_true_pose_patches_lie_on_the_surfaces_of_the_other_scan() -> None:
    shares = _shares(np.eye(4))
    assert shares["free space"] < 0.02
    assert sum(share for name, share in shares.items() if "residual" in name) > 0.8
    assert shares["hidden"] < 0.1
    found = agreement(_room(1), _room(2), np.eye(4))
    assert found.overlap > 0.95
    assert found.rms_m < 0.05
    assert found.free_space_violation < 0.01


@pytest.mark.parametrize("along_m", [0.0, 3.0, 500.0])
def test_patches_are_counted_without_what_else_two_scans_show(along_m: float) -> None:
    moved = geometry.transform(geometry.yaw(0.3), [along_m, 0.5, 0.0])
    np.testing.assert_array_equal(counts_at(_room(1), _room(2), moved), agreement(_room(1), _room(2), moved).counts)


def test_patches_are_in_free_space_or_hidden_behind_what_the_other_scan_saw() -> None:
    """Turned by 90 degrees, the sides of the room stand in its middle, and its ends behind its walls."""
    turned = geometry.transform(geometry.yaw(np.pi / 2), 0.0)
    assert _shares(turned)["free space"] > 0.2
    assert _shares(turned)["hidden"] > 0.2
    assert agreement(_room(1), _room(2), turned).free_space_violation > 0.1


def test_what_is_out_of_sight_or_out_of_range_counts_for_nothing() -> None:
    far = agreement(_room(1), _room(2), geometry.transform(np.eye(3), [500.0, 0.0, 0.0]))
    assert far.counts.sum() == 0.0
    assert far.overlap == 0.0
    assert math.isinf(far.rms_m)


def test_what_the_other_scan_did_not_look_at_counts_for_nothing() -> None:
    """Of one scan of the room only the front half is left: the patches behind are not hidden, but out of its view."""
    surface = _room(2).surface
    front = surface.points[surface.points[:, 0] > 0.0].astype(np.float32)
    half = prepare_observed(front, np.zeros(len(front), np.uint8), config=CONFIG)
    seen = first_look(_room(1), half, np.eye(4))
    patches = patches_of(_room(1).surface)
    x = np.bincount(patches.patch, patches.points[:, 0]) / patches.size
    assert (seen[x < -1.5] == -1).mean() > 0.95
    assert (seen[x > 1.5] >= 0).mean() > 0.95


def test_near_and_far_patches_have_bins_of_their_own() -> None:
    patches = patches_of(_room(1).surface)
    range_m = np.bincount(patches.patch, np.linalg.norm(patches.points, axis=1)) / patches.size
    seen = first_look(_room(1), _room(2), np.eye(4))
    is_far = seen >= len(KINDS)
    assert (range_m[is_far] > 9.0).all()
    assert (range_m[~is_far & (seen >= 0)] < 11.0).all()
    assert [name.split(", ")[0] for name in BINS] == ["near"] * len(KINDS) + ["far"] * len(KINDS)


def test_the_patches_are_the_same_in_both_directions() -> None:
    T_target_source = geometry.transform(geometry.yaw(0.1), [0.2, 0.1, 0.0])
    forth = agreement(_room(1), _room(2), T_target_source)
    back = agreement(_room(2), _room(1), geometry.inverse(T_target_source))
    np.testing.assert_array_equal(forth.of_source, back.of_target)
    np.testing.assert_array_equal(forth.of_target, back.of_source)
    assert forth.overlap == pytest.approx(back.overlap)
    seen = first_look(_room(1), _room(2), T_target_source)
    np.testing.assert_array_equal(seen, forth.of_source)


def test_a_patch_counts_once_however_many_points_it_has() -> None:
    patches = patches_of(_room(1).surface)
    assert patches.size.sum() == len(patches.points)
    assert 50 < len(patches.size) < len(patches.points) / 5
    assert agreement(_room(1), _room(2), np.eye(4)).of_source.shape == patches.size.shape
