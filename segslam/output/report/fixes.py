"""The plot of a georeferenced run: which position fixes were kept, and how far they are from the drive."""

import csv
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from segslam.output.georeferenced import FIXES, read_globe
from segslam.output.report.figures import ACCEPTED, CORRECTED, FALSE, WIDTH_IN, svg

RESIDUALS = ("residual_east_m", "residual_north_m")


def draw_fixes(folder: Path) -> str | None:
    """SVG text: fixes over the path in top view, and residuals over time; None for a run without fixes."""
    globe = read_globe(folder)
    file = folder / FIXES
    if globe is None or not file.is_file():
        return None
    with file.open(newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["residual_east_m"]]
    enu_m, residual_m = (_columns(rows, *names) for names in (("east_m", "north_m"), RESIDUALS))
    minutes = np.array([int(row["stamp_ns"]) for row in rows], float) / 60e9
    kept = np.array([row["kept"] == "1" for row in rows], bool)
    figure = Figure(figsize=(WIDTH_IN, 1.5 * WIDTH_IN), layout="constrained")
    above, over_time = figure.subplots(2, 1, height_ratios=(2, 1))
    above.plot(*globe.T_enu_lidar[:, :2, 3].T, color=CORRECTED, linewidth=1.2, label="trajectory", zorder=3)
    for chosen, color, name in ((kept, ACCEPTED, "kept"), (~kept, FALSE, "not kept")):
        above.plot(
            *enu_m[chosen].T,
            ".",
            color=color,
            markersize=4,
            label=f"{name}: {chosen.sum()}",
            scalex=False,
            scaley=False,
        )
        distance_m = np.hypot(*residual_m[chosen].T)
        over_time.plot(minutes[chosen] - minutes.min(initial=np.inf), distance_m, ".", color=color, markersize=4)
    above.set(xlabel="east (m)", ylabel="north (m)")
    above.set_aspect("equal", adjustable="datalim")
    figure.legend(loc="outside upper center", ncols=3)
    over_time.set(xlabel="time (minutes)", ylabel="residual (m)", yscale="log")
    over_time.yaxis.set_major_formatter("{x:g}")
    return svg(figure, "fixes")


def _columns(rows: list[dict[str, str]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows]).reshape(-1, len(names))
