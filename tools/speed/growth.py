"""How cost grows with the length of a drive: graphs and proposals as long as no simulation is."""

import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.log.drawing import Drawing
from segslam.pose_graph import G2oGraph, optimize_graph
from segslam.pose_graph.edges import Edge
from segslam.proximity import ProximityDetector
from segslam.types import GraphEstimate, LoopClosure

STEP_M = 2.0
LAP = 500
"""Keyframes of a round of a town block; every later round closes loops with the one before."""
SIGMA_RAD, SIGMA_M = 0.002, 0.02


def graph(num_poses: int, num_closures: int, *, false_share: float, seed: int = 0) -> G2oGraph:
    """Rounds of one circle, each a little higher, as odometry that drifts sees them; some closures are lies."""
    rng = np.random.default_rng(seed)
    true = _rounds(num_poses)
    information = np.diag(geometry.tangent(rotation_rad=SIGMA_RAD, translation_m=SIGMA_M) ** -2.0)
    edges = [_edge(rng, true, i, i + 1, information) for i in range(num_poses - 1)]
    poses = {0: true[0]}
    for edge in edges:
        poses[edge.b] = poses[edge.a] @ edge.T_a_b
    sources = np.sort(rng.choice(np.arange(LAP, num_poses), num_closures, replace=num_closures > num_poses - LAP))
    lies = rng.random(num_closures) < false_share
    for source, lie in zip(sources.tolist(), lies.tolist(), strict=True):
        edges.append(_edge(rng, true, source - LAP, source, information, lie=lie))
    return G2oGraph(poses, edges)


def optimisation(num_poses: int, num_closures: int, *, false_share: float) -> dict[str, Any]:
    """Seconds, memory of the process so far, and closures switched off."""
    made = graph(num_poses, num_closures, false_share=false_share)
    before = time.process_time()
    found = optimize_graph(made, robust="gnc")
    return {
        "num_poses": num_poses,
        "num_closures": num_closures,
        "false_share": false_share,
        "seconds": found.seconds,
        "cpu_seconds": time.process_time() - before,
        "iterations": found.iterations,
        "num_outliers": found.num_outliers,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def curves(sizes: tuple[int, ...]) -> dict[str, Any]:
    """Seconds by size, and the exponent of the power law through the larger half of them."""
    measured = {
        "optimise_graph": [optimisation(n, n // 5, false_share=0.2)["seconds"] for n in sizes],
        "propose_loops": [_propose_seconds(n) for n in sizes],
        "draw_path": [_draw_seconds(n) for n in sizes],
    }
    return {
        name: {"size": list(sizes), "seconds": seconds, "exponent": exponent(sizes, seconds)}
        for name, seconds in measured.items()
    }


def exponent(sizes: tuple[int, ...], seconds: list[float]) -> float:
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(seconds[half:]), 1)[0])


def _propose_seconds(num_keyframes: int) -> float:
    """Of one search for candidates, with a closure on every fifth keyframe."""
    detector, poses = ProximityDetector(Config().proximity), _rounds(num_keyframes)
    for source in range(LAP, num_keyframes, 5):
        detector.note_closure(_closure(source, source - LAP))
    travel_m = STEP_M * np.arange(num_keyframes)
    return _timed(lambda: detector.candidates(num_keyframes - 1, poses, travel_m))


def _draw_seconds(num_keyframes: int) -> float:
    drawing = Drawing(Config().log)
    poses = dict(enumerate(_rounds(num_keyframes)))
    drawing._T_odom_keyframe = poses
    estimate = GraphEstimate(poses, 0.0, {})
    return _timed(lambda: list(drawing.draw_estimate(estimate, stamp_ns=0)))


def _timed(work: Callable[[], object]) -> float:
    times = []
    for _ in range(5):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)


def _rounds(num_poses: int) -> np.ndarray:
    turn = 2.0 * np.pi / LAP
    radius_m = STEP_M / turn
    return np.stack(
        [
            geometry.transform(
                geometry.yaw(turn * i), [radius_m * np.sin(turn * i), -radius_m * np.cos(turn * i), 1e-4 * i]
            )
            for i in range(num_poses)
        ]
    )


def _edge(
    rng: np.random.Generator, true: np.ndarray, a: int, b: int, information: np.ndarray, *, lie: bool = False
) -> Edge:
    noise = rng.normal(size=6) * geometry.tangent(rotation_rad=SIGMA_RAD, translation_m=SIGMA_M)
    if lie:
        noise = rng.normal(size=6) * geometry.tangent(rotation_rad=0.3, translation_m=5.0)
    return Edge(a, b, geometry.inverse(true[a]) @ true[b] @ geometry.exp(noise), information)


def _closure(source_id: int, target_id: int) -> LoopClosure:
    return LoopClosure(source_id, target_id, np.eye(4), np.eye(6), alignment=None)  # type: ignore[arg-type]
