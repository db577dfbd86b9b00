"""`segslam label` and `calibrate`: labels of scans, and the error of their vertical angles."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_not_read, check_own, check_scans, make_folder
from segslam.cli.console import Terminal
from segslam.cli.options import EncodingOption, LabelsOption, Numbering, OverwriteOption, ScanOptions, Settings
from segslam.core.errors import BadScan, SegslamError, counted
from segslam.core.interrupts import same_command_with, when_stopped

if TYPE_CHECKING:
    from segslam.scans import Dataset
    from segslam.slam.adjustment.vertical_angle import VerticalAngle

logger = logging.getLogger(__name__)
DriveArgument = Annotated[Path, "KITTI folder (with sequences/), folder of scans, or recording."]


def label(
    data: DriveArgument,
    *,
    out: Annotated[Path, "New folder for the labels and pictures."],
    labels: LabelsOption,
    truth: Annotated[Path | None, "Folder of true .label files to compare with."] = None,
    options: ScanOptions,
    encoding: EncodingOption = None,
    truth_encoding: Annotated[Numbering | None, "Numbering of the true labels, if it cannot be detected."] = None,
    write_as: Annotated[Numbering, "Numbering of the written label files."] = "raw",
    pictures: Annotated[int, typer.Option(min=0, help="Number of scans to draw, spread evenly over the drive.")] = 1,
    changes: Settings,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Label scans: write a .label file per scan and pictures, and measure the accuracy if true labels are given.

    Example: segslam label kitti --labels network:model.onnx --frames 0:3 --truth kitti/sequences/00/labels --out labels
    """
    if truth_encoding is not None and truth is None:
        raise SegslamError(f"--truth-encoding {truth_encoding}: only true labels have one; give them with --truth")
    check_own(out, "*.label")
    check_not_read(out, [data, truth, data / labels])
    terminal.announce(f"label: opening {data}")
    from segslam.bench.labelling import Tally

    angle_deg = changes.load().sensor.vertical_angle_deg

    def opened(source: str, numbering: Numbering | None) -> "Dataset":
        return replace(options.source(data, source, numbering), vertical_angle_deg=angle_deg).open()

    scans = opened(labels, encoding)
    true_scans = None
    if truth:  # a relative folder is searched here, then beside the scans
        try:
            true_scans = opened(str(truth.expanduser().absolute() if truth.is_dir() else truth), truth_encoding)
        except SegslamError as error:
            text = str(error).replace("--labels", "--truth", 1).replace("--encoding", "--truth-encoding")
            raise SegslamError(text) from error
    folder = make_folder(out.resolve(), overwrite=overwrite, made_by=("*.label",))
    tally = Tally(scans, true_scans, folder, write_as=write_as, num_pictures=pictures)
    when_stopped(f"{out} has the labels of the scans so far; for all scans: {same_command_with('--overwrite')}")
    for row in terminal.progress(range(len(scans)), len(scans), "label"):
        tally.add(row)
    if not tally.seconds:
        raise SegslamError(f"{data}: none of the {len(scans)} scans could be labelled; see the warnings above")
    figures = tally.figures()
    terminal.table(figures, _table(figures, out))


def _table(figures: dict[str, Any], folder: Path) -> str:
    """The figures as text, one line per class."""
    scores = figures.get("iou", {})
    scans = counted(figures["num_scans"], "scan")
    lines = [f"{scans}, {figures['num_points']} points, {figures['ms_per_scan']:.0f} ms per scan"]
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


def calibrate(
    data: DriveArgument,
    *,
    scans: ScanOptions,
    distance_m: Annotated[
        float, typer.Option("--distance", min=50, help="Use the first scans, up to this distance of travel (m).")
    ] = 400.0,
    changes: Settings,
    terminal: Terminal,
) -> None:
    """Measure the error of a LiDAR's vertical angles from the first few hundred metres of a drive.

    The angle is positive if the points of the scans are too low. It is the error that remains with the given settings;
    the value of the setting that corrects it is printed as well.
    Example: segslam calibrate kitti --sequence 00 --set sensor.vertical_angle_deg=0
    """
    check_scans(data)
    settings = changes.load()
    terminal.announce(f"calibrate: opening {data}")
    from segslam.slam.adjustment.vertical_angle import Calibrator

    opened = replace(scans.source(data), vertical_angle_deg=settings.sensor.vertical_angle_deg).open()
    calibrator = Calibrator(settings)
    for scan in terminal.progress(opened, len(opened), "calibrate"):
        try:
            calibrator.add(scan)
        except BadScan as error:
            logger.warning("%s; skipped", error)
        if calibrator.travel_m > distance_m:
            break
    found, applied_deg = calibrator.vertical_angle(), opened.vertical_angle_deg
    figures = {
        "vertical_deg": found.angle_deg if found else None,
        "sigma_deg": found.sigma_deg if found else None,
        "num_pairs": found.num_pairs if found else 0,
        "is_significant": found is not None and found.is_significant,
        "applied_deg": applied_deg,
        "set_deg": applied_deg + found.angle_deg if found else None,
    }
    terminal.answer(figures, _summary(found, applied_deg, calibrator.travel_m))


def _summary(found: "VerticalAngle | None", applied_deg: float, travel_m: float) -> str:
    from segslam.slam.adjustment.vertical_angle import APART_M, MIN_PAIRS, MOST_DEG, described

    if found is None:
        return (
            f"the vertical angle cannot be measured in {travel_m:.0f} m of travel: at least {MIN_PAIRS} pairs of scans "
            f"{APART_M[0]:g} m apart must show it, and {MOST_DEG:.1f} degrees at most; give a longer drive along a "
            "street, or denser scans"
        )
    text = f"{described(found)} ({found.num_pairs} pairs of scans, {applied_deg:g} degrees corrected on reading)"
    if found.is_significant:
        return f"{text}; set sensor.vertical_angle_deg={applied_deg + found.angle_deg:.2f}"
    return f"{text}: not significant; keep sensor.vertical_angle_deg={applied_deg:g}"
