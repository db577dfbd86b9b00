"""Poses from floor plans: what stands in two scans, seen from above, laid on one another in every way.

Correlative scan matching (Olson, "Real-Time Correlative Scan Matching", ICRA 2009) over the full circle. Not in the
paper. Where walls are all that two scans share, as in a courtyard, there are no clusters to match, and features seen
from 10 m apart rarely look alike; but the walls still fill the same cells.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from segslam import geometry
from segslam.segregator.solver import Direction
from segslam.types import Points, Registration, Rotation

CELL_M = 0.5
NUM_YAWS = 90
"""Chosen: a turn of half a step moves what is 15 m away by a cell."""
REACH_M = 32.0
"""Chosen: points farther from their sensor are left out."""
MAX_SHIFT_M = 20.0
"""Chosen: farthest that two scans lie apart."""
MAX_COUNT = 8
"""Chosen: points of a cell beyond which it counts no more: a tower is no surer than a house."""
BLUR_CELLS = 0.7
SLICE_M, NUM_SLICES = 0.25, 80
"""Of the heights that are compared, the middle slice being the sensor's."""
MAX_RISE_SLICES = 20
SAME_YAWS, SAME_CELLS = 2, 3
"""Chosen: poses no farther apart in yaw and in either direction are one."""

INFORMATION = np.diag(1.0 / geometry.tangent(rotation_rad=math.pi / NUM_YAWS, translation_m=CELL_M) ** 2)
"""Of a pose that is right to a cell and half a yaw step."""

HALF = int(REACH_M / CELL_M)
SIZE = next_fast_len(2 * HALF + int(MAX_SHIFT_M / CELL_M), real=True)  # wide enough that nothing wraps onto the other


class _Level(NamedTuple):
    """Points in a frame that shares the scan's origin and is level."""

    points: Points
    R_level_scan: Rotation


def plan_hypotheses(
    source: Points, target: Points, source_up: Direction, target_up: Direction, *, num_poses: int
) -> Iterator[Registration]:
    """Rough poses of the source in the target, the best agreement first: right to a cell and half a yaw step.

    Points are those on upright surfaces, thinned evenly, each in its own scan's frame; `up` are the unit directions in
    which those frames have up. Inliers are the points of the source that find a place of the target filled.
    """
    scans = _levelled(source, source_up), _levelled(target, target_up)
    if min(len(scan.points) for scan in scans) == 0:
        return
    volume, steps = _correlation(scans[0].points, scans[1].points)
    for yaw_index, i, j in _peaks(volume, num_poses):
        R_yaw = geometry.yaw(math.tau * yaw_index / NUM_YAWS)
        T_flat = geometry.transform(R_yaw, CELL_M * np.array([steps[i], steps[j], 0.0]))
        rise_m, num_filled = _rise(geometry.apply(T_flat, scans[0].points), scans[1].points)
        shift = T_flat[:3, 3] + [0.0, 0.0, rise_m]
        R_scan_level = scans[1].R_level_scan.T
        yield Registration(
            T_target_source=geometry.transform(R_scan_level @ R_yaw @ scans[0].R_level_scan, R_scan_level @ shift),
            num_correspondences=len(source),
            num_inliers=num_filled,
            rms_m=CELL_M,
            information=INFORMATION,
        )


def _levelled(scan: Points, up: Direction) -> _Level:
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    turn = axis / sine * math.atan2(sine, up[2]) if sine > 1e-9 else np.zeros(3)
    R_level_scan = geometry.exp(geometry.tangent(rotation_rad=turn, translation_m=0.0))[:3, :3]
    points = scan @ R_level_scan.T
    return _Level(points[np.abs(points[:, :2]).max(axis=1, initial=0.0) < REACH_M], R_level_scan)


def _correlation(source: Points, target: Points) -> tuple[Float[np.ndarray, "yaws shifts shifts"], np.ndarray]:
    """Agreement of the plans for each yaw of the source and each shift in x and y, and those shifts in cells."""
    angles = math.tau * np.arange(NUM_YAWS) / NUM_YAWS
    cosines, sines = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y = source[:, 0], source[:, 1]
    turned = rfft2(_plans(cosines * x - sines * y, sines * x + cosines * y))
    blurred = gaussian_filter(_plans(target[None, :, 0], target[None, :, 1])[0], BLUR_CELLS)
    agreement = irfft2(rfft2(blurred) * np.conj(turned), (SIZE, SIZE))
    steps = np.arange(-int(MAX_SHIFT_M / CELL_M), int(MAX_SHIFT_M / CELL_M) + 1)
    return agreement[:, steps[:, None], steps[None, :]], steps


def _plans(x: np.ndarray, y: np.ndarray) -> Float[np.ndarray, "plans size size"]:
    """Points in each cell, up to MAX_COUNT, for each row of coordinates."""
    i, j = np.floor(x / CELL_M).astype(np.int64) + HALF, np.floor(y / CELL_M).astype(np.int64) + HALF
    plan = np.broadcast_to(np.arange(len(x))[:, None], x.shape)
    inside = (i >= 0) & (i < 2 * HALF) & (j >= 0) & (j < 2 * HALF)
    cells = (plan * SIZE + i) * SIZE + j
    counts = np.bincount(cells[inside], minlength=len(x) * SIZE * SIZE)
    return np.minimum(counts, MAX_COUNT).astype(np.float32).reshape(len(x), SIZE, SIZE)


def _peaks(volume: Float[np.ndarray, "yaws shifts shifts"], num_peaks: int) -> Iterator[tuple[int, int, int]]:
    """The highest places of the volume, which is used up: all around one found is taken out."""
    for _ in range(num_peaks):
        yaw_index, i, j = (int(place) for place in np.unravel_index(volume.argmax(), volume.shape))
        yield yaw_index, i, j
        around = (np.arange(yaw_index - SAME_YAWS, yaw_index + SAME_YAWS + 1)) % NUM_YAWS
        volume[around, max(i - SAME_CELLS, 0) : i + SAME_CELLS + 1, max(j - SAME_CELLS, 0) : j + SAME_CELLS + 1] = -1.0


def _rise(source: Points, target: Points) -> tuple[float, int]:
    """How far up (m) most of the source's points come to slices of cells that the target fills, and how many do."""
    filled = np.zeros((SIZE, SIZE, NUM_SLICES), bool)
    filled[*_slots(target)] = True
    i, j, k = _slots(source)
    rises = np.arange(-MAX_RISE_SLICES, MAX_RISE_SLICES + 1)
    moved = np.clip(k[:, None] + rises, 0, NUM_SLICES - 1)
    num_filled = filled[i[:, None], j[:, None], moved].sum(axis=0)
    return SLICE_M * float(rises[num_filled.argmax()]), int(num_filled.max())


def _slots(points: Points) -> tuple[np.ndarray, ...]:
    middle = np.array([HALF, HALF, NUM_SLICES // 2])
    cells = np.floor(points / [CELL_M, CELL_M, SLICE_M]).astype(np.int64) + middle
    within = ((cells >= 0) & (cells < [SIZE, SIZE, NUM_SLICES])).all(axis=1)
    return tuple(cells[within].T)
