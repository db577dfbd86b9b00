"""Quality of labels: intersection over union (IoU) as in SemanticKITTI (Behley et al., ICCV 2019).

Only points with a known true class count. Moving classes count as their static class.
"""

import numpy as np
from jaxtyping import Int

from segslam.core.types import GROUND_LABELS, Label, Labels

Confusion = Int[np.ndarray, "20 20"]
"""Number of points by true class (row) and label (column), as learning ids 0 to 19; row 0 is empty."""

NUM_CLASSES = 20
STILL = np.arange(len(Label), dtype=np.uint8)
"""Class of each label; moving classes map to their static class."""
for _label in list(Label)[NUM_CLASSES:]:
    STILL[_label] = Label[_label.name.removeprefix("MOVING_")]
GROUPS = {
    "ground": GROUND_LABELS,
    "car": (Label.CAR,),
    "building": (Label.BUILDING,),
    "vegetation": (Label.VEGETATION,),
    "trunk_or_pole": (Label.TRUNK, Label.POLE),
}
"""Groups of classes that matter for loop closing."""


def confusion(labels: Labels, truth: Labels) -> Confusion:
    """Number of points for each pair of true class and label."""
    known = truth != Label.UNLABELLED
    pairs = STILL[truth[known]].astype(np.int64) * NUM_CLASSES + STILL[labels[known]]
    return np.bincount(pairs, minlength=NUM_CLASSES**2).reshape(NUM_CLASSES, NUM_CLASSES)


def class_scores(counts: Confusion) -> dict[str, float]:
    """IoU of each class that occurs in the ground truth or in the labels, the most frequent first."""
    present = [label for label in list(Label)[1:NUM_CLASSES] if counts[label].sum() + counts[:, label].sum()]
    present.sort(key=lambda label: -counts[label].sum())
    return {label.name.lower(): _score(counts, (label,)) for label in present}


def group_scores(counts: Confusion) -> dict[str, float]:
    """IoU of the groups of classes that matter for loop closing."""
    return {
        name: _score(counts, members)
        for name, members in GROUPS.items()
        if counts[list(members)].sum() + counts[:, list(members)].sum()
    }


def largest_confusions(counts: Confusion, count: int) -> list[tuple[Label, Label, float]]:
    """(true class, label, share of all points) of the most frequent confusions."""
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
