"""Labels that are made only when they are asked for: a network costs more than all else, and few scans are kept."""

from segslam.types import Labels, Mask, ScanLabels


def made(labels: ScanLabels) -> Labels:
    """The labels, which are made now if they were not before."""
    return labels() if callable(labels) else labels


def of_rows(labels: ScanLabels, rows: Mask) -> ScanLabels:
    """The labels of some rows; late labels stay late."""
    if callable(labels):
        return lambda: labels()[rows]
    return labels[rows]
