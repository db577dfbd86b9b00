"""`segslam map`."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    EncodingOption,
    FramesOption,
    JsonOption,
    LabelsOption,
    QuietOption,
    SequenceOption,
    SetOption,
    print_json,
    progress,
    say,
)

if TYPE_CHECKING:
    from segslam.alignment import Labeller
    from segslam.config import Config, OdometryConfig
    from segslam.datasets import Dataset
    from segslam.odometry import Odometry
    from segslam.runs import Run
    from segslam.types import Trajectory


def map_command(
    data: Annotated[Path, typer.Argument(help="KITTI's folder (with sequences/), a folder of scans, or a recording.")],
    out: Annotated[Path, typer.Option(help="New folder for the run.")],
    dataset: DatasetOption = None,
    sequence: SequenceOption = "00",
    frames: FramesOption = None,
    labels: LabelsOption = "auto",
    encoding: EncodingOption = None,
    odometry: Annotated[
        Path | None, typer.Option(help="Use this trajectory (KITTI or TUM format, LiDAR frame) in place of KISS-ICP.")
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Map a sequence: corrected trajectory, log, loops and, where there is ground truth, the error.

    Example: segslam map kitti --sequence 00 --frames 0:1000 --out runs/00
    """
    from segslam.config import load_config
    from segslam.datasets import open_dataset

    settings_now = load_config(config, settings or ())
    scans = open_dataset(data, sequence=sequence, dataset=dataset, labels=labels, encoding=encoding, frames=frames)
    given = _given_odometry(odometry, scans, settings_now.odometry) if odometry else None
    map_scans(scans, out, settings=settings_now, odometry=given, json=json, quiet=quiet)


def map_scans(
    scans: "Dataset", out: Path, *, settings: "Config", odometry: "Odometry | None" = None, json: bool, quiet: bool
) -> None:
    """Map a data set into a new folder, and show the figures. Raises typer.Exit(130) if Ctrl-C ended it early."""
    from segslam.runs import Run, new_folder
    from segslam.slam import Slam

    slam = Slam(settings, odometry=odometry, labeller=_labeller(scans))
    run = Run(
        new_folder(out),
        slam,
        dataset=scans.name,
        T_camera_lidar=scans.T_camera_lidar,
        reference=scans.reference,
    )
    interrupted = _process(run, scans, quiet=quiet)
    metrics = finish(run, scans.reference, json=json, quiet=quiet)
    if interrupted:
        say(f"stopped: {metrics['num_scans']} of {len(scans)} scans are mapped", quiet=quiet)
        raise typer.Exit(130)


def finish(
    run: "Run",
    reference: "Trajectory | None",
    *,
    json: bool,
    quiet: bool,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """End a run: write its results, and show its figures, `more` among them, which are returned."""
    from segslam.runs import accuracy, write_metrics

    result, metrics = run.finish()
    if reference is not None:
        metrics |= accuracy(result, reference)
    metrics |= more
    write_metrics(run.folder, metrics)
    if json:
        print_json(metrics)
    else:
        say(summary(metrics, run.folder), quiet=quiet)
    return metrics


def summary(metrics: dict[str, Any], folder: Path) -> str:
    """What a person wants to know of a run at a glance."""
    lines = [
        f"{metrics['num_scans']} scans in {metrics['seconds_total']:.1f} s ({metrics['scans_per_second']:.1f}/s), "
        f"{metrics['num_keyframes']} keyframes, {metrics['num_loops_accepted']} loops of "
        f"{metrics['num_candidates']} candidates"
    ]
    if skipped := metrics["num_scans_skipped"]:
        lines.append(f"{skipped} bad scans were skipped")
    if "ate_m" in metrics:
        lines.append(
            f"error after alignment: {metrics['ate_m']:.3f} m, odometry alone {metrics['odometry_ate_m']:.3f} m; "
            f"false loops: {metrics['num_loops_false']}"
        )
    if "num_loops_won" in metrics:
        before = f", error {metrics['recorded_ate_m']:.3f} m before" if "recorded_ate_m" in metrics else ""
        lines.append(f"replayed: {metrics['num_loops_won']} loops won, {metrics['num_loops_lost']} lost{before}")
    return "\n".join([*lines, f"results in {folder}"])


def _process(run: "Run", scans: "Dataset", *, quiet: bool) -> bool:
    """Map every scan. Whether Ctrl-C ended it before the last one."""
    with suppress(KeyboardInterrupt):
        for _ in progress(run.map(scans), total=len(scans), title="map", quiet=quiet):
            pass
        return False
    return True


def _given_odometry(file: Path, scans: "Dataset", config: "OdometryConfig") -> "Odometry":
    """TUM rows are found by stamp; KITTI rows by the scan's number, or by its place if there is a row for each scan."""
    import numpy as np

    from segslam.odometry import GivenOdometry
    from segslam.trajectory import read_poses
    from segslam.types import SegslamError, Trajectory

    poses = read_poses(file)
    if poses.stamp_ns is not None:
        trajectory = Trajectory(np.arange(len(poses)), poses.stamp_ns, poses.T_a_b)
        return GivenOdometry(trajectory, config, match="stamp")
    by_number = len(poses) > int(scans.scan_index.max())
    if not by_number and len(poses) != len(scans):
        raise SegslamError(f"{file}: {len(poses)} poses for {len(scans)} scans; give one a scan, or TUM's format")
    rows = np.arange(len(poses)) if by_number else scans.scan_index
    return GivenOdometry(Trajectory(rows, np.zeros(len(poses), dtype=np.int64), poses.T_a_b), config)


def _labeller(scans: "Dataset") -> "Labeller | None":
    """None, for labels by shape, unless `--labels` says that scans without labels stay so."""
    from segslam.semantics.label_files import unlabelled

    return None if scans.labels.geometric else lambda points: unlabelled(len(points))
