"""Two drives round one block on two days, and one in another town, as folders in KITTI's layout."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from segslam.bench.simulation.files import prepare_folder, write_drive
from segslam.bench.simulation.tracks import Drive, example_drive, in_lane
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig
from segslam.core import geometry
from segslam.core.trajectory import Poses

STEP_M, RADIUS_M, NUM_POSES = 1.8, 18.0, 44


def write_day(
    root: Path, *, day: int, first: int, num_scans: int, seed: int = 3, without: Collection[int] = ()
) -> Path:
    """The scans `first` to `first + num_scans` of a drive round a block on a day, in another lane on another day.

    `without` leaves scans out, by their number from 0. Returns the folder that holds `sequences`; its true poses are in
    one frame for all days.
    """
    block = _block()
    driven = in_lane(block, left_m=0.5 * bool(day))
    rows = slice(first, first + num_scans)
    driven = replace(driven, T_world_lidar=driven.T_world_lidar[rows], time_s=driven.time_s[rows])
    config = SimulationConfig(
        world=WorldConfig(moving_cars=0.0, day=day), sensor=SensorConfig(name="os1-64", sweep_rotation_sigma_deg=0.0)
    )
    prepare_folder(root, "00", overwrite=False)
    only = set(range(num_scans)) - set(without)
    list(write_drive(root, "00", block, config=config, seed=seed, driven=driven, only=only))
    return root


def _block() -> Drive:
    """Half a round and more."""
    along = STEP_M * np.arange(NUM_POSES) / RADIUS_M
    poses: Poses = np.stack(
        [geometry.transform(geometry.yaw(a), [RADIUS_M * np.sin(a), -RADIUS_M * np.cos(a), 1.73]) for a in along]
    )
    return Drive(poses, 0.2 * np.arange(len(along)), example_drive(1).calib)
