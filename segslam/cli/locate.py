"""`segslam locate`."""

from json import dumps
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.compiling import compile_kernels
from segslam.cli.console import EncodingOption, QuietOption, announce, print_out, progress, say

if TYPE_CHECKING:
    from segslam.core.types import Labels, Points, Rejected
    from segslam.run.locator import Located, Locator


def locate(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run, or its log.mcap.")],
    scans: Annotated[list[Path], typer.Argument(help="Scans to locate: .bin, .npy, .ply or .pcd.")],
    dataset: Annotated[str | None, typer.Option(help="kitti: apply KITTI's correction of the vertical angles.")] = None,
    labels: Annotated[
        str, typer.Option(help="Labels: geometric, none, or a folder of .label files named like the scans.")
    ] = "geometric",
    encoding: EncodingOption = None,
    json: Annotated[
        bool,
        typer.Option("--json", help="Print a JSON list with one object per scan on standard output, and nothing else."),
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Find the poses of single scans in a finished run, without an initial guess. Exit status 1 if none is found.

    Example: segslam locate runs/00 004413.bin 000020.bin --dataset kitti
    """
    for scan in scans:
        check_exists(scan, "give scan files")
    announce(f"locate: reading {run}", quiet=quiet)
    from segslam.core.types import SegslamError
    from segslam.output.folder import folder_of
    from segslam.run.locator import Locator

    if dataset not in (None, "kitti"):
        raise SegslamError(f"--dataset {dataset}: only kitti needs a correction; omit the option for other data")
    locator = Locator.from_run(folder_of(run))
    compile_kernels(quiet=quiet)
    num_bad = 0
    found = []
    for scan in progress(scans, total=len(scans), title="locate", quiet=quiet):
        started = perf_counter()
        try:
            points, classes = _read(scan, scans, dataset, labels, encoding, locator)
        except SegslamError as error:
            num_bad += 1
            found.append(
                _not_found("unreadable", str(error).partition("; ")[0]) | {"seconds": perf_counter() - started}
            )
        else:
            started = perf_counter()
            found.append(_figures(locator.locate(points, classes)) | {"seconds": perf_counter() - started})
    if json:
        print_out(dumps(found, allow_nan=False))
    else:
        _show(scans, found, quiet=quiet)
    if num_bad:
        raise SegslamError(f"{num_bad} of {len(scans)} scans cannot be read; copy the files again, or omit them")
    if not any(one["found"] for one in found):
        raise typer.Exit(1)


def _read(
    scan: Path, scans: list[Path], dataset: str | None, labels: str, encoding: Any, locator: "Locator"
) -> tuple["Points", "Labels | None"]:
    """Points of a scan and their labels; None for labels if they are to be computed from geometry."""
    import numpy as np

    from segslam.labels.label_files import encoding_of, read_labels
    from segslam.labels.late import computed
    from segslam.scans.clouds import read_cloud
    from segslam.scans.dataset import make_scan
    from segslam.scans.kitti import VERTICAL_ANGLE_DEG

    angle_deg = locator.config.sensor.vertical_angle_deg
    if angle_deg is None:
        angle_deg = VERTICAL_ANGLE_DEG if dataset == "kitti" else 0.0
    points = read_cloud(scan)
    ids = np.zeros(len(points), np.uint8)
    if labels not in ("geometric", "none"):
        files = [Path(labels) / f"{one.stem}.label" for one in scans]
        for file in files:
            check_exists(file, "--labels: give geometric, none, or a folder with a .label file for each scan")
        ids = read_labels(Path(labels) / f"{scan.stem}.label", len(points), encoding or encoding_of(files))
    ready = make_scan(scan, 0, 0, points, ids, vertical_angle_deg=angle_deg)
    return ready.points, None if labels == "geometric" else computed(ready.labels)


def _figures(found: "Located | Rejected") -> dict[str, Any]:
    from segslam.core.types import Rejected

    if isinstance(found, Rejected):
        return _not_found(found.reason.value, found.detail, found.probability, found.evidence)
    return {
        "found": True,
        "T_world_lidar": found.T_world_lidar.ravel().tolist(),
        "keyframe": found.keyframe_id,
        "inliers": found.inliers,
        "overlap": found.overlap,
        "probability": found.alignment.probability,
        "evidence": found.alignment.evidence,
        "reason": None,
        "detail": None,
    }


def _not_found(
    reason: str, detail: str, probability: float | None = None, evidence: dict[str, float] | None = None
) -> dict[str, Any]:
    nothing = dict.fromkeys(("T_world_lidar", "keyframe", "inliers", "overlap"))
    judged = {"probability": probability, "evidence": evidence or None}
    return {"found": False, **nothing, **judged, "reason": reason, "detail": detail}


def _show(scans: list[Path], found: list[dict[str, Any]], *, quiet: bool) -> None:
    """Print file and pose of each scan on standard output, and details on standard error."""
    for scan, one in zip(scans, found, strict=True):
        if one["found"]:
            print_out(f"{scan} " + " ".join(f"{value:.6f}" for value in one["T_world_lidar"]))
            say(
                f"{scan}: at keyframe {one['keyframe']}, {one['inliers']} inliers, overlap {one['overlap']:.2f}, "
                f"probability {one['probability']:.4f}, {1000 * one['seconds']:.0f} ms",
                quiet=quiet,
            )
        else:
            say(f"{scan}: not found: {one['reason']} ({one['detail']})")
