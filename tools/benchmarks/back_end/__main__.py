"""Benchmark of the back end on real trajectories, without scans: proposals, graph, outliers, time.

If two keyframes are within reach of each other in the (levelled) ground truth, their closure is the true pose with
noise; otherwise there is none. Outliers are a share of all closures. Each result is compared with that of exact
closures.

    python -m tools.benchmarks.back_end ../shared/data --out back_end.json --sequence 00 --sequence 08 --seeds 3
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tools.benchmarks import common
from tools.benchmarks.back_end.drives import CONFIG, exact, read_drive
from tools.benchmarks.back_end.outliers import KINDS, draw_outliers, finished
from tools.benchmarks.back_end.search import search

SHARES = (0.3, 0.7)


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
    row["without_outliers"] = finished(drive, true, [])
    row["exact_closures"] = finished(drive, exact(true, drive.truth), [])
    row["ate_by_exact"] = row["without_outliers"]["ate_m"] / row["exact_closures"]["ate_m"]
    row["outliers"] = []
    for kind in KINDS if true else ():
        for share in shares:
            rng = np.random.default_rng([seed, 2, round(100 * share)])
            result = finished(drive, true, draw_outliers(drive, kind, round(len(true) * share / (1.0 - share)), rng))
            ratio = result["ate_m"] / row["without_outliers"]["ate_m"]
            row["outliers"].append({"kind": kind, "share": share, "ate_ratio": ratio, **result})
    return row


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
