"""Keyframes and their poses to one clean map: a cloud, a picture from above, an occupancy grid.

Two passes: the keyframes once, into voxels by tile and a picture of what each saw, both on disk; then tile after tile,
without what moved, into the files. Memory holds some of the keyframes and one tile, however long the drive.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from segslam.config import MapConfig
from segslam.map.clouds import LasCloud, PcdCloud, PlyCloud, check_las
from segslam.map.gathered import Gathered
from segslam.map.grid import Grid
from segslam.map.part import Extent, MapFile, Part
from segslam.map.picture import Picture
from segslam.system.interrupts import removed_when_stopped
from segslam.system.whole_files import check_target, whole_file
from segslam.types import Keyframe, SegslamError, Transform

__all__ = ["MapSummary", "check_names", "write_map"]

KINDS: dict[str, type[MapFile]] = {
    ".ply": PlyCloud,
    ".pcd": PcdCloud,
    ".las": LasCloud,
    ".laz": LasCloud,
    ".png": Picture,
    ".yaml": Grid,
}
"""By the ending of a file's name."""


@dataclass(frozen=True, slots=True)
class MapSummary:
    """What a map was made of."""

    num_keyframes: int
    num_points: int
    """In the map: a voxel each."""
    num_moving_points: int
    """Number of points of moving classes that were removed."""
    num_voxels_seen_through: int
    """Voxels that were left out because other keyframes saw through them."""


def check_names(files: Sequence[Path]) -> None:
    """Raises SegslamError for a file with an unknown extension, or one that needs a missing package."""
    for file in files:
        if file.suffix.lower() not in KINDS:
            raise SegslamError(f"{file}: unknown kind of map; its name has to end in {', '.join(KINDS)}")
        if KINDS[file.suffix.lower()] is LasCloud:
            check_las(file)


def _unseen(parts: Iterator[Part], _: int) -> Iterator[Part]:
    return parts


def write_map(
    placed: Iterable[tuple[Keyframe, Transform]],
    files: Sequence[Path],
    *,
    config: MapConfig,
    show: Callable[[Iterator[Part], int], Iterator[Part]] = _unseen,
) -> MapSummary:
    """Make the map of keyframes, each with its T_world_keyframe, and write it to each of the files, one at least.

    The extension selects what is written: .ply, .pcd, .las, .laz the cloud, .png the map from above, .yaml with a
    .pgm beside it the occupancy grid. Files appear when they are whole. `show` is given the parts that are written and
    their number, to show the progress. Raises SegslamError for another ending, for a folder that is not there, or if no
    keyframe has a point, and OSError where the disk is full.
    """
    check_names(files)
    for file in files:
        check_target(file)
    with TemporaryDirectory(dir=files[0].parent, prefix=".map-") as name, removed_when_stopped(Path(name)):
        scratch = Path(name)
        gathered = Gathered(scratch, config)
        for keyframe, T_world_keyframe in placed:
            gathered.add(keyframe, T_world_keyframe)
        extent = gathered.extent()
        if extent is None:
            raise SegslamError(f"{files[0]}: no keyframe has a static point; there is nothing to map")
        parts = show(gathered.parts(), gathered.num_tiles)
        num_points = _write(parts, extent, files, scratch=scratch / "files", config=config)
    return MapSummary(
        num_keyframes=gathered.num_keyframes,
        num_points=num_points,
        num_moving_points=gathered.num_moving_points,
        num_voxels_seen_through=gathered.num_voxels_seen_through,
    )


def _write(parts: Iterable[Part], extent: Extent, files: Sequence[Path], *, scratch: Path, config: MapConfig) -> int:
    """Write the parts to all files, in a scratch folder until they are whole; the number of points."""
    folders = [scratch / str(number) for number in range(len(files))]
    for folder in folders:
        folder.mkdir(parents=True)
    writers = [
        KINDS[file.suffix.lower()](folder / file.name, extent, config=config)
        for file, folder in zip(files, folders, strict=True)
    ]
    num_points = 0
    for part in parts:
        num_points += len(part.points)
        for writer in writers:
            writer.add(part)
    for file, folder, writer in zip(files, folders, writers, strict=True):
        writer.close()
        for made in folder.iterdir():  # a grid is two files
            with whole_file(file.parent / made.name) as unfinished:
                shutil.move(made, unfinished)
    return num_points
