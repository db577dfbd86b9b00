"""One clean map from keyframes and their poses: a point cloud, a top-view image, an occupancy grid.

There are two passes. The first sorts the points of all keyframes into voxels by tile, and stores a range image of each
keyframe, both on disk. The second removes moving objects tile by tile and writes the files. Memory holds some keyframes
and one tile, whatever the length of the drive.
"""

import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from segslam.core.config import MapConfig
from segslam.core.interrupts import removed_when_stopped
from segslam.core.types import Keyframe, SegslamError, Transform
from segslam.core.whole_files import check_target, whole_file
from segslam.output.map.clouds import LasCloud, PcdCloud, PlyCloud, check_las
from segslam.output.map.grid import Grid
from segslam.output.map.part import Extent, MapFile, Part
from segslam.output.map.picture import Picture
from segslam.output.map.projected import GeoTiff, check_projected
from segslam.output.map.store import MapStore
from segslam.slam.adjustment import Progress, no_progress

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin


KINDS: dict[str, type[MapFile]] = {
    ".ply": PlyCloud,
    ".pcd": PcdCloud,
    ".las": LasCloud,
    ".laz": LasCloud,
    ".png": Picture,
    ".yaml": Grid,
    ".tif": GeoTiff,
    ".tiff": GeoTiff,
}
"""Writers by file extension."""


@dataclass(frozen=True, slots=True)
class MapSummary:
    """Contents of a map."""

    num_keyframes: int
    num_points: int
    """Voxels in the map."""
    num_moving_points: int
    """Number of points of moving classes that were removed."""
    num_voxels_seen_through: int
    """Number of voxels removed because other keyframes saw through them."""


def check_names(files: Sequence[Path], *, origin: "Origin | None" = None) -> None:
    """Raises SegslamError for a file with an unknown extension, or one that needs a missing package or the origin."""
    for file in files:
        if file.suffix.lower() not in KINDS:
            raise SegslamError(f"{file}: unknown kind of map; its name must end in {', '.join(KINDS)}")
        if KINDS[file.suffix.lower()] is LasCloud:
            check_las(file, is_projected=origin is not None)
        if KINDS[file.suffix.lower()] is GeoTiff:
            check_projected(file, origin)


def check_files(files: Sequence[Path], *, origin: "Origin | None" = None) -> None:
    """Raises SegslamError as `check_names`, for a file that cannot be written, or for one that is given twice."""
    check_names(files, origin=origin)
    for file in files:
        check_target(file)
        if files.count(file) > 1:
            raise SegslamError(f"{file}: given twice; give each file once")


def write_map(
    placed: Iterable[tuple[Keyframe, Transform]],
    files: Sequence[Path],
    *,
    config: MapConfig,
    origin: "Origin | None" = None,
    show: Progress = no_progress,
) -> MapSummary:
    """Make the map of the keyframes, each with its T_world_keyframe, and write it to one or more files.

    The extension selects the format: .ply, .pcd, .las, .laz: point cloud; .png: top view; .yaml, with a .pgm beside it:
    occupancy grid; .tif: the top view as GeoTIFF. With the `origin` of the world frame (east, north, up) on the globe,
    .las and .laz are in UTM. Files are written atomically. `show` passes the parts on while they are
    written, to show progress. Raises SegslamError for another extension, a missing folder, or if no keyframe has a
    point; raises OSError if the disk is full.
    """
    check_files(files, origin=origin)
    with TemporaryDirectory(dir=files[0].parent, prefix=".map-") as name, removed_when_stopped(Path(name)):
        scratch = Path(name)
        store = MapStore(scratch, config)
        for keyframe, T_world_keyframe in placed:
            store.add(keyframe, T_world_keyframe)
        has_picture = any(issubclass(KINDS[file.suffix.lower()], Picture) for file in files)
        extent = store.extent(for_picture=has_picture)
        if extent is None:
            raise SegslamError(f"{files[0]}: no keyframe has a static point; there is nothing to map")
        parts = show(store.parts(), store.num_tiles, "clean")
        num_points = _write(parts, replace(extent, origin=origin), files, scratch=scratch / "files", config=config)
    return MapSummary(
        num_keyframes=store.num_keyframes,
        num_points=num_points,
        num_moving_points=store.num_moving_points,
        num_voxels_seen_through=store.num_voxels_seen_through,
    )


def _write(parts: Iterable[Part], extent: Extent, files: Sequence[Path], *, scratch: Path, config: MapConfig) -> int:
    """Write the parts to all files, in a scratch folder until they are complete; returns the number of points."""
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
    for writer in writers:
        writer.close()
    with ExitStack() as complete:
        for file, folder in zip(files, folders, strict=True):
            for made in folder.iterdir():  # a grid is two files
                shutil.move(made, complete.enter_context(whole_file(file.parent / made.name)))
    return num_points
