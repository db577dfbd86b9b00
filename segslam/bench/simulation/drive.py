"""Sweeps along a drive through a simulated world. A sweep depends only on the seed and its own number."""

from collections.abc import Collection, Iterator

import numpy as np

from segslam.bench.simulation.drift import sweep_errors
from segslam.bench.simulation.sensor import Sweep, make_sensor, sweep
from segslam.bench.simulation.world import World, build_world
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig
from segslam.core.trajectory import Poses
from segslam.core.types import Scan, Vector


def simulate_drive(
    T_world_lidar: Poses, time_s: Vector, *, seed: int = 0, config: SimulationConfig | None = None
) -> Iterator[Scan]:
    """Labelled scans from level poses (n, 4, 4) at the times `time_s` (n,), ascending.

    `drive_sweeps` also returns intensities and instances.
    """
    config = config or SimulationConfig()
    world = build_world(T_world_lidar, time_s, config=config.world, seed=seed)
    for index, one in enumerate(drive_sweeps(world, T_world_lidar, time_s, config=config.sensor, seed=seed)):
        yield one.scan(index=index, stamp_ns=round(time_s[index] * 1e9))


def drive_sweeps(
    world: World,
    T_world_lidar: Poses,
    time_s: Vector,
    *,
    config: SensorConfig,
    seed: int,
    only: Collection[int] | None = None,
) -> Iterator[Sweep]:
    """The sweeps of a drive through a world, in order; only the numbers in `only`, if given.

    The sensor is the same on each simulated day; its noise differs.
    """
    sensor = make_sensor(config, seed=seed)
    days = [world.day] if world.day else []
    errors = sweep_errors(time_s, config=config, rng=np.random.default_rng([seed, 3, *days]))
    for index, (T_world_now, now, error) in enumerate(zip(T_world_lidar, time_s, errors, strict=True)):
        if only is not None and index not in only:
            continue
        rng = np.random.default_rng([seed, 4, index, *days])
        yield sweep(world, sensor, T_world_now, rng=rng, time_s=float(now), error=error)
