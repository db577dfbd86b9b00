"""What turning back a leftover vertical angle does to finished runs: errors without and with it, and the decision.

Odometry, scans and closures come from each run's log, so one run of `segslam map` serves any number of settings. Beside
the closures that the run found stand perfect ones, the truth where two keyframes lie within 6 m.

    segslam simulate D --sequence 06 --poses 06.txt --seed 11 --set sensor.vertical_angle_error_deg=0.35
    segslam map D --sequence 06 --out runs/06
    python tools/bench_drift.py runs/06 --out drift.json
"""

import argparse
import json
import platform
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from segslam import geometry, refine
from segslam.config import Config
from segslam.evaluation import trajectory_metrics
from segslam.log import read_log
from segslam.pose_graph import PoseGraph, judge
from segslam.types import Alignment, AngleSamples, Keyframe, LoopClosure, Registration, SegslamError
from segslam.vertical_angle import sample_angles

REACH_M = 6.0
SPACING_M = 6.0
REVISIT_M = 50.0
PERFECT_SIGMAS = geometry.tangent(rotation_rad=np.radians(0.1), translation_m=0.05)


@dataclass(frozen=True, eq=False)
class Drive:
    """The keyframes of a run, their true poses, and the closures that it found."""

    keyframes: list[Keyframe]
    truth: np.ndarray
    closures: list[LoopClosure]

    @property
    def odometry(self) -> np.ndarray:
        return np.array([keyframe.T_odom_keyframe for keyframe in self.keyframes])

    @property
    def travel_m(self) -> np.ndarray:
        return np.array([keyframe.travel_m for keyframe in self.keyframes])


def read_drive(run: Path) -> Drive:
    """Raises SegslamError for a run without true poses."""
    log = read_log(run / "log.mcap")
    reference = log.reference()
    if reference is None:
        raise SegslamError(f"{run}: the log holds no true poses; name a run of data that has some")
    row_of_scan = {int(scan): row for row, scan in enumerate(reference.scan_index)}
    steps = list(log.steps())
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    outcomes = [attempt.outcome for step in steps for attempt in step.attempts]
    rows = [row_of_scan[keyframe.scan_index] for keyframe in keyframes]
    closures = [outcome for outcome in outcomes if isinstance(outcome, LoopClosure)]
    return Drive(keyframes, reference.T_world_lidar[rows], closures)


def perfect_closures(drive: Drive) -> list[LoopClosure]:
    """The true motion to the nearest older keyframe, where one lies within reach."""
    closures, last_m = [], -np.inf
    for source, travel_m in enumerate(drive.travel_m):
        old = np.flatnonzero(drive.travel_m < travel_m - REVISIT_M)
        apart_m = np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1)
        if len(old) and apart_m.min() <= REACH_M and travel_m - last_m >= SPACING_M:
            target, last_m = int(old[apart_m.argmin()]), travel_m
            closures.append(_closure(source, target, geometry.inverse(drive.truth[target]) @ drive.truth[source]))
    return closures


def _closure(source: int, target: int, T_target_source: np.ndarray) -> LoopClosure:
    registration = Registration(T_target_source, 0, 0, 0.0, np.diag(PERFECT_SIGMAS**-2.0))
    alignment = Alignment(registration, registration, 1.0, 0.0, 0.0)
    return LoopClosure(source, target, T_target_source, registration.information, alignment)


def finished(
    drive: Drive, closures: list[LoopClosure], samples: AngleSamples | None, config: Config
) -> tuple[dict[str, float], float]:
    """Errors at the end with these closures, straightened by the samples if there are any; and the seconds it took."""
    graph = PoseGraph(config.graph)
    for keyframe in drive.keyframes:
        graph.add_keyframe(keyframe.id, keyframe.T_odom_keyframe, keyframe.travel_m)
    for closure in closures:
        graph.add_closure(closure)
    started = time.perf_counter()
    if samples is not None:
        graph.straighten(samples)
    graph.finish()
    return errors(graph.T_world_keyframes, drive), time.perf_counter() - started


def errors(poses: np.ndarray, drive: Drive) -> dict[str, float]:
    metrics = trajectory_metrics(poses, drive.truth)
    return {"ate_m": metrics["ate_m"], "height_m": metrics["height_m"]}


def row_of(run: Path, config: Config) -> dict[str, Any]:
    drive = read_drive(run)

    def surface(keyframe_id: int) -> refine.Surface:
        thinned = refine.thin(drive.keyframes[keyframe_id].points, config=config.refine)
        return refine.prepare(thinned, config=config.refine)

    started = time.perf_counter()
    samples = sample_angles(surface, drive.odometry, drive.travel_m)
    evidence = judge(samples)
    sampling_s = time.perf_counter() - started
    row: dict[str, Any] = {
        "run": run.name,
        "keyframes": len(drive.keyframes),
        "travel_m": float(drive.travel_m[-1]),
        "odometry": errors(drive.odometry, drive),
        "evidence": asdict(evidence),
        "excess_mdeg_per_m": float(1e3 * np.degrees(np.median(samples.excess_rad_per_m))),
        "sampling_s": sampling_s,
    }
    for name, closures in (("found", drive.closures), ("perfect", perfect_closures(drive))):
        plain, plain_s = finished(drive, closures, None, config)
        forced, _ = finished(drive, closures, samples, config)
        decided = forced if evidence.chosen else plain
        row[name] = {
            "closures": len(closures),
            "plain": plain,
            "forced": forced,
            "decided": decided,
            "plain_s": plain_s,
        }
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows for a reader, ATE in metres."""
    lines = [
        "| run | leftover (deg) | chosen, t | odometry | found closures: plain | decided | perfect: plain | decided |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        evidence, found, perfect = row["evidence"], row["found"], row["perfect"]
        angle = "-" if evidence["angle_deg"] is None else f"{evidence['angle_deg']:.3f}"
        t_value = "-" if evidence["t_value"] is None else f"{evidence['t_value']:.1f}"
        cells = [
            row["run"],
            angle,
            f"{'yes' if evidence['chosen'] else 'no'}, {t_value}",
            f"{row['odometry']['ate_m']:.3f}",
            f"{found['plain']['ate_m']:.3f} ({found['closures']})",
            f"{found['decided']['ate_m']:.3f}",
            f"{perfect['plain']['ate_m']:.3f} ({perfect['closures']})",
            f"{perfect['decided']['ate_m']:.3f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="folders that `segslam map` wrote, of data with true poses")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    config = Config()
    rows = [row_of(run, config) for run in options.runs]
    machine = {"processor": platform.processor(), "machine": platform.machine(), "python": platform.python_version()}
    report = {"machine": machine, "commit": commit, "config": config.model_dump(mode="json"), "rows": rows}
    options.out.write_text(json.dumps(report, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
