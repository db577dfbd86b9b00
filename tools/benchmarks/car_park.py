"""Drives up a car park whose storeys look the same, simulated, with default settings.

    python -m tools.benchmarks.car_park [--storeys 5] [--cars same] [--back] [--sensor 16] [--seed 1]

Half of each storey is level, half is a ramp to the next one, 3 m higher; a round is 130 m long. The walls and pillars
of all storeys are the same, with `--cars same` also their cars. Without `--back` no place is visited twice: each loop
is false.
"""

import json
import math
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from segslam.bench.simulation.mesh import Mesh, box, mesh, placed
from segslam.bench.simulation.objects import car
from segslam.core import geometry
from segslam.core.types import Label, Points
from tools.benchmarks import common
from tools.benchmarks.altered import Altered, mapped
from tools.benchmarks.scene_drives import NOISE_M, SWAY, SWAY_SCANS, TURN_DEG
from tools.benchmarks.scene_models import SENSORS, scan_points
from tools.benchmarks.scene_parts import Scene, lifted, scene_of_parts, slab, wall

STOREY_M, LENGTH_M, WIDTH_M = 3.0, 64.0, 34.0
RAMP = (10.0, 54.0, 17.0, 34.0)
"""Its extent in x and y; it falls along x."""
STEP_M, SENSOR_M = 0.8, 1.8
CORNERS = ((8.0, 8.4, 0), (54.0, 8.4, 0), (57.0, 9.5, 0), (58.5, 12.0, 0), (58.5, 22.0, 0), (57.0, 24.5, 0))
CORNERS_ABOVE = ((10.0, 25.6, 1), (7.0, 24.5, 1), (5.5, 22.0, 1), (5.5, 12.0, 1), (6.3, 9.5, 1))
ROUND = (*CORNERS, (54.0, 25.6, 0), *CORNERS_ABOVE)
"""x and y of a round (m), and whether the ramp is below."""


def _height(x: float, y: float) -> float:
    """Of the floor above that of the storey (m)."""
    first, last, low, _ = RAMP
    return STOREY_M * float(np.clip((last - x) / (last - first), 0.0, 1.0)) if y > low else 0.0


def _storey(rng: np.random.Generator) -> list[Mesh]:
    first, last, low, high = RAMP
    ramp = np.array([[first, low, STOREY_M], [last, low, 0.0], [last, high, 0.0], [first, high, STOREY_M]])
    parts = [
        slab(0.0, LENGTH_M, 0.0, low, 0.0, Label.OTHER_GROUND),
        slab(last, LENGTH_M, low, high, 0.0, Label.OTHER_GROUND),
        slab(0.0, first, low, high, STOREY_M, Label.OTHER_GROUND),
        mesh(ramp, np.array([[0, 1, 2], [0, 2, 3]]), Label.OTHER_GROUND),
        wall([(0.0, high), (0.0, 0.0), (LENGTH_M, 0.0), (LENGTH_M, high)], 1.1),
        wall([(10.0, 17.2), (26.0, 17.2)], 2.85),
        wall([(38.0, 17.2), (54.0, 17.2)], 2.85),
        box(4.0, 3.0, 0.0, 2.9, Label.BUILDING, at=(32.0, 1.5)),
    ]
    pillar = box(0.5, 0.5, 0.0, 2.95, Label.BUILDING)
    for y in (5.5, 11.5, 22.5, 28.5):
        parts += [placed(pillar, x, y, _height(x, y)) for x in np.arange(16.0, 54.0, 8.0)]
    for y in (2.7, 14.2, 19.8, 31.3):
        parts += [
            placed(car(rng), x, y + rng.normal(0.0, 0.15), _height(x, y), yaw_rad=rng.choice([-0.5, 0.5]) * math.pi)
            for x in np.arange(12.0, 53.0, 2.6)
            if rng.random() < 0.45 and not 29.0 < x < 35.0
        ]
    return parts


def car_park(num_storeys: int, *, same_cars: bool, seed: int) -> Scene:
    """The building, and the path up through it."""
    parts = [slab(-60.0, 120.0, -60.0, 90.0, -0.02, Label.OTHER_GROUND)]
    for storey in range(num_storeys + 1):
        rng = np.random.default_rng(seed if same_cars else [seed, storey])
        parts += [lifted(part, STOREY_M * storey) for part in _storey(rng)]
    corners = [(x, y, STOREY_M * (storey + above)) for storey in range(num_storeys) for x, y, above in ROUND]
    return scene_of_parts(parts, _smooth(np.array(corners[: -len(CORNERS_ABOVE)])), 10.0)


def _smooth(corners: np.ndarray) -> np.ndarray:
    """Positions and headings, as of `Scene.path`, every 0.1 m along a line with round corners."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.column_stack([np.interp(np.arange(0.0, along_m[-1], 0.1), along_m, column) for column in corners.T])
    at = gaussian_filter1d(at, 12.0, axis=0, mode="nearest")
    ahead = np.gradient(at, axis=0)
    return np.column_stack([at, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))])


def driven(scene: Scene, sensor: str, seed: int, *, is_back: bool) -> Altered:
    """The drive up, and down again if `is_back`. The sensor pitches with the ramp and sways."""
    slope = np.gradient(scene.path[:, :3], axis=0)
    pitch = -np.arctan2(slope[:, 2], np.hypot(slope[:, 0], slope[:, 1]))
    up = np.column_stack([scene.path, pitch])[:: round(STEP_M / 0.1)]
    turn = np.tile(up[-1], (round(180.0 / TURN_DEG) - 1, 1))
    turn[:, 3] += np.radians(TURN_DEG) * np.arange(1, len(turn) + 1)
    down = up[::-1] * [1.0, 1.0, 1.0, 1.0, -1.0] + [0.0, 0.0, 0.0, math.pi, 0.0]
    places = np.concatenate([up, turn, down]) if is_back else up
    sway = gaussian_filter1d(np.random.default_rng(seed).normal(size=(len(places), 6)), SWAY_SCANS, axis=0)
    sway *= SWAY / sway.std(axis=0)
    poses = np.array(
        [
            geometry.transform(geometry.yaw(heading), [x, y, z + SENSOR_M])
            @ geometry.exp(geometry.tangent(rotation_rad=[0.0, tilt, 0.0], translation_m=0.0))
            @ geometry.exp(swayed)
            for (x, y, z, heading, tilt), swayed in zip(places, sway, strict=True)
        ]
    )

    def points_of(number: int) -> Points:
        rng = np.random.default_rng([seed, number])
        return scan_points(scene, sensor, poses[number], noise_m=NOISE_M, rng=rng)

    return Altered(points_of, 0.1 * np.arange(len(poses)), poses)


def run_benchmark() -> None:
    """Print the figures of one drive, and write them to a file."""
    options = common.parser(__doc__, "car_park")
    options.add_argument("--storeys", type=int, default=5)
    options.add_argument("--cars", choices=("same", "different"), default="same")
    options.add_argument("--back", action="store_true")
    options.add_argument("--sensor", default="16", choices=tuple(SENSORS))
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--out", type=Path, default=Path("car_park.json"))
    given = options.parse_args()
    scene = car_park(given.storeys, same_cars=given.cars == "same", seed=given.seed)
    drive = driven(scene, given.sensor, given.seed, is_back=given.back)
    row = {"storeys": given.storeys, "cars": given.cars, "scans": len(drive.stamps_s), **mapped(drive)}
    print(json.dumps(row), flush=True)
    common.write_report(given.out, {"rows": [row]})


if __name__ == "__main__":
    run_benchmark()
