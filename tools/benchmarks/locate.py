"""Single scans of another drive located in a finished run: success and false poses, where the truth of both is known.

    python -m tools.benchmarks.locate RUN DATA [--sequence 06] [--every 25] [--labels auto] [--yaws 24]

The true poses of both are in one frame, as those of two days that `segslam simulate` makes with one seed. A scan counts
if a keyframe of the run is within 10 m; found is within 2 m and 5 degrees of the true pose in its keyframe. With
`--yaws`, each scan is located at so many headings.
"""

import json
from collections import Counter, defaultdict
from itertools import product
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from segslam.core import geometry
from segslam.core.types import Rejected
from segslam.labels.label_files import computed
from segslam.output.finished import read_run
from segslam.run.locator import Locator
from segslam.scans import open_dataset
from tools.benchmarks import common
from tools.benchmarks.common import PoseError

WITHIN_M = 10.0


def main() -> None:
    parser = common.parser(__doc__, "locate")
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence", default="00")
    parser.add_argument("--every", type=int, default=25)
    parser.add_argument("--labels", default="auto")
    parser.add_argument("--yaws", type=int, default=1)
    options = parser.parse_args()
    run = read_run(options.run)
    data = open_dataset(options.data, sequence=options.sequence, labels=options.labels)
    if run.reference is None or data.reference is None:
        parser.error("the true poses of both drives are needed")
    T_of_scan, T_of_query = (
        dict(zip(reference.scan_index.tolist(), reference.T_world_lidar, strict=True))
        for reference in (run.reference, data.reference)
    )
    scans = run.result.trajectory.scan_index[run.result.keyframe_rows]
    T_keyframes = np.stack([T_of_scan[int(scan)] for scan in scans])
    locator = Locator.from_run(options.run)
    outcomes: Counter[str] = Counter()
    by_scan: defaultdict[int, Counter[str]] = defaultdict(Counter)
    seconds, cpu_seconds = [], []
    for row, turn in product(range(0, len(data), options.every), range(options.yaws)):
        scan = data[row]
        T_turned_lidar = geometry.transform(geometry.yaw(2.0 * np.pi * turn / options.yaws), np.zeros(3))
        T_true = T_of_query[int(scan.index or 0)] @ geometry.inverse(T_turned_lidar)
        near = np.linalg.norm(T_keyframes[:, :3, 3] - T_true[:3, 3], axis=1).min() <= WITHIN_M
        labels = computed(scan.labels)
        started, started_cpu = perf_counter(), process_time()
        found = locator.locate(geometry.apply(T_turned_lidar, scan.points), labels if labels.any() else None)
        seconds.append(perf_counter() - started)
        cpu_seconds.append(process_time() - started_cpu)
        if isinstance(found, Rejected):
            outcome = f"rejected: {found.reason.value}"
        else:
            T_lidar_found = geometry.inverse(T_true) @ T_keyframes[found.keyframe_id]
            error = PoseError.of(T_lidar_found @ found.alignment.fine.T_target_source)
            outcome = "found" if error.success else "false"
        outcomes[("" if near else "off the map, ") + outcome] += 1
        by_scan[int(scan.index or 0)][outcome] += 1
    counted = sum(count for name, count in outcomes.items() if not name.startswith("off"))
    figures = {
        "num_keyframes": len(T_keyframes),
        "num_scans_near": counted,
        "success": outcomes["found"] / max(counted, 1),
        "num_false": outcomes["false"] + outcomes["off the map, false"],
        "outcomes": dict(outcomes),
        "by_scan": {scan: dict(counts) for scan, counts in by_scan.items()},
        "seconds_median": float(np.median(seconds)),
        "cpu_seconds_median": float(np.median(cpu_seconds)),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
