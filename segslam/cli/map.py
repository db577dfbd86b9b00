"""`segslam map`."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_same, is_finished, log_to_resume
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
from segslam.cli.view import open_scene

if TYPE_CHECKING:
    from segslam.alignment import Labeller
    from segslam.config import Config, OdometryConfig
    from segslam.datasets import Dataset
    from segslam.log import RunLog
    from segslam.odometry import Odometry
    from segslam.runs import Run
    from segslam.types import BadScan, Step, Trajectory


def map_command(
    data: Annotated[Path, typer.Argument(help="KITTI's folder (with sequences/), a folder of scans, or a recording.")],
    out: Annotated[Path, typer.Option(help="New folder for the run; that of the run for --resume.")],
    dataset: DatasetOption = None,
    sequence: SequenceOption = "00",
    frames: FramesOption = None,
    topic: Annotated[str, typer.Option(help="Of the points, in a recording that has several (rosbag, mcap).")] = "",
    labels: LabelsOption = "auto",
    encoding: EncodingOption = None,
    odometry: Annotated[
        Path | None, typer.Option(help="Use this trajectory (KITTI or TUM format, LiDAR frame) in place of KISS-ICP.")
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    view: Annotated[
        bool, typer.Option("--view", help="Watch it in Rerun's viewer, as `segslam view` shows it.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out, killed or stopped.")] = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Map a sequence: corrected trajectory, log, loops and, where there is ground truth, the error.

    Example: segslam map kitti --sequence 00 --frames 0:1000 --out runs/00
    """
    from segslam.config import load_config
    from segslam.datasets import open_dataset
    from segslam.results import read_metrics

    recorded = log_to_resume(out) if resume else None
    settings_now = load_config(config, settings or (), base=recorded.config if recorded else None)
    scans = open_dataset(
        data, sequence=sequence, dataset=dataset, labels=labels, encoding=encoding, frames=frames, topic=topic
    )
    options = {
        "frames": frames or "",
        "topic": topic,
        "labels": labels,
        "encoding": encoding or "",
        "odometry": str(odometry or ""),
    }
    given = _given_odometry(odometry, scans, settings_now.odometry) if odometry else None
    if recorded is not None:
        check_same(recorded, settings_now, dataset=scans.name, options=options)
        if is_finished(recorded, scans):
            say(f"{out}: finished already, all {len(scans)} scans; nothing is left to resume", quiet=quiet)
            if json:
                print_json(read_metrics(out))
            raise typer.Exit(0)
    scene = open_scene(None, view_every=settings_now.log.view_every) if view else None
    map_scans(
        scans,
        out,
        settings=settings_now,
        odometry=given,
        options=options,
        recorded=recorded,
        watch=scene.add if scene else _nobody,
        json=json,
        quiet=quiet,
    )
    if scene:
        scene.end()


def _nobody(_: "Step | BadScan") -> None:
    """Watches."""


def map_scans(
    scans: "Dataset",
    out: Path,
    *,
    settings: "Config",
    odometry: "Odometry | None" = None,
    options: Mapping[str, str] = MappingProxyType({}),
    recorded: "RunLog | None" = None,
    watch: "Callable[[Step | BadScan], None]" = _nobody,
    json: bool,
    quiet: bool,
) -> None:
    """Map a data set into a new folder, or go on with the run `recorded` there, and show the figures.

    `watch` is given each step. Raises typer.Exit(130) if Ctrl-C ended it early.
    """
    from segslam.run_files import new_folder
    from segslam.runs import Run
    from segslam.slam import Slam

    slam = Slam(settings, odometry=odometry, labeller=_labeller(scans))
    with Run(
        out if recorded else new_folder(out),
        slam,
        dataset=scans.name,
        T_camera_lidar=scans.T_camera_lidar,
        reference=scans.reference,
        options=options,
        resumes=recorded is not None,
    ) as run:
        if recorded is not None:
            _take_over(run, recorded, scans, watch, quiet=quiet)
        resumed = {} if recorded is None else {"num_scans_resumed": run.num_scans_resumed}
        interrupted = _process(run, scans, watch, quiet=quiet)
        metrics = finish(run, scans.reference, json=json, quiet=quiet, more=resumed)
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
    from segslam.report import write_report
    from segslam.run_files import write_metrics
    from segslam.runs import accuracy

    result, metrics = run.finish()
    if reference is not None:
        metrics |= accuracy(result, reference)
    metrics |= more
    write_metrics(run.folder, metrics)
    write_report(run.folder)
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
    if "num_scans_resumed" in metrics:
        lines.append(f"of these scans, {metrics['num_scans_resumed']} are from the log")
    if "num_loops_won" in metrics:
        before = f", error {metrics['recorded_ate_m']:.3f} m before" if "recorded_ate_m" in metrics else ""
        lines.append(f"replayed: {metrics['num_loops_won']} loops won, {metrics['num_loops_lost']} lost{before}")
    return "\n".join([*lines, f"results in {folder}"])


def _take_over(
    run: "Run", recorded: "RunLog", scans: "Dataset", watch: "Callable[[Step | BadScan], None]", *, quiet: bool
) -> None:
    """Do again what the log holds. Raises typer.Exit(130) for Ctrl-C, which leaves the log as it was."""
    try:
        for step in progress(run.resume(recorded, scans), total=recorded.num_steps(), title="resume", quiet=quiet):
            watch(step)
    except KeyboardInterrupt as interrupt:
        raise typer.Exit(130) from interrupt


def _process(run: "Run", scans: "Dataset", watch: "Callable[[Step | BadScan], None]", *, quiet: bool) -> bool:
    """Map every scan. Whether Ctrl-C ended it before the last one."""
    with suppress(KeyboardInterrupt):
        left = len(scans) - run.num_scans_resumed - run.num_scans_skipped
        for step in progress(run.map(scans), total=left, title="map", quiet=quiet):
            watch(step)
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
