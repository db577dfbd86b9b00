"""Simulated labelled street scenes and LiDAR sensors; writes sequences in KITTI format with exact ground truth."""

from segslam.bench.simulation.files import prepare_folder, write_drive, write_sequence
from segslam.bench.simulation.sensor import SweepError, drive_sweeps, make_sensor, sweep, sweep_errors
from segslam.bench.simulation.tracks import Drive, example_drive, in_lane, level_revisits, level_world, read_drive
from segslam.bench.simulation.world import build_world
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig, simulation_config

__all__ = [
    "Drive",
    "SensorConfig",
    "SimulationConfig",
    "SweepError",
    "WorldConfig",
    "build_world",
    "drive_sweeps",
    "example_drive",
    "in_lane",
    "level_revisits",
    "level_world",
    "make_sensor",
    "prepare_folder",
    "read_drive",
    "simulation_config",
    "sweep",
    "sweep_errors",
    "write_drive",
    "write_sequence",
]
