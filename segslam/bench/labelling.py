"""Labels of the scans of a drive: written to files, drawn, counted, and compared with true ones."""

import logging
from pathlib import Path
from statistics import median_low
from time import perf_counter
from typing import Any

import numpy as np

from segslam.core.types import BadScan, Label, Labels, Scan
from segslam.core.whole_files import write_whole
from segslam.labels import geometric_labels
from segslam.labels.encodings import Encoding
from segslam.labels.label_files import computed, write_labels
from segslam.labels.scores import NUM_CLASSES, class_scores, confusion, group_scores, largest_confusions
from segslam.output.folder import write_csv
from segslam.output.report.labels import draw_labels, fitting_image
from segslam.scans import Dataset

logger = logging.getLogger(__name__)


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
            write_whole(self._folder / f"{name}.png", self._picture(name, scan, labels, truth))

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
            "iou_of_groups": group_scores(counts),
            "confusions": [
                {"truth": true.name.lower(), "label": given.name.lower(), "share": share}
                for true, given, share in largest_confusions(counts, 6)
            ],
        }

    def _picture(self, name: str, scan: Scan, labels: Labels, truth: Labels | None) -> bytes:
        network = self._scans.labels.network
        image = network.settings if network else fitting_image(scan.points)
        title = f"{self._scans.name}, scan {name}, {len(labels)} points"
        return draw_labels(scan.points, labels, truth=truth, image=image, title=title)
