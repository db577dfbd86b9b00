"""Pictures of the labels of a scan: range image and top view, in the colours of the classes."""

import io

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from segslam.core import geometry
from segslam.core.types import Label, Labels, Points
from segslam.labels.encodings import Colors, of_classes
from segslam.labels.network_settings import ImageSettings
from segslam.labels.range_image import EMPTY, project
from segslam.labels.scores import STILL

REACH_M = 50.0
CELL_M = 0.2
BACKGROUND, WRONG, RIGHT, MOVING = (24, 24, 24), (255, 60, 40), (110, 110, 110), (255, 42, 42)
"""Red, green, blue."""

Image = UInt8[np.ndarray, "_ _ 3"]


def draw_labels(points: Points, labels: Labels, *, truth: Labels | None, image: ImageSettings, title: str) -> bytes:
    """A PNG of the labels; with true labels also these, and the wrong labels in red."""
    panels = {"labels": _colors(labels)}
    if truth is not None:
        known = truth != Label.UNLABELLED
        wrong = known & (STILL[labels] != STILL[truth])
        colors = np.where(wrong[:, None], WRONG, RIGHT).astype(np.uint8)
        panels |= {"true labels": _colors(truth), f"{wrong.sum() / max(known.sum(), 1):.1%} wrong (red)": colors}
    figure = Figure(figsize=(15, 1.2 * len(panels) + (8.5 if len(panels) == 1 else 5.8)), layout="constrained")
    ranges, above, legend = figure.subfigures(3, 1, squeeze=False, height_ratios=[1.2 * len(panels), 5.0, 0.8])[:, 0]
    ranges.suptitle(title, parse_math=False)  # names of files may contain a dollar sign
    strips = ranges.subplots(len(panels), 1, squeeze=False)[:, 0]
    squares = above.subplots(1, len(panels), squeeze=False)[0]
    for (name, colors), strip, square in zip(panels.items(), strips, squares, strict=True):
        strip.imshow(_range_image(points, colors, image), aspect="auto", interpolation="nearest")
        strip.set(title=f"range image, {name}", xticks=[], yticks=[])
        square.imshow(_from_above(points, colors), extent=(REACH_M, -REACH_M, -REACH_M, REACH_M))
        square.set(title=f"top view, {name}", xlabel="y, left (m)", ylabel="x, ahead (m)")
    legend.legend(handles=_legend(labels, truth), loc="center", ncols=7, frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=100)
    return content.getvalue()


def fitting_image(points: Points) -> ImageSettings:
    """An image for a scan of any sensor; excludes the lowest and highest percent of its points."""
    elevations = np.degrees(geometry.spherical(points)[1])
    low, high = np.percentile(elevations, [1, 99])
    return ImageSettings(field_of_view_deg=(float(low), float(max(high, low + 1.0))), height=64, width=1024)


def _colors(labels: Labels) -> Colors:
    colors = of_classes(STILL[labels])
    colors[labels >= Label.MOVING_CAR] = MOVING
    return colors


def _range_image(points: Points, colors: Colors, settings: ImageSettings) -> Image:
    nearest = project(points.astype(np.float64), settings=settings).nearest
    return np.where((nearest == EMPTY)[..., None], BACKGROUND, colors[nearest]).astype(np.uint8)


def _from_above(points: Points, colors: Colors) -> Image:
    """Top view with x up and y to the left; the highest point of a pixel is visible."""
    side = round(2 * REACH_M / CELL_M)
    picture = np.full((side, side, 3), BACKGROUND, np.uint8)
    order = np.argsort(points[:, 2], kind="stable")  # the last assignment to a pixel remains
    rows, columns = np.floor((REACH_M - points[order, :2].astype(np.float64)) / CELL_M).astype(np.int64).T
    inside = (rows >= 0) & (rows < side) & (columns >= 0) & (columns < side)
    picture[rows[inside], columns[inside]] = colors[order[inside]]
    return picture


def _legend(labels: Labels, truth: Labels | None) -> list[Patch]:
    """A patch for each class in the labels, with its share."""
    shares = np.bincount(labels, minlength=len(Label)) / max(len(labels), 1)
    drawn = np.union1d(np.unique(labels), [] if truth is None else np.unique(truth)).astype(np.uint8)
    colors = _colors(drawn) / 255
    return [
        Patch(color=color, label=f"{Label(label).name.lower()} {shares[label]:.1%}")
        for label, color in zip(drawn, colors, strict=True)
    ]
