"""The back end alone, on the shape of real drives: proposals, graph, lies among the closures, time. No scan is needed.

Where two keyframes lie within reach of each other in the (levelled) truth, a closure is the truth with noise; elsewhere
none is found. Odometry is a real one (trajectories/simple_online_NN.txt) where there is one, else a simulated drift.

    python tools/bench_back_end.py ../shared/data --out back_end.json --sequence 00 --sequence 05 --seeds 2
"""

import argparse
import itertools
import json
import platform
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from segslam import geometry
from segslam.config import Config
from segslam.datasets.kitti import read_calibration
from segslam.evaluation import revisits, trajectory_metrics
from segslam.keyframes import KeyframeSelector
from segslam.pose_graph import PoseGraph
from segslam.proximity import ProximityDetector
from segslam.simulation import level, upright
from segslam.trajectory import lidar_from_camera, read_poses
from segslam.types import Alignment, LoopClosure, Registration

CONFIG = Config()
REACH_M = 8.0
CLOSURE_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.1), translation_m=0.05)
STEP_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.03), translation_m=0.02)
"""Of simulated odometry, per root of a metre."""
RATE_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.0005), translation_m=0.004)
"""Of its slowly varying error, per metre."""
RATE_MEMORY_M = 200.0
SHARES_OF_LIES = {"random": (0.0, 0.3, 0.7, 0.9), "grouped": (0.1, 0.3, 0.5)}


@dataclass(frozen=True, eq=False)
class Drive:
    """The keyframes of a drive."""

    truth: np.ndarray
    odometry: np.ndarray
    travel_m: np.ndarray


def read_keyframes(data: Path, sequence: str, rng: np.random.Generator) -> Drive:
    T_camera_lidar = read_calibration(data / "kitti" / "sequences" / sequence / "calib.txt")
    truth = level(upright(_lidar_poses(data / "kitti" / "poses" / f"{sequence}.txt", T_camera_lidar)))
    measured = data / "trajectories" / f"simple_online_{sequence}.txt"
    odometry = _lidar_poses(measured, T_camera_lidar) if measured.is_file() else drifting(truth, rng)
    selector, rows, travel = KeyframeSelector(CONFIG.keyframes), [], []
    for row, T_odom_lidar in enumerate(odometry):
        if selector.update(T_odom_lidar):
            rows.append(row)
            travel.append(selector.travel_m)
    return Drive(truth[rows], odometry[rows], np.array(travel))


def _lidar_poses(path: Path, T_camera_lidar: np.ndarray) -> np.ndarray:
    return lidar_from_camera(read_poses(path).T_a_b, T_camera_lidar)


def drifting(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Odometry with a random error at each step and one that varies slowly along the way."""
    poses, rate = [truth[0]], RATE_SIGMAS * rng.normal(size=6)
    for T_a, T_b in itertools.pairwise(truth):
        T_a_b = geometry.inverse(T_a) @ T_b
        way_m = geometry.distance(T_a_b)
        kept = np.exp(-way_m / RATE_MEMORY_M)
        rate = kept * rate + np.sqrt(1.0 - kept**2) * RATE_SIGMAS * rng.normal(size=6)
        error = rate * way_m + STEP_SIGMAS * np.sqrt(way_m) * rng.normal(size=6)
        poses.append(poses[-1] @ T_a_b @ geometry.exp(error))
    return np.array(poses)


def closure(source: int, target: int, T_target_source: np.ndarray, rng: np.random.Generator) -> LoopClosure:
    measured = T_target_source @ geometry.exp(CLOSURE_SIGMAS * rng.normal(size=6))
    registration = Registration(measured, 0, 0, 0.0, np.diag(CLOSURE_SIGMAS**-2.0))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source, target, measured, registration.information, alignment)


def propose_and_close(drive: Drive, rng: np.random.Generator) -> dict[str, Any]:
    """Proposals as while driving, closures where the truth is within reach: recall, tries, errors before and after."""
    graph, detector = PoseGraph(CONFIG.graph), ProximityDetector(CONFIG.proximity)
    sources, tried, seconds = [], 0, []
    for keyframe_id, (T_odom_keyframe, travel) in enumerate(zip(drive.odometry, drive.travel_m, strict=True)):
        graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel))
        found = []
        for candidate in detector.candidates(keyframe_id, graph.T_world_keyframes, graph.travel_m):
            tried += 1
            T_target_source = geometry.inverse(drive.truth[candidate.target_id]) @ drive.truth[keyframe_id]
            if geometry.distance(T_target_source) <= REACH_M:
                found.append(closure(keyframe_id, candidate.target_id, T_target_source, rng))
        for loop in found:
            graph.add_closure(loop)
            detector.note_closure(loop)
        if found:
            sources.append(keyframe_id)
            started = time.perf_counter()
            graph.optimize()
            seconds.append(time.perf_counter() - started)
    started = time.perf_counter()
    estimate = graph.finish()
    last = np.array(seconds[-max(1, len(seconds) // 10) :])
    return {
        "keyframes": graph.num_keyframes,
        "tried": tried,
        "closures": len(estimate.closure_weights),
        "switched_off": sum(weight == 0.0 for weight in estimate.closure_weights.values()),
        "recall_4m": _recall(drive, sources),
        "odometry": _errors(drive, drive.odometry),
        "final": _errors(drive, graph.T_world_keyframes),
        "optimize_ms_last_tenth": {"median": 1e3 * np.median(last), "p95": 1e3 * np.percentile(last, 95)},
        "finish_s": time.perf_counter() - started,
    }


def _recall(drive: Drive, sources: list[int]) -> float | None:
    """Share of the keyframes that revisit a place with a closure within 10 m of travel."""
    wanted = drive.travel_m[revisits(drive.truth)]
    closed = drive.travel_m[sources]
    near = [bool(len(closed)) and np.abs(closed - travel).min() <= 10.0 for travel in wanted]
    return float(np.mean(near)) if near else None


def _errors(drive: Drive, poses: np.ndarray) -> dict[str, float]:
    metrics = trajectory_metrics(poses, drive.truth)
    return {"ate_m": metrics["ate_m"], "height_m": metrics["height_m"]}


def believe(drive: Drive, kind: str, share: float, rng: np.random.Generator) -> dict[str, Any]:
    """All true closures 6 m apart, with lies that are a share of all: what is believed at the end, and the error."""
    true = list(_true_closures(drive, rng))
    lies = list(_lies(drive, kind, round(len(true) * share / (1.0 - share)), rng))
    graph = PoseGraph(CONFIG.graph)
    for keyframe_id, (T_odom_keyframe, travel) in enumerate(zip(drive.odometry, drive.travel_m, strict=True)):
        graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel))
    for loop in true + lies:
        graph.add_closure(loop)
    started = time.perf_counter()
    weights = graph.finish().closure_weights
    return {
        "kind": kind,
        "share": share,
        "true": len(true),
        "true_switched_off": sum(weights[loop.source_id, loop.target_id] == 0.0 for loop in true),
        "lies": len(lies),
        "lies_believed": sum(weights[loop.source_id, loop.target_id] > 0.0 for loop in lies),
        "final": _errors(drive, graph.T_world_keyframes),
        "finish_s": time.perf_counter() - started,
    }


def _true_closures(drive: Drive, rng: np.random.Generator) -> Iterator[LoopClosure]:
    last_m = -np.inf
    for source, travel in enumerate(drive.travel_m):
        old = np.flatnonzero(drive.travel_m < travel - CONFIG.proximity.min_travel_m)
        apart = np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1)
        if len(old) and apart.min() <= REACH_M and travel - last_m >= 6.0:
            target, last_m = int(old[apart.argmin()]), travel
            yield closure(source, target, geometry.inverse(drive.truth[target]) @ drive.truth[source], rng)


def _lies(drive: Drive, kind: str, num: int, rng: np.random.Generator) -> Iterator[LoopClosure]:
    """Random pairs, or groups of up to 15 that agree with each other as a repeated street would make them."""
    done = 0
    while done < num:
        length = 1 if kind == "random" else min(int(rng.integers(5, 16)), num - done)
        source = int(rng.integers(length + 60, len(drive.truth) - length))
        target = int(rng.integers(0, source - length - 40))
        heading = rng.uniform(-np.pi, np.pi) if kind == "random" else rng.choice([0.0, np.pi])
        T_first = geometry.transform(geometry.yaw(heading), [*rng.normal(0.0, 3.0, 2), rng.normal(0.0, 0.3)])
        for k in range(length):
            T_target_first = geometry.inverse(drive.truth[target + k]) @ drive.truth[target]
            T_first_source = geometry.inverse(drive.truth[source]) @ drive.truth[source + k]
            yield closure(source + k, target + k, T_target_first @ T_first @ T_first_source, rng)
        done += length


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with kitti/ and trajectories/")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--sequence", action="append", help="may be repeated; default 00, 05, 06, 07")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    rows = []
    for sequence in options.sequence or ["00", "05", "06", "07"]:
        for seed in range(options.seeds):
            drive = read_keyframes(options.data, sequence, np.random.default_rng([seed, 0]))
            row = {"sequence": sequence, "seed": seed, **propose_and_close(drive, np.random.default_rng([seed, 1]))}
            row["lies"] = [
                believe(drive, kind, share, np.random.default_rng([seed, 2]))
                for kind, shares in SHARES_OF_LIES.items()
                for share in shares
            ]
            rows.append(row)
            print(json.dumps(row), flush=True)
    machine = {"processor": platform.processor(), "machine": platform.machine(), "python": platform.python_version()}
    report = {"machine": machine, "commit": commit, "config": CONFIG.model_dump(mode="json"), "rows": rows}
    options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
