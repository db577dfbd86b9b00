"""A LiDAR that is carried and swings, simulated: points measured one after the other, with times; default settings.

    python -m tools.benchmarks.carried [SCENE ...] [--sensor 16] [--swing walk shake] [--seed 0] [--out carried.json]

A person walks along the path of a scene, turns, and walks back, for 30 s. Each row is a run of `segslam map`.
"""

import json
import math
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from segslam.bench.simulation.world import rays_of
from segslam.core import geometry
from segslam.core.types import Transform
from segslam.output.finished import read_run
from tools.benchmarks import common
from tools.benchmarks.altered import FIGURES
from tools.benchmarks.scene_models import SCENES, SENSORS, Scene, beams_of, continuous_path, measured

NUM_SCANS, INTERVAL_S, NUM_PARTS = 300, 0.1, 40
SPEED_M_S, TURN_S, NOISE_M = 1.4, 2.0, 0.02
SWINGS = {"calm": (2.0, 0.5, 5.0, 0.3), "walk": (8.0, 0.7, 25.0, 0.4), "shake": (20.0, 0.8, 50.0, 0.6)}
"""Amplitude (degrees) and frequency (Hz) of roll and pitch, and of the heading."""
SWAY_M, SWAY_HZ = np.array([0.08, 0.08, 0.05]), np.array([0.9, 0.9, 1.8])
HEADER = """VERSION 0.7
FIELDS x y z t
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {num}
HEIGHT 1
POINTS {num}
DATA binary
"""


def walked(scene: Scene, swing: str, seed: int) -> Callable[[float], Transform]:
    """The pose of the sensor in the world at a time (s)."""
    path, along_m = continuous_path(scene)
    columns = [*path[:, :3].T, np.unwrap(path[:, 3])]
    turn_s = min(along_m[-1] / SPEED_M_S, (NUM_SCANS * INTERVAL_S - TURN_S) / 2)
    rng = np.random.default_rng(seed)
    phase, faster = rng.uniform(0.0, 2.0 * math.pi, 6), rng.uniform(0.9, 1.1, 6)
    tilt_deg, tilt_hz, heading_deg, heading_hz = SWINGS[swing]
    amplitude = geometry.tangent(rotation_rad=np.radians([tilt_deg, tilt_deg, heading_deg]), translation_m=SWAY_M)
    hz = faster * [tilt_hz, 0.8 * tilt_hz, heading_hz, *SWAY_HZ]

    def pose(time_s: float) -> Transform:
        turned = min(max((time_s - turn_s) / TURN_S, 0.0), 1.0)
        walked_s = min(time_s, turn_s) - max(time_s - turn_s - TURN_S, 0.0)
        *at, heading = (np.interp(SPEED_M_S * walked_s, along_m, column) for column in columns)
        swung = amplitude * np.sin(2.0 * math.pi * hz * time_s + phase)
        return geometry.transform(geometry.yaw(heading + math.pi * turned), np.array(at)) @ geometry.exp(swung)

    return pose


def write_drive(folder: Path, name: str, sensor: str, swing: str, seed: int) -> None:
    """Scans as PCD files with times of the points, and the poses at the end of each sweep."""
    scene = SCENES[name](seed)
    pose = walked(scene, swing, seed)
    turns, half = SENSORS[sensor][0] > 0, math.radians(SENSORS[sensor][2]) / 2
    for number in range(NUM_SCANS):
        rng = np.random.default_rng([seed, number])
        beams = beams_of(sensor, rng)
        time = (np.arctan2(beams[:, 1], beams[:, 0]) / half + 1.0) / 2.0 if turns else rng.random(len(beams))
        part = np.minimum(time * NUM_PARTS, NUM_PARTS - 1).astype(int)
        rays = np.empty((len(beams), 6), np.float32)
        for k in range(NUM_PARTS):
            now_s = INTERVAL_S * (number + (k + 0.5) / NUM_PARTS)
            rays[part == k] = rays_of(pose(now_s), beams[part == k])
        points, seen = measured(scene, beams, rays, noise_m=NOISE_M, rng=rng)
        rows = np.column_stack([points, INTERVAL_S * (part[seen] + 0.5) / NUM_PARTS]).astype("<f4")
        (folder / f"{number:06d}.pcd").write_bytes(HEADER.format(num=len(rows)).encode() + rows.tobytes())
    np.savetxt(folder / "times.txt", INTERVAL_S * np.arange(NUM_SCANS), fmt="%.6f")
    ends = np.array([pose(INTERVAL_S * (number + 1)) for number in range(NUM_SCANS)])
    np.savetxt(folder / "poses.txt", ends[:, :3].reshape(-1, 12), fmt="%.9g")


def run_benchmark() -> None:
    """Print a row for each scene and swing, and write all to a file."""
    options = common.parser(__doc__, "carried")
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    options.add_argument("--sensor", default="16", choices=SENSORS)
    options.add_argument("--swing", nargs="+", default=["walk", "shake"], choices=SWINGS)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", type=Path, default=Path("carried.json"))
    given = options.parse_args()
    figures = []
    for name in given.scenes or SCENES:
        for swing in given.swing:
            with TemporaryDirectory() as folder:
                drive = Path(folder) / "drive"
                drive.mkdir()
                write_drive(drive, name, given.sensor, swing, given.seed)
                common.segslam("map", drive, "--out", f"{folder}/run")
                metrics = read_run(Path(folder) / "run").metrics
            row = {"scene": name, "sensor": given.sensor, "swing": swing, "seed": given.seed}
            figures.append(row | {key: metrics.get(key) for key in ("kiss_icp_ate_m", *FIGURES)})
            print(json.dumps(figures[-1]), flush=True)
    common.write_report(given.out, {"rows": figures})


if __name__ == "__main__":
    run_benchmark()
