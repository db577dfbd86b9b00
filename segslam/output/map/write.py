"""One clean map from keyframes and their poses: a point cloud, a top-view image, an occupancy grid.

There are two passes. The first sorts the points of all keyframes into voxels by tile, and stores a range image of each
keyframe, both on disk. The second removes moving objects tile by tile and writes the files. Memory holds some keyframes
and one tile, whatever the length of the drive.
"""

import shutil
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from segslam.core import geometry
from segslam.core.config import MapConfig
from segslam.core.extras import how_to_install
from segslam.core.points import within_range
from segslam.core.processes import Progress, no_progress
from segslam.core.types import Keyframe, Label, Points, SegslamError, Transform, Vector
from segslam.core.whole_files import check_target, temporary_folder, whole_file
from segslam.labels.encodings import of_classes
from segslam.output.map.clouds import BinaryCloud, LasCloud, PcdCloud, PlyCloud
from segslam.output.map.from_above import BESIDE_M, cut_heights, free_heights
from segslam.output.map.grid import Grid, free_range_m
from segslam.output.map.picture import GeoTiff, Picture, of_numbers
from segslam.output.map.tiles import Part, Tile, Tiles, corner, distance_m
from segslam.output.map.views import moved, nearest_returns

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
SHARES = 0.01, 0.99
"""Share of the voxels, at both ends, that the colour scale ignores as outliers."""


def check_names(files: Sequence[Path], *, origin: "Origin | None" = None, others: Iterable[str] = ()) -> None:
    """Raises SegslamError for a file with an unknown extension, or one that needs a missing package or the origin.

    `others`: known extensions of files that are no maps, for the message.
    """
    for file in files:
        kind = KINDS.get(file.suffix.lower())
        if kind is None:
            raise SegslamError(f"{file}: unknown kind of map; its name must end in {', '.join([*KINDS, *others])}")
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


def write_map(
    placed: Iterable[tuple[Keyframe, Transform]],
    files: Sequence[Path],
    *,
    config: MapConfig,
    origin: "Origin | None" = None,
    begun: Container[int] = (),
    show: Progress = no_progress,
) -> dict[str, int]:
    """Make the map of the keyframes, each with its T_world_keyframe, and write it to files; returns its figures.

    The extension selects the format: .ply, .pcd, .las, .laz: point cloud; .png: top view; .yaml, with a .pgm beside it:
    occupancy grid; .tif: the top view as GeoTIFF. With the `origin` of the world frame (east, north, up) on the globe,
    .las and .laz are in UTM. Files are written atomically. `show` passes the parts on, to show progress. Raises
    SegslamError for another extension, a missing folder, or if no keyframe has a point, OSError if the disk is full.
    """
    check_names(files, origin=origin)
    for file in files:
        check_target(file)
    with temporary_folder(files[0].parent, ".map-") as scratch:
        store = MapStore(scratch, config, origin)
        for keyframe, T_world_keyframe in placed:
            if keyframe.scan_index in begun:
                store.begun.append(len(store.places))
            store.add(keyframe, T_world_keyframe)
        if not len(store.tiles):
            raise SegslamError(f"{files[0]}: no keyframe of known pose has a static point; there is nothing to map")
        parts = show(store.parts(), len(store.tiles), "clean")
        num_points = _write(parts, store, files, scratch=scratch / "files")
    return {
        "num_map_points": num_points,
        "num_map_moving_points": store.num_moving_points,
        "num_map_voxels_seen_through": store.num_voxels_seen_through,
    }


def _write(parts: Iterable[Part], store: "MapStore", files: Sequence[Path], *, scratch: Path) -> int:
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


class MapStore:
    """The keyframes of a map, added one by one, and then its clean parts and what the writers of files need."""

    def __init__(self, scratch: Path, config: MapConfig, origin: "Origin | None") -> None:
        """`scratch`: an empty folder, which the caller removes; `origin` of the world frame on the globe, if known."""
        self.config = config
        self.origin = origin
        self.tiles = Tiles(scratch / "tiles", voxel_m=config.voxel_m)
        self._scratch = scratch
        self._T_keyframe_world: list[Transform] = []
        self.places: list[Vector] = []
        """Position of each keyframe in the world (m)."""
        self.begun: list[int] = []
        """The rows of `places` at which another drive begins."""
        self.free_m: list[Vector] = []
        """Free range of each keyframe, by direction in the world: `grid.free_range_m`."""
        self.has_intensities = True
        self.num_moving_points = 0
        self.num_voxels_seen_through = 0

    def add(self, keyframe: Keyframe, T_world_keyframe: Transform) -> None:
        """Add a keyframe: the near points of static classes as voxels, and all points as a range image.

        Raises SegslamError if the map is coloured by intensity and the keyframe has none.
        """
        if keyframe.intensities is None and self.config.color == "intensity":
            raise SegslamError(
                f"map.color=intensity: keyframe {keyframe.id} has no intensities; runs contain them only if mapped "
                "with `--set map.color=intensity`; or use map.color=class or height"
            )
        self.has_intensities &= keyframe.intensities is not None
        moves = keyframe.labels >= Label.MOVING_CAR
        kept = within_range(keyframe.points, 0.0, self.config.max_range_m) & ~moves
        self.num_moving_points += int(moves.sum())
        intensities = np.zeros(len(kept), np.float32) if keyframe.intensities is None else keyframe.intensities
        points = geometry.apply(T_world_keyframe, keyframe.points[kept].astype(np.float64))
        self.tiles.add(points, keyframe.labels[kept], intensities[kept])
        place = T_world_keyframe[:3, 3]
        self.free_m.append(free_range_m(points - place, keyframe.labels[kept]))
        view = nearest_returns(keyframe.points.astype(np.float32), self.config.voxel_m)
        np.save(self._scratch / f"{len(self.places)}.npy", view)
        self._T_keyframe_world.append(geometry.inverse(T_world_keyframe))
        self.places.append(place)

    @property
    def path_m(self) -> Points:
        """(n, 3) positions of the keyframes in the world, in order (m)."""
        return np.array(self.places)

    @cached_property
    def cut_m(self) -> Vector:
        """(n,) heights above which points near each position hide the picture: `from_above.cut_heights`."""
        near_path = (
            self.tiles.voxels(tile)["point"] + corner(tile)
            for tile in self.tiles
            if any(distance_m(tile, place) < BESIDE_M for place in self.places)
        )
        return cut_heights(self.path_m, free_heights(self.path_m, near_path))

    def parts(self) -> Iterator[Part]:
        """The clean voxels of each tile, in the order that `Part` names."""
        color = self.config.color
        for tile in self.tiles:
            voxels = self.tiles.voxels(tile)
            gone = moved(voxels["point"], voxels["label"], self._views_of(tile), config=self.config)
            self.num_voxels_seen_through += int(gone.sum())
            kept = voxels[~gone]
            world = kept["point"] + corner(tile)
            values = kept["intensity"] if color == "intensity" else world[:, 2]
            paint = of_classes(kept["label"]) if color == "class" else of_numbers(values, span=self.span())
            yield Part(tile, world, kept["label"], kept["intensity"], paint)

    def span(self) -> tuple[float, float]:
        """Values at both ends of the colour scale, heights or intensities."""
        return (self.tiles.intensities if self.config.color == "intensity" else self.tiles.heights).span(*SHARES)

    def _views_of(self, tile: Tile) -> Iterator[tuple[np.ndarray, Transform]]:
        """The range image of each keyframe near a tile, and T_keyframe_tile."""
        T_world_tile = geometry.transform(np.eye(3), corner(tile))
        for number, place in enumerate(self.places):
            if distance_m(tile, place) < self.config.view_range_m:
                yield np.load(self._scratch / f"{number}.npy"), self._T_keyframe_world[number] @ T_world_tile
