"""Back end on whole drives: errors, closures, comparison with exact closures, calibration of edges.

Odometry and closures come from each run's log, so one run of `segslam map` is sufficient for many settings. The found
closures are compared with exact ones: at the same places, and for all keyframes within 6 m of each other.

    segslam simulate D --sequence 06 --poses 06.txt --seed 11 --set sensor.vertical_angle_error_deg=0.35
    segslam map D --sequence 06 --out runs/06
    python -m tools.benchmarks.sequences runs/06 --out sequences.json
"""

from pathlib import Path
from typing import Any

import numpy as np

from segslam.core import geometry
from segslam.core.evaluation import loop_metrics
from segslam.core.types import LoopClosure, SegslamError
from segslam.graph.closure_pairs import adjoints
from segslam.graph.noise import DEGREES_OF_FREEDOM, closure_information, odometry_information
from segslam.output.log import read_log
from tools.benchmarks import common
from tools.benchmarks.back_end.drives import CONFIG, Drive

REACH_M = 6.0
SPACING_M = 6.0
REVISIT_M = 50.0
LENGTHS = (1, 10, 100)
"""Lengths of chains in keyframes."""


def read_recorded(run: Path) -> tuple[Drive, list[LoopClosure]]:
    """A drive that was mapped, and the closures that were found. Raises SegslamError for a run without true poses."""
    log = read_log(run / "log.mcap")
    reference = log.reference()
    if reference is None:
        raise SegslamError(f"{run}: the log contains no true poses; give a run of data with ground truth")
    row_of_scan = {int(scan): row for row, scan in enumerate(reference.scan_index)}
    steps = list(log.steps())
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    outcomes = [attempt.outcome for step in steps for attempt in step.attempts]
    drive = Drive(
        truth=reference.T_world_lidar[[row_of_scan[keyframe.scan_index] for keyframe in keyframes]],
        odometry=np.array([keyframe.T_odom_keyframe for keyframe in keyframes]),
        travel_m=np.array([keyframe.travel_m for keyframe in keyframes]),
    )
    return drive, [outcome for outcome in outcomes if isinstance(outcome, LoopClosure)]


def exact_everywhere(drive: Drive) -> list[LoopClosure]:
    """True closures to the nearest older keyframe, for all keyframes with one within reach."""
    closures, last_m = [], -np.inf
    for source, travel_m in enumerate(drive.travel_m):
        old = np.flatnonzero(drive.travel_m < travel_m - REVISIT_M)
        apart_m = np.linalg.norm(drive.truth[old, :3, 3] - drive.truth[source, :3, 3], axis=1)
        if len(old) and apart_m.min() <= REACH_M and travel_m - last_m >= SPACING_M:
            target, last_m = int(old[apart_m.argmin()]), travel_m
            closures.append(drive.exact(source, target))
    return closures


def odometry_calibration(drive: Drive) -> dict[str, float | None]:
    """Mean chi-square of odometry chains of each length; None if the drive is shorter."""
    summed = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(_carried(drive), axis=0)])
    back = adjoints(np.linalg.inv(drive.odometry))
    found: dict[str, float | None] = {}
    for length in LENGTHS:
        chi2 = [
            _chi2(
                geometry.inverse(drive.odometry[start]) @ drive.odometry[start + length],
                drive.true(start, start + length),
                np.linalg.inv(back[start + length] @ (summed[start + length] - summed[start]) @ back[start + length].T),
            )
            for start in range(len(drive.truth) - length)
        ]
        found[f"chain_{length}"] = float(np.mean(chi2)) if chi2 else None
    return found


def closure_calibration(drive: Drive, closures: list[LoopClosure]) -> float | None:
    """Mean chi-square of closures with the weights of the graph; None without closures."""
    chi2 = [
        _chi2(loop.T_target_source, drive.true(loop.target_id, loop.source_id), closure_information(loop.information))
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


def row_of(run: Path) -> dict[str, Any]:
    """All figures of one run."""
    drive, closures = read_recorded(run)
    pairs = np.array([(loop.source_id, loop.target_id) for loop in closures], dtype=int).reshape(-1, 2)
    found = np.array([loop.T_target_source for loop in closures]).reshape(-1, 4, 4)
    row: dict[str, Any] = {
        "run": f"{run.parent.name}/{run.name}",
        "keyframes": len(drive.truth),
        "travel_m": float(drive.travel_m[-1]),
        "odometry": drive.errors(drive.odometry),
        "loops": {"closures": len(closures), **loop_metrics(found, pairs, drive.truth)},
        "noise": {**odometry_calibration(drive), "closures": closure_calibration(drive, closures)},
    }
    kinds = {
        "found": closures,
        "exact": [drive.exact(*pair) for pair in pairs.tolist()],
        "exact_everywhere": exact_everywhere(drive),
    }
    for name, loops in kinds.items():
        estimate, errors, seconds = drive.finished(loops)
        row[name] = {"closures": len(loops), **errors, "switched_off": len(estimate.rejected), "seconds": seconds}
    row["ate_by_exact"] = row["found"]["ate_m"] / row["exact"]["ate_m"]
    return row


def cells(row: dict[str, Any]) -> common.Row:
    """A row for a reader, ATE in metres of keyframes."""
    found, loops, noise = row["found"], row["loops"], row["noise"]
    return {
        "run": row["run"],
        "odometry": _number(row["odometry"]["ate_m"]),
        "ATE": _number(found["ate_m"]),
        "height": _number(found.get("height_m")),
        "KITTI %": _number(found.get("kitti_translation_percent")),
        "closures, false, off": f"{loops['closures']}, {loops.get('num_loops_false', 0)}, {found['switched_off']}",
        "recall": _number(loops.get("loop_recall")),
        "exact, same places": _number(row["exact"]["ate_m"]),
        "ratio": _number(row["ate_by_exact"]),
        "exact, all within 6 m": f"{_number(row['exact_everywhere']['ate_m'])} ({row['exact_everywhere']['closures']})",
        "chi2 of chains": ", ".join(f"{k}: {_number(noise[f'chain_{k}'])}" for k in LENGTHS),
        "chi2 of closures": _number(noise["closures"]),
    }


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def main() -> None:
    parser = common.parser(__doc__, "sequences")
    parser.add_argument("runs", type=Path, nargs="+", help="folders that `segslam map` wrote, of data with true poses")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args()
    rows = [row_of(run) for run in options.runs]
    common.write_report(options.out, {"config": CONFIG.model_dump(mode="json"), "rows": rows})
    print(common.markdown("Back end", list(map(cells, rows))))


if __name__ == "__main__":
    main()
