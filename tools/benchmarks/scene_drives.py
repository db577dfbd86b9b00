"""Drives through scenes that are no streets, simulated: there, a turn on the spot, and back, with default settings.

    python -m tools.benchmarks.scene_drives [SCENE ...] [--sensors "16" "70 wide"] [--seed 0] [--out scene_drives.json]

A sensor moves 0.4 m a scan, or turns by 12 degrees, and sways by centimetres and degrees. Each row is a run of
`segslam map`. `--stride 6` leaves out scans; `--stride 0.1 --metres 12` is a slow robot on the first part of the path.
"""

import json
import math
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segslam.core import geometry
from segslam.core.types import Points
from tools.benchmarks import common
from tools.benchmarks.altered import Altered, mapped
from tools.benchmarks.scene_models import SCENES, SENSORS, continuous_path, scan_points

STEP_M, TURN_DEG, INTERVAL_S = 0.4, 12.0, 0.1
SWAY = geometry.tangent(rotation_rad=np.radians([1.2, 1.2, 2.0]), translation_m=[0.05, 0.05, 0.03])
"""Standard deviations of the sway."""
SWAY_SCANS = 6.0
NOISE_M = 0.02


def driven(name: str, sensor: str, seed: int, stride: float, most_m: float = math.inf) -> Altered:
    """A drive along the path of a scene, `most_m` or as far as it leads without a jump, and back."""
    scene = SCENES[name](seed)
    path, along_m = continuous_path(scene)
    at_m = np.arange(0.0, min(along_m[-1], most_m), STEP_M * stride)
    there = np.column_stack([np.interp(at_m, along_m, column) for column in path.T])
    turn = np.tile(there[-1], (round(180.0 / (TURN_DEG * stride)) - 1, 1))
    turn[:, 3] += np.radians(TURN_DEG * stride) * np.arange(1, len(turn) + 1)
    places = np.concatenate([there, turn, there[::-1] + np.array([0.0, 0.0, 0.0, math.pi])])
    sway = gaussian_filter1d(np.random.default_rng(seed).normal(size=(len(places), 6)), SWAY_SCANS / stride, axis=0)
    sway *= SWAY / sway.std(axis=0)
    poses = np.array(
        [
            geometry.transform(geometry.yaw(heading), at) @ geometry.exp(swayed)
            for (*at, heading), swayed in zip(places, sway, strict=True)
        ]
    )

    def points_of(number: int) -> Points:
        rng = np.random.default_rng([seed, number])
        return scan_points(scene, sensor, poses[number], noise_m=NOISE_M, rng=rng)

    return Altered(points_of, INTERVAL_S * stride * np.arange(len(poses)), poses)


def run_benchmark() -> None:
    """Print a row for each scene and sensor, and write all to a file."""
    options = common.parser(__doc__, "scene_drives")
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    options.add_argument("--sensors", nargs="+", default=["16", "70 wide"], help=", ".join(SENSORS))
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--stride", type=float, default=1.0)
    options.add_argument("--metres", type=float, default=math.inf)
    options.add_argument("--out", type=Path, default=Path("scene_drives.json"))
    given = options.parse_args()
    rows = []
    for sensor in given.sensors:
        for name in given.scenes or SCENES:
            drive = driven(name, sensor, given.seed, given.stride, given.metres)
            rows.append({"scene": name, "sensor": sensor, "scans": len(drive.stamps_s), **mapped(drive)})
            print(json.dumps(rows[-1]), flush=True)
    common.write_report(given.out, {"rows": rows})


if __name__ == "__main__":
    run_benchmark()
