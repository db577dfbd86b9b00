"""Time and memory of the search for similar places, by the number of places."""

from time import process_time

import numpy as np

from segslam.candidates import Places, PlaceSignature
from tools.benchmarks.common import Row

NUM_QUERIES = 20


def search_costs(signatures: np.ndarray, numbers: list[int]) -> list[Row]:
    """A row for each number of places. `signatures`: (n, 24, 60) of an index, repeated at other yaws."""
    places, rows, rng = Places(), list[Row](), np.random.default_rng(0)
    for number in numbers:
        while len(places) < number:
            drawn = np.roll(signatures[rng.integers(len(signatures))], rng.integers(60), axis=1)
            places.add(len(places), PlaceSignature(drawn))
        started = process_time()
        for query in signatures[:: max(1, len(signatures) // NUM_QUERIES)][:NUM_QUERIES]:
            places.shortlist(PlaceSignature(query))
        spent_ms = (process_time() - started) / NUM_QUERIES * 1e3
        rows.append(
            {
                "places": number,
                "CPU a query (ms)": round(spent_ms, 2),
                "MB": round(number * places.bytes_per_place / 1e6),
            }
        )
    return rows
