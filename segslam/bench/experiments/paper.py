"""Values of the Segregator paper (Yin et al., ICRA 2023), for comparison with measurements on the same lists."""

from collections.abc import Sequence
from itertools import chain, product
from typing import Any

from segslam.bench.experiments.pairs import PairList

NAMES = [f"kitti{one}_{band}" for one, band in product(("00", "05", "06", "07", "08"), ("3to5", "8to10", "10to15"))]
"""The easy, medium and hard list of each sequence, by the distance of the scans (m)."""
COUNTS = ((8503, 7527, 21267), (5155, 5243, 11600), (1128, 1113, 2825), (1311, 1169, 2877), (2064, 2750, 9457))
NUM_PAIRS = dict(zip(NAMES, chain.from_iterable(COUNTS), strict=True))
SUCCESS_PERCENT = {
    "vgicp": ((95.6, 34.1, 14.9), (82.6, 34.6, 25.3), (94.6, 66.7, 35.1), (80.0, 36.5, 0.8), (0.24, 0.0, 4.9)),
    "teaser": ((97.0, 65.4, 41.1), (96.4, 73.4, 48.0), (99.8, 94.3, 83.2), (91.1, 49.2, 30.7), (96.6, 74.8, 49.5)),
    "quatro": ((96.9, 66.2, 41.2), (96.3, 73.7, 48.1), (99.8, 93.9, 83.2), (91.3, 51.0, 31.9), (96.8, 75.2, 49.8)),
    "segator": ((98.6, 88.3, 75.4), (77.8, 72.2, 59.0), (91.0, 74.6, 63.8), (100.0, 95.5, 81.4), (90.3, 84.4, 78.2)),
    "segregator": ((99.7, 89.3, 80.7), (98.7, 93.2, 81.8), (100.0, 99.6, 98.3), (100.0, 98.1, 88.0),
                   (96.9, 94.1, 88.8)),
}  # fmt: skip
"""Success rate (error below 2 m and 5 degrees) on those lists."""
TIMING_SEQUENCE = "06"
TIMING_KEYS = ("success_percent", "translation_m", "rotation_deg", "mean_ms", "mean_edges")
TIMING = {
    "vgicp": (55.4, 0.07, 0.10, 90.0),
    "teaser": (89.0, 0.36, 0.67, 150.0, 3025.0),
    "quatro": (89.0, 0.36, 0.66, 150.0),
    "segregator": (99.0, 0.09, 0.27, 100.0, 2687.0),
    "segregator-c2f": (99.0, 0.07, 0.12, 150.0),
}
"""Values over all three lists of 06; `mean_edges` is the paper's average inlier count, AIC."""
DETERIORATION = {10: (0.09, 0.20), 30: (0.04, 0.22), 50: (0.31, 0.21), 70: (0.06, 1.70), 90: (0.27, 1.70)}
"""Segregator's error (m, degrees) by percentage of lost labels, on scans 0 and 10 of 05."""


def success_percent(method: str, pairs: str, num_pairs: int) -> float | None:
    """The paper's value for a list of this name (kittiSS_LOtoHI) and number of pairs; None if the paper has none."""
    if method not in SUCCESS_PERCENT or NUM_PAIRS.get(pairs) != num_pairs:
        return None
    return dict(zip(NAMES, chain.from_iterable(SUCCESS_PERCENT[method]), strict=True))[pairs]


def with_paper_values(
    results: dict[str, dict[str, Any]], *, experiment: str, sequence: str, lists: Sequence[PairList]
) -> dict[str, dict[str, Any]]:
    """The results with the paper's values for the same method and pairs under the key `paper`.

    `pairs`: success by list. `timing`: all values if the lists are the paper's three lists of 06. `deterioration`:
    errors if the pair is scans 0 and 10 of 05. The comparison also applies to lists that were sampled.
    """
    whole = {one.name: one.num_whole for one in lists}
    all_lists = {name: number for name, number in NUM_PAIRS.items() if name.startswith(f"kitti{TIMING_SEQUENCE}")}
    is_paper_pair = len(lists) == 1 and lists[0].pairs.tolist() == [[0, 10]]
    timing = TIMING if (experiment, sequence.zfill(2), whole) == ("timing", TIMING_SEQUENCE, all_lists) else {}
    reduced = is_paper_pair and (experiment, sequence.zfill(2)) == ("deterioration", "05")

    def paper_of(method: str, one: dict[str, Any]) -> dict[str, Any]:
        """`paper` for one value of the varied quantity, or an empty mapping."""
        if reduced and method == "segregator" and one["lost_percent"] in DETERIORATION:
            return {"paper": dict(zip(TIMING_KEYS[1:], DETERIORATION[one["lost_percent"]], strict=False))}
        value = success_percent(method, one["list"], whole[one["list"]]) if "list" in one else None
        return {} if value is None else {"paper": {"success_percent": value}}

    return {
        method: own
        | ({"paper": dict(zip(TIMING_KEYS, timing[method], strict=False))} if method in timing else {})
        | {"by": [one | paper_of(method, one) for one in own["by"]]}
        for method, own in results.items()
    }
