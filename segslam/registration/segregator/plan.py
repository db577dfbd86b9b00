"""Poses from floor plans: the standing points of two scans, seen from above, correlated over all yaws and shifts.

Correlative scan matching (Olson, "Real-Time Correlative Scan Matching", ICRA 2009) over the full circle. Not in the
paper. If two scans share only walls, as in a courtyard, there are no clusters to match, and features from viewpoints
10 m apart are rarely similar; but the walls still occupy the same cells.
"""

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Complex, Float
from scipy.fft import ifft, irfft, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from segslam.core import geometry
from segslam.core.kernels import kernel
from segslam.core.types import Direction, Points, Registration, Vector

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


class FloorPlan:
    """Points of a scan on upright surfaces, levelled, and their spectra at all yaws, which are computed once."""

    def __init__(self, points: Points, up: Direction) -> None:
        """`points`: evenly downsampled, in the scan's frame; `up`: upward unit vector in this frame."""
        self.R_level_scan = geometry.level(up)
        level = points @ self.R_level_scan.T
        self.num_points = len(points)
        self.points = level[np.abs(level[:, :2]).max(axis=1, initial=0.0) < REACH_M]
        """The points within reach in a level frame with the scan's origin."""

    @cached_property
    def turned(self) -> Complex[np.ndarray, "yaws size half"]:
        """Spectrum of the plan at each yaw."""
        return np.conj(rfft2(_plans(self.points, math.tau * np.arange(NUM_YAWS) / NUM_YAWS)))


def plan_hypotheses(source: FloorPlan, target: FloorPlan, *, num_poses: int) -> Iterator[Registration]:
    """Coarse poses of the source in the target, sorted by agreement; errors up to one cell and half a yaw step.

    Inliers are the points of the source that fall into occupied cells of the target.
    """
    if min(len(source.points), len(target.points)) == 0:
        return
    blurred = gaussian_filter(_plans(target.points, np.zeros(1))[0], BLUR_CELLS)
    steps = np.arange(-int(MAX_SHIFT_M / CELL_M), int(MAX_SHIFT_M / CELL_M) + 1)
    agreement = ifft(rfft2(blurred) * source.turned, axis=1, overwrite_x=True)[:, steps]
    volume = np.ascontiguousarray(irfft(agreement, SIZE, axis=2)[:, :, steps])  # for each yaw and shift in x and y
    filled = np.zeros((SIZE, SIZE, NUM_SLICES), bool)
    filled[*_slots(target.points)] = True
    rises = np.arange(-MAX_RISE_SLICES, MAX_RISE_SLICES + 1)
    for yaw_index, i, j in _peaks(volume, num_poses):
        R_yaw = geometry.yaw(math.tau * yaw_index / NUM_YAWS)
        T_flat = geometry.transform(R_yaw, CELL_M * np.array([steps[i], steps[j], 0.0]))
        rows, columns, slices = _slots(geometry.apply(T_flat, source.points))
        num_filled = filled[rows, columns, np.clip(slices + rises[:, None], 0, NUM_SLICES - 1)].sum(axis=1)
        shift = T_flat[:3, 3] + [0.0, 0.0, SLICE_M * float(rises[num_filled.argmax()])]
        R_scan_level = target.R_level_scan.T
        yield Registration(
            T_target_source=geometry.transform(R_scan_level @ R_yaw @ source.R_level_scan, R_scan_level @ shift),
            num_correspondences=source.num_points,
            num_inliers=int(num_filled.max()),
            rms_m=CELL_M,
            information=INFORMATION,
        )


def _plans(points: Points, yaws_rad: Vector) -> Float[np.ndarray, "plans size size"]:
    """Points in each cell, up to MAX_COUNT, after each rotation."""
    return _counts(np.ascontiguousarray(points[:, :2], dtype=np.float64), np.cos(yaws_rad), np.sin(yaws_rad))


@kernel("float32[:, :, ::1](float64[:, ::1], float64[:], float64[:])")
def _counts(points, cosines, sines):
    counts = np.zeros((len(cosines), SIZE, SIZE), np.float32)
    for k in range(len(cosines)):
        for x, y in points:
            i = math.floor((cosines[k] * x - sines[k] * y) / CELL_M) + HALF
            j = math.floor((sines[k] * x + cosines[k] * y) / CELL_M) + HALF
            if 0 <= i < 2 * HALF and 0 <= j < 2 * HALF and counts[k, i, j] < MAX_COUNT:
                counts[k, i, j] += 1.0
    return counts


def _peaks(volume: Float[np.ndarray, "yaws shifts shifts"], num_peaks: int) -> Iterator[tuple[int, int, int]]:
    """The maxima of the volume, in descending order; it is changed: the surroundings of each maximum are cleared."""
    flat = volume.reshape(NUM_YAWS, -1)
    places = flat.argmax(axis=1)
    largest = flat.max(axis=1)
    for _ in range(num_peaks):
        yaw_index = int(largest.argmax())
        i, j = (int(place) for place in np.unravel_index(places[yaw_index], volume.shape[1:]))
        yield yaw_index, i, j
        around = (np.arange(yaw_index - SAME_YAWS, yaw_index + SAME_YAWS + 1)) % NUM_YAWS
        volume[around, max(i - SAME_CELLS, 0) : i + SAME_CELLS + 1, max(j - SAME_CELLS, 0) : j + SAME_CELLS + 1] = -1.0
        places[around] = flat[around].argmax(axis=1)
        largest[around] = flat[around, places[around]]


def _slots(points: Points) -> tuple[np.ndarray, ...]:
    middle = np.array([HALF, HALF, NUM_SLICES // 2])
    cells = np.floor(points / [CELL_M, CELL_M, SLICE_M]).astype(np.int64) + middle
    within = ((cells >= 0) & (cells < [SIZE, SIZE, NUM_SLICES])).all(axis=1)
    return tuple(cells[within].T)
