"""`segslam calibrate`."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    FramesOption,
    JsonOption,
    QuietOption,
    SequenceOption,
    SetOption,
    announce,
    print_json,
    progress,
    say,
)

if TYPE_CHECKING:
    from segslam.odometry.calibration import Calibrator, VerticalAngle
    from segslam.scans import Dataset

logger = logging.getLogger(__name__)


def calibrate(
    data: Annotated[Path, typer.Argument(help="KITTI folder (with sequences/), folder of scans, or recording.")],
    dataset: DatasetOption = None,
    sequence: SequenceOption = "00",
    frames: FramesOption = None,
    topic: Annotated[str, typer.Option(help="Point cloud topic, if the recording (rosbag, mcap) has several.")] = "",
    distance_m: Annotated[
        float, typer.Option("--distance", min=50, help="Use the first scans, up to this distance of travel (m).")
    ] = 400.0,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure the error of a LiDAR's vertical angles from the first few hundred metres of a drive.

    The angle is positive if the points of the scans are too low. It is the error that remains with the given settings;
    the value of the setting that corrects it is printed as well.
    Example: segslam calibrate kitti --sequence 00 --set sensor.vertical_angle_deg=0
    """
    from segslam.core.config import load_config

    check_exists(data, "give the folder with sequences/ or with the scans")
    settings_now = load_config(config, settings or ())
    announce(f"calibrate: opening {data}", quiet=quiet)
    from segslam.odometry.calibration import Calibrator
    from segslam.scans import open_dataset

    scans = open_dataset(
        data,
        sequence=sequence,
        dataset=dataset,
        labels="none",
        frames=frames,
        topic=topic,
        vertical_angle_deg=settings_now.sensor.vertical_angle_deg,
    )
    calibrator = Calibrator(settings_now)
    for _ in progress(_driven(calibrator, scans, distance_m), total=len(scans), title="calibrate", quiet=quiet):
        pass
    found = calibrator.vertical_angle()
    applied_deg = scans.vertical_angle_deg
    if json:
        print_json(_figures(found, applied_deg))
    else:
        say(_summary(found, applied_deg, calibrator.travel_m), quiet=quiet)


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


def _figures(found: "VerticalAngle | None", applied_deg: float) -> dict[str, object]:
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
    from segslam.odometry.calibration import MIN_PAIRS, described

    if found is None:
        return (
            f"the vertical angle cannot be measured: fewer than {MIN_PAIRS} usable pairs of scans 10 m apart in "
            f"{travel_m:.0f} m of travel; give a longer drive along a street, or denser scans"
        )
    text = f"{described(found)} ({found.num_pairs} pairs of scans, {applied_deg:g} degrees corrected on reading)"
    if found.is_significant:
        return f"{text}; set sensor.vertical_angle_deg={applied_deg + found.angle_deg:.2f}"
    return f"{text}: not significant; keep sensor.vertical_angle_deg={applied_deg:g}"
