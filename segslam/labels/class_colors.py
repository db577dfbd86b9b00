"""Colours of the classes, the same in maps, logs and viewers."""

import numpy as np
from jaxtyping import UInt8

from segslam.core.types import Label, Labels

COLORS = {
    Label.UNLABELLED: "#9a9a9a",
    Label.CAR: "#3f7fd6",
    Label.BICYCLE: "#43c6c9",
    Label.MOTORCYCLE: "#2b8f9c",
    Label.TRUCK: "#5a4fcf",
    Label.OTHER_VEHICLE: "#7d6be0",
    Label.PERSON: "#e0332e",
    Label.BICYCLIST: "#e85a9b",
    Label.MOTORCYCLIST: "#b03a7c",
    Label.ROAD: "#6f5b73",
    Label.PARKING: "#a488a8",
    Label.SIDEWALK: "#8a6f8e",
    Label.OTHER_GROUND: "#7c5a4a",
    Label.BUILDING: "#e8b93c",
    Label.FENCE: "#d9823b",
    Label.VEGETATION: "#3f9b45",
    Label.TRUNK: "#8b5a2b",
    Label.TERRAIN: "#9bcf6a",
    Label.POLE: "#f4e58c",
    Label.TRAFFIC_SIGN: "#ff4f3f",
}
"""Chosen, for the classes that maps contain: ground in violet and green, vehicles in blue."""

Colors = UInt8[np.ndarray, "_ 3"]
"""Red, green and blue, one row per point."""


def of_classes(labels: Labels) -> Colors:
    """The colour of each label's class."""
    table = np.array([list(bytes.fromhex(COLORS.get(label, "#000000")[1:])) for label in Label], np.uint8)
    return table[labels]
