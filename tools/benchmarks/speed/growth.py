"""How cost grows with the length of a drive: graphs, proposals and whole drives as long as no simulation is."""

import resource
import tempfile
import time
import timeit
from collections.abc import Callable
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from segslam.candidates.proximity import ProximityDetector
from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.threads import Stopwatch
from segslam.core.types import (
    Alignment,
    GraphEstimate,
    Keyframe,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Registration,
    Step,
    Trajectory,
)
from segslam.graph.batch import optimize_graph
from segslam.graph.chains import Chains
from segslam.graph.edges import Edge
from segslam.graph.g2o import G2oGraph
from segslam.graph.noise import closure_information, odometry_information
from segslam.odometry.sweep import GivenOdometry
from segslam.output.log import LogWriter
from segslam.output.log.drawing import Drawing
from segslam.slam.slam import Slam

STEP_M = 2.0
LAP = 500
"""Keyframes of a round of a town block; every later round closes loops with the one before."""
ROUNDS = 4
"""Rounds of one block before the drive moves to the next."""
AWAY = 100
"""Keyframes from a block to the next."""
SIGMAS = geometry.tangent(rotation_rad=0.002, translation_m=0.02)
INFORMATION = np.diag(SIGMAS**-2.0)


def graph(num_poses: int, num_closures: int, *, false_share: float) -> G2oGraph:
    """Rounds of one circle, each a little higher, with drifting odometry; some closures are false."""
    rng = np.random.default_rng(0)
    true = _rounds(num_poses)
    edges = [_edge(rng, true, i, i + 1) for i in range(num_poses - 1)]
    poses = {0: true[0]}
    for edge in edges:
        poses[edge.b] = poses[edge.a] @ edge.T_a_b
    sources = np.sort(rng.choice(np.arange(LAP, num_poses), num_closures, replace=num_closures > num_poses - LAP))
    lies = rng.random(num_closures) < false_share
    for source, lie in zip(sources.tolist(), lies.tolist(), strict=True):
        edges.append(_edge(rng, true, source - LAP, source, lie=lie))
    return G2oGraph(poses, edges)


def optimisation(num_poses: int, num_closures: int, *, false_share: float) -> dict[str, Any]:
    """Seconds, peak memory of the process, and rejected closures."""
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


def _pipeline(true: np.ndarray) -> Slam:
    """A pipeline whose loops are true poses with noise: no scans are registered."""
    config = load_config(None, ["retrieval.enabled=false", "adjustment.max_minutes=0"])
    no_scans = Trajectory(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4, 4)))
    slam, rng = Slam(config, odometry=GivenOdometry(no_scans, config.odometry)), np.random.default_rng(0)

    def attempts(candidate: LoopCandidate, watch: Stopwatch) -> tuple[LoopAttempt, ...]:
        edge = _edge(rng, true, candidate.target_id, candidate.source_id)
        found = Registration(edge.T_a_b, 30, 30, 0.05, INFORMATION)
        alignment = Alignment(found, found, 0.8, 0.05, 0.0)
        ids = candidate.source_id, candidate.target_id
        return (LoopAttempt(candidate, LoopClosure(*ids, edge.T_a_b, INFORMATION, alignment), {}),)

    slam._loops._attempts = attempts  # type: ignore[method-assign]
    return slam


def drive(num_keyframes: int) -> dict[str, float]:
    """Seconds that all but the alignment of scans takes, from the keyframe to the log and the final optimum."""
    true = _town(num_keyframes)
    config = Config().graph
    sigmas = geometry.tangent(
        rotation_rad=np.radians(config.odometry_sigma_deg), translation_m=config.odometry_sigma_m
    ) * np.sqrt(STEP_M)
    rng = np.random.default_rng(1)
    motions = [geometry.inverse(a) @ b @ geometry.exp(rng.normal(size=6) * sigmas) for a, b in pairwise(true)]
    slam, num_closures = _pipeline(true), 0
    with tempfile.TemporaryDirectory() as folder, LogWriter(Path(folder) / "log.mcap", config=slam.config) as log:
        slam.keep_clouds_in(log)
        started = time.perf_counter()
        for i, T_odom_lidar in enumerate(accumulate(motions, np.matmul, initial=np.eye(4))):
            points, labels = np.zeros((10, 3), np.float32), np.zeros(10, np.uint8)
            keyframe = Keyframe(i, i, i * 10**8, T_odom_lidar, STEP_M * i, points, labels)
            step = slam.repeat(Step(i, i * 10**8, T_odom_lidar, keyframe, (), None, {}))
            log.write(step)
            num_closures += sum(isinstance(attempt.outcome, LoopClosure) for attempt in step.attempts)
        driven_s = time.perf_counter() - started
        result = slam.finish()
        log.write_result(result.estimate, result.trajectory)
        seconds = time.perf_counter() - started
    errors_m = np.linalg.norm(result.trajectory.T_world_lidar[:, :3, 3] - true[:, :3, 3], axis=1)
    return {
        "seconds": seconds,
        "finish_seconds": seconds - driven_s,
        "num_closures": num_closures,
        "worst_m": float(errors_m.max()),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def curves(sizes: tuple[int, ...], drive_sizes: tuple[int, ...]) -> dict[str, Any]:
    """Seconds by size, and the exponent of the power law through the larger half of them."""
    measured: dict[str, tuple[tuple[int, ...], Callable[[int], dict[str, Any]]]] = {
        "optimise_graph": (sizes, lambda n: {"seconds": optimisation(n, n // 5, false_share=0.2)["seconds"]}),
        "propose_loops": (sizes, lambda n: {"seconds": _propose_seconds(n)}),
        "draw_path": (sizes, lambda n: {"seconds": _draw_seconds(n)}),
        "drive": (drive_sizes, drive),
    }
    found = {}
    for name, (numbers, measure) in measured.items():
        rows = [measure(number) for number in numbers]
        found[name] = {"size": list(numbers), "exponent": exponent(numbers, [row["seconds"] for row in rows])}
        found[name] |= {key: [row[key] for row in rows] for key in rows[0]}
    return found


def exponent(sizes: tuple[int, ...], seconds: list[float]) -> float:
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(seconds[half:]), 1)[0])


def _propose_seconds(num_keyframes: int) -> float:
    """Of one search for candidates, with a closure on every fifth keyframe."""
    detector, poses = ProximityDetector(Config().proximity), _rounds(num_keyframes)
    pairs = [(source, source - LAP) for source in range(LAP, num_keyframes, 5)]
    for pair in pairs:
        detector.note_closure(LoopClosure(*pair, np.eye(4), np.eye(6), alignment=None))  # type: ignore[arg-type]
    detector.note_estimate({})
    travel_m = STEP_M * np.arange(num_keyframes)
    motions = [
        Edge(i, i + 1, T_a_b, odometry_information(STEP_M, T_a_b, Config().graph))
        for i, T_a_b in enumerate(np.linalg.inv(poses[:-1]) @ poses[1:])
    ]
    closures = [Edge(a, b, np.eye(4), closure_information(np.eye(6))) for b, a in pairs]
    chains = Chains(poses, motions, closures)
    return min(
        timeit.repeat(lambda: detector.candidates(num_keyframes - 1, poses, travel_m, chains.covariances), number=1)
    )


def _draw_seconds(num_keyframes: int) -> float:
    drawing = Drawing()
    poses = dict(enumerate(_rounds(num_keyframes)))
    drawing._T_odom_keyframe = poses
    estimate = GraphEstimate(poses, 0.0, {})
    return min(timeit.repeat(lambda: list(drawing.draw_estimate(estimate, stamp_ns=0)), number=1))


def _town(num_poses: int) -> np.ndarray:
    """Some rounds of a block, on straight ahead, rounds of the next block, and so on."""
    place = np.arange(num_poses - 1) % (ROUNDS * LAP + AWAY)
    turns = np.where(place < ROUNDS * LAP, 2.0 * np.pi / LAP, 0.0)
    steps = (geometry.transform(geometry.yaw(turn), [STEP_M, 0.0, 0.0]) for turn in turns)
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(4))))


def _rounds(num_poses: int) -> np.ndarray:
    """Rounds of one circle, each a little higher."""
    turn = 2.0 * np.pi / LAP
    radius_m = STEP_M / turn
    poses = np.tile(np.eye(4), (num_poses, 1, 1))
    for i, pose in enumerate(poses):
        pose[:3, :3] = geometry.yaw(turn * i)
        pose[:3, 3] = radius_m * np.sin(turn * i), -radius_m * np.cos(turn * i), 1e-4 * i
    return poses


def _edge(rng: np.random.Generator, true: np.ndarray, a: int, b: int, *, lie: bool = False) -> Edge:
    noise = rng.normal(size=6) * SIGMAS
    if lie:
        noise = rng.normal(size=6) * geometry.tangent(rotation_rad=0.3, translation_m=5.0)
    return Edge(a, b, geometry.inverse(true[a]) @ true[b] @ geometry.exp(noise), INFORMATION)
