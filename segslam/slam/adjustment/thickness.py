"""Thickness of the surfaces of a map: a figure of its sharpness that needs no ground truth.

Flat patches that two scans of different places, or of different passes, both observe are thin if the poses of the scans
are right. The patch and its normal come from one scan alone, so that a bad pose cannot change which patches count.
"""

from collections.abc import Callable, Sequence

import numpy as np

from segslam.core import geometry
from segslam.core.points import cell_keys, group_moments, within_range
from segslam.core.probabilities import SIGNIFICANT
from segslam.core.processes import in_parts
from segslam.core.trajectory import Poses
from segslam.core.types import IndexPairs, Points, Transform, Vector
from segslam.slam.adjustment.alignment import MOST_PAIRS

CELL_M = 1.0
"""Chosen: edge of the cells that hold a patch; walls and roads are flat over it."""
WITHIN_M = 30.0
"""Chosen: points farther from their sensor are too sparse for a cell."""
MIN_POINTS = 5
"""Chosen: points of each scan in a patch."""
FLAT = 0.05
"""Chosen: a patch is flat if its standard deviation along the normal is below this share of the next larger one."""
MIN_PATCHES = 20
"""Chosen: the median of fewer is too uncertain."""


def map_thickness_m(points_of: Callable[[int], Points], T_world: Poses, pairs: IndexPairs) -> list[Vector]:
    """Standard deviation of points about the plane of each patch that both scans of a pair observe, by pair (m).

    `pairs` (k, 2): keyframes that see the same surfaces, of which at most `MOST_PAIRS` are used.
    """
    chosen = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).astype(int))]
    return list(
        in_parts(
            chosen.tolist(),
            lambda part: [
                patch_thickness_m(points_of(a), points_of(b), geometry.inverse(T_world[a]) @ T_world[b])
                for a, b in part
            ],
        )
    )


def median_m(thickness_m: Sequence[Vector]) -> float | None:
    """The median over all patches; None if there are too few."""
    patches = np.concatenate([np.empty(0), *thickness_m])
    return float(np.median(patches)) if len(patches) >= MIN_PATCHES else None


def is_thicker(before_m: Sequence[Vector], after_m: Sequence[Vector]) -> bool:
    """True if the same pairs of scans show significantly thicker surfaces afterwards (signed ranks of Wilcoxon)."""
    from scipy.stats import wilcoxon  # takes a third of a second; logs are read without it

    medians = [
        (np.median(before), np.median(after))
        for before, after in zip(before_m, after_m, strict=True)
        if len(before) and len(after)
    ]
    if len(medians) == 0:
        return False
    change = np.subtract(*np.transpose(medians)[::-1])
    return bool(change.any() and wilcoxon(change, alternative="greater").pvalue < SIGNIFICANT)


def patch_thickness_m(points_a: Points, points_b: Points, T_a_b: Transform) -> Vector:
    """(k,) root mean square distance of the points of two scans to the plane of each flat patch that both observe (m).

    The normal of the plane is that of the points of scan a, its position the mean of all points.
    """
    a = points_a[within_range(points_a, 0.0, WITHIN_M)].astype(np.float64)
    b = geometry.apply(T_a_b, points_b[within_range(points_b, 0.0, WITHIN_M)].astype(np.float64))
    keys, _ = cell_keys(np.vstack([a, b]), CELL_M)
    _, cell = np.unique(keys, return_inverse=True)
    in_a, in_b = cell[: len(a)], cell[len(a) :]
    num = int(cell.max(initial=-1)) + 1
    counts = np.column_stack([np.bincount(in_a, minlength=num), np.bincount(in_b, minlength=num)])
    means, covariances = group_moments(a, in_a, num)
    shared = np.flatnonzero((counts >= MIN_POINTS).all(axis=1))
    variances, directions = np.linalg.eigh(covariances[shared])
    flat = variances[:, 0] < FLAT**2 * variances[:, 1]
    normals = np.zeros((num, 3))
    normals[shared[flat]] = directions[flat, :, 0]
    heights = np.concatenate([np.einsum("ij,ij->i", p - means[c], normals[c]) for p, c in ((a, in_a), (b, in_b))])
    first, second = (np.bincount(cell, heights**power, num)[shared[flat]] for power in (1, 2))
    total = counts.sum(axis=1)[shared[flat]]
    return np.sqrt(np.maximum(second / total - (first / total) ** 2, 0.0))
