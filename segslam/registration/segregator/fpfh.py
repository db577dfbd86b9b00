"""Fast point feature histograms.

Rusu, Blodow, Beetz, "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009, sections II and III.

For two points with normals, the source s is the one whose normal has the smaller angle to the line between them, and
the target t is the other. With the unit vector d from s to t, u = n_s, v = d x u (normalised) and w = u x v, three
angles are defined:

    alpha = v . n_t        phi = u . d        theta = atan2(w . n_t, u . n_t)

The simple histogram (SPFH) of a point counts each angle over its neighbours in 11 bins. Its FPFH is the sum, with equal
weight, of its own SPFH and of the weighted mean of its neighbours' SPFH. The columns (theta, alpha, phi; 33 in all) and
the weight of a neighbour (inverse squared distance) are those of the Point Cloud Library. The library omits the point's
own SPFH.
"""

import math

import numpy as np
from jaxtyping import Float

from segslam.core.kernels import kernel
from segslam.core.points import Neighbours
from segslam.core.types import Indices, Points

BINS = 11
CENTRE = BINS // 2
COLUMNS = 3 * BINS


@kernel("int64(float64)")
def _bin(fraction):
    """The bin of a value at `fraction` of its range."""
    return min(max(int(BINS * fraction), 0), BINS - 1)


@kernel("UniTuple(int64, 3)(float64[:, :], float64[:, :], int64, int64)")
def _pair_columns(points, normals, source, target):
    """The columns of theta, alpha and phi of two points, independent of their order."""
    dx = points[target, 0] - points[source, 0]
    dy = points[target, 1] - points[source, 1]
    dz = points[target, 2] - points[source, 2]
    scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * scale, dy * scale, dz * scale
    phi = normals[source, 0] * dx + normals[source, 1] * dy + normals[source, 2] * dz
    other_phi = normals[target, 0] * dx + normals[target, 1] * dy + normals[target, 2] * dz
    if abs(phi) < abs(other_phi):
        source, target = target, source
        dx, dy, dz, phi = -dx, -dy, -dz, -other_phi
    ux, uy, uz = normals[source, 0], normals[source, 1], normals[source, 2]
    tx, ty, tz = normals[target, 0], normals[target, 1], normals[target, 2]
    vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
    sine = math.sqrt(vx * vx + vy * vy + vz * vz)
    if sine == 0.0:  # the line is parallel to the normal: v is undefined
        return CENTRE, BINS + CENTRE, 2 * BINS + CENTRE
    wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx  # scaled by sine, like v
    alpha = (vx * tx + vy * ty + vz * tz) / sine
    theta = math.atan2(wx * tx + wy * ty + wz * tz, (ux * tx + uy * ty + uz * tz) * sine)
    return _bin(theta / math.tau + 0.5), BINS + _bin(0.5 * alpha + 0.5), 2 * BINS + _bin(0.5 * phi + 0.5)


@kernel("float32[:, :](float64[:, :], float64[:, :], int64[:], int64[:], int32[:], boolean[:])")
def simple_histograms(points, normals, starts, ends, rows, wanted):
    """(n, 33) SPFH of each wanted point; zeros for other points and for points without neighbours.

    Points must be distinct, and the neighbour relation symmetric.
    """
    histograms = np.zeros((len(points), COLUMNS), np.float32)  # half the memory of float64 takes half the time
    for row in range(len(points)):
        for at in range(starts[row], ends[row]):
            other = rows[at]
            if other > row and (wanted[row] or wanted[other]):  # each pair once
                for column in _pair_columns(points, normals, row, other):
                    histograms[row, column] += 1.0
                    histograms[other, column] += 1.0
    for row in range(len(points)):
        scale = np.float32(100.0 * wanted[row] / max(ends[row] - starts[row] - 1, 1))
        for column in range(COLUMNS):
            histograms[row, column] *= scale
    return histograms


@kernel("float64[:, :](float64[:, :], float32[:, :], int64[:], int64[:], int32[:], int64[:])")
def neighbour_histograms(points, histograms, starts, ends, rows, chosen):
    """(k, 33) weighted sum of the neighbours' histograms of each chosen row; zeros for a point without neighbours."""
    sums = np.zeros((len(chosen), COLUMNS))
    for index in range(len(chosen)):
        row = chosen[index]
        for at in range(starts[row], ends[row]):
            if rows[at] != row:
                x = points[rows[at], 0] - points[row, 0]
                y = points[rows[at], 1] - points[row, 1]
                z = points[rows[at], 2] - points[row, 2]
                weight = 1.0 / (x * x + y * y + z * z)
                for column in range(COLUMNS):
                    sums[index, column] += weight * histograms[rows[at], column]
        for angle in range(3):
            total = 0.0
            for column in range(BINS * angle, BINS * (angle + 1)):
                total += sums[index, column]
            for column in range(BINS * angle, BINS * (angle + 1)):
                sums[index, column] *= 100.0 / max(total, 1e-300)
    return sums


def fpfh(points: Points, normals: Points, neighbours: Neighbours, chosen: Indices) -> Float[np.ndarray, "_ 33"]:
    """FPFH (k, 33) of the chosen rows; each third of a row sums to 200, or is zero without neighbours.

    Neighbours are those within a radius. The points must be distinct.
    """
    wanted = np.zeros(len(points), bool)
    for row in chosen:
        wanted[neighbours.rows[neighbours.starts[row] : neighbours.ends[row]]] = True
    simple = simple_histograms(points, normals, *neighbours, wanted)
    return simple[chosen] + neighbour_histograms(points, simple, *neighbours, chosen)
