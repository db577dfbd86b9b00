"""The vote of pixels on the label of a point, against a plain twin."""

import numpy as np
import pytest
from helpers.made_networks import SETTINGS

from segslam.core.types import Label
from segslam.labels.network_settings import NetworkSettings, VoteSettings
from segslam.labels.range_image import Projection, point_labels, window_weights

NETWORK = NetworkSettings.model_validate(SETTINGS)


def _twin(image: np.ndarray, projection: Projection, settings: VoteSettings) -> np.ndarray:
    """Every window as a list of (weighted distance, label), sorted."""
    ranges_m = projection.image_ranges_m()
    weights = window_weights(settings.window, settings.sigma_px)
    half = settings.window // 2
    labels = []
    for row, column, range_m in zip(projection.rows, projection.columns, projection.ranges_m, strict=True):
        voters = []
        for down in range(-half, half + 1):
            for right in range(-half, half + 1):
                if 0 <= row + down < len(image):
                    pixel = row + down, (column + right) % image.shape[1]
                    apart_m = abs(ranges_m[pixel] - range_m) if (down or right) else 0.0
                    voters.append((apart_m * weights[down + half, right + half], image[pixel]))
        voters = sorted(voters, key=lambda voter: voter[0])[: settings.neighbours]
        votes = np.bincount([label for apart_m, label in voters if apart_m <= settings.cutoff_m], minlength=len(Label))
        votes[Label.UNLABELLED] = 0
        labels.append(votes.argmax())
    return np.array(labels, dtype=np.uint8)


@pytest.mark.parametrize(
    "settings",
    [
        VoteSettings(),
        VoteSettings(window=1, neighbours=1),
        VoteSettings(window=7, neighbours=9, sigma_px=2.0, cutoff_m=4.0),
        VoteSettings(window=3, neighbours=20),
    ],
)
def test_votes_are_those_of_the_plain_twin(settings: VoteSettings) -> None:
    rng = np.random.default_rng(1)
    projection = Projection(rng.uniform([-9, -9, -3], [9, 9, 3], (800, 3)), settings=NETWORK)
    image = rng.integers(0, 5, projection.nearest.shape, dtype=np.uint8)
    found = point_labels(image, projection, settings=settings)
    np.testing.assert_array_equal(found, _twin(image, projection, settings))
    assert (found != Label.UNLABELLED).mean() > 0.5  # the seed leaves something to vote on


def test_a_wall_behind_a_post_keeps_its_label_where_the_post_hides_it() -> None:
    azimuths = np.radians(np.arange(-20.0, 20.0, 1.0))
    heights = np.linspace(-0.1, 0.1, 9) * 20.0
    wall = np.array([[20 * np.cos(a), 20 * np.sin(a), z] for a in azimuths for z in heights])
    post = np.array([[5.0, 0.1, z / 4] for z in heights])
    projection = Projection(np.concatenate([wall, post]), settings=NETWORK)
    image = np.where(projection.nearest >= len(wall), np.uint8(Label.POLE), np.uint8(Label.BUILDING))
    labels = point_labels(image, projection, settings=VoteSettings())
    hidden = projection.nearest[projection.rows[: len(wall)], projection.columns[: len(wall)]] >= len(wall)
    assert hidden.any()
    np.testing.assert_array_equal(labels[: len(wall)], Label.BUILDING)
    shown = point_labels(image, projection, settings=VoteSettings(window=1, neighbours=1))[: len(wall)]
    np.testing.assert_array_equal(shown[hidden], Label.POLE)  # what it would be without the vote


def test_weights_favour_the_middle_and_are_even_about_it() -> None:
    weights = window_weights(5, 1.0)
    assert weights.argmin() == 12
    np.testing.assert_allclose(weights, weights[::-1, ::-1])
    np.testing.assert_allclose((1.0 - weights).sum(), 1.0)
