"""The page of a fleet: which drives are joined, by how many loops, and what failed; each component in top view."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.figure import Figure

from segslam.core.errors import counted, noun
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import Poses
from segslam.core.whole_files import write_whole
from segslam.output.report import figures
from segslam.output.report.page import document, picture_section, section, table

if TYPE_CHECKING:
    from segslam.run.fleets.orchestrate import FleetResult


def write_report(result: "FleetResult") -> Path:
    """Write `report.html` into the folder of a fleet; returns its path."""
    plots = "".join(
        picture_section(
            f"Component {number}: {', '.join(component['drives'])}",
            _drawn(result.folder / component["folder"], component["drives"]),
        )
        for number, component in enumerate(result.components)
        if "reason" not in component
    )
    num_mapped = sum(drive["state"] == "mapped" for drive in result.drives.values())
    components, loops = len(result.components), result.num_loops_between
    body = (
        f'<div class="tiles"><div><b>{num_mapped} of {len(result.drives)}</b>drives mapped</div>'
        f"<div><b>{components}</b>{noun(components, 'component')}</div>"
        f"<div><b>{loops}</b>{noun(loops, 'loop')} between drives</div></div>\n"
        f"{section('Components', _components(result))}{section('Drives', _drives(result.drives))}"
        f'<div class="plots">{plots}</div>'
    )
    file = result.folder / "report.html"
    write_whole(file, document(f"{result.folder.name}: {counted(len(result.drives), 'drive')}", body))
    return file


def _components(result: "FleetResult") -> str:
    rows = []
    for number, one in enumerate(result.components):
        error = one.get("reason") or (f"{one['ate_m']:.3f} m" if "ate_m" in one else "no truth in one frame")
        link = f'<a href="{escape(one["folder"])}/report.html">{number}</a>'
        rows.append((link, escape(", ".join(one["drives"])), one.get("num_loops_between", 0), escape(error)))
    return table(rows, head=("component", "drives", "loops between them", "error"))


def _drives(drives: Mapping[str, Mapping[str, Any]]) -> str:
    rows = []
    for name, drive in drives.items():
        link = escape(name)
        if drive["state"] == "mapped":
            link = f'<a href="runs/{link}/report.html">{link}</a>'
        state = f"{drive['state']}: {drive['reason']}" if "reason" in drive else drive["state"]
        rows.append((link, escape(state), drive["component"]))
    return table(rows, head=("drive", "state", "component"))


def _drawn(folder: Path, names: list[str]) -> str:
    """The trajectories of a component's drives in top view, as SVG."""
    poses: dict[str, Poses] = {name: read_poses(folder / "drives" / f"{name}_tum.txt").T_a_b for name in names}
    with matplotlib.rc_context(figures.STYLE):
        figure = Figure(figsize=(7.0, 6.0), layout="constrained")
        axes = figure.subplots()
        colors = matplotlib.colormaps["turbo"].resampled(max(len(names), 2))
        for number, (name, path) in enumerate(poses.items()):
            axes.plot(*path[:, :2, 3].T, color=colors(number), label=name, linewidth=1.4)
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=4, fontsize=10)
        return figures.svg(figure, folder.name)
