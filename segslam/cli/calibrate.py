"""`segslam calibrate`."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import Terminal
from segslam.cli.options import ScanOptions, Settings

if TYPE_CHECKING:
    from segslam.scans import Dataset
    from segslam.slam.adjustment.vertical_angle import Calibrator, VerticalAngle

logger = logging.getLogger(__name__)


def calibrate(
    data: Annotated[Path, typer.Argument(help="KITTI folder (with sequences/), folder of scans, or recording.")],
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
    check_exists(data, "give the folder with sequences/ or with the scans")
    settings = changes.load()
    terminal.announce(f"calibrate: opening {data}")
    from segslam.slam.adjustment.vertical_angle import Calibrator

    opened = scans.source(data, vertical_angle_deg=settings.sensor.vertical_angle_deg).open()
    calibrator = Calibrator(settings)
    for _ in terminal.progress(_driven(calibrator, opened, distance_m), len(opened), "calibrate"):
        pass
    found, applied_deg = calibrator.vertical_angle(), opened.vertical_angle_deg
    terminal.answer(_figures(found, applied_deg), _summary(found, applied_deg, calibrator.travel_m))


def _driven(calibrator: "Calibrator", scans: "Dataset", distance_m: float) -> "Iterator[None]":
    """Yields after each usable scan, until the drive is long enough."""
    from segslam.core.types import BadScan

    for scan in scans:
        try:
            calibrator.add(scan)
        except BadScan as error:
            logger.warning("%s; skipped", error)
        yield
        if calibrator.travel_m > distance_m:
            return


def _figures(found: "VerticalAngle | None", applied_deg: float) -> dict[str, Any]:
    """The figures; null if the angle is unknown."""
    return {
        "vertical_deg": found.angle_deg if found else None,
        "sigma_deg": found.sigma_deg if found else None,
        "num_pairs": found.num_pairs if found else 0,
        "is_significant": found is not None and found.is_significant,
        "applied_deg": applied_deg,
        "set_deg": applied_deg + found.angle_deg if found else None,
    }


def _summary(found: "VerticalAngle | None", applied_deg: float, travel_m: float) -> str:
    from segslam.slam.adjustment.vertical_angle import APART_M, MIN_PAIRS, described

    if found is None:
        return (
            f"the vertical angle cannot be measured: fewer than {MIN_PAIRS} usable pairs of scans {APART_M[0]:g} m "
            f"apart in {travel_m:.0f} m of travel; give a longer drive along a street, or denser scans"
        )
    text = f"{described(found)} ({found.num_pairs} pairs of scans, {applied_deg:g} degrees corrected on reading)"
    if found.is_significant:
        return f"{text}; set sensor.vertical_angle_deg={applied_deg + found.angle_deg:.2f}"
    return f"{text}: not significant; keep sensor.vertical_angle_deg={applied_deg:g}"
