"""Keyframes of a map on disk: all keyframes are added, then the clean voxels are read tile by tile."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.config import MapConfig
from segslam.core.points import within_range
from segslam.core.types import Keyframe, Label, Labels, Points, SegslamError, Transform, Vector
from segslam.labels.class_colors import Colors, of_classes
from segslam.output.map.free_ranges import FreeRanges
from segslam.output.map.overhead import BESIDE_M, cut_heights
from segslam.output.map.part import Extent, Part, of_numbers
from segslam.output.map.tiles import Tile, Tiles, corner, distance_m
from segslam.output.map.views import Views, moved


class MapStore:
    """Voxels by tile, and a range image of each keyframe."""

    def __init__(self, scratch: Path, config: MapConfig) -> None:
        """`scratch`: an empty folder, which the caller removes."""
        self._config = config
        self._tiles = Tiles(scratch / "tiles", voxel_m=config.voxel_m)
        self._views = Views(scratch / "views", spread_m=config.voxel_m)
        self._free_ranges = FreeRanges()
        self._T_keyframe_world: list[Transform] = []
        self._places: list[np.ndarray] = []
        self._has_intensities = True
        self.num_moving_points = 0
        self.num_voxels_seen_through = 0

    @property
    def num_keyframes(self) -> int:
        """Number of keyframes added."""
        return len(self._places)

    @property
    def num_tiles(self) -> int:
        """Number of parts that `parts` yields."""
        return len(self._tiles)

    def add(self, keyframe: Keyframe, T_world_keyframe: Transform) -> None:
        """Add a keyframe: the near points of static classes as voxels, and all points as a range image.

        Raises SegslamError if the map is coloured by intensity and the keyframe has none.
        """
        if keyframe.intensities is None and self._config.color == "intensity":
            raise SegslamError(
                f"map.color=intensity: keyframe {keyframe.id} has no intensities; runs contain them only if mapped "
                "with `--set map.color=intensity`; or use map.color=class or height"
            )
        self._has_intensities &= keyframe.intensities is not None
        moves = keyframe.labels >= Label.MOVING_CAR
        kept = within_range(keyframe.points, 0.0, self._config.max_range_m) & ~moves
        self.num_moving_points += int(moves.sum())
        intensities = np.zeros(len(kept), np.float32) if keyframe.intensities is None else keyframe.intensities
        points = geometry.apply(T_world_keyframe, keyframe.points[kept].astype(np.float64))
        self._tiles.add(points, keyframe.labels[kept], intensities[kept])
        self._free_ranges.add(points, keyframe.labels[kept], T_world_keyframe[:3, 3])
        self._views.add(keyframe.points)
        self._T_keyframe_world.append(geometry.inverse(T_world_keyframe))
        self._places.append(T_world_keyframe[:3, 3])

    def extent(self, *, for_picture: bool) -> Extent | None:
        """Extent of the tiles that have voxels; None if there are none. Heights to cut are found for pictures only."""
        tiles = list(self._tiles)
        if not tiles:
            return None
        (west, south), (east, north) = np.min(tiles, axis=0).tolist(), np.max(tiles, axis=0).tolist()
        brightest = self._tiles.brightest if self._has_intensities else None
        path_m = np.array(self._places)
        return Extent(
            west,
            east,
            south,
            north,
            brightest=brightest,
            path_m=path_m,
            span=self._span(),
            free_ranges=self._free_ranges,
            cut_m=cut_heights(path_m, self._near_path()) if for_picture else None,
        )

    def _near_path(self) -> Iterator[Points]:
        """The voxels of each tile through which the path leads, in the world."""
        for tile in self._tiles:
            if any(distance_m(tile, place) < BESIDE_M for place in self._places):
                yield self._tiles.voxels(tile)["point"] + corner(tile)

    def parts(self) -> Iterator[Part]:
        """The clean voxels of each tile, in the order that `MapFile` requires."""
        for tile in self._tiles:
            voxels = self._tiles.voxels(tile)
            gone = moved(voxels["point"], voxels["label"], self._views_of(tile), config=self._config)
            self.num_voxels_seen_through += int(gone.sum())
            kept = voxels[~gone]
            world = kept["point"] + corner(tile)
            paint = self._colors(kept["label"], world[:, 2], kept["intensity"])
            yield Part(tile, world, kept["label"], kept["intensity"], paint)

    def _colors(self, labels: Labels, heights: Vector, intensities: Vector) -> Colors:
        match self._config.color:
            case "class":
                return of_classes(labels)
            case "height":
                return of_numbers(heights, span=self._span())
            case "intensity":
                return of_numbers(intensities, span=self._span())

    def _span(self) -> tuple[float, float]:
        """Values at both ends of the colour scale."""
        return self._tiles.intensity_span() if self._config.color == "intensity" else self._tiles.height_span_m()

    def _views_of(self, tile: Tile) -> Iterator[tuple[np.ndarray, Transform]]:
        """The range image of each keyframe near a tile, and T_keyframe_tile."""
        T_world_tile = geometry.transform(np.eye(3), corner(tile))
        for number, place in enumerate(self._places):
            if distance_m(tile, place) < self._config.view_range_m:
                yield self._views[number], self._T_keyframe_world[number] @ T_world_tile
