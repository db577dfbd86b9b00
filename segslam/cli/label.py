"""`segslam label`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_own
from segslam.cli.console import Terminal
from segslam.cli.options import EncodingOption, LabelsOption, Numbering, OverwriteOption, ScanOptions, Settings
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.scans import Dataset


def label(
    data: Annotated[Path, typer.Argument(help="KITTI folder (with sequences/), folder of scans, or recording.")],
    *,
    out: Annotated[Path, typer.Option(help="New folder for the labels and pictures.")],
    labels: LabelsOption,
    truth: Annotated[Path | None, typer.Option(help="Folder of true .label files to compare with.")] = None,
    options: ScanOptions,
    encoding: EncodingOption = None,
    truth_encoding: Annotated[
        Numbering | None, typer.Option(help="Numbering of the true labels, if it cannot be detected.")
    ] = None,
    write_as: Annotated[Numbering, typer.Option(help="Numbering of the written label files.")] = "raw",
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
    from segslam.bench.labelling import Tally
    from segslam.output.folder import new_folder

    angle_deg = changes.load().sensor.vertical_angle_deg

    def opened(source: str, numbering: Numbering | None) -> "Dataset":
        return options.source(data, source, numbering, vertical_angle_deg=angle_deg).open()

    scans = opened(labels, encoding)
    true_scans = None
    if truth:  # a relative folder is searched here, then beside the scans
        try:
            true_scans = opened(str(truth.expanduser().absolute() if truth.is_dir() else truth), truth_encoding)
        except SegslamError as error:
            text = str(error).replace("--labels", "--truth", 1).replace("--encoding", "--truth-encoding")
            raise SegslamError(text) from error
    folder = out if overwrite and out.is_dir() else new_folder(out)
    tally = Tally(scans, true_scans, folder, write_as=write_as, num_pictures=pictures)
    for row in terminal.progress(range(len(scans)), len(scans), "label"):
        tally.add(row)
    if not tally.seconds:
        raise SegslamError(f"{data}: none of the {len(scans)} scans could be labelled; see the warnings above")
    figures = tally.figures()
    terminal.table(figures, _table(figures, folder))


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
