"""Top views: what hangs over the path and is cut, and the image, one pixel per map pixel, with path and scale bar."""

import io
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from segslam.core.types import Indices, Points, Vector

DPI = 100
PATH = "#d62728"
SMALL_PX = 1500
"""Chosen: a little more than the width of the report."""
LEGEND_PX, LEAST_PX = 190, 700
"""Chosen: width of the legend, and smallest width of the map."""
NUM_CELLS = 256
"""Chosen: number of cells in x and in y that show without a search that most points are not over the path."""
Window = tuple[float, float, float, float]
"""West, east, south and north end of a top view (m)."""
BESIDE_M = 0.5
"""Chosen: a point within this horizontal distance of a keyframe's position, above it, hangs over it."""
LOWEST_M = 0.5
"""Chosen: what is nearer above the sensor is its mount or its operator."""
NEIGHBOURS = 11
"""Chosen: number of keyframes along the path of which most must be covered."""
SHARE = 0.5
"""Of the way from the sensor up to what hangs over it: where the picture is cut."""


def drawn_map(
    image: np.ndarray, window: Window, *, path_m: Points, title: str, marks: Iterable[tuple[str, str]]
) -> bytes:
    """A PNG of a map in top view: an image (rows, columns, 3), a path, a scale bar, and a legend beside it."""
    height, width = image.shape[:2]
    zoom = max(1.0, LEAST_PX / width)
    large = max(1.0, zoom * width / SMALL_PX)  # text stays readable in a reduced picture
    share = zoom * width / (zoom * width + large * LEGEND_PX)
    figure = Figure(figsize=((zoom * width + large * LEGEND_PX) / DPI, zoom * height / DPI), facecolor="none")
    axes, legend = (figure.add_axes(place) for place in ((0.0, 0.0, share, 1.0), (share, 0.0, 1.0 - share, 1.0)))
    draw_path(axes, path_m, color=PATH, width=1.5 * large)
    scale_bar(axes, window[1] - window[0], color="black", size=11.0 * large)
    axes.set(xlim=window[:2], ylim=window[2:])
    axes.axis("off")
    legend.axis("off")
    handles = [
        Line2D([], [], color=color, marker="s", linestyle="", label=text, markersize=6 * large) for text, color in marks
    ]
    handles.insert(0, Line2D([], [], color=PATH, label="trajectory"))
    size = 10.0 * large
    legend.legend(
        handles=handles,
        title=title,
        loc="upper left",
        frameon=False,
        fontsize=size,
        title_fontsize=size,
        alignment="left",
    )
    return _png_over(image, (round(zoom * width), round(zoom * height)), figure)


def _png_over(image: np.ndarray, size: tuple[int, int], figure: Figure) -> bytes:
    """A PNG of the image, scaled to a size, with the figure over it. `imshow` would take 120 bytes for each pixel."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = Image.fromarray(np.asarray(canvas.buffer_rgba()))
    picture = Image.new("RGB", drawn.size, "white")
    picture.paste(Image.fromarray(image).resize(size, Image.Resampling.NEAREST))
    picture.paste(drawn, mask=drawn)
    return _png_of(picture)


def _png_of(image: Image.Image) -> bytes:
    content = io.BytesIO()
    image.save(content, format="png")
    return content.getvalue()


def scale_bar(axes: Axes, width_m: float, *, color: str, size: float = 11.0) -> None:
    """Draw a bar of a round length, at most a quarter of the shown width, in the lower left corner."""
    length_m = round_length_m(width_m / 4)
    share = length_m / width_m
    left, low = 0.03, 0.035
    axes.plot(
        [left, left + share], [low, low], color=color, linewidth=4, solid_capstyle="butt", transform=axes.transAxes
    )
    text = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:g} km"
    axes.text(left, low + 0.012, text, color=color, fontsize=size, transform=axes.transAxes, va="bottom")


def round_length_m(longest_m: float) -> float:
    """The largest length of 1, 2 or 5 times a power of ten below the limit."""
    power = 10.0 ** math.floor(math.log10(longest_m))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= longest_m * (1 + 1e-9))


def draw_path(axes: Axes, path_m: Points, *, color: str, width: float) -> None:
    """Draw a trajectory, (n, 3) positions in order, and its start."""
    xy = path_m[:, :2]
    axes.plot(*xy.T, color=color, linewidth=width, solid_joinstyle="round")
    axes.plot(*xy[0], "o", color=color, markersize=3 + 2 * width, markeredgecolor="white", markeredgewidth=0.8)


def small_png(file: Path) -> bytes:
    """A PNG file, reduced to `SMALL_PX` along its longer side if it is larger."""
    with Image.open(file) as image:
        if max(image.size) <= SMALL_PX:
            return file.read_bytes()
        small = image.convert("RGB")
        small.thumbnail((SMALL_PX, SMALL_PX))
        return _png_of(small)


def png(figure: Figure, *, dpi: int = DPI) -> bytes:
    """The figure as a PNG; equal data give equal bytes."""
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=dpi, metadata={"Software": None})
    return image.getvalue()


def cut_heights(path_m: Points, free_m: Vector) -> Vector:
    """Height (n,) in the world (m) above which points near each position of the path hide the picture; inf: none do.

    The sensor has passed through free space, and the lowest point above a position ends this space (`free_heights`).
    Where most of the neighbouring positions have such a point, the sensor drove below a ceiling, and points higher than
    half way up to it are cut. Below the open sky, trees and wires hang over few positions: over 1 % of the real KITTI
    00, so that nothing is cut; over 100 % of a roofed courtyard. An avenue whose trees meet above the path (17
    keyframes of NCLT) is cut like a ceiling.
    """
    covered = np.isfinite(free_m)
    inside = uniform_filter1d(covered.astype(float), NEIGHBOURS, mode="nearest") > 0.5
    if not inside.any():
        return np.full(len(path_m), np.inf)
    _, nearest = cKDTree(path_m[covered]).query(path_m)
    return np.where(inside, path_m[:, 2] + SHARE * free_m[covered][nearest], np.inf)


def free_heights(path_m: Points, clouds: Iterable[Points]) -> Vector:
    """Height (n,) above each position of the path of the lowest point that hangs over it (m); inf without one.

    `clouds`: the points (k, 3) of the map in the world, in any pieces.
    """
    tree = cKDTree(path_m[:, :2])
    free_m = np.full(len(path_m), np.inf)
    lowest_m = path_m[:, 2].min()
    is_near = np.zeros((NUM_CELLS, NUM_CELLS), bool)
    for beside_m in np.indices((3, 3, 1)).reshape(3, -1).T - 1.0:
        is_near[_cells(path_m + beside_m)] = True
    for cloud in clouds:
        high = cloud[cloud[:, 2] > lowest_m + LOWEST_M]  # others are over no position
        points = high[is_near[_cells(high)]]  # others are 1 m away or more
        away_m, row = tree.query(points[:, :2], distance_upper_bound=BESIDE_M)
        beside = np.isfinite(away_m)
        above_m = points[beside, 2] - path_m[row[beside], 2]
        over = above_m > LOWEST_M
        np.minimum.at(free_m, row[beside][over], above_m[over])
    return free_m


def _cells(points: Points) -> tuple[Indices, Indices]:
    """The cell of 1 m of each point, in x and in y; cells repeat every `NUM_CELLS`."""
    x, y = np.floor(points[:, :2].T).astype(np.int64) % NUM_CELLS
    return x, y


def visible(points: Points, path_m: Points, cut_m: Vector) -> np.ndarray:
    """(k,) True for points that are not above the cut of the nearest position of the path."""
    if not np.isfinite(cut_m).any():
        return np.ones(len(points), bool)
    _, nearest = cKDTree(path_m[:, :2]).query(points[:, :2])
    return points[:, 2] <= cut_m[nearest]
