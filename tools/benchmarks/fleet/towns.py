"""Simulated drives through parts of KITTI's routes: four days in each town, both directions, another lane."""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from segslam.bench.simulation.files import prepare_folder, write_drive
from segslam.bench.simulation.tracks import Drive, in_lane, read_drive
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig

TOWNS = ("00", "05", "06", "07", "02", "08")
NUM_FRAMES = 240
DAYS = ((0, 160, 0.0, False), (80, 240, 0.6, False), (0, 160, -0.5, True), (80, 240, 0.0, True))
"""First and last frame of the part of the town, offset to the left (m), and whether it is driven backwards."""
FIRST = 100
SEED = 3501


def write_towns(out: Path, poses: Path, *, num_frames: int) -> Iterator[str]:
    """Write the drives of all towns, and the whole of each in one drive; yields the names of folders."""
    for town in TOWNS:
        road = read_drive(poses / f"{town}.txt", sequence=town)
        road = _part(road, slice(FIRST, FIRST + num_frames))
        scale = num_frames / NUM_FRAMES
        for day, (first, last, left_m, reverse) in enumerate(DAYS):
            part = _part(road, slice(round(first * scale), round(last * scale)))
            yield _write(out / f"{town}_{day}", road, in_lane(part, left_m=left_m, reverse=reverse), town, day)
        yield _write(out / f"{town}_whole", road, road, town, 0)


def write_list(file: Path, drives: Sequence[Path]) -> Path:
    """The list that `segslam fleet` reads."""
    file.write_text(json.dumps([{"data": str(drive), "name": drive.name} for drive in drives]), encoding="utf-8")
    return file


def drives_in(folder: Path, *, whole: bool = False) -> list[Path]:
    """The drives that were written, one town after the other; with `whole` those that map a town at once."""
    found = sorted(path for path in folder.iterdir() if (path / "sequences").is_dir())
    return [path for path in found if path.name.endswith("_whole") == whole]


def fleet_command(listed: Path, out: Path, *options: str) -> list[str]:
    """`segslam fleet` with the drives of a list, all in the frame of their true poses."""
    words = ("fleet", str(listed), "--out", str(out), "--same-reference", "-q", *options)
    return [sys.executable, "-m", "segslam", *words]


def _write(folder: Path, road: Drive, driven: Drive, town: str, day: int) -> str:
    if not folder.exists():
        config = SimulationConfig(world=WorldConfig(day=day), sensor=SensorConfig())
        prepare_folder(folder, "00", overwrite=False)
        list(write_drive(folder, "00", road, config=config, seed=SEED + int(town), driven=driven))
    return folder.name


def _part(drive: Drive, rows: slice) -> Drive:
    return replace(drive, T_world_lidar=drive.T_world_lidar[rows], time_s=drive.time_s[rows])
