"""Benchmark of the back end on real trajectories, without scans: proposals, graph, outliers, time.

If two keyframes are within reach of each other in the (levelled) ground truth, their closure is the true pose with
noise; otherwise there is none. Outliers are a share of all closures. Each result is compared with that of exact
closures.

    python -m tools.benchmarks.back_end ../shared/data --out back_end.json --sequence 00 --sequence 08 --seeds 3
"""

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from segslam.candidates.proximity import ProximityDetector
from segslam.core import geometry
from segslam.core.evaluation import FOUND_WITHIN_M, REVISIT_MIN_TRAVEL_M
from segslam.core.types import LoopClosure
from segslam.graph import PoseGraph
from tools.benchmarks import common
from tools.benchmarks.back_end.drives import CONFIG, Drive, closure, read_drive

REACH_M = 8.0
"""Distance up to which two keyframes are always registered."""
MAX_ROUNDS = 3
SHARES = (0.3, 0.7)
KINDS = ("random", "grouped", "nearby")
"""False closures: single pairs anywhere; groups with a common error anywhere; groups displaced along the road."""
NEARBY_M = 25.0
SLIDE_M = (5.0, 20.0)


class Search:
    """Search for loops in a drive."""

    def __init__(self, drive: Drive, rng: np.random.Generator) -> None:
        self._drive, self._rng = drive, rng
        self.graph, self.detector = PoseGraph(CONFIG.graph), ProximityDetector(CONFIG.proximity)
        self.closures: list[LoopClosure] = []
        self._tried: set[tuple[int, int]] = set()

    def look(self, keyframe_id: int) -> int:
        """Try new candidates of one keyframe; returns the number of closures found."""
        found = []
        graph = self.graph
        for candidate in self.detector.candidates(
            keyframe_id, graph.T_world_keyframes, graph.travel_m, graph.covariances
        ):
            pair = (keyframe_id, candidate.target_id)
            if pair in self._tried:
                continue
            self._tried.add(pair)
            T_target_source = self._drive.true(candidate.target_id, keyframe_id)
            if geometry.distance(T_target_source) <= REACH_M:
                found.append(closure(*pair, T_target_source, self._rng))
        for loop in found:
            graph.add_closure(loop)
            self.detector.note_closure(loop)
        self.closures += found
        return len(found)

    def figures(self) -> dict[str, Any]:
        return {
            "tried": len(self._tried),
            "closures": len(self.closures),
            "recall_4m": self._recall(4.0),
            "recall_10m": self._recall(10.0),
            **self._drive.errors(self.graph.T_world_keyframes),
        }

    def _recall(self, within_m: float) -> float | None:
        """Share of the keyframes this near to an old one that have a closure within 10 m of travel."""
        wanted = self._drive.travel_m[list(_revisits(self._drive, within_m))]
        closed = self._drive.travel_m[[loop.source_id for loop in self.closures]]
        away_m = np.abs(wanted[:, None] - closed).min(axis=1, initial=np.inf)
        return float((away_m <= FOUND_WITHIN_M).mean()) if len(wanted) else None


def _revisits(drive: Drive, within_m: float) -> Iterator[int]:
    positions = drive.truth[:, :3, 3]
    for row, position in enumerate(positions):
        old = positions[:row][drive.travel_m[:row] <= drive.travel_m[row] - REVISIT_MIN_TRAVEL_M]
        if len(old) and np.linalg.norm(old - position, axis=1).min() <= within_m:
            yield row


def search(drive: Drive, rng: np.random.Generator) -> tuple[list[LoopClosure], dict[str, Any]]:
    """The closures found while driving; recall, tries, errors; and the same after each search with corrected poses."""
    looking, seconds = Search(drive, rng), []
    for keyframe_id, (T_odom_keyframe, travel) in enumerate(zip(drive.odometry, drive.travel_m, strict=True)):
        looking.graph.add_keyframe(keyframe_id, T_odom_keyframe, float(travel))
        if looking.look(keyframe_id):
            started = time.perf_counter()
            estimate = looking.graph.optimize()
            looking.detector.note_estimate(estimate.closure_weights)
            seconds.append(time.perf_counter() - started)
    last = np.array(seconds[-max(1, len(seconds) // 10) :] or [np.nan])
    looking.graph.finish()
    closures, figures = list(looking.closures), looking.figures()
    figures["optimize_ms_last_tenth"] = {"median": 1e3 * np.median(last), "p95": 1e3 * np.percentile(last, 95)}
    figures["odometry_ate_m"] = drive.errors(drive.odometry)["ate_m"]
    figures["again"] = []
    while len(figures["again"]) < MAX_ROUNDS:
        if not sum(looking.look(keyframe_id) for keyframe_id in range(len(drive.truth))):
            break
        looking.graph.finish()
        figures["again"].append(looking.figures())
    return closures, figures


def measure(data: Path, sequence: str, odometry: str, seed: int, shares: list[float]) -> dict[str, Any]:
    """All figures of one drive."""
    drive = read_drive(data, sequence, odometry, np.random.default_rng([seed, 0]))
    true, found = search(drive, np.random.default_rng([seed, 1]))
    row: dict[str, Any] = {
        "sequence": sequence,
        "odometry": odometry,
        "seed": seed,
        "keyframes": len(drive.truth),
        "search": found,
    }
    row["without_outliers"] = finished(drive, true)
    row["exact_closures"] = finished(drive, [drive.exact(loop.source_id, loop.target_id) for loop in true])
    row["ate_by_exact"] = row["without_outliers"]["ate_m"] / row["exact_closures"]["ate_m"]
    row["outliers"] = []
    for kind in KINDS if true else ():
        for share in shares:
            rng = np.random.default_rng([seed, 2, round(100 * share)])
            result = finished(drive, true, draw_outliers(drive, kind, round(len(true) * share / (1.0 - share)), rng))
            ratio = result["ate_m"] / row["without_outliers"]["ate_m"]
            row["outliers"].append({"kind": kind, "share": share, "ate_ratio": ratio, **result})
    return row


def finished(drive: Drive, true: Sequence[LoopClosure], false: Sequence[LoopClosure] = ()) -> dict[str, Any]:
    """Which of the true and false closures the final optimisation keeps, and the error."""
    estimate, errors, seconds = drive.finished((*true, *false))
    weights, is_true = estimate.closure_weights, {(loop.source_id, loop.target_id) for loop in true}
    return {
        "true": len(true),
        "true_rejected": sum(weights[pair] == 0.0 for pair in is_true),
        "outliers": len(false),
        "outliers_kept": sum(weight > 0.0 for pair, weight in weights.items() if pair not in is_true),
        **errors,
        "finish_s": seconds,
    }


def draw_outliers(drive: Drive, kind: str, num: int, rng: np.random.Generator) -> list[LoopClosure]:
    """`num` false closures, in groups of 5 to 15 neighbours with a common error."""
    found: list[LoopClosure] = []
    while len(found) < num:
        found += _group(drive, kind, 1 if kind == "random" else int(rng.integers(5, 16)), rng)
    return found[:num]


def _group(drive: Drive, kind: str, length: int, rng: np.random.Generator) -> Iterator[LoopClosure]:
    source = int(rng.integers(length + 60, len(drive.truth) - length))
    if kind == "nearby":
        yield from _nearby(drive, source, length, rng)
        return
    target = int(rng.integers(0, source - length - 40))
    heading = rng.uniform(-np.pi, np.pi) if kind == "random" else rng.choice([0.0, np.pi])
    T_first = geometry.transform(geometry.yaw(heading), [*rng.normal(0.0, 3.0, 2), rng.normal(0.0, 0.3)])
    yield from _moved_along(drive, source, target, 1, T_first, length, rng)


def _nearby(drive: Drive, source: int, length: int, rng: np.random.Generator) -> Iterator[LoopClosure]:
    """True closures displaced along the road; none without another visit within reach."""
    old = np.flatnonzero(drive.travel_m[:source] < drive.travel_m[source] - CONFIG.proximity.min_travel_m)
    near = old[np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1) < NEARBY_M]
    if len(near):
        target = int(rng.choice(near))
        T_true = drive.true(target, source)
        slide = [rng.choice([-1.0, 1.0]) * rng.uniform(*SLIDE_M), rng.normal(0.0, 0.5), rng.normal(0.0, 0.1)]
        direction = 1 if T_true[0, 0] > 0 else -1
        T_first = geometry.transform(np.eye(3), slide) @ T_true
        yield from _moved_along(drive, source, target, direction, T_first, length, rng)


def _moved_along(
    drive: Drive,
    source: int,
    target: int,
    direction: int,
    T_first: np.ndarray,
    length: int,
    rng: np.random.Generator,
) -> Iterator[LoopClosure]:
    """The closures of a group of consecutive keyframes; the target moves forwards (1) or backwards (-1)."""
    for k in range(length):
        seen = target + direction * k
        if 0 <= seen < source - 10:
            T_seen_next = drive.true(seen, target) @ T_first @ drive.true(source, source + k)
            yield closure(source + k, seen, T_seen_next, rng)


def main() -> None:
    parser = common.parser(__doc__, "back_end")
    parser.add_argument("data", type=Path, help="folder with kitti/ and trajectories/")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--sequence", action="append", help="may be repeated; default 00, 05, 06, 08, 09")
    parser.add_argument("--odometry", default="calibrated", choices=["measured", "drifting", "calibrated", "allowed"])
    parser.add_argument("--share", type=float, action="append", help=f"of outliers; may be repeated; default {SHARES}")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    rows = []
    for sequence in options.sequence or ["00", "05", "06", "08", "09"]:
        for seed in range(options.seeds):
            rows.append(measure(options.data, sequence, options.odometry, seed, options.share or list(SHARES)))
            print(json.dumps(rows[-1]), flush=True)
    common.write_report(options.out, {"config": CONFIG.model_dump(mode="json"), "rows": rows})


if __name__ == "__main__":
    main()
