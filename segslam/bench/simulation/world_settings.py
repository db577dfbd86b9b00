"""Settings of the simulated street world and of its sensor."""

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from segslam.core.config import Section, validated, with_overrides

SensorName = Literal["hdl64", "os1-64", "vlp16"]


class WorldConfig(Section):
    """Objects along the streets. Densities are per 100 m and side; objects that do not fit are omitted."""

    cars: float = Field(5.0, ge=0, le=16, description="parked cars")
    trees: float = Field(7.0, ge=0, le=30, description="trees beside the road")
    lamps: float = Field(2.5, ge=0, le=20, description="street lamps")
    signs: float = Field(2.5, ge=0, le=20, description="traffic signs")
    clutter: float = Field(2.0, ge=0, le=20, description="bins, switch boxes and similar objects without a class")
    built: float = Field(0.75, ge=0, le=1, description="share of the lots with a building")
    courts: float = Field(0.6, ge=0, le=3, description="paved courts with parked cars, between the houses")
    shrubs: float = Field(1.0, ge=0, le=3, description="bushes and trees on the lots, relative to the default number")
    hedged: float = Field(0.6, ge=0, le=1, description="share of the lots with a hedge towards the street")
    fenced: float = Field(0.2, ge=0, le=1, description="share of the lots with a fence towards the street")
    equal_tree_rows: bool = Field(
        False, description="identical trees at equal distances, so that all places look the same"
    )
    parked_cars_gone: float = Field(
        0.0, ge=0, le=1, description="share of the parking places whose car differs or is missing at a later visit"
    )
    day: int = Field(
        0, ge=0, description="day of the drive: streets are the same on all days, parked and moving cars differ"
    )
    moving_cars: float = Field(1.0, ge=0, le=10, description="moving cars per 100 m of the drive")
    sensor_height_m: float = Field(1.73, gt=0, description="height of the sensor above the road (m); default: KITTI's")


class SensorConfig(Section):
    """The sensor and its errors. A sigma of 0 switches an error off."""

    name: SensorName = "hdl64"
    range_sigma_m: float = Field(0.02, ge=0, description="noise of each range (m)")
    dropout: float = Field(0.02, ge=0, lt=1, description="share of the returns lost at random")
    beam_angle_sigma_deg: float = Field(
        0.02, ge=0, description="residual calibration error of each beam's vertical angle (degrees)"
    )
    beam_range_sigma_m: float = Field(0.01, ge=0, description="residual calibration error of each beam's range (m)")
    vertical_angle_error_deg: float = Field(
        0.03, ge=-1, le=1, description="constant error of all vertical angles, positive if points are too low (degrees)"
    )
    axis_wander_sigma_deg: float = Field(
        0.08,
        ge=0,
        description="slowly varying error of all vertical angles, and of the azimuth ahead and behind (degrees)",
    )
    axis_wander_s: float = Field(15.0, gt=0, description="correlation time of that error (s)")
    sweep_rotation_sigma_deg: float = Field(0.2, ge=0, description="uncompensated rotation within one sweep (degrees)")
    sweep_translation_sigma_m: float = Field(0.03, ge=0, description="uncompensated translation within one sweep (m)")
    sweep_correlation_s: float = Field(0.5, gt=0, description="correlation time of the uncompensated motion (s)")


class SimulationConfig(Section):
    """The world and the sensor that drives through it."""

    world: WorldConfig = WorldConfig()
    sensor: SensorConfig = SensorConfig()


def simulation_config(sensor: str, overrides: Sequence[str] = ()) -> SimulationConfig:
    """The default settings for a sensor, changed by texts of the form `world.key=value` or `sensor.key=value`.

    Raises SegslamError, naming the key, for an unknown key or a value out of range.
    """
    values = with_overrides({"sensor": {"name": sensor}}, overrides, source="--set", example="world.cars=3")
    return validated(SimulationConfig, values, "--set")
