"""Plain twins of DCVC with the authors' settings: by all pairs of points, and as their program goes about it."""

import itertools

import networkx as nx
import numpy as np

START_M, STEP_M = 0.35, 0.0004


def curved_bins(points: np.ndarray) -> np.ndarray:
    """(n, 3) radial, pitch and azimuth bin of each point, by the formulas of T-LOAM; azimuth 0 and 300 are one bin."""
    points = points.astype(float)
    distance = np.linalg.norm(points, axis=1)
    pitch = np.degrees(np.arcsin(points[:, 2] / distance))
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360.0
    bounds = min(5.0, distance.min()) + np.cumsum(START_M - STEP_M * np.arange(1, 600))
    radial = [np.flatnonzero(d < bounds)[0] for d in distance]
    return np.column_stack([radial, np.round((pitch - min(0.0, pitch.min())) / 1.2), np.round(azimuth / 1.2)]).astype(
        int
    )


def touching(a: np.ndarray, b: np.ndarray) -> bool:
    turn = abs(a[2] - b[2])
    return bool(max(abs(a[0] - b[0]), abs(a[1] - b[1]), min(turn, 300 - turn)) <= 1)


def plain_dcvc(points: np.ndarray) -> set[frozenset[int]]:
    """Connected components of the graph of all pairs of points whose voxels touch."""
    bins = curved_bins(points)
    graph = nx.Graph()
    graph.add_nodes_from(range(len(points)))
    pairs = itertools.combinations(range(len(points)), 2)
    graph.add_edges_from((i, j) for i, j in pairs if touching(bins[i], bins[j]))
    return {frozenset(component) for component in nx.connected_components(graph)}


def authors_dcvc(points: np.ndarray) -> np.ndarray:
    """The cluster of each point as the authors' program finds it, in one pass over the points in their order.

    A point that already has a cluster is passed over, so it never joins two clusters that meet around it. Azimuth
    does not wrap, and voxels above the last full row of pitch are no one's neighbours.
    """
    bins = curved_bins(points)
    members: dict[tuple[int, ...], list[int]] = {}
    for row, voxel in enumerate(bins):
        members.setdefault(tuple(voxel[[1, 0, 2]]), []).append(row)
    pitch = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points.astype(float), axis=1)))
    top = int((max(0.0, pitch.max()) - min(0.0, pitch.min())) / 1.2)
    cluster = np.full(len(points), -1)
    for row, (radial, level, azimuth) in enumerate(bins):
        if cluster[row] >= 0:
            continue
        around = itertools.product(
            range(max(level - 1, 0), min(level + 1, top) + 1), (radial - 1, radial, radial + 1), range(-1, 2)
        )
        nearby = [other for z, y, x in around for other in members.get((z, y, azimuth + x), [])]
        for other in nearby:
            if cluster[row] >= 0 and cluster[other] >= 0:
                cluster[cluster == cluster[row]] = cluster[other]
            else:
                cluster[row] = cluster[other] = max(cluster[row], cluster[other])
        if cluster[row] < 0:
            cluster[[row, *nearby]] = cluster.max() + 1
    return cluster
