"""Simulated sequences in KITTI's format. The reader for real data recovers the exact points and poses."""

import json
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from segslam.bench.simulation.sensor import Sweep, drive_sweeps
from segslam.bench.simulation.tracks import Drive
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SimulationConfig
from segslam.core import geometry
from segslam.core.errors import reason
from segslam.core.geometry import raise_beams
from segslam.core.trajectory import camera_from_lidar
from segslam.core.types import SegslamError, WorkFailed
from segslam.core.whole_files import write_whole
from segslam.labels.encodings import RAW_OF_LABEL
from segslam.scans.kitti import VERTICAL_ANGLE_DEG, parse_calibration

SETTINGS_FILE = "simulation.json"


def prepare_folder(out: Path, sequence: str, *, overwrite: bool) -> None:
    """Create the folders of a sequence.

    An existing sequence is removed if it was simulated and `overwrite` is set. Raises SegslamError, naming the folder,
    otherwise; real data is never removed.
    """
    if Path(sequence).name != sequence or sequence in ("", ".."):
        raise SegslamError(f"--sequence {sequence}: must be a plain name such as 00")
    folder, poses = out / "sequences" / sequence, out / "poses" / f"{sequence}.txt"
    there = next((path for path in (folder, poses) if path.exists()), None)
    if there is not None and not (folder / SETTINGS_FILE).is_file():
        raise SegslamError(f"{there}: exists and was not simulated by segslam; choose another folder or --sequence")
    if there is not None and not overwrite:
        raise SegslamError(f"{there}: exists; choose another folder or --sequence, or pass --overwrite")
    try:
        if there is not None:
            shutil.rmtree(folder)
            poses.unlink(missing_ok=True)
        for part in (folder / "velodyne", folder / "labels", poses.parent):
            part.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SegslamError(f"{out}: cannot be written ({error}); choose another folder") from error


def write_drive(
    out: Path,
    sequence: str,
    drive: Drive,
    *,
    config: SimulationConfig,
    seed: int,
    driven: Drive | None = None,
    num_frames: int | None = None,
    only: Collection[int] | None = None,
) -> Iterator[int]:
    """Write the first `num_frames` simulated scans (None: all) to a prepared folder; yields the number of scans done.

    The streets follow `drive`; the sensor follows `driven` if it is given. In both cases poses are in the frame of the
    first pose of `drive`, so that several drives through one town share one frame. If `only` is given, only these scans
    are written, but the times and poses of all up to the last. The world is built for the whole drive, so a shorter
    simulation has the same scans. The settings and the seed are written beside the scans.
    If writing is interrupted, the folder holds a shorter but complete sequence: a scan is written after its labels,
    time and pose. Raises WorkFailed, with the number of scans, if the disk is full.
    """
    folder = out / "sequences" / sequence
    settings = {"seed": seed, "config": config.model_dump(mode="json")}
    write_whole(folder / SETTINGS_FILE, json.dumps(settings, indent=1) + "\n")
    world = World(drive.T_world_lidar, drive.time_s, config=config.world, seed=seed)
    driven = driven or drive
    write_whole(folder / "calib.txt", driven.calib)
    T_first_lidar = geometry.inverse(drive.T_world_lidar[0]) @ driven.T_world_lidar
    T_first_camera = camera_from_lidar(T_first_lidar, parse_calibration(driven.calib, folder / "calib.txt"))
    numbers = [index for index in range(num_frames or len(driven.time_s)) if only is None or index in only]
    sweeps = drive_sweeps(
        world, driven.T_world_lidar, driven.time_s, config=config.sensor, seed=seed, only=frozenset(numbers)
    )
    done = next_line = 0
    try:
        with (folder / "times.txt").open("w") as times, (out / "poses" / f"{sequence}.txt").open("w") as poses:
            for index, one in zip(numbers, sweeps, strict=False):
                for line in range(next_line, index + 1):
                    print(f"{driven.time_s[line]:.6e}", file=times)
                    print(" ".join(f"{value:.9e}" for value in T_first_camera[line, :3].ravel()), file=poses)
                next_line = index + 1
                times.flush()
                poses.flush()
                _write_scan(folder, f"{index:06d}", one)
                done += 1
                yield done
    except OSError as error:
        raise WorkFailed(f"{folder}: stopped after {done} scans ({reason(error)}); free space there") from error


def _write_scan(folder: Path, name: str, one: Sweep) -> None:
    raw = RAW_OF_LABEL[one.labels] | one.instances.astype(np.uint32) << 16
    labels, part = folder / "labels" / f"{name}.label", folder / "velodyne" / f"{name}.part"
    try:
        raw.astype("<u4").tofile(labels)
        np.column_stack([uncorrected(one.points), one.intensity]).astype("<f4").tofile(part)
        part.replace(part.with_suffix(".bin"))
    except OSError:
        labels.unlink(missing_ok=True)
        part.unlink(missing_ok=True)
        raise


def uncorrected(points: np.ndarray) -> np.ndarray:
    """Points with their vertical angles lowered by the correction that readers of KITTI's scans apply."""
    return raise_beams(points, -VERTICAL_ANGLE_DEG)
