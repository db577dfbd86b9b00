"""Keyframes of a real drive (NCLT) recognised among the older ones, with no prior.

    python -m tools.benchmarks.recognition DATA [--queries 473:560] [--every 1] [--left-out 50]

DATA is the folder of real data with `nclt/`. Each query is a submap of 11 scans, and so is each place; the last metres
of travel before a query are left out. Found is within 2 m and 5 degrees of the optimised poses.
"""

import json
from collections import Counter
from pathlib import Path
from time import process_time

import numpy as np

from segslam.candidates import Places, signature_of, signatures_around
from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.trajectory import travelled_m
from segslam.core.types import Rejected
from segslam.slam.recognition import MAX_PLACES, recognise
from tools.benchmarks import common
from tools.benchmarks.common import PoseError
from tools.benchmarks.submaps import Submaps

NEAR_M = 10.0
"""A query counts if there is an older place this near; a pose that is farther off is wrong."""


def main() -> None:
    parser = common.parser(__doc__, "recognition")
    parser.add_argument("data", type=Path)
    parser.add_argument("--queries", default="473:560")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--left-out", type=float, default=50.0, help="travel before a query without places (m)")
    options = parser.parse_args()
    config = load_config()
    submaps = Submaps(options.data / "nclt", config)
    at = submaps.T_world_lidar[:, :3, 3]
    travel_m = travelled_m(submaps.T_world_lidar)
    first, end = map(int, options.queries.split(":"))
    index = Places()
    for row in range(end):
        points = submaps.cloud(row)
        index.add(row, signature_of(points, np.zeros(len(points), np.uint8)))
    outcomes: Counter[str] = Counter()
    ranks, seconds = [], []
    for row in range(first, end, options.every):
        num_old = int(np.searchsorted(travel_m, travel_m[row] - options.left_out, side="right"))
        revisits = np.linalg.norm(at[:num_old] - at[row], axis=1).min() <= NEAR_M
        points = submaps.cloud(row)
        labels = np.zeros(len(points), np.uint8)
        query = submaps.prepared(row)
        started = process_time()
        own = signature_of(points, labels)
        shortlist = index.shortlist(own, below_id=num_old)
        near = (k for k, one in enumerate(shortlist) if np.linalg.norm(at[one.place_id] - at[row]) < NEAR_M)
        ranks.append(next(near, None))
        world = submaps.T_world_lidar.__getitem__
        found = recognise(query, shortlist, submaps.prepared, world, config=config, max_places=3)
        if isinstance(found, Rejected):
            around = signatures_around(points, labels)
            shortlist = index.shortlist_around((own, *around), below_id=num_old)
            found = recognise(query, shortlist, submaps.prepared, world, config=config, max_places=MAX_PLACES)
        seconds.append(process_time() - started)
        if isinstance(found, Rejected):
            outcome = f"rejected: {found.reason.value}"
        else:
            error = PoseError.of(geometry.inverse(submaps.T_world_lidar[row]) @ found.T_world_lidar)
            outcome = "found" if error.success else ("wrong" if error.translation_m > NEAR_M else "off")
        outcomes[("" if revisits else "no revisit, ") + outcome] += 1
    figures = {
        "queries": len(ranks),
        "outcomes": dict(outcomes),
        "recall_at_1": float(np.mean([rank == 0 for rank in ranks])),
        "recall_at_20": float(np.mean([rank is not None for rank in ranks])),
        "cpu_seconds_median": float(np.median(seconds)),
    }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
