"""Labels that are computed on first use: a network is slow, and only keyframes need labels."""

from segslam.core.types import Labels, Mask, ScanLabels


def computed(labels: ScanLabels) -> Labels:
    """The labels, computed now if necessary."""
    return labels() if callable(labels) else labels


def of_rows(labels: ScanLabels, rows: Mask) -> ScanLabels:
    """The labels of some rows; labels that are computed on first use stay so."""
    if callable(labels):
        return lambda: labels()[rows]
    return labels[rows]
