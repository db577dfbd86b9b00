"""Simulated labelled street scenes and LiDAR sensors; writes sequences in KITTI format with exact ground truth."""

from segslam.simulation.drift import SweepError, sweep_errors
from segslam.simulation.drive import drive_sweeps, simulate_drive
from segslam.simulation.files import prepare_folder, write_drive, write_sequence
from segslam.simulation.label_errors import LabelErrorConfig, network_like
from segslam.simulation.levelling import level, upright
from segslam.simulation.routes import made_up_loop
from segslam.simulation.sensor import Sensor, Sweep, make_sensor, sweep
from segslam.simulation.tracks import Drive, in_lane, made_up_drive, read_drive
from segslam.simulation.world import Hits, World, build_world
from segslam.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig, simulation_config

__all__ = [
    "Drive",
    "Hits",
    "LabelErrorConfig",
    "Sensor",
    "SensorConfig",
    "SimulationConfig",
    "Sweep",
    "SweepError",
    "World",
    "WorldConfig",
    "build_world",
    "drive_sweeps",
    "in_lane",
    "level",
    "made_up_drive",
    "made_up_loop",
    "make_sensor",
    "network_like",
    "prepare_folder",
    "read_drive",
    "simulate_drive",
    "simulation_config",
    "sweep",
    "sweep_errors",
    "upright",
    "write_drive",
    "write_sequence",
]
