import numpy as np
import pytest

from segslam.slam.adjustment import submaps
from segslam.slam.adjustment.submaps import all_pairs, pairs_along, pairs_between_passes

RADIUS_M = 5.0


@pytest.fixture(autouse=True)
def _short_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distances that suit the drives of these tests."""
    monkeypatch.setattr(submaps, "STEPS", (3, 6))
    monkeypatch.setattr(submaps, "OTHER_PLACE_M", RADIUS_M)


def poses(places: np.ndarray) -> np.ndarray:
    T_world = np.tile(np.eye(4), (len(places), 1, 1))
    T_world[:, :3, 3] = places
    return T_world


def known(source: int, others: np.ndarray) -> np.ndarray:
    """Covariances of poses that are known."""
    return np.tile(1e-4 * np.eye(6), (len(others), 1, 1))


def there_and_back(*, height_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """100 m ahead and back, 3 m beside."""
    ahead = np.column_stack([np.arange(0.0, 100.0, 2.0), np.zeros((50, 2))])
    back = ahead[::-1] + np.array([0.0, 3.0, height_m])
    places = np.vstack([ahead, back])
    return poses(places), np.arange(len(places)) * 2.0


def test_pairs_along_the_drive_have_the_configured_distances() -> None:
    assert pairs_along(12).tolist() == [
        [0, 3],
        [2, 5],
        [4, 7],
        [6, 9],
        [8, 11],
        [0, 6],
        [2, 8],
        [4, 10],
    ]


def test_a_pair_that_may_be_out_of_reach_of_an_alignment_is_none() -> None:
    T_world, travel_m = there_and_back()
    sigma_m = np.where(np.arange(len(travel_m)) < 50, 0.1, 0.4)

    def covariances(source: int, others: np.ndarray) -> np.ndarray:
        return np.stack([np.diag([0.0, 0.0, 0.0, *[sigma_m[max(source, other)] ** 2] * 3]) for other in others])

    pairs = all_pairs(T_world, travel_m, covariances, min_travel_m=50.0)
    assert pairs.max() < 50, "with 0.4 m, one in 80 is more than a metre off"
    assert len(pairs) == len(pairs_along(50))
    assert len(all_pairs(T_world, travel_m, known, min_travel_m=50.0)) > len(pairs_along(100))


def test_each_node_is_paired_with_the_nearest_of_another_pass() -> None:
    T_world, travel_m = there_and_back()
    pairs = pairs_between_passes(T_world, travel_m, min_travel_m=50.0)
    assert len(pairs)
    assert (travel_m[pairs[:, 1]] - travel_m[pairs[:, 0]] >= 50.0).all()
    apart_m = np.linalg.norm(T_world[pairs[:, 0], :3, 3] - T_world[pairs[:, 1], :3, 3], axis=1)
    assert apart_m.max() < RADIUS_M
    assert len(np.unique(pairs[:, 1])) == len(pairs)


def test_passes_on_two_storeys_are_not_paired() -> None:
    T_world, travel_m = there_and_back(height_m=2.6)
    assert not len(pairs_between_passes(T_world, travel_m, min_travel_m=50.0))


def test_pairs_are_sorted_by_source_and_too_short_a_drive_has_none() -> None:
    T_world, travel_m = there_and_back()
    pairs = all_pairs(T_world, travel_m, known, min_travel_m=50.0)
    assert (np.diff(pairs[:, 1]) >= 0).all()
    assert all_pairs(T_world[:2], travel_m[:2], known, min_travel_m=50.0).shape == (0, 2)


def test_no_submap_is_paired_with_itself_or_a_later_one() -> None:
    T_world, travel_m = there_and_back()
    pairs = pairs_between_passes(T_world, travel_m, min_travel_m=0.0)
    assert len(pairs)
    assert (pairs[:, 0] < pairs[:, 1]).all()


def test_a_pair_along_the_drive_that_is_one_of_two_passes_is_there_once() -> None:
    travel_m = 0.5 * np.arange(200)
    circle = poses(6.0 * np.column_stack([np.cos(travel_m / 6.0), np.sin(travel_m / 6.0), np.zeros(200)]))
    pairs = all_pairs(circle, travel_m, known, min_travel_m=3.0)
    assert [186, 192] in pairs_between_passes(circle, travel_m, min_travel_m=3.0).tolist()
    assert [186, 192] in pairs_along(200).tolist()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
