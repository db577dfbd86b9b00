"""What can be chosen about the simulated street world and the sensor that drives through it."""

from collections.abc import Sequence
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError

from segslam.config import Section
from segslam.types import SegslamError

SensorName = Literal["hdl64", "os1-64", "vlp16"]


class WorldConfig(Section):
    """What stands along the streets. Densities are per 100 m and side; what does not fit is left out."""

    cars: float = Field(5.0, ge=0, le=16, description="parked cars")
    trees: float = Field(7.0, ge=0, le=30, description="trees beside the road")
    lamps: float = Field(2.5, ge=0, le=20, description="street lamps")
    signs: float = Field(2.5, ge=0, le=20, description="traffic signs")
    clutter: float = Field(2.0, ge=0, le=20, description="bins, switch boxes and the like, of no class")
    built: float = Field(0.75, ge=0, le=1, description="share of the lots that hold a building")
    courts: float = Field(0.6, ge=0, le=3, description="paved courts with parked cars, between the houses")
    shrubs: float = Field(
        1.0, ge=0, le=3, description="bushes and trees on the lots, as a multiple of the usual number"
    )
    hedged: float = Field(0.6, ge=0, le=1, description="share of the lots that a hedge closes towards the street")
    fenced: float = Field(0.2, ge=0, le=1, description="share of the lots that a fence closes towards the street")
    equal_tree_rows: bool = Field(
        False, description="plant equal trees at equal distances, so that all places look the same"
    )
    parked_cars_gone: float = Field(
        0.0, ge=0, le=1, description="share of parking places whose car is gone or another one at a later visit"
    )
    day: int = Field(
        0, ge=0, description="day of the drive: streets stay the same from day to day, parked and moving cars do not"
    )
    moving_cars: float = Field(1.0, ge=0, le=10, description="moving cars per 100 m of the drive")
    sensor_height_m: float = Field(1.73, gt=0, description="of the sensor above its road, KITTI's (m)")


class SensorConfig(Section):
    """The sensor and what is wrong with it. A sigma of 0 switches its error off."""

    name: SensorName = "hdl64"
    range_sigma_m: float = Field(0.02, ge=0, description="noise of each range (m)")
    dropout: float = Field(0.02, ge=0, lt=1, description="share of the returns lost at random")
    beam_angle_sigma_deg: float = Field(
        0.02, ge=0, description="leftover error of each beam's vertical angle (degrees)"
    )
    beam_range_sigma_m: float = Field(0.01, ge=0, description="leftover error of each beam's range (m)")
    vertical_angle_error_deg: float = Field(
        0.03, ge=-1, le=1, description="leftover error of all vertical angles: the points lie too low by it (degrees)"
    )
    axis_wander_sigma_deg: float = Field(
        0.08,
        ge=0,
        description="slowly changing error of all vertical angles, and of azimuth ahead and behind (degrees)",
    )
    axis_wander_s: float = Field(15.0, gt=0, description="time in which that error changes (s)")
    sweep_rotation_sigma_deg: float = Field(
        0.2, ge=0, description="turn within one sweep that nobody compensated (degrees)"
    )
    sweep_translation_sigma_m: float = Field(
        0.03, ge=0, description="translation within one sweep that nobody compensated (m)"
    )
    sweep_correlation_s: float = Field(0.5, gt=0, description="time in which that motion changes (s)")


class SimulationConfig(Section):
    """The world and the sensor that drives through it."""

    world: WorldConfig = WorldConfig()
    sensor: SensorConfig = SensorConfig()


def simulation_config(sensor: str, overrides: Sequence[str] = ()) -> SimulationConfig:
    """The defaults for a sensor, changed by texts `world.key=value` and `sensor.key=value`.

    Raises SegslamError that names the key for what is unknown or out of range.
    """
    values: dict[str, dict[str, Any]] = {"world": {}, "sensor": {"name": sensor}}
    for text in overrides:
        key, _, value = text.partition("=")
        section, _, name = key.strip().partition(".")
        if section not in values or not name or not value:
            raise SegslamError(f"--set {text}: write it as world.key=value or sensor.key=value, as in world.cars=3")
        values[section][name] = yaml.safe_load(value)
    try:
        return SimulationConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        section, name = (str(part) for part in first["loc"])
        known = ", ".join((WorldConfig if section == "world" else SensorConfig).model_fields)
        remedy = f"known there: {known}" if first["type"] == "extra_forbidden" else f"got {first['input']!r}"
        raise SegslamError(f"{section}.{name}: {first['msg']}; {remedy}") from error
