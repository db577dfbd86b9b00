"""Geometric labels compared with true labels over a simulated drive with 16 and with 64 beams.

    python -m tools.benchmarks.label_maps WORK --out FILE.json [--sensor vlp16 --sensor hdl64] [--frames 346] [--seed 3]

WORK is a folder for scans and runs; existing scans and runs are reused. Both maps of a drive share one odometry.
"""

import json
from pathlib import Path
from typing import Any

from segslam.output.finished import read_metrics
from tools.benchmarks import common

KEYS = (
    *("num_scans", "num_keyframes", "num_candidates", "num_loops_accepted", "num_loops_false"),
    *("ate_m", "odometry_ate_m"),
)
AXIS_WANDER_DEG = 0.25
"""Chosen: enough error of the sensor for so short a drive to drift visibly, as in the demo."""


def mapped(data: Path, out: Path, *options: object) -> dict[str, Any]:
    """The figures of a run, made if it is not there."""
    if not (out / "metrics.json").exists():
        common.segslam("map", data, "--sequence", "00", "--out", out, *options)
    metrics = read_metrics(out)
    return {key: metrics[key] for key in KEYS if key in metrics}


def compared(work: Path, sensor: str, *, num_frames: int | None, seed: int) -> dict[str, Any]:
    """The map with true labels, the map with labels from shape, and the ratio of their errors."""
    data, true, shape = (work / f"{sensor}-{name}" for name in ("scans", "true", "shape"))
    if not (data / "poses" / "00.txt").exists():
        wander = f"sensor.axis_wander_sigma_deg={AXIS_WANDER_DEG}"
        frames = [] if num_frames is None else ["--frames", num_frames]
        common.segslam("simulate", data, "--sensor", sensor, "--seed", seed, "--set", wander, *frames, "--overwrite")
    with_true = mapped(data, true, "--labels", "labels")
    with_shape = mapped(data, shape, "--labels", "geometric", "--odometry", true / "odometry_tum.txt")
    ratio = with_shape["ate_m"] / with_true["ate_m"]
    return {"true": with_true, "shape": with_shape, "ate_ratio": round(ratio, 3)}


def main() -> None:
    parser = common.parser(__doc__, "label_maps")
    parser.add_argument("work", type=Path)
    parser.add_argument("--sensor", action="append", help="hdl64, os1-64 or vlp16; may be repeated")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    results = {
        sensor: compared(options.work, sensor, num_frames=options.frames, seed=options.seed)
        for sensor in options.sensor or ("vlp16", "hdl64")
    }
    common.write_report(options.out, results)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
