"""The three encodings of SemanticKITTI's classes in label files, and their detection; colours of the classes.

`raw`: the ids of the annotation (Behley et al. 2019), 0-99 and 252-259. `learning`: the 19 classes of the benchmark
as 1-19, 0 = unlabelled, and 20-25 for moving classes. `learning-0`: predictions without the unlabelled class, i.e.
the learning ids minus one, 0-18.
"""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Int, Integer, UInt8

from segslam.core.types import Label, Labels, SegslamError

Ids = Integer[np.ndarray, "_"]
"""Class ids as a file stores them, one per point."""
Histogram = Int[np.ndarray, "_"]
"""Number of points of each id: `np.bincount` of the ids."""
Encoding = Literal["raw", "learning", "learning-0"]
ENCODINGS: tuple[Encoding, ...] = get_args(Encoding)

UNKNOWN = 255  # entry of the tables below for ids that do not exist
CLASSES: dict[Label, tuple[tuple[int, ...], str]] = {
    Label.UNLABELLED: ((0, 1, 52, 99), "#9a9a9a"),
    Label.CAR: ((10,), "#3f7fd6"),
    Label.BICYCLE: ((11,), "#43c6c9"),
    Label.MOTORCYCLE: ((15,), "#2b8f9c"),
    Label.TRUCK: ((18,), "#5a4fcf"),
    Label.OTHER_VEHICLE: ((13, 16, 20), "#7d6be0"),
    Label.PERSON: ((30,), "#e0332e"),
    Label.BICYCLIST: ((31,), "#e85a9b"),
    Label.MOTORCYCLIST: ((32,), "#b03a7c"),
    Label.ROAD: ((40, 60), "#6f5b73"),
    Label.PARKING: ((44,), "#a488a8"),
    Label.SIDEWALK: ((48,), "#8a6f8e"),
    Label.OTHER_GROUND: ((49,), "#7c5a4a"),
    Label.BUILDING: ((50,), "#e8b93c"),
    Label.FENCE: ((51,), "#d9823b"),
    Label.VEGETATION: ((70,), "#3f9b45"),
    Label.TRUNK: ((71,), "#8b5a2b"),
    Label.TERRAIN: ((72,), "#9bcf6a"),
    Label.POLE: ((80,), "#f4e58c"),
    Label.TRAFFIC_SIGN: ((81,), "#ff4f3f"),
    Label.MOVING_CAR: ((252,), ""),
    Label.MOVING_BICYCLIST: ((253,), ""),
    Label.MOVING_PERSON: ((254,), ""),
    Label.MOVING_MOTORCYCLIST: ((255,), ""),
    Label.MOVING_OTHER_VEHICLE: ((256, 257, 259), ""),
    Label.MOVING_TRUCK: ((258,), ""),
}
"""Raw ids of each class, the `learning_map` of the benchmark inverted, and its colour if maps contain it.

Colours are chosen: ground in violet and green, vehicles in blue.
"""
RAW = {label: ids for label, (ids, _) in CLASSES.items()}
COLORS = {label: color for label, (_, color) in CLASSES.items() if color}
RAW_OF_LABEL = np.array([RAW[label][0] for label in Label], dtype=np.uint32)
"""The raw id that is written for each label; merged classes such as buses are written as the class they merge into."""

RARE = (Label.BICYCLE, Label.MOTORCYCLE, Label.BICYCLIST, Label.MOTORCYCLIST)
RARE_MAX_SHARE = 0.02
"""Chosen: together they have 0.1 % of the data set's points, and under 0.1 % of each real scan tried."""
ROAD_MIN_SHARE = 0.02  # chosen: the real scans of KITTI 00 contain 20 to 28 %

Colors = UInt8[np.ndarray, "_ 3"]
"""Red, green and blue, one row per point."""


def to_labels(ids: Ids, encoding: Encoding) -> Labels:
    """The labels of ids. Raises SegslamError for an id that the encoding does not contain."""
    table = _TABLES[encoding]
    labels = table[np.minimum(ids, len(table) - 1)]
    unknown = labels == UNKNOWN
    if unknown.any():
        raise SegslamError(f"id {ids[unknown][0]} is not in the encoding {encoding}; give the right one by --encoding")
    return labels


def to_ids(labels: Labels, encoding: Encoding) -> Ids:
    """The ids of labels, as a file stores them. Raises SegslamError for a label that the encoding does not contain."""
    if encoding == "raw":
        return RAW_OF_LABEL[labels]
    if encoding == "learning":
        return labels.astype(np.uint32)
    missing = (labels == Label.UNLABELLED) | (labels > Label.TRAFFIC_SIGN)
    if missing.any():
        name = Label(labels[missing][0]).name.lower()
        raise SegslamError(
            f"the encoding {encoding} has no id for {name} ({missing.sum()} points); use raw or learning"
        )
    return labels.astype(np.uint32) - 1


def detect_encoding(num_points_of_id: Histogram) -> Encoding:
    """The only encoding that fits the ids of some scans; `num_points_of_id` counts the points of each id.

    An encoding is excluded if it does not contain all ids. Unless only `raw` remains, an encoding is also excluded if
    more than 2 % of the points would be two-wheelers, or less than 2 % road. Raises SegslamError, with the reason,
    unless exactly one encoding remains.
    """
    ids = np.flatnonzero(num_points_of_id)
    fitting = [
        encoding for encoding, table in _TABLES.items() if (table[np.minimum(ids, len(table) - 1)] != UNKNOWN).all()
    ]
    possible = [one for one in fitting if fitting == ["raw"] or _looks_like_a_street(num_points_of_id, one)]
    if len(possible) != 1:
        shown = ", ".join(str(value) for value in ids[:30]) or "none"
        why = "no encoding contains all of them"
        if fitting:
            shares = "the shares of road and two-wheelers do not confirm exactly one"
            why = f"they fit {' and '.join(fitting)}, and {shares}"
        raise SegslamError(
            f"the numbering of the classes cannot be detected (ids: {shown}): {why}; "
            f"pass --encoding {'|'.join(ENCODINGS)}, or --labels geometric if the classes are not SemanticKITTI's"
        )
    return possible[0]


def _looks_like_a_street(num_points_of_id: Histogram, encoding: Encoding) -> bool:
    ids = np.flatnonzero(num_points_of_id)
    share = np.bincount(to_labels(ids, encoding), num_points_of_id[ids], minlength=len(Label))
    share = share / max(1, num_points_of_id.sum())
    return bool(share[list(RARE)].sum() <= RARE_MAX_SHARE and share[Label.ROAD] >= ROAD_MIN_SHARE)


def _table(label_of_id: dict[int, Label]) -> Labels:
    """Label of each id; UNKNOWN for missing ids. The last row stands for all larger ids."""
    table = np.full(max(label_of_id) + 2, UNKNOWN, dtype=np.uint8)
    for value, label in label_of_id.items():
        table[value] = label
    return table


_TABLES: dict[Encoding, Labels] = {
    "raw": _table({value: label for label, values in RAW.items() for value in values}),
    "learning": _table({int(label): label for label in Label}),
    "learning-0": _table({int(label) - 1: label for label in Label if Label.CAR <= label <= Label.TRAFFIC_SIGN}),
}


def of_classes(labels: Labels) -> Colors:
    """The colour of each label's class."""
    table = np.array([list(bytes.fromhex(COLORS.get(label, "#000000")[1:])) for label in Label], np.uint8)
    return table[labels]
