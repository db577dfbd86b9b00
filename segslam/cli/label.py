"""`segslam label`."""

import logging
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from segslam.cli.checks import check_own
from segslam.cli.console import Terminal
from segslam.cli.options import EncodingOption, LabelsOption, OverwriteOption, ScanOptions, Settings
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.core.types import Labels, Scan
    from segslam.labels.encodings import Encoding
    from segslam.scans import Dataset

logger = logging.getLogger(__name__)


def label(
    data: Annotated[Path, typer.Argument(help="KITTI folder (with sequences/), folder of scans, or recording.")],
    *,
    out: Annotated[Path, typer.Option(help="New folder for the labels and pictures.")],
    labels: LabelsOption,
    truth: Annotated[Path | None, typer.Option(help="Folder of true .label files to compare with.")] = None,
    options: ScanOptions,
    encoding: EncodingOption = None,
    truth_encoding: Annotated[
        Literal["raw", "learning", "learning-0"] | None,
        typer.Option(help="Numbering of the true labels, if it cannot be detected."),
    ] = None,
    write_as: Annotated[
        Literal["raw", "learning", "learning-0"], typer.Option(help="Numbering of the written label files.")
    ] = "raw",
    pictures: Annotated[int, typer.Option(min=0, help="Number of scans to draw, spread evenly over the drive.")] = 1,
    changes: Settings,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Label scans: write a .label file per scan and pictures, and measure the accuracy if true labels are given.

    Example: segslam label kitti --labels network:model.onnx --frames 0:3 --truth kitti/sequences/00/labels --out labels
    """
    check_own(out, "*.label")
    terminal.announce(f"label: opening {data}")
    from segslam.output.folder import new_folder

    angle_deg = changes.load().sensor.vertical_angle_deg

    def opened(source: str, numbering: "Encoding | None") -> "Dataset":
        return options.source(data, source, numbering, vertical_angle_deg=angle_deg).open()

    scans = opened(labels, encoding)
    true_scans = _open_truth(truth, truth_encoding, opened) if truth else None
    folder = out if overwrite and out.is_dir() else new_folder(out)
    tally = Tally(scans, true_scans, folder, write_as=write_as, num_pictures=pictures)
    for row in terminal.progress(range(len(scans)), len(scans), "label"):
        tally.add(row)
    if not tally.seconds:
        raise SegslamError(f"{data}: none of the {len(scans)} scans could be labelled; see the warnings above")
    figures = tally.figures()
    terminal.table(figures, _table(figures, folder))


def _open_truth(truth: Path, numbering: "Encoding | None", opened: Any) -> "Dataset":
    """The same scans with their true labels. A relative folder is searched here, then beside the scans."""
    try:
        scans: Dataset = opened(str(truth.expanduser().absolute() if truth.is_dir() else truth), numbering)
    except SegslamError as error:
        raise SegslamError(
            str(error).replace("--labels", "--truth", 1).replace("--encoding", "--truth-encoding")
        ) from error
    return scans


class Tally:
    """Labels scans, writes their labels, and counts classes and confusions."""

    def __init__(
        self,
        scans: "Dataset",
        true_scans: "Dataset | None",
        folder: Path,
        *,
        write_as: "Encoding",
        num_pictures: int,
    ) -> None:
        import numpy as np

        from segslam.core.types import Label
        from segslam.labels.scores import NUM_CLASSES

        self._scans, self._true_scans = scans, true_scans
        self._folder = folder
        self._encoding = write_as
        self._drawn = set(np.linspace(0, len(scans) - 1, num_pictures).astype(int).tolist())
        self._num_points = np.zeros(len(Label), np.int64)
        self._confusion = np.zeros((NUM_CLASSES, NUM_CLASSES), np.int64)
        self.seconds: list[float] = []

    def add(self, row: int) -> None:
        """Label a scan; a warning for an unusable one. It is drawn if it was selected for drawing."""
        import numpy as np

        from segslam.core.types import BadScan
        from segslam.core.whole_files import write_whole
        from segslam.labels import geometric_labels
        from segslam.labels.label_files import computed, write_labels
        from segslam.labels.scores import confusion

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
        from statistics import median_low

        import numpy as np

        from segslam.core.types import Label
        from segslam.labels.scores import class_scores, group_scores, largest_confusions
        from segslam.output.folder import write_csv

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

    def _picture(self, name: str, scan: "Scan", labels: "Labels", truth: "Labels | None") -> bytes:
        from segslam.output.report.labels import draw_labels, fitting_image

        network = self._scans.labels.network
        image = network.settings if network else fitting_image(scan.points)
        title = f"{self._scans.name}, scan {name}, {len(labels)} points"
        return draw_labels(scan.points, labels, truth=truth, image=image, title=title)


def _table(figures: dict[str, Any], folder: Path) -> str:
    """The figures as text, one line per class."""
    scores = figures.get("iou", {})
    lines = [f"{figures['num_scans']} scans, {figures['num_points']} points, {figures['ms_per_scan']:.0f} ms per scan"]
    lines.append(f"{'class':16}{'share':>8}{'IoU':>8}" if scores else f"{'class':16}{'share':>8}")
    for name in [*figures["shares"], *(name for name in scores if name not in figures["shares"])]:
        score = f"{scores[name]:8.3f}" if name in scores else ""
        lines.append(f"{name:16}{figures['shares'].get(name, 0.0):8.2%}{score}")
    if scores:
        groups = ", ".join(f"{name} {score:.3f}" for name, score in figures["iou_of_groups"].items())
        confusions = ", ".join(
            f"{each['truth']} as {each['label']} {each['share']:.1%}" for each in figures["confusions"]
        )
        lines += [
            f"correct: {figures['accuracy']:.1%} of the points with a known class; mean IoU {figures['mean_iou']:.3f}",
            f"IoU of groups: {groups}",
            f"most frequent confusions: {confusions or 'none'}",
        ]
    return "\n".join([*lines, f"labels and pictures in {folder}"])
