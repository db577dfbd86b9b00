"""Pictures of two overlaid scans in top view."""

import io
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from segslam.core import geometry
from segslam.core.types import Points, Transform

SOURCE, TARGET = "#D55E00", "#4D4D4D"
VIEW_M = 50.0


def draw_pair(source: Points, target: Points, *, poses: Mapping[str, Transform], title: str) -> bytes:
    """The two scans as a PNG, a panel for each of `poses`: a name and T_target_source."""
    figure = Figure(figsize=(3.6 * len(poses), 4.4), layout="compressed")
    figure.suptitle(title, fontsize=11)
    panels = figure.subplots(1, len(poses), squeeze=False)[0]
    for axes, (name, T_target_source) in zip(panels, poses.items(), strict=True):
        for points, color, label in (
            (target, TARGET, "target"),
            (geometry.apply(T_target_source, source), SOURCE, "source"),
        ):
            near = points[np.abs(points[:, :2]).max(axis=1) < VIEW_M]
            axes.plot(near[:, 0], near[:, 1], ",", color=color, label=label, rasterized=True)
        axes.set(title=name, xlim=(-VIEW_M, VIEW_M), ylim=(-VIEW_M, VIEW_M), aspect="equal", xlabel="x (m)")
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=140)
    return image.getvalue()
