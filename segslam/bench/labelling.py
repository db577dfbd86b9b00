"""Labels of the scans of a drive: written to files, drawn, counted, and compared with true ones.

Scores are intersections over unions (IoU) as in SemanticKITTI (Behley et al., ICCV 2019): only points with a known true
class count; moving classes count as their static class.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from statistics import median_low
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from segslam.core import geometry
from segslam.core.types import GROUND_LABELS, BadScan, Label, Labels, Points
from segslam.core.whole_files import write_whole
from segslam.labels import geometric_labels
from segslam.labels.encodings import Colors, Encoding, of_classes
from segslam.labels.label_files import computed, write_labels
from segslam.labels.network_settings import ImageSettings
from segslam.labels.range_image import EMPTY, Projection
from segslam.output.folder import write_csv
from segslam.output.map.from_above import png
from segslam.scans import Dataset

logger = logging.getLogger(__name__)
REACH_M = 50.0
CELL_M = 0.2
BACKGROUND, WRONG, RIGHT, MOVING = (24, 24, 24), (255, 60, 40), (110, 110, 110), (255, 42, 42)
"""Red, green, blue."""
NUM_CLASSES = 20
STILL = np.arange(len(Label), dtype=np.uint8)
"""Class of each label; moving classes map to their static class."""
for _label in list(Label)[NUM_CLASSES:]:
    STILL[_label] = Label[_label.name.removeprefix("MOVING_")]
GROUPS = {
    "ground": GROUND_LABELS,
    "car": (Label.CAR,),
    "building": (Label.BUILDING,),
    "vegetation": (Label.VEGETATION,),
    "trunk_or_pole": (Label.TRUNK, Label.POLE),
}
"""Groups of classes that matter for loop closing."""

Image = UInt8[np.ndarray, "_ _ 3"]
Confusion = Int[np.ndarray, "20 20"]
"""Number of points by true class (row) and label (column), as learning ids 0 to 19; row 0 is empty."""


class Tally:
    """Labels scans, writes their labels, and counts classes and confusions."""

    def __init__(
        self, scans: Dataset, true_scans: Dataset | None, folder: Path, *, write_as: Encoding, num_pictures: int
    ) -> None:
        self._scans, self._true_scans = scans, true_scans
        self._folder = folder
        self._encoding = write_as
        self._drawn = set(np.linspace(0, len(scans) - 1, num_pictures).astype(int).tolist())
        self._num_points = np.zeros(len(Label), np.int64)
        self._confusion = np.zeros((NUM_CLASSES, NUM_CLASSES), np.int64)
        self.seconds: list[float] = []

    def add(self, row: int) -> None:
        """Label a scan; a warning for an unusable one. It is drawn if it was selected for drawing."""
        try:
            scan = self._scans[row]
            truth = None if self._true_scans is None else computed(self._true_scans[row].labels)
        except BadScan as error:
            logger.warning("%s; skipped", error)
            return
        started = perf_counter()
        labels = computed(scan.labels)
        if self._scans.labels.geometric and not labels.any():
            labels = geometric_labels(scan.points)
        self.seconds.append(perf_counter() - started)
        self._num_points += np.bincount(labels, minlength=len(self._num_points))
        if truth is not None:
            self._confusion += confusion(labels, truth)
        name = self._scans.names[row]
        write_labels(self._folder / f"{name}.label", labels, scan.kept, self._encoding)
        if row in self._drawn:
            network = self._scans.labels.network
            image = network.settings if network else fitting_image(scan.points)
            title = f"{self._scans.name}, scan {name}, {len(labels)} points"
            picture = draw_labels(scan.points, labels, truth=truth, image=image, title=title)
            write_whole(self._folder / f"{name}.png", picture)

    def figures(self) -> dict[str, Any]:
        """Shares of the classes and time; with true labels also scores, and `confusion.csv` is written."""
        shares = self._num_points / self._num_points.sum()
        most_first = np.argsort(-shares, kind="stable")
        figures: dict[str, Any] = {
            "num_scans": len(self.seconds),
            "num_points": int(self._num_points.sum()),
            "ms_per_scan": 1000 * median_low(self.seconds),
            "shares": {Label(int(i)).name.lower(): float(shares[i]) for i in most_first if shares[i]},
        }
        counts = self._confusion
        if not counts.any():
            return figures
        names = [label.name.lower() for label in list(Label)[: len(counts)]]
        rows = ([name, *row] for name, row in zip(names[1:], counts[1:].tolist(), strict=True))
        write_csv(self._folder / "confusion.csv", ["truth \\ label", *names], rows)
        by_class = class_scores(counts)
        known = [by_class[Label(int(i)).name.lower()] for i in np.flatnonzero(counts.sum(axis=1))]
        return figures | {
            "accuracy": float(np.trace(counts) / counts.sum()),
            "mean_iou": float(np.mean(known)),
            "iou": by_class,
            "iou_of_groups": scores(counts, GROUPS),
            "confusions": [
                {"truth": true.name.lower(), "label": given.name.lower(), "share": share}
                for true, given, share in largest_confusions(counts, 6)
            ],
        }


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
    nearest = Projection(points.astype(np.float64), settings=image).nearest
    for (name, colors), strip, square in zip(panels.items(), strips, squares, strict=True):
        seen = np.where((nearest == EMPTY)[..., None], BACKGROUND, colors[nearest]).astype(np.uint8)
        strip.imshow(seen, aspect="auto", interpolation="nearest")
        strip.set(title=f"range image, {name}", xticks=[], yticks=[])
        square.imshow(_from_above(points, colors), extent=(REACH_M, -REACH_M, -REACH_M, REACH_M))
        square.set(title=f"top view, {name}", xlabel="y, left (m)", ylabel="x, ahead (m)")
    legend.legend(handles=_legend(labels, truth), loc="center", ncols=7, frameon=False)
    return png(figure)


def fitting_image(points: Points) -> ImageSettings:
    """An image for a scan of any sensor; excludes the lowest and highest percent of its points."""
    elevations = np.degrees(geometry.spherical(points)[1])
    low, high = np.percentile(elevations, [1, 99])
    return ImageSettings(field_of_view_deg=(float(low), float(max(high, low + 1.0))), height=64, width=1024)


def _colors(labels: Labels) -> Colors:
    colors = of_classes(STILL[labels])
    colors[labels >= Label.MOVING_CAR] = MOVING
    return colors


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


def confusion(labels: Labels, truth: Labels) -> Confusion:
    """Number of points for each pair of true class and label."""
    known = truth != Label.UNLABELLED
    pairs = STILL[truth[known]].astype(np.int64) * NUM_CLASSES + STILL[labels[known]]
    return np.bincount(pairs, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)


def class_scores(counts: Confusion) -> dict[str, float]:
    """IoU of each class that occurs in the ground truth or in the labels, the most frequent first."""
    classes = sorted(list(Label)[1:NUM_CLASSES], key=lambda label: -counts[label].sum())
    return scores(counts, {label.name.lower(): (label,) for label in classes})


def scores(counts: Confusion, groups: Mapping[str, tuple[Label, ...]]) -> dict[str, float]:
    """IoU of each of these groups that occurs."""
    found = {}
    for name, members in groups.items():
        chosen = list(members)
        both = counts[np.ix_(chosen, chosen)].sum()
        if either := counts[chosen].sum() + counts[:, chosen].sum() - both:
            found[name] = float(both / either)
    return found


def largest_confusions(counts: Confusion, count: int) -> list[tuple[Label, Label, float]]:
    """(true class, label, share of all points) of the most frequent confusions."""
    wrong = counts * (1 - np.eye(NUM_CLASSES, dtype=np.int64))
    largest = np.argsort(-wrong, axis=None, kind="stable")[:count]
    rows, columns = np.unravel_index(largest, wrong.shape)
    return [
        (Label(row), Label(column), float(wrong[row, column] / counts.sum()))
        for row, column in zip(rows, columns, strict=True)
        if wrong[row, column]
    ]
