"""Colours of a map by height or intensity."""

import numpy as np

from segslam.core.types import Vector
from segslam.labels.class_colors import Colors


def scale_of(span: tuple[float, float], *, steps: int = 6) -> list[tuple[float, str]]:
    """(text, colour) of evenly spaced values from the end of a span to its start, as `of_numbers` colours them."""
    values = np.linspace(span[1], span[0], steps)
    return [
        (float(value), f"#{r:02x}{g:02x}{b:02x}")
        for value, (r, g, b) in zip(values, of_numbers(values, span=span), strict=True)
    ]


def of_numbers(values: Vector, *, span: tuple[float, float]) -> Colors:
    """Colours (n, 3) from dark violet, at the start of the span and below, to yellow, at its end and above."""
    from matplotlib import colormaps

    low, high = span
    table = (255 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    return table[(share * (len(table) - 1)).astype(np.int64)]
