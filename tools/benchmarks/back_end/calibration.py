"""Calibration of edges: mean chi-square per degree of freedom of true edges; 1 if the noise model is correct."""

from collections.abc import Iterable

import numpy as np

from segslam.core import geometry
from segslam.core.types import LoopClosure
from segslam.graph.closure_pairs import adjoints
from segslam.graph.noise import DEGREES_OF_FREEDOM, closure_information, odometry_information
from tools.benchmarks.back_end.drives import CONFIG, Drive

LENGTHS = (1, 10, 100)
"""Lengths of chains in keyframes."""


def odometry_calibration(drive: Drive) -> dict[str, float | None]:
    """Mean chi-square of odometry chains of each length; None if the drive is shorter."""
    summed = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(_carried(drive), axis=0)])
    back = adjoints(np.linalg.inv(drive.odometry))
    found: dict[str, float | None] = {}
    for length in LENGTHS:
        chi2 = [
            _chi2(
                geometry.inverse(drive.odometry[start]) @ drive.odometry[start + length],
                geometry.inverse(drive.truth[start]) @ drive.truth[start + length],
                np.linalg.inv(back[start + length] @ (summed[start + length] - summed[start]) @ back[start + length].T),
            )
            for start in range(len(drive.truth) - length)
        ]
        found[f"chain_{length}"] = float(np.mean(chi2)) if chi2 else None
    return found


def closure_calibration(drive: Drive, closures: Iterable[LoopClosure]) -> float | None:
    """Mean chi-square of closures with the weights of the graph; None without closures."""
    chi2 = [
        _chi2(
            loop.T_target_source,
            geometry.inverse(drive.truth[loop.target_id]) @ drive.truth[loop.source_id],
            closure_information(loop.information),
        )
        for loop in closures
    ]
    return float(np.mean(chi2)) if chi2 else None


def _carried(drive: Drive) -> np.ndarray:
    """(n - 1, 6, 6) covariances of the edges in the odometry's frame."""
    motions = np.linalg.inv(drive.odometry[:-1]) @ drive.odometry[1:]
    information = [
        odometry_information(way_m, T_a_b, CONFIG.graph)
        for way_m, T_a_b in zip(np.diff(drive.travel_m), motions, strict=True)
    ]
    turns = adjoints(drive.odometry[1:])
    return turns @ np.linalg.inv(np.array(information)) @ turns.transpose(0, 2, 1)


def _chi2(T_found: np.ndarray, T_true: np.ndarray, information: np.ndarray) -> float:
    error = geometry.log(geometry.inverse(T_true) @ T_found)
    return float(error @ information @ error) / DEGREES_OF_FREEDOM
