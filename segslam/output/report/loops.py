"""The loops of the report: pictures of some pairs, and the interactive top view.

Pictures show the best accepted candidates, and the rejected ones closest to acceptance. The data of the top view are
for `interactive.js`, drawn by plotly.js, all embedded in the page.
"""

import base64
import gzip
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from importlib import resources
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from segslam.core import geometry
from segslam.core.evaluation import pose_errors
from segslam.core.trajectory import begun_among, parted
from segslam.core.types import (
    GROUND_LABELS,
    REJECTED_WEIGHT,
    CloudOf,
    Indices,
    Labels,
    LoopAttempt,
    LoopClosure,
    Points,
    Rejected,
    RejectReason,
    Transform,
)
from segslam.output.accuracy import aligned_by
from segslam.output.finished import FinishedRun
from segslam.output.map.from_above import png
from segslam.output.report.figures import Line, paths_of, true_scans
from segslam.slam.slam_result import outcome_text

MOST_SCANS = 3000
"""Chosen: of longer drives, every second scan is drawn, or every third, and so on; a browser pans these smoothly."""
MOST_PAIRS = 150
"""Chosen: number of loop candidates with clouds, accepted ones first; 3 kB a keyframe."""
CLOUD_POINTS = 500
NEAR_M = 50.0
"""Chosen: points drawn of each cloud, and their largest distance."""
STEP_M = 0.1
"""Resolution of the coordinates of clouds, in whole numbers of 16 bits."""
NUM_EACH = 3
APART = 10
"""Chosen: keyframes between two pictures of one kind, so that they show different places."""
SOURCE, TARGET = "#D55E00", "#4D4D4D"
VIEW_M = 50.0


def with_clouds(run: FinishedRun) -> list[LoopAttempt]:
    """The loop candidates whose clouds are shown: accepted ones, spread over the drive, then the rejected ones."""
    attempts = run.result.attempts
    accepted = [one for one in attempts if isinstance(one.outcome, LoopClosure)]
    rejected = [one for one in attempts if not isinstance(one.outcome, LoopClosure)]
    kept = [accepted[row] for row in _spread(len(accepted), MOST_PAIRS)]
    return kept + [rejected[row] for row in _spread(len(rejected), MOST_PAIRS - len(kept))]


def top_view(run: FinishedRun, cloud_of: CloudOf) -> str:
    """HTML of the view, with the clouds of some loops: those of `with_clouds`."""
    ids = {number for attempt in with_clouds(run) for number in attempt.candidate.pair}
    data = {
        "paths": [_path(line) for line in paths_of(run)],
        "values": _values(run),
        "loops": [_loop(run, attempt, ids) for attempt in run.result.attempts],
        "clouds": {str(number): _cloud(*cloud_of(number)) for number in sorted(ids)},
        "step_m": STEP_M,
    }
    script = resources.files("segslam.output.report").joinpath("interactive.js").read_text(encoding="utf-8")
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return (
        "<p>Scroll or pinch to zoom, drag to move, double-click to see all. Point at a dot to see its figures; click "
        "on a loop to see its two scans before and after.</p>"
        f'<label>colour of the trajectory: <select id="colour"></select></label>'
        '<div id="topview"></div><div id="pair"></div><noscript>This view needs JavaScript.</noscript>'
        f'<script type="application/json" id="topview-data">{text}</script>'
        f'<script type="text/plain" id="plotly-packed">{packed_plotly()}</script>'
        f"<script>{script}</script>"
    )


@lru_cache(1)
def packed_plotly() -> str:
    """plotly.js (MIT licence), compressed, in base64; the page unpacks it."""
    source = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, 9, mtime=0)).decode("ascii")


def _path(line: Line) -> dict[str, Any]:
    x, y = _thinned(line.poses[:, :2, 3], line.begun).T
    return {"name": line.name, "color": line.color, "x": _rounded(x), "y": _rounded(y)}


def _values(run: FinishedRun) -> dict[str, list[float | None]]:
    """What the trajectory can be coloured by; the last of `paths_of` has the same scans."""
    trajectory = run.result.trajectory
    values = {
        "scan": trajectory.scan_index.astype(float),
        "time (s)": (trajectory.stamp_ns - trajectory.stamp_ns[0]) / 1e9,
        "height (m)": trajectory.T_world_lidar[:, 2, 3],
    }
    true = true_scans(run)
    if true is not None and len(true[0]) == len(trajectory):
        rows, truth = true
        aligned = aligned_by(trajectory.T_world_lidar[rows], truth, "se3")
        values["error (m)"] = pose_errors(aligned, truth).translation_m
    return {name: _rounded(_thinned(of_scans, run.result.begun)) for name, of_scans in values.items()}


def _loop(run: FinishedRun, attempt: LoopAttempt, ids: set[int]) -> dict[str, Any]:
    source_id, target_id = pair = attempt.candidate.pair
    estimate, rows = run.result.estimate, run.result.keyframe_rows
    T_world, T_odom = estimate.T_world_keyframe, run.result.odometry.T_world_lidar[rows]
    kind = "rejected"
    if isinstance(attempt.outcome, LoopClosure):
        kind = "accepted" if estimate.closure_weights[pair] >= REJECTED_WEIGHT else "rejected by the optimiser"
    loop: dict[str, Any] = {
        "name": f"{source_id} to {target_id}",
        "kind": kind,
        "ends": [_rounded(T_world[number][:2, 3]) for number in pair],
        "text": outcome_text(attempt, estimate.closure_weights),
    }
    if ids.issuperset(pair):
        loop["pair"] = list(pair)
        for name, poses in (("before", T_odom), ("after", T_world)):
            T_target_source = geometry.inverse(poses[target_id]) @ poses[source_id]
            loop[name] = _rounded(T_target_source[:2].ravel(), 5)  # what gives x and y in the target
    return loop


def _cloud(points: Points, labels: Labels) -> str:
    """Points above ground in steps of `STEP_M`: 16-bit x, y, z of each, little endian, in base64."""
    standing = _standing(points, labels)
    points = standing if len(standing) else points
    near = points[np.abs(points).max(axis=1, initial=0.0) < NEAR_M]
    kept = near[_spread(len(near), CLOUD_POINTS)]
    return base64.b64encode(np.round(kept / STEP_M).astype("<i2").tobytes()).decode("ascii")


def _thinned(rows: np.ndarray, begun: Indices) -> np.ndarray:
    """Some of the rows (n, ...), with one of NaN where another drive begins."""
    kept = np.arange(0, len(rows), 1 + (len(rows) - 1) // MOST_SCANS)
    return parted(rows[kept], begun_among(kept, begun))


def _rounded(values: np.ndarray, digits: int = 2) -> list[float | None]:
    """Rounded values; None for NaN, which JSON does not have."""
    return [None if np.isnan(value) else round(float(value), digits) for value in values]


def _spread(num: int, most: int) -> list[int]:
    """Rows of at most so many of a number of items, evenly spread."""
    return np.linspace(0, num - 1, min(num, most)).astype(int).tolist()


def choose(attempts: Sequence[LoopAttempt]) -> list[LoopAttempt]:
    """Accepted candidates by overlap; then rejected ones, those that failed last first, by distance."""
    reasons = list(RejectReason)
    accepted = [(-one.outcome.alignment.overlap, one) for one in attempts if isinstance(one.outcome, LoopClosure)]
    rejected = [
        ((-reasons.index(one.outcome.reason), one.candidate.distance_m), one)
        for one in attempts
        if isinstance(one.outcome, Rejected)
    ]
    return _apart(accepted) + _apart(rejected)


def draw(run: FinishedRun, cloud_of: CloudOf) -> dict[str, bytes]:
    """A PNG for each of the candidates of `choose`, by caption."""
    pictures = {}
    for attempt in choose(run.result.attempts):
        source_id, target_id = attempt.candidate.pair
        T_world = run.result.estimate.T_world_keyframe
        poses = {"initial guess": attempt.candidate.T_target_source_prior}
        if isinstance(attempt.outcome, LoopClosure):
            poses["registered"] = attempt.outcome.T_target_source
        else:
            poses["final map"] = geometry.inverse(T_world[target_id]) @ T_world[source_id]
        source, target = (_standing(*cloud_of(number)).astype(np.float64) for number in (source_id, target_id))
        caption = f"{source_id} to {target_id}: {outcome_text(attempt, run.result.estimate.closure_weights)}"
        pictures[caption] = draw_pair(source, target, poses=poses, title=f"keyframes {caption}")
    return pictures


def _apart(ranked: Iterable[tuple[Any, LoopAttempt]]) -> list[LoopAttempt]:
    """The attempts of lowest rank, each some keyframes from the others."""
    chosen: list[LoopAttempt] = []
    for _, attempt in sorted(ranked, key=lambda pair: pair[0]):
        source_id = attempt.candidate.source_id
        if len(chosen) < NUM_EACH and all(abs(source_id - one.candidate.source_id) >= APART for one in chosen):
            chosen.append(attempt)
    return chosen


def _standing(points: Points, labels: Labels) -> Points:
    """The points that are not labelled as ground."""
    return points[~np.isin(labels, np.array(GROUND_LABELS, np.uint8))]


def draw_pair(source: Points, target: Points, *, poses: Mapping[str, Transform], title: str) -> bytes:
    """The two scans as a PNG, a panel for each of `poses`: a name and T_target_source."""
    figure = Figure(figsize=(3.6 * len(poses), 4.4), layout="compressed")
    figure.suptitle(fill(title, 31 * len(poses)), fontsize=11)
    panels = figure.subplots(1, len(poses), squeeze=False)[0]
    for axes, (name, T_target_source) in zip(panels, poses.items(), strict=True):
        for points, color in ((target, TARGET), (geometry.apply(T_target_source, source), SOURCE)):
            near = points[np.abs(points[:, :2]).max(axis=1) < VIEW_M]
            axes.plot(near[:, 0], near[:, 1], ",", color=color, rasterized=True)
        axes.set(title=name, xlim=(-VIEW_M, VIEW_M), ylim=(-VIEW_M, VIEW_M), aspect="equal", xlabel="x (m)")
    return png(figure, dpi=140)
