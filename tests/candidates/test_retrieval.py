"""Place recognition."""

import math

import numpy as np
import pytest

from segslam.candidates import Places, PlaceSignature, signature_of, signature_of_standing
from segslam.core import geometry
from segslam.core.types import Label, SegslamError


def street(seed: int, *, num_posts: int = 60) -> np.ndarray:
    """Posts and walls around the origin, their points 0.1 m apart."""
    rng = np.random.default_rng(seed)
    heights = np.arange(0.5, 4.0, 0.1)
    posts = [
        np.column_stack([np.tile(place, (len(heights), 1)), heights]) for place in rng.uniform(-28, 28, (num_posts, 2))
    ]
    walls = []
    for _ in range(8):
        start, angle = rng.uniform(-20, 20, 2), rng.uniform(0, math.pi)
        along = start + np.arange(0, 12, 0.1)[:, None] * [math.cos(angle), math.sin(angle)]
        walls += [np.column_stack([along, np.full(len(along), z)]) for z in heights[::4]]
    return np.vstack([*posts, *walls])


def places(num: int) -> Places:
    index = Places()
    for number in range(num):
        index.add(number, signature_of_standing(street(number)))
    return index


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, 100.0, 200.0, 333.0])
def test_a_place_is_found_under_any_yaw_and_a_sideways_shift(yaw_deg: float) -> None:
    index = places(30)
    T = geometry.transform(geometry.yaw(math.radians(yaw_deg)), np.array([1.0, 3.0, 0.0]))
    moved = geometry.apply(geometry.inverse(T), street(17))
    best = index.shortlist(signature_of_standing(moved))[0]
    assert best.place_id == 17
    apart_deg = math.degrees(best.yaw_rad) - yaw_deg
    assert abs((apart_deg + 90.0) % 180.0 - 90.0) <= 3.0  # the yaw is known up to half a turn, in steps of 3 degrees


def test_the_best_of_a_shortlist_come_first_and_it_may_be_limited_to_older_places() -> None:
    index = places(12)
    signature = signature_of_standing(street(5))
    found = index.shortlist(signature, most=4)
    assert found[0].place_id == 5
    assert found[0].score == pytest.approx(1.0)
    assert len(found) == 4
    assert sorted((candidate.score for candidate in found), reverse=True) == [candidate.score for candidate in found]
    assert {candidate.place_id for candidate in index.shortlist(signature, below_id=5)} == set(range(5))
    assert Places().shortlist(signature) == ()


def test_a_signature_is_small_and_comes_back_from_its_bytes() -> None:
    signature = signature_of_standing(street(0))
    data = signature.to_bytes()
    assert len(data) <= 3000
    assert places(1).bytes_per_place <= 3000
    assert (PlaceSignature.from_bytes(data).spectrum == signature.spectrum).all()
    with pytest.raises(SegslamError, match="1439 bytes"):
        PlaceSignature.from_bytes(data[1:])


def test_ground_tilt_and_moving_objects_do_not_change_a_signature() -> None:
    x, y = np.meshgrid(np.arange(-30, 30, 0.4), np.arange(-30, 30, 0.4))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.8)])
    standing = street(3) - [0.0, 0.0, 1.8]
    points = np.vstack([ground, standing])
    labels = np.zeros(len(points), np.uint8)
    index = places(30)
    plain = index.shortlist(signature_of(points, labels))[0]
    assert plain.place_id == 3
    lean = geometry.exp(geometry.tangent(rotation_rad=np.array([0.1, -0.15, 0.0]), translation_m=0.0))
    leaning = index.shortlist(signature_of(geometry.apply(lean, points), labels))[0]
    assert leaning.place_id == 3
    assert leaning.score > 0.9 * plain.score
    truck = np.random.default_rng(0).uniform([3, -2, -1.5], [12, 2, 2], (20_000, 3))
    passing = signature_of(
        np.vstack([points, truck]),
        np.append(labels, np.full(len(truck), Label.MOVING_TRUCK, np.uint8)),
    )
    assert (passing.spectrum == signature_of(points, labels).spectrum).all()


def test_points_outside_the_image_do_not_change_a_signature() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-60, 60, (40_000, 2)), rng.normal(-1.7, 0.02, 40_000)])
    points = np.vstack([street(3), ground]).astype(np.float32)
    near = points[np.abs(points[:, :2]).max(axis=1) < 33.0]
    whole, cut = (signature_of(some, np.zeros(len(some), np.uint8)) for some in (points, near))
    assert whole.to_bytes() == cut.to_bytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e20, 1e300])
def test_points_of_no_number_do_not_change_a_signature(value: float) -> None:
    expected = signature_of_standing(street(3)).spectrum
    for point in np.where(np.eye(3, dtype=bool), value, 1.0):
        np.testing.assert_array_equal(signature_of_standing(np.vstack([street(3), point])).spectrum, expected)


def test_scans_without_points_have_a_signature() -> None:
    empty = np.empty((0, 3), np.float32)
    signature = signature_of(empty, np.empty(0, np.uint8))
    assert not signature.spectrum.any()
    assert len(places(3).shortlist(signature)) == 3
