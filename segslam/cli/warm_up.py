"""`segslam warm-up`."""

from typing import TYPE_CHECKING

from segslam.cli.console import JsonOption, QuietOption, print_json, say

if TYPE_CHECKING:
    from segslam.types import Points

NUM_POLES = 16
SIGHT_M = 30.0


def warm_up(json: JsonOption = False, quiet: QuietOption = False) -> None:
    """Compile what is compiled on first use, so that the first run does not wait for it: after installing, in an image.

    Compiled code is kept beside the package, or in NUMBA_CACHE_DIR where that cannot be written.

    Example: segslam warm-up
    """
    from time import perf_counter

    import numpy as np

    from segslam.config import load_config
    from segslam.slam import Slam
    from segslam.types import Scan

    started = perf_counter()
    slam = Slam(load_config(None, ["proximity.min_travel_m=0", "keyframes.distance_m=0.1", "verify.min_overlap=0"]))
    for index in range(3):
        points = _street_seen_from(0.5 * index)
        slam.process(Scan(index, index * 100_000_000, points, np.zeros(len(points), np.uint8)))
    result = slam.finish()
    seconds, num_tried = perf_counter() - started, len(result.attempts)
    if json:
        print_json({"seconds": seconds, "num_loops_tried": num_tried})
    else:
        say(f"ready in {seconds:.1f} s; {num_tried} loops were tried", quiet=quiet)


def _street_seen_from(x: float) -> "Points":
    """A flat street with poles and two walls; the sensor is `x` along it and 1.7 m high."""
    import numpy as np

    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-SIGHT_M, SIGHT_M, (20_000, 2)), np.full(20_000, -1.7)])
    feet = rng.uniform(-0.6 * SIGHT_M, 0.6 * SIGHT_M, (NUM_POLES, 1, 2)) + rng.uniform(-0.05, 0.05, (NUM_POLES, 80, 2))
    poles = np.concatenate([feet, np.broadcast_to(np.linspace(-1.7, 1.5, 80)[:, None], (NUM_POLES, 80, 1))], axis=2)
    along, up = rng.uniform(-SIGHT_M, SIGHT_M, 10_000), rng.uniform(-1.7, 4.0, 10_000)
    walls = np.column_stack([along, np.where(np.arange(10_000) % 2, 20.0, -20.0), up])
    return (np.concatenate([ground, poles.reshape(-1, 3), walls]) - [x, 0.0, 0.0]).astype(np.float32)
