"""How good labels are: intersection over union with the truth, as SemanticKITTI has it (Behley et al., ICCV 2019).

Scored are points whose true class is known. Moving things count as the class of what moves.
"""

import numpy as np
from jaxtyping import Int

from segslam.types import GROUND_LABELS, Label, Labels

Confusion = Int[np.ndarray, "20 20"]
"""Points by true class (row) and by label (column), classes as learning ids 0 to 19; row 0 is empty."""

NUM_CLASSES = 20
STILL = np.arange(len(Label), dtype=np.uint8)
"""The class of each label, of moving labels that of the thing that moves."""
for _label in list(Label)[NUM_CLASSES:]:
    STILL[_label] = Label[_label.name.removeprefix("MOVING_")]
GROUPS = {
    "ground": GROUND_LABELS,
    "car": (Label.CAR,),
    "building": (Label.BUILDING,),
    "vegetation": (Label.VEGETATION,),
    "trunk_or_pole": (Label.TRUNK, Label.POLE),
}
"""Groups of classes that loop closing distinguishes."""


def confusion(labels: Labels, truth: Labels) -> Confusion:
    """How often each label was given to each true class."""
    known = truth != Label.UNLABELLED
    pairs = STILL[truth[known]].astype(np.int64) * NUM_CLASSES + STILL[labels[known]]
    return np.bincount(pairs, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)


def class_scores(counts: Confusion) -> dict[str, float]:
    """Intersection over union of each class that the truth or the labels have, the most frequent first."""
    present = [label for label in list(Label)[1:NUM_CLASSES] if counts[label].sum() + counts[:, label].sum()]
    present.sort(key=lambda label: -counts[label].sum())
    return {label.name.lower(): _score(counts, (label,)) for label in present}


def group_scores(counts: Confusion) -> dict[str, float]:
    """The same for the groups of classes that loop closing distinguishes."""
    return {
        name: _score(counts, members)
        for name, members in GROUPS.items()
        if counts[list(members)].sum() + counts[:, list(members)].sum()
    }


def largest_confusions(counts: Confusion, count: int) -> list[tuple[Label, Label, float]]:
    """True class, label given in its place, and their share of all points; the most frequent first."""
    wrong = counts * (1 - np.eye(NUM_CLASSES, dtype=np.int64))
    largest = np.argsort(-wrong, axis=None, kind="stable")[:count]
    rows, columns = np.unravel_index(largest, wrong.shape)
    total = counts.sum()
    return [
        (Label(row), Label(column), float(wrong[row, column] / total))
        for row, column in zip(rows, columns, strict=True)
        if wrong[row, column]
    ]


def _score(counts: Confusion, members: tuple[Label, ...]) -> float:
    chosen = list(members)
    both = counts[np.ix_(chosen, chosen)].sum()
    return float(both / (counts[chosen].sum() + counts[:, chosen].sum() - both))
