import numpy as np
import pytest
from helpers.yards import seen

from segslam.core import geometry
from segslam.slam.adjustment.thickness import is_thicker, map_thickness_m, median_m, patch_thickness_m

PLACES_M = np.array([-6.0, -2.0, 2.0, 6.0])
PAIRS = np.array([[0, 1], [1, 2], [2, 3], [0, 2]])


def points_of(keyframe_id: int) -> np.ndarray:
    return seen(float(PLACES_M[keyframe_id]), seed=keyframe_id).astype(np.float32)


def poses(error_m: float = 0.0) -> np.ndarray:
    """True poses, every second one too high and too far left."""
    return np.array(
        [
            geometry.transform(np.eye(3), [x_m, error_m * (row % 2), error_m * (row % 2)])
            for row, x_m in enumerate(PLACES_M)
        ]
    )


def test_a_map_with_true_poses_is_as_thick_as_the_noise_of_the_sensor() -> None:
    thickness_m = median_m(map_thickness_m(points_of, poses(), PAIRS))
    assert thickness_m is not None
    assert 0.0 < thickness_m < 0.012  # a centimetre of noise along the beams


def test_the_thickness_grows_with_the_error_of_the_poses() -> None:
    found = [median_m(map_thickness_m(points_of, poses(error_m), PAIRS[:3])) for error_m in (0.0, 0.03, 0.1)]
    assert None not in found
    assert found == sorted(found)
    assert found[2] > 4 * found[0]


def test_two_parallel_planes_are_half_their_distance_thick() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-5.0, 5.0, (4000, 2)), np.full(4000, 0.5)])
    above = geometry.transform(np.eye(3), [0.0, 0.0, 0.2])
    thickness_m = patch_thickness_m(plane, plane, above)
    assert np.median(thickness_m) == pytest.approx(0.1, abs=1e-3)


def test_too_few_shared_patches_have_no_thickness() -> None:
    apart = poses()
    apart[:, 0, 3] *= 100.0
    assert median_m(map_thickness_m(points_of, apart, PAIRS)) is None
    assert median_m(map_thickness_m(points_of, poses(), np.empty((0, 2), dtype=int))) is None


def test_surfaces_are_thicker_if_nearly_all_pairs_show_it() -> None:
    thin = [np.array([0.01, 0.012, 0.03])] * 15
    thick = [patches + 0.002 for patches in thin]
    assert is_thicker(thin, thick)
    assert not is_thicker(thick, thin)
    assert not is_thicker(thin, thin)
    assert not is_thicker(thin[:5], thick[:5]), "too few to tell"
    assert not is_thicker(thin, [*thick[:8], *[patches - 0.002 for patches in thin[:7]]])
    empty = [np.empty(0)] * 15
    assert not is_thicker(thin, empty)
    assert not is_thicker([], [])
