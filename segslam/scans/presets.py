"""Settings for kinds of environments: street, campus, indoor."""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from segslam.core.config import Config, load_config
from segslam.core.points import voxel_first, within_range
from segslam.core.types import BadScan, Points, Transform
from segslam.scans import Dataset
from segslam.scans.kitti import VERTICAL_ANGLE_DEG

Preset = Literal["driving", "campus", "indoor"]
SETTINGS: Mapping[Preset, tuple[str, ...]] = {
    "driving": (),
    "campus": ("proximity.min_travel_m=25",),
    "indoor": (
        "odometry.voxel_size_m=0.4",
        "odometry.min_range_m=0.5",
        "odometry.max_range_m=40",
        "keyframes.distance_m=1",
        "proximity.min_travel_m=20",
    ),
}
"""Differences from the defaults, which are for driving. Chosen on `courtyard` and a simulated office (indoor) and on
NCLT (campus): ATE 0.022 instead of 0.030 m, 0.020 instead of 0.028 m, and 0.20 instead of 0.22 to 0.35 m."""
LARGEST_M: Mapping[Preset, float] = {"indoor": 12.0, "campus": 17.0}
"""Chosen: largest `extent_m` of such an environment. Measured: office 7 m, courtyard 10 m, NCLT 14 m, KITTI 00 20 m,
and 23 to 30 m along the simulated 06."""
VOXEL_M = 0.5
FARTHEST_M = Config().odometry.max_range_m
"""Points beyond the sensor's range, which is that of the odometry by default, are no surfaces."""
NUM_SCANS = 9
"""Chosen: number of scans examined, spread over the recording; about 20 ms each."""
SEQUENTIAL_SCANS = 80
"""Chosen: number of scans read from the start of a recording without random access."""


def preset(name: Preset) -> Config:
    """The defaults with the settings of a preset."""
    return load_config(None, SETTINGS[name])


def defaults_in_effect(config: Config, T_camera_lidar: Transform | None) -> Config:
    """The defaults that were in effect in a run with these settings; KITTI's data has a calibration."""
    if config.sensor.vertical_angle_deg is None:  # not the settings in effect
        return Config()
    angle_deg = 0.0 if T_camera_lidar is None else VERTICAL_ANGLE_DEG
    return load_config(None, [f"sensor.vertical_angle_deg={angle_deg}"])


def preset_for(extent_m: float | None) -> Preset:
    """The preset for surfaces at this median distance; `driving` if it is unknown."""
    names = [name for name, largest_m in LARGEST_M.items() if extent_m is not None and extent_m <= largest_m]
    return names[0] if names else "driving"


def extent_m(scans: Dataset) -> float | None:
    """Median horizontal distance (m) of the surfaces around the sensor; None if no scan can be used.

    The median is over scans spread evenly over the data set, or over its start if it can only be read in order.
    """
    medians_m: list[float] = []
    last = min(len(scans), SEQUENTIAL_SCANS) if scans.is_sequential else len(scans)
    for row in np.unique(np.linspace(0, last - 1, NUM_SCANS).astype(int)).tolist():
        try:
            median_m = extent_of(scans[row].points)
        except BadScan:
            continue  # reported when the scan is mapped
        if median_m is not None:
            medians_m.append(median_m)
    return float(np.median(medians_m)) if medians_m else None


def extent_of(points: Points) -> float | None:
    """Median horizontal distance (m) of the surfaces of one scan in the LiDAR frame; None without usable points."""
    near = points[within_range(points, 0.0, FARTHEST_M)]
    distance_m = np.linalg.norm(near[voxel_first(near, VOXEL_M), :2], axis=1)
    return float(np.median(distance_m)) if len(distance_m) > 0 else None
