"""Poses from floor plans: the standing points of two scans, seen from above, correlated over all yaws and shifts.

Correlative scan matching (Olson, "Real-Time Correlative Scan Matching", ICRA 2009) over the full circle. Not in the
paper. If two scans share only walls, as in a courtyard, there are no clusters to match, and features from viewpoints
10 m apart are rarely similar; but the walls still occupy the same cells.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.fft import ifft, irfft, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from segslam import geometry
from segslam.system.kernels import kernel
from segslam.types import Direction, Points, Registration, Rotation, Vector

CELL_M = 0.5
NUM_YAWS = 90
"""Chosen: a rotation by half a step moves a point at 15 m by one cell."""
REACH_M = 32.0
"""Chosen: points farther from their sensor are ignored (m)."""
MAX_SHIFT_M = 20.0
"""Chosen: largest distance between the two scans (m)."""
MAX_COUNT = 8
"""Chosen: largest number of points counted per cell, so that tall objects do not dominate."""
BLUR_CELLS = 0.7
SLICE_M, NUM_SLICES = 0.25, 80
"""Number of height slices compared; the middle slice is at the sensor's height."""
MAX_RISE_SLICES = 20
SAME_YAWS, SAME_CELLS = 2, 3
"""Chosen: poses within these steps of yaw and shift are the same."""

INFORMATION = np.diag(1.0 / geometry.tangent(rotation_rad=math.pi / NUM_YAWS, translation_m=CELL_M) ** 2)
"""Information of a pose with errors of one cell and half a yaw step."""

HALF = int(REACH_M / CELL_M)
SIZE = next_fast_len(2 * HALF + int(MAX_SHIFT_M / CELL_M), real=True)  # wide enough that nothing wraps onto the other


class _Level(NamedTuple):
    """Points in a level frame with the scan's origin."""

    points: Points
    R_level_scan: Rotation


def plan_hypotheses(
    source: Points, target: Points, source_up: Direction, target_up: Direction, *, num_poses: int
) -> Iterator[Registration]:
    """Coarse poses of the source in the target, sorted by agreement; errors up to one cell and half a yaw step.

    Points: evenly downsampled points on upright surfaces, each in its own scan's frame; `up`: upward unit vectors in
    these frames. Inliers are the points of the source that fall into occupied cells of the target.
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
    R_level_scan = geometry.level(up)
    points = scan @ R_level_scan.T
    return _Level(points[np.abs(points[:, :2]).max(axis=1, initial=0.0) < REACH_M], R_level_scan)


def _correlation(source: Points, target: Points) -> tuple[Float[np.ndarray, "yaws shifts shifts"], np.ndarray]:
    """Correlation of the plans for each yaw of the source and each shift in x and y, and the shifts in cells."""
    turned = rfft2(_plans(source, math.tau * np.arange(NUM_YAWS) / NUM_YAWS))
    blurred = gaussian_filter(_plans(target, np.zeros(1))[0], BLUR_CELLS)
    steps = np.arange(-int(MAX_SHIFT_M / CELL_M), int(MAX_SHIFT_M / CELL_M) + 1)
    agreement = ifft(rfft2(blurred) * np.conj(turned), axis=1)[:, steps]
    return irfft(agreement, SIZE, axis=2)[:, :, steps], steps


def _plans(points: Points, yaws_rad: Vector) -> Float[np.ndarray, "plans size size"]:
    """Points in each cell, up to MAX_COUNT, after each rotation."""
    flat = np.ascontiguousarray(points[:, :2], dtype=np.float64)
    return _counts(flat, np.cos(yaws_rad), np.sin(yaws_rad), CELL_M, HALF, SIZE, MAX_COUNT)


@kernel("float32[:, :, ::1](float64[:, ::1], float64[:], float64[:], float64, int64, int64, int64)")
def _counts(points, cosines, sines, cell_m, half, size, most):
    counts = np.zeros((len(cosines), size, size), np.float32)
    for k in range(len(cosines)):
        for x, y in points:
            i = math.floor((cosines[k] * x - sines[k] * y) / cell_m) + half
            j = math.floor((sines[k] * x + cosines[k] * y) / cell_m) + half
            if 0 <= i < 2 * half and 0 <= j < 2 * half and counts[k, i, j] < most:
                counts[k, i, j] += 1.0
    return counts


def _peaks(volume: Float[np.ndarray, "yaws shifts shifts"], num_peaks: int) -> Iterator[tuple[int, int, int]]:
    """The maxima of the volume, in descending order; it is changed: the surroundings of each maximum are cleared."""
    for _ in range(num_peaks):
        yaw_index, i, j = (int(place) for place in np.unravel_index(volume.argmax(), volume.shape))
        yield yaw_index, i, j
        around = (np.arange(yaw_index - SAME_YAWS, yaw_index + SAME_YAWS + 1)) % NUM_YAWS
        volume[around, max(i - SAME_CELLS, 0) : i + SAME_CELLS + 1, max(j - SAME_CELLS, 0) : j + SAME_CELLS + 1] = -1.0


def _rise(source: Points, target: Points) -> tuple[float, int]:
    """Height offset (m) at which most source points fall into occupied cells of the target, and their number."""
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
