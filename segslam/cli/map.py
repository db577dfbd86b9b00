"""`segslam map`."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.checks import check_intensities, check_same, is_finished, log_to_resume
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
from segslam.cli.ending import finish
from segslam.cli.export import WITH_MAP, map_summary, write_maps
from segslam.cli.view import open_scene

if TYPE_CHECKING:
    from segslam.alignment import Labeller
    from segslam.config import Config, MapConfig, OdometryConfig
    from segslam.datasets import Dataset
    from segslam.log import RunLog
    from segslam.odometry import Odometry
    from segslam.runs import Run
    from segslam.types import BadScan, Step


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
    with_map: Annotated[bool, typer.Option("--map", help="Write one clean cloud, map.ply, and map.png too.")] = False,
    map_file: Annotated[
        list[Path] | None,
        typer.Option(help="Write the map as this file of the run: .ply .pcd .las .laz .png .yaml; may be repeated."),
    ] = None,
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
    from segslam.map import check_names

    map_files = [out / name for name in (*(WITH_MAP if with_map else ()), *(map_file or ()))]
    check_names(map_files)
    recorded = log_to_resume(out) if resume else None
    settings_now = load_config(config, settings or (), base=recorded.config if recorded else None)
    by_intensity = settings_now.map.color == "intensity"
    scans = open_dataset(
        data,
        sequence=sequence,
        dataset=dataset,
        labels=labels,
        encoding=encoding,
        frames=frames,
        topic=topic,
        intensities=by_intensity,
    )
    if by_intensity:
        check_intensities(scans)
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
            _complete(recorded, map_files, config=settings_now.map, json=json, quiet=quiet)
            raise typer.Exit(0)
    scene = open_scene(None, view_every=settings_now.log.view_every) if view else None
    map_scans(
        scans,
        out,
        settings=settings_now,
        odometry=given,
        options=options,
        recorded=recorded,
        map_files=map_files,
        watch=scene.add if scene else _nobody,
        json=json,
        quiet=quiet,
    )
    if scene:
        scene.end()


def _complete(recorded: "RunLog", map_files: Sequence[Path], *, config: "MapConfig", json: bool, quiet: bool) -> None:
    """Give a finished run the maps that it lacks, and show its figures."""
    from segslam.results import read_metrics

    folder = recorded.path.parent
    say(f"{folder}: finished already, with all scans; nothing is left to resume", quiet=quiet)
    if missing := [file for file in map_files if not file.exists()]:
        made = write_maps(recorded, missing, config=config, quiet=quiet)
        say(map_summary(made, missing), quiet=quiet)
    if json:
        print_json(read_metrics(folder))


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
    map_files: Sequence[Path] = (),
    watch: "Callable[[Step | BadScan], None]" = _nobody,
    json: bool,
    quiet: bool,
) -> None:
    """Map a data set into a new folder, or go on with the run `recorded` there, and show the figures.

    `watch` is given each step. Raises typer.Exit(130) if Ctrl-C ended it early.
    """
    from segslam.odometry import OdometryApart
    from segslam.run_files import new_folder
    from segslam.runs import Run
    from segslam.slam import Slam

    folder = out if recorded else new_folder(out)
    apart = OdometryApart(settings.odometry) if odometry is None else None
    with Run(
        folder,
        Slam(settings, odometry=odometry or apart, labeller=_labeller(scans)),
        dataset=scans.name,
        T_camera_lidar=scans.T_camera_lidar,
        reference=scans.reference,
        options=options,
        resumes=recorded is not None,
    ) as run:
        with apart or nullcontext():
            if recorded is not None:
                _take_over(run, recorded, scans, watch, quiet=quiet)
            interrupted = _process(run, scans, watch, quiet=quiet)
        resumed = {} if recorded is None else {"num_scans_resumed": run.num_scans_resumed}
        metrics = finish(run, scans.reference, map_files=map_files, json=json, quiet=quiet, more=resumed)
    if interrupted:
        say(f"stopped: {metrics['num_scans']} of {len(scans)} scans are mapped", quiet=quiet)
        raise typer.Exit(130)


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
