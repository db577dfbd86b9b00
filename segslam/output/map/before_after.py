"""The map from odometry alone beside the corrected map, with a detail of the place where loop closing changed most.

Each pixel counts the points in it, in top view: walls are sharp lines in an accurate map and blurred in another.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from segslam.core import geometry
from segslam.core.errors import noun
from segslam.core.points import within_range
from segslam.core.processes import in_parts
from segslam.core.types import (
    GROUND_LABELS,
    REJECTED_WEIGHT,
    CloudOf,
    GraphEstimate,
    Indices,
    Label,
    Labels,
    Points,
    Transform,
    Vector,
)
from segslam.output.map.from_above import Window, cut_heights, draw_path, free_heights, png, scale_bar, visible

MOST_PIXELS = 900
"""Chosen: largest number of pixels along the longer side of a panel."""
FINEST_M = 0.1
"""Chosen: smallest size of a pixel, about the error of a keyframe's pose."""
REACH_M = 40.0
"""Chosen: points farther from their keyframe are not drawn; they are sparse and blur both maps."""
DETAIL_M = 30.0
"""Chosen: smallest half width of the detail."""
BEFORE, AFTER, BACKGROUND = "#E69F00", "#56B4E9", "#10141a"


class BeforeAfter:
    """The figure of some keyframes, of which several processes read the clouds."""

    def __init__(
        self,
        T_odom_keyframe: Mapping[int, Transform],
        estimate: GraphEstimate,
        keyframe_ids: Sequence[int],
        cloud_of: CloudOf,
    ) -> None:
        """Poses of all keyframes by odometry, and the last estimate; the keyframes to draw."""
        first = min(T_odom_keyframe)
        T_world_odom = estimate.T_world_keyframe[first] @ geometry.inverse(T_odom_keyframe[first])
        poses = {keyframe_id: T_world_odom @ T for keyframe_id, T in T_odom_keyframe.items()}
        self._maps = (poses, estimate.T_world_keyframe)
        self._cloud_of = cloud_of
        self._path_m = np.array([T[:3, 3] for _, T in sorted(estimate.T_world_keyframe.items())])
        self._cut_m = np.full(len(self._path_m), np.inf)
        places = np.array([T[:2, 3] for poses in self._maps for T in poses.values()])
        corners = np.array([places.min(axis=0) - REACH_M / 2, places.max(axis=0) + REACH_M / 2])
        (west, south), (east, north) = corners.tolist()
        self._panels = [_Density((west, east, south, north)) for _ in self._maps]
        self._loops = [pair for pair, weight in estimate.closure_weights.items() if weight >= REJECTED_WEIGHT]
        detail = most_changed(*self._maps, self._loops)
        if detail is not None:
            self._panels += [_Density(window) for window in _details(self._maps, detail)]
        cut_m = cut_heights(self._path_m, self._count(keyframe_ids))
        if np.isfinite(cut_m).any():
            self._cut_m = cut_m
            self._count(keyframe_ids)

    def _count(self, keyframe_ids: Sequence[int]) -> Vector:
        """Count the points of these keyframes in all panels; returns `free_heights` by them."""
        free_m, counts = zip(*in_parts(keyframe_ids, self._counted), strict=True)
        for panel, of_parts in zip(self._panels, zip(*counts, strict=True), strict=True):
            panel.counts = np.sum(of_parts, axis=0, dtype=np.uint32)
        return np.min(free_m, axis=0)

    def _counted(self, keyframe_ids: Sequence[int]) -> Iterator[tuple[Vector, list[np.ndarray]]]:
        """One pair: `free_heights` by these keyframes, and the number of their points in the pixels of each panel."""
        free_m = np.full(len(self._path_m), np.inf)
        counts = [np.zeros_like(panel.counts) for panel in self._panels]
        for number in keyframe_ids:
            points, labels = self.below_ceiling(number)
            free_m = np.minimum(free_m, free_heights(self._path_m, [self._placed(number, points)]))
            stands = ~np.isin(labels, np.array(GROUND_LABELS, np.uint8)) & (labels < Label.MOVING_CAR)
            stands &= within_range(points, 0.0, REACH_M)
            placed = [geometry.apply(poses[number], points[stands].astype(np.float64)) for poses in self._maps]
            for panel, counted, in_map in zip(self._panels, counts, cycle(placed), strict=False):
                np.add.at(counted.reshape(-1), panel.pixels(in_map), np.uint32(1))
        yield free_m, counts

    def below_ceiling(self, keyframe_id: int) -> tuple[Points, Labels]:
        """Points and labels of a keyframe without those that hide the others in top view."""
        points, labels = self._cloud_of(keyframe_id)
        if np.isinf(self._cut_m).all():
            return points, labels
        seen = visible(self._placed(keyframe_id, points), self._path_m, self._cut_m)
        return points[seen], labels[seen]

    def _placed(self, keyframe_id: int, points: Points) -> Points:
        return geometry.apply(self._maps[1][keyframe_id], points.astype(np.float64))

    def draw(self) -> bytes:
        """The figure as a PNG: the whole maps above, the detail of the largest change below, if there are closures."""
        rows = [self._panels[first : first + 2] for first in range(0, len(self._panels), 2)]
        heights = [panels[0].height_per_width for panels in rows]
        layout = ConstrainedLayoutEngine(w_pad=0.04, h_pad=0.04, wspace=0.0, hspace=0.0)
        figure = Figure(figsize=(12.0, 6.0 * sum(heights) + 0.5), facecolor=BACKGROUND, layout=layout)
        grid = figure.subplots(len(heights), 2, squeeze=False, height_ratios=heights)
        num = len(self._loops)
        corrected = f"corrected by {num} {noun(num, 'loop')}" if num else "adjusted as a whole; no loop was found"
        titles = ("before: odometry only", f"after: {corrected}")
        for row, panels in zip(grid, rows, strict=True):
            brightest = max(panel.brightest() for panel in panels)
            for axes, panel, poses, color in zip(row, panels, self._maps, (BEFORE, AFTER), strict=True):
                panel.draw(axes, brightest, np.array([T[:3, 3] for T in poses.values()]), color)
        for axes, title in zip(grid[0], titles, strict=True):
            axes.set_title(title, color="white", fontsize=15)
        return png(figure)


class _Density:
    """Number of points in each pixel of a window."""

    def __init__(self, window: Window) -> None:
        west, east, south, north = self._window = window
        width_m, height_m = east - west, north - south
        self._pixel_m = max(FINEST_M, max(width_m, height_m) / MOST_PIXELS)
        self.counts = np.zeros((int(height_m / self._pixel_m) + 1, int(width_m / self._pixel_m) + 1), np.uint32)
        self.height_per_width = height_m / width_m

    def pixels(self, points: Points) -> Indices:
        """(k,) indices in the flat counts: the pixels of those points (n, 3) of the world that are in the window."""
        west, _, south, _ = self._window
        column, row = (
            _whole_steps(values - first, self._pixel_m) for values, first in zip(points.T, (west, south), strict=False)
        )
        rows, columns = self.counts.shape
        seen = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return row[seen] * columns + column[seen]

    def brightest(self) -> float:
        """A count that few pixels exceed."""
        counted = self.counts[self.counts > 0]
        return float(np.percentile(counted, 99)) if len(counted) else 1.0

    def draw(self, axes: Axes, brightest: float, path_m: Points, color: str) -> None:
        """Draw the logarithm of the counts, a path in a colour, and a scale bar; no ticks."""
        west, east, south, north = self._window
        image = np.log1p(self.counts) / np.log1p(brightest)
        axes.imshow(
            image, origin="lower", extent=self._window, cmap="bone", vmin=0.0, vmax=1.0, interpolation="antialiased"
        )
        draw_path(axes, path_m, color=color, width=1.4)
        axes.set(xlim=(west, east), ylim=(south, north), xticks=[], yticks=[], facecolor=BACKGROUND)
        scale_bar(axes, east - west, color="white")


def _whole_steps(values: Vector, step: float) -> Indices:
    """`values // step` in half the time: a quotient is wrong only where it was rounded up to a whole number."""
    quotients = values / step
    steps = np.floor(quotients)
    rounded = steps == quotients
    steps[rounded] = values[rounded] // step
    return steps.astype(np.int64)


def most_changed(
    before: Mapping[int, Transform], after: Mapping[int, Transform], loops: Iterable[tuple[int, int]]
) -> tuple[int, int] | None:
    """The loop (source, target) whose relative pose changed most; None without loops."""

    def moved_m(loop: tuple[int, int]) -> float:
        T_before, T_after = (geometry.inverse(poses[loop[1]]) @ poses[loop[0]] for poses in (before, after))
        return geometry.distance(geometry.inverse(T_after) @ T_before)

    return max(loops, key=moved_m, default=None)


def _details(maps: Iterable[Mapping[int, Transform]], loop: tuple[int, int]) -> list[Window]:
    """A window of each map around both ends of a loop; all have one size, so that the panels have one scale."""
    ends = np.array([[poses[keyframe_id][:2, 3] for keyframe_id in loop] for poses in maps])
    apart_m = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max())
    half_m = DETAIL_M + min(apart_m, DETAIL_M)
    return [(x - half_m, x + half_m, y - half_m / 1.6, y + half_m / 1.6) for x, y in ends.mean(axis=1)]
