"""Share of moving and of static points that a map omits: a simulated run compared with its true labels.

Moving classes are hidden from the map first, so that the views of other keyframes alone decide:

    python -m tools.benchmarks.map RUN DATA --sequence 06 --out figures.json
"""

import json
import resource
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
from open3d.io import read_point_cloud
from scipy.spatial import cKDTree

from segslam import open_dataset
from segslam.bench.labelling import STILL
from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.types import Keyframe, Label, Transform
from segslam.labels.label_files import computed
from segslam.output.log import read_log
from segslam.output.map.write import write_map
from tools.benchmarks import common


def main() -> None:
    """Make the map and print one JSON object."""
    parser = common.parser(__doc__, "map")
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence", default="00")
    common.add_settings(parser)
    parser.add_argument("--every", type=int, default=4, help="look at the points of every n-th keyframe")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    log = read_log(given.run / "log.mcap")
    config = load_config(None, given.set, base=log.config)
    result = log.result()
    if result is None:
        parser.error(f"{given.run}: the run did not finish")
    T_world_keyframe = result[0].T_world_keyframe

    def placed() -> Iterator[tuple[Keyframe, Transform]]:
        for step in log.steps():
            if step.keyframe is not None:
                hidden = replace(step.keyframe, labels=STILL[step.keyframe.labels])
                yield hidden, T_world_keyframe[hidden.id]

    started = perf_counter()
    with TemporaryDirectory() as folder:
        cloud = Path(folder) / "map.ply"
        summary = write_map(placed(), [cloud], config=config.map)
        points = np.asarray(read_point_cloud(cloud).points)
    seconds = perf_counter() - started
    kept = np.unique(_cells(points, config.map.voxel_m))
    counts: Counter[str] = Counter()
    scans = open_dataset(given.data, sequence=given.sequence)
    row_of_scan = {int(number): row for row, number in enumerate(scans.scan_index)}
    for keyframe, T in islice(placed(), 0, None, given.every):
        scan = scans[row_of_scan[keyframe.scan_index]]
        near = np.linalg.norm(keyframe.points, axis=1) < config.map.max_range_m
        distance_m, match = cKDTree(scan.points).query(keyframe.points[near])
        if distance_m.max() > 0.02:
            parser.error(f"{given.data}: scan {scan.index} is not the one that the run mapped")
        moves = computed(scan.labels)[match] >= Label.MOVING_CAR
        world = geometry.apply(T, keyframe.points[near].astype(np.float64))
        in_map = np.isin(_cells(world, config.map.voxel_m), kept)
        counts.update(moving=int(moves.sum()), moving_left=int((moves & in_map).sum()))
        counts.update(standing=int((~moves).sum()), standing_lost=int((~moves & ~in_map).sum()))
    figures = {
        "settings": config.map.model_dump(mode="json"),
        "num_keyframes": len(T_world_keyframe),
        "num_map_points": summary["num_map_points"],
        **counts,
        "moving_removed_percent": 100 * (1 - counts["moving_left"] / max(counts["moving"], 1)),
        "standing_lost_percent": 100 * counts["standing_lost"] / counts["standing"],
        "seconds": seconds,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if given.out:
        common.write_report(given.out, figures)
    print(json.dumps(figures, indent=2))


def _cells(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """A number for the voxel of each point."""
    return (np.floor(points / voxel_m).astype(np.int64) + 2**19) @ np.array([2**42, 2**21, 1])


if __name__ == "__main__":
    main()
