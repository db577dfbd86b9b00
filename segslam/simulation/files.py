"""Simulated sequences in KITTI's format, so that the reader of real data reads them back as the truth."""

import json
import shutil
from collections.abc import Collection, Iterable, Iterator
from itertools import count
from pathlib import Path

import numpy as np

from segslam import geometry
from segslam.errors import reason
from segslam.geometry import raise_beams
from segslam.semantics.encodings import RAW_OF_LABEL
from segslam.simulation.drive import drive_sweeps
from segslam.simulation.sensor import Sweep
from segslam.simulation.tracks import Drive, parse_calib
from segslam.simulation.world import build_world
from segslam.simulation.world_settings import SimulationConfig
from segslam.system.whole_files import write_whole
from segslam.trajectory import camera_from_lidar
from segslam.types import SegslamError, Transform, WorkFailed

SETTINGS_FILE = "simulation.json"
KITTI_VERTICAL_ANGLE_DEG = 0.205  # what readers of KITTI's scans add to each vertical angle


def prepare_folder(out: Path, sequence: str, *, overwrite: bool) -> None:
    """Make room for a sequence. One that is there is refused, or removed if it was simulated and may be overwritten.

    Raises SegslamError that names what is there: real data is never removed.
    """
    if Path(sequence).name != sequence or not sequence:
        raise SegslamError(f"--sequence {sequence}: must be a plain name such as 00")
    folder, poses = out / "sequences" / sequence, out / "poses" / f"{sequence}.txt"
    there = next((path for path in (folder, poses) if path.exists()), None)
    if there is not None and not (folder / SETTINGS_FILE).is_file():
        raise SegslamError(f"{there}: is there and was not simulated here; choose another folder or --sequence")
    if there is not None and not overwrite:
        raise SegslamError(f"{there}: is there already; choose another folder or --sequence, or pass --overwrite")
    try:
        if there is not None:
            shutil.rmtree(folder)
            poses.unlink(missing_ok=True)
        for part in (folder / "velodyne", folder / "labels", poses.parent):
            part.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SegslamError(f"{out}: cannot write there ({error}); choose another folder") from error


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
    """Simulate the first scans of a drive (None: all) into a prepared folder; yields how many are complete.

    The streets are those of `drive`; the sensor takes the path `driven`, if given. Poses are in the frame of the first
    pose of `drive` in either case, so that several drives through one town have their poses in one frame.
    `only` leaves out all others of them, but not their times and poses. The world is that of the whole drive, so fewer
    scans are the same scans. Settings and seed are kept beside them.
    """
    settings = {"seed": seed, "config": config.model_dump(mode="json")}
    write_whole(out / "sequences" / sequence / SETTINGS_FILE, json.dumps(settings, indent=1) + "\n")
    world = build_world(drive.T_world_lidar, drive.time_s, config=config.world, seed=seed)
    driven = driven or drive
    numbers = [index for index in range(num_frames or len(driven.time_s)) if only is None or index in only]
    sweeps = drive_sweeps(
        world, driven.T_world_lidar, driven.time_s, config=config.sensor, seed=seed, only=frozenset(numbers)
    )
    yield from write_sequence(out, sequence, driven, sweeps, numbers=numbers, T_world_origin=drive.T_world_lidar[0])


def write_sequence(
    out: Path,
    sequence: str,
    drive: Drive,
    sweeps: Iterable[Sweep],
    *,
    numbers: Iterable[int] | None = None,
    T_world_origin: Transform | None = None,
) -> Iterator[int]:
    """Write sweep after sweep into a prepared folder, yielding how many are complete.

    `numbers` are those of the scans, ascending; 0, 1, ... unless given. Times and poses have no gap up to the last.
    Stopped at any moment, what is there is a shorter sequence: a scan appears whole, after its labels, time and pose.
    Raises WorkFailed, with the number of scans, if the disk is full.
    Poses are the camera's, in the frame of the camera of the first, or of a LiDAR at `T_world_origin`.
    """
    folder = out / "sequences" / sequence
    write_whole(folder / "calib.txt", drive.calib)
    T_camera_lidar = parse_calib(drive.calib, source="calib")
    origin = drive.T_world_lidar[0] if T_world_origin is None else T_world_origin
    T_first_lidar = geometry.inverse(origin) @ drive.T_world_lidar
    T_first_camera = camera_from_lidar(T_first_lidar, T_camera_lidar)
    done = next_line = 0
    try:
        with (folder / "times.txt").open("w") as times, (out / "poses" / f"{sequence}.txt").open("w") as poses:
            for index, one in zip(count() if numbers is None else numbers, sweeps, strict=False):
                for line in range(next_line, index + 1):
                    print(f"{drive.time_s[line]:.6e}", file=times)
                    print(" ".join(f"{value:.9e}" for value in T_first_camera[line, :3].ravel()), file=poses)
                next_line = index + 1
                times.flush()
                poses.flush()
                _write_scan(folder, f"{index:06d}", one)
                done += 1
                yield done
    except OSError as error:
        raise WorkFailed(f"{folder}: stopped after {done} scans ({reason(error)}); make room there") from error


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
    """Points with their vertical angles lowered by what readers of KITTI's scans add to them."""
    return raise_beams(points, -KITTI_VERTICAL_ANGLE_DEG)
