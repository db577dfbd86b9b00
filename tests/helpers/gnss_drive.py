"""Position fixes of the generated run of `finished_run`, and its graph."""

from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Points, Transform
from segslam.gnss import Origin, geodetic_from_enu
from segslam.graph import Edge
from segslam.graph.g2o import G2oGraph, write_g2o
from segslam.output.finished import read_run
from segslam.output.folder import ADJUSTED_GRAPH

ORIGIN = Origin(48.98, 8.39, 115.0)
T_ENU_MAP = geometry.transform(geometry.yaw(0.7), [12.0, -7.0, 3.0])
SIGMA_M = np.array([0.02, 0.02, 0.02, 0.03, 0.03, 0.03])
"""Standard deviations of the motions from keyframe to keyframe: radians, then metres."""


def motions(T_map_keyframe: Poses) -> list[Edge]:
    """A chain of keyframes."""
    information = np.diag((0.1 * SIGMA_M) ** -2.0)
    return [
        Edge(row, row + 1, geometry.inverse(T_map_keyframe[row]) @ T_map_keyframe[row + 1], information)
        for row in range(len(T_map_keyframe) - 1)
    ]


def write_graph(folder: Path) -> None:
    """The graph of a generated run."""
    result = read_run(folder).result
    T_map_keyframe = result.trajectory.T_world_lidar[result.keyframe_rows]
    write_g2o(folder / ADJUSTED_GRAPH, G2oGraph(dict(enumerate(T_map_keyframe)), motions(T_map_keyframe)))


def write_fixes(
    file: Path, stamp_ns: np.ndarray, T_map_lidar: Poses, *, sigma_m: float = 0.05, T_enu_map: Transform = T_ENU_MAP
) -> Points:
    """A CSV file with a fix a scan, at the LiDAR; returns the true positions in the local frame of `ORIGIN`."""
    rng = np.random.default_rng(4)
    enu_m = geometry.apply(T_enu_map, T_map_lidar[:, :3, 3])
    places = geodetic_from_enu(enu_m + sigma_m * rng.standard_normal(enu_m.shape), ORIGIN)
    rows = [
        f"{1e-9 * int(stamp):.6f},{a:.10f},{b:.10f},{c:.4f}" for stamp, (a, b, c) in zip(stamp_ns, places, strict=True)
    ]
    file.write_text("\n".join(["time,latitude,longitude,height", *rows]) + "\n")
    return enu_m
