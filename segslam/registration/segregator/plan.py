"""Poses from floor plans: the standing points of two scans, seen from above, correlated over all yaws and shifts.

Correlative scan matching (Olson, "Real-Time Correlative Scan Matching", ICRA 2009) over the full circle. Not in the
paper. If two scans share only walls, as in a courtyard, there are no clusters to match, and features from viewpoints
10 m apart are rarely similar; but the walls still occupy the same cells. Scans 30 m apart, which share little, are
aligned by the walls and poles of the part that both see.
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

CELL_M = 0.8
"""Chosen with the next three, on submaps of NCLT, the courtyard, HKU 1 and dense scans of KITTI 00."""
NUM_YAWS = 60
"""Chosen: a rotation by half a step moves a point at 15 m by one cell. Even: half of them follow from the others."""
REACH_M = 50.0
"""Points farther from their sensor are ignored (m)."""
MAX_SHIFT_M = 40.0
"""Largest distance between the two scans (m)."""
MAX_COUNT = 20
"""Chosen: largest number of points counted per cell, so that tall objects do not dominate."""
BLUR_CELLS = 0.7
SLICE_M, NUM_SLICES = 0.25, 80
"""Number of height slices compared; the middle slice is at the sensor's height."""
MAX_RISE_SLICES = 20
SAME_YAWS, SAME_CELLS = 2, 2
"""Chosen: poses within these steps of yaw and shift are the same."""

INFORMATION = np.diag(1.0 / geometry.tangent(rotation_rad=math.pi / NUM_YAWS, translation_m=CELL_M) ** 2)
"""Information of a pose with errors of one cell and half a yaw step."""

HALF = int(REACH_M / CELL_M)
SIZE = next_fast_len(2 * HALF + int(MAX_SHIFT_M / CELL_M), real=True)  # wide enough that nothing wraps onto the other
_PHASE = np.exp(-1j * math.tau * (2 * HALF - 1) / SIZE * np.arange(SIZE))
HALF_TURN = np.outer(_PHASE, _PHASE[: SIZE // 2 + 1]).astype(np.complex64)
"""Spectrum of a plan turned by 180 degrees, relative to the conjugate one: cell i becomes cell 2 HALF - 1 - i."""


class FloorPlan:
    """Points of a scan on upright surfaces, levelled, and their spectra at all yaws, which are computed once."""

    def __init__(self, points: Points, normals: Points, up: Direction) -> None:
        """`points`: evenly downsampled, with unit normals, in the scan's frame; `up`: upward unit vector there."""
        self.R_level_scan = geometry.level(up)
        level = points @ self.R_level_scan.T
        self.num_points = len(points)
        is_near = np.abs(level[:, :2]).max(axis=1, initial=0.0) < REACH_M
        self.points = level[is_near]
        """The points within reach in a level frame with the scan's origin."""
        east, north, _ = (normals[is_near] @ self.R_level_scan.T).T
        self._doubled_rad = 2.0 * np.arctan2(north, east)

    def at(self, yaws_rad: Vector) -> Float[np.ndarray, "3 yaws size size"]:
        """In each cell the number of points, up to MAX_COUNT, and the sums of the cosines and sines of twice the angle
        of their normals, after each rotation."""
        points = np.ascontiguousarray(self.points[:, :2], dtype=np.float64)
        return _summed(points, np.cos(self._doubled_rad), np.sin(self._doubled_rad), np.cos(yaws_rad), np.sin(yaws_rad))

    @cached_property
    def turned(self) -> Complex[np.ndarray, "3 yaws size half"]:
        """Spectra of the plan at each yaw of the first half turn."""
        return np.conj(rfft2(self.at(math.tau * np.arange(NUM_YAWS // 2) / NUM_YAWS)))


def plan_hypotheses(source: FloorPlan, target: FloorPlan, *, num_poses: int) -> Iterator[Registration]:
    """Coarse poses of the source in the target, sorted by agreement; errors up to one cell and half a yaw step.

    Points in the same cell agree by twice the squared cosine between their normals, 1 + cos(2 a). At each shift, the
    agreement by chance, which is the mean over all yaws, is subtracted: small shifts have more of it than large ones.
    Inliers are the points of the source that fall into occupied cells of the target.
    """
    if min(len(source.points), len(target.points)) == 0:
        return
    blurred = gaussian_filter(target.at(np.zeros(1)), (0.0, 0.0, BLUR_CELLS, BLUR_CELLS))
    steps = np.arange(-int(MAX_SHIFT_M / CELL_M), int(MAX_SHIFT_M / CELL_M) + 1)
    spectra = rfft2(blurred)
    halves = (spectra, source.turned), (spectra * np.conj(HALF_TURN), np.conj(source.turned))
    spectrum = np.concatenate([np.einsum("cyij,cyij->yij", *half) for half in halves])
    agreement = ifft(spectrum, axis=1, overwrite_x=True)[:, steps]
    volume = np.ascontiguousarray(irfft(agreement, SIZE, axis=2)[:, :, steps])  # for each yaw and shift in x and y
    volume -= volume.mean(axis=0)
    filled = np.zeros((SIZE, SIZE, NUM_SLICES), bool)
    filled[*_slots(target.points)] = True
    for yaw_index, i, j in _peaks(volume, num_poses):
        R_yaw = geometry.yaw(math.tau * yaw_index / NUM_YAWS)
        T_flat = geometry.transform(R_yaw, CELL_M * np.array([steps[i], steps[j], 0.0]))
        num_filled = _num_filled(filled, *_slots(geometry.apply(T_flat, source.points)))
        shift = T_flat[:3, 3] + [0.0, 0.0, SLICE_M * (int(num_filled.argmax()) - MAX_RISE_SLICES)]
        R_scan_level = target.R_level_scan.T
        yield Registration(
            T_target_source=geometry.transform(R_scan_level @ R_yaw @ source.R_level_scan, R_scan_level @ shift),
            num_correspondences=source.num_points,
            num_inliers=int(num_filled.max()),
            rms_m=CELL_M,
            information=INFORMATION,
        )


@kernel("float32[:, :, :, ::1](float64[:, ::1], float64[:], float64[:], float64[:], float64[:])")
def _summed(points, cosines2, sines2, cosines, sines):
    summed = np.zeros((3, len(cosines), SIZE, SIZE), np.float32)
    for k in range(len(cosines)):
        c, s = cosines[k], sines[k]
        c2, s2 = c * c - s * s, 2.0 * c * s
        for p in range(len(points)):
            x, y = points[p, 0], points[p, 1]
            i = math.floor((c * x - s * y) / CELL_M) + HALF
            j = math.floor((s * x + c * y) / CELL_M) + HALF
            if 0 <= i < 2 * HALF and 0 <= j < 2 * HALF and summed[0, k, i, j] < MAX_COUNT:
                summed[0, k, i, j] += 1.0
                summed[1, k, i, j] += c2 * cosines2[p] - s2 * sines2[p]
                summed[2, k, i, j] += s2 * cosines2[p] + c2 * sines2[p]
    return summed


@kernel("int64[::1](boolean[:, :, ::1], int64[:], int64[:], int64[:])")
def _num_filled(filled, rows, columns, slices):
    """Number of slots that are filled after each rise."""
    num = np.zeros(2 * MAX_RISE_SLICES + 1, np.int64)
    for k in range(len(rows)):
        for rise in range(len(num)):
            risen = min(max(slices[k] + rise - MAX_RISE_SLICES, 0), NUM_SLICES - 1)
            num[rise] += filled[rows[k], columns[k], risen]
    return num


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
        near_i, near_j = (slice(max(place - SAME_CELLS, 0), place + SAME_CELLS + 1) for place in (i, j))
        volume[around, near_i, near_j] = -math.inf
        places[around] = flat[around].argmax(axis=1)
        largest[around] = flat[around, places[around]]


def _slots(points: Points) -> tuple[np.ndarray, ...]:
    middle = np.array([HALF, HALF, NUM_SLICES // 2])
    cells = np.floor(points / [CELL_M, CELL_M, SLICE_M]).astype(np.int64) + middle
    within = ((cells >= 0) & (cells < [SIZE, SIZE, NUM_SLICES])).all(axis=1)
    return tuple(cells[within].T)
