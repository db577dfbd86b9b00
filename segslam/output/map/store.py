"""What a map is made from: voxels by tile, and what each keyframe has seen."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from segslam.core import geometry
from segslam.core.config import MapConfig
from segslam.core.points import within_range
from segslam.core.types import Keyframe, Label, Points, SegslamError, Transform, Vector
from segslam.labels.encodings import of_classes
from segslam.output.map.from_above import BESIDE_M, cut_heights
from segslam.output.map.grid import free_range_m
from segslam.output.map.picture import of_numbers
from segslam.output.map.tiles import Part, Tile, Tiles, corner, distance_m
from segslam.output.map.views import Views, moved

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin

SHARES = 0.01, 0.99
"""Share of the voxels, at both ends, that the colour scale ignores as outliers."""


class MapStore:
    """The keyframes of a map, added one by one, and then its clean parts and what the writers of files need."""

    def __init__(self, scratch: Path, config: MapConfig, origin: "Origin | None") -> None:
        """`scratch`: an empty folder, which the caller removes; `origin` of the world frame on the globe, if known."""
        self.config = config
        self.origin = origin
        self.tiles = Tiles(scratch / "tiles", voxel_m=config.voxel_m)
        self._views = Views(scratch / "views", spread_m=config.voxel_m)
        self._T_keyframe_world: list[Transform] = []
        self.places: list[Vector] = []
        """Position of each keyframe in the world (m)."""
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
        self._views.add(keyframe.points)
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
        return cut_heights(self.path_m, near_path)

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
                yield self._views[number], self._T_keyframe_world[number] @ T_world_tile
