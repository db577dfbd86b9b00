"""Back end on whole drives: errors, closures, comparison with exact closures, calibration of edges.

Odometry and closures come from each run's log, so one run of `segslam map` is sufficient for many settings. The found
closures are compared with exact ones: at the same places, and for all keyframes within 6 m of each other.

    segslam simulate D --sequence 06 --poses 06.txt --seed 11 --set sensor.vertical_angle_error_deg=0.35
    segslam map D --sequence 06 --out runs/06
    python -m tools.benchmarks.sequences runs/06 --out sequences.json
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.evaluation import trajectory_metrics
from segslam.core.types import LoopClosure
from segslam.graph import PoseGraph
from tools.benchmarks import common
from tools.benchmarks.back_end.drives import CONFIG, exact
from tools.benchmarks.back_end.recorded import (
    Recorded,
    closure_calibration,
    exact_everywhere,
    odometry_calibration,
    read_recorded,
)

FIGURES = ("ate_m", "height_m", "kitti_translation_percent")


def finished(drive: Recorded, closures: list[LoopClosure]) -> dict[str, Any]:
    """Errors after the final optimisation with these closures."""
    graph = PoseGraph(CONFIG.graph)
    for keyframe in drive.keyframes:
        graph.add_keyframe(keyframe.id, keyframe.T_odom_keyframe, keyframe.travel_m)
    for closure in closures:
        graph.add_closure(closure)
    started = time.perf_counter()
    rejected = graph.finish().rejected
    seconds = time.perf_counter() - started
    return {**errors(graph.T_world_keyframes, drive), "switched_off": len(rejected), "seconds": seconds}


def errors(poses: np.ndarray, drive: Recorded) -> dict[str, float]:
    """Of keyframes."""
    metrics = trajectory_metrics(poses, drive.truth)
    return {name: metrics[name] for name in FIGURES if name in metrics}


def row_of(run: Path) -> dict[str, Any]:
    """All figures of one run."""
    drive = read_recorded(run)
    row: dict[str, Any] = {
        "run": f"{run.parent.name}/{run.name}",
        "keyframes": len(drive.keyframes),
        "travel_m": float(drive.travel_m[-1]),
        "odometry": errors(drive.odometry, drive),
        "loops": drive.loops(),
        "noise": {**odometry_calibration(drive), "closures": closure_calibration(drive, drive.closures)},
    }
    kinds = {
        "found": drive.closures,
        "exact": exact(drive.closures, drive.truth),
        "exact_everywhere": exact_everywhere(drive),
    }
    for name, closures in kinds.items():
        row[name] = {"closures": len(closures), **finished(drive, closures)}
    row["ate_by_exact"] = row["found"]["ate_m"] / row["exact"]["ate_m"]
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows for a reader, ATE in metres of keyframes."""
    lines = [
        "| run | odometry | ATE | height | KITTI % | closures, false, off | recall | exact, same places | ratio "
        "| exact, all within 6 m | chi2 of chains 1, 10, 100; closures |",
        "|" + "---|" * 11,
    ]
    for row in rows:
        found, loops, noise = row["found"], row["loops"], row["noise"]
        cells = [
            row["run"],
            _number(row["odometry"]["ate_m"]),
            _number(found["ate_m"]),
            _number(found.get("height_m")),
            _number(found.get("kitti_translation_percent")),
            f"{loops['closures']}, {loops['num_loops_false']}, {found['switched_off']}",
            _number(loops.get("loop_recall")),
            _number(row["exact"]["ate_m"]),
            _number(row["ate_by_exact"]),
            f"{_number(row['exact_everywhere']['ate_m'])} ({row['exact_everywhere']['closures']})",
            f"{', '.join(_number(noise[f'chain_{k}']) for k in (1, 10, 100))}; {_number(noise['closures'])}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def main() -> None:
    parser = common.parser(__doc__, "sequences")
    parser.add_argument("runs", type=Path, nargs="+", help="folders that `segslam map` wrote, of data with true poses")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args()
    rows = [row_of(run) for run in options.runs]
    common.write_report(options.out, {"config": CONFIG.model_dump(mode="json"), "rows": rows})
    print(table(rows))


if __name__ == "__main__":
    main()
