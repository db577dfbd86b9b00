"""One clean map from keyframes and their poses: a point cloud, a top-view image, an occupancy grid.

There are two passes. The first sorts the points of all keyframes into voxels by tile, and stores a range image of each
keyframe, both on disk. The second removes moving objects tile by tile and writes the files. Memory holds some keyframes
and one tile, whatever the length of the drive.
"""

import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from segslam.core.config import MapConfig
from segslam.core.extras import how_to_install
from segslam.core.interrupts import removed_when_stopped
from segslam.core.types import Keyframe, SegslamError, Transform
from segslam.core.whole_files import check_target, whole_file
from segslam.output.map.clouds import BinaryCloud, LasCloud, PcdCloud, PlyCloud
from segslam.output.map.grid import Grid
from segslam.output.map.picture import Picture
from segslam.output.map.projected import GeoTiff
from segslam.output.map.store import MapStore
from segslam.output.map.tiles import Part
from segslam.slam.adjustment import Progress, no_progress

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin


MapFile = BinaryCloud | LasCloud | Picture | Grid
"""Made from a path and the `MapStore`; `add` takes the parts in their order, and `close` completes the file."""
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


def check_names(files: Sequence[Path], *, origin: "Origin | None" = None) -> None:
    """Raises SegslamError for a file with an unknown extension, or one that needs a missing package or the origin."""
    for file in files:
        kind = KINDS.get(file.suffix.lower())
        if kind is None:
            raise SegslamError(f"{file}: unknown kind of map; its name must end in {', '.join(KINDS)}")
        if kind is LasCloud:
            _check_packages(file, "LAS and LAZ need", ("laspy", "lazrs"), extra="las", others=".ply and .pcd do not")
        if kind is LasCloud and origin is not None:
            _check_packages(file, "a coordinate system needs", ("pyproj",), extra="geo", others=".ply does not")
        if kind is GeoTiff:
            _check_packages(file, "GeoTIFF needs", ("pyproj", "rasterio"), extra="geo", others=".png does not")
            if origin is None:
                raise SegslamError(
                    f"{file}: the run has no place on the globe; `segslam georeference RUN --gnss FIXES` first"
                )


def _check_packages(file: Path, needs: str, packages: Sequence[str], *, extra: str, others: str) -> None:
    if any(find_spec(name) is None for name in packages):
        raise SegslamError(f"{file}: {needs} extra packages: {how_to_install(extra)}; {others}")


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
) -> dict[str, int]:
    """Make the map of the keyframes, each with its T_world_keyframe, and write it to files; returns its figures.

    The extension selects the format: .ply, .pcd, .las, .laz: point cloud; .png: top view; .yaml, with a .pgm beside it:
    occupancy grid; .tif: the top view as GeoTIFF. With the `origin` of the world frame (east, north, up) on the globe,
    .las and .laz are in UTM. Files are written atomically. `show` passes the parts on, to show progress. Raises
    SegslamError for another extension, a missing folder, or if no keyframe has a point, OSError if the disk is full.
    """
    check_files(files, origin=origin)
    with TemporaryDirectory(dir=files[0].parent, prefix=".map-") as name, removed_when_stopped(Path(name)):
        scratch = Path(name)
        store = MapStore(scratch, config, origin)
        for keyframe, T_world_keyframe in placed:
            store.add(keyframe, T_world_keyframe)
        if not len(store.tiles):
            raise SegslamError(f"{files[0]}: no keyframe has a static point; there is nothing to map")
        parts = show(store.parts(), len(store.tiles), "clean")
        num_points = _write(parts, store, files, scratch=scratch / "files")
    return {
        "num_map_points": num_points,
        "num_map_moving_points": store.num_moving_points,
        "num_map_voxels_seen_through": store.num_voxels_seen_through,
    }


def _write(parts: Iterable[Part], store: MapStore, files: Sequence[Path], *, scratch: Path) -> int:
    """Write the parts to all files, in a scratch folder until they are complete; returns the number of points."""
    writers = []
    for number, file in enumerate(files):
        folder = scratch / str(number)
        folder.mkdir(parents=True)
        writers.append(KINDS[file.suffix.lower()](folder / file.name, store))
    num_points = 0
    for part in parts:
        num_points += len(part.points)
        for writer in writers:
            writer.add(part)
    for writer in writers:
        writer.close()
    with ExitStack() as complete:
        for number, file in enumerate(files):
            for made in (scratch / str(number)).iterdir():  # a grid is two files
                shutil.move(made, complete.enter_context(whole_file(file.parent / made.name)))
    return num_points
