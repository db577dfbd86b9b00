"""Mapping of a data set into a run folder with one call."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from segslam.core.config import Config, OdometryConfig, check_config
from segslam.core.errors import brief
from segslam.core.pose_files import read_poses
from segslam.core.types import BadScan, SegslamError, Step, Trajectory
from segslam.core.whole_files import expanded
from segslam.labels.encodings import Encoding
from segslam.labels.label_files import unlabelled, whole_source
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.sweep import GivenOdometry, Odometry
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import new_folder
from segslam.run.run import Run
from segslam.scans import Dataset, DataSource
from segslam.scans.presets import extent_m, preset, preset_for
from segslam.slam.slam import Slam

SlamOf = Callable[..., Slam]
"""What makes the pipeline of a run: `Slam`, or another with the same arguments and methods."""


def map_folder(
    data: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    sequence: str = "00",
    dataset: str | None = None,
    labels: str = "auto",
    encoding: Encoding | None = None,
    frames: str | None = None,
    topic: str = "",
    odometry: Odometry | None = None,
    on_step: Callable[[Step], object] = lambda step: None,
    slam_of: SlamOf = Slam,
    options: Mapping[str, str] = MappingProxyType({}),
    place: Callable[[Path], str] | None = None,
) -> FinishedRun:
    """Map a folder of scans or a recording into the new folder `out`, like `segslam map`; returns the finished run.

    Options are those of `open_dataset` and `Slam`; without `config`, the preset that fits the scans is used. `on_step`
    is called with each Step, in order. `slam_of` creates the pipeline; `options` are written to the log; `place`
    georeferences the folder of the run. Scans that cannot be used are skipped with a warning. Raises SegslamError,
    naming the file and the remedy, also if no scan remains.
    """
    check_config(config)
    if not isinstance(odometry, Odometry | None):
        raise SegslamError(f"odometry: {brief(str(odometry))} is not an Odometry; for a file: segslam map --odometry")
    source = DataSource(expanded(data), sequence, dataset, labels, encoding, frames, topic)
    scans = open_scans(source, config or Config())
    config = in_effect(config or preset(preset_for(extent_m(scans))), scans.vertical_angle_deg)
    folder = new_folder(expanded(out))
    maker = None if slam_of is Slam or "in_map" in options else slam_of
    own = {"odometry": odometry, "slam_of": maker, "place": place}
    not_resumed = [name for name, value in own.items() if value is not None]
    recorded = {**resume_options(source), "python": ", ".join(not_resumed), **options}
    kiss = KissOdometry(config.odometry, keeps_alone=scans.reference is not None)
    with begun(scans, folder, config, odometry=odometry or kiss, slam_of=slam_of, options=recorded) as run:
        for step in run.map(scans):
            if not isinstance(step, BadScan):
                on_step(step)
        run.complete(place=place)
    return read_run(folder)


def begun(
    scans: Dataset, folder: Path, config: Config, *, odometry: Odometry, slam_of: SlamOf = Slam, **more: Any
) -> Run:
    """A run that maps a data set, before its first scan. `more`: the other arguments of `Run`."""
    labeller = None if scans.labels.geometric else lambda points: unlabelled(len(points))
    return Run(
        folder,
        slam_of(config, odometry=odometry, labeller=labeller),
        dataset=scans.name,
        T_camera_lidar=scans.T_camera_lidar,
        reference=scans.reference,
        **more,
    )


def resume_options(
    source: DataSource, *, odometry: Path | None = None, map_files: Sequence[Path] = ()
) -> dict[str, str]:
    """The options that `segslam resume` reads from the log of a run."""
    return {
        "data": str(expanded(source.data).resolve()),
        "dataset": source.dataset or "",
        "sequence": source.sequence,
        "frames": source.frames or "",
        "topic": source.topic,
        "labels": whole_source(source.labels),
        "encoding": source.encoding or "",
        "odometry": str(odometry.resolve()) if odometry else "",
        "map_files": json.dumps([str(name) for name in map_files]),
    }


def open_scans(source: DataSource, config: Config) -> Dataset:
    """The scans as a run with these settings needs them: their vertical angle, and intensities if the map has them."""
    by_intensity = config.map.color == "intensity"
    return replace(source, intensities=by_intensity, vertical_angle_deg=config.sensor.vertical_angle_deg).open()


def in_effect(settings: Config, vertical_angle_deg: float) -> Config:
    """The settings, with the vertical angle by which scans are corrected on reading; they may not define one."""
    sensor = settings.sensor.model_copy(update={"vertical_angle_deg": vertical_angle_deg})
    return settings.model_copy(update={"sensor": sensor})


def given_odometry(file: Path, scans: Dataset, config: OdometryConfig) -> Odometry:
    """Odometry from a file. TUM rows are matched by stamp; KITTI rows by scan number, or position among mapped scans.

    Raises SegslamError unless the number of KITTI rows is that of all scans of the data or of the mapped scans.
    """
    poses = read_poses(file)
    if poses.stamp_ns is not None:
        trajectory = Trajectory(np.arange(len(poses)), poses.stamp_ns, poses.T_a_b)
        return GivenOdometry(trajectory, config, match="stamp")
    by_number = len(poses) == scans.num_recorded
    if not by_number and len(poses) != len(scans):
        numbers = dict.fromkeys((scans.num_recorded, len(scans)))
        raise SegslamError(
            f"{file}: {len(poses)} poses, but {scans.name} has {' or '.join(map(str, numbers))}; KITTI format needs "
            "one line per scan, TUM format is matched by stamp"
        )
    rows = np.arange(len(poses)) if by_number else scans.scan_index
    return GivenOdometry(Trajectory(rows, np.zeros(len(poses), dtype=np.int64), poses.T_a_b), config)
