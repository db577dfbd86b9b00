"""Pictures of loop candidates: the best accepted ones, and the rejected ones closest to acceptance."""

import io
from collections.abc import Iterable, Mapping
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from segslam.core import geometry
from segslam.core.types import (
    GROUND_LABELS,
    Keyframe,
    LoopAttempt,
    LoopClosure,
    Points,
    Rejected,
    RejectReason,
    Transform,
)
from segslam.output.finished import FinishedRun
from segslam.slam.slam_result import outcome_text

NUM_EACH = 3
APART = 10
"""Chosen: keyframes between two pictures of one kind, so that they show different places."""
SOURCE, TARGET = "#D55E00", "#4D4D4D"
VIEW_M = 50.0


def choose(attempts: Iterable[LoopAttempt]) -> list[LoopAttempt]:
    """Accepted candidates by overlap; then rejected ones, those that failed last first, by distance."""
    attempts = list(attempts)
    accepted = [a for a in attempts if isinstance(a.outcome, LoopClosure)]
    rejected = [a for a in attempts if isinstance(a.outcome, Rejected)]
    return _apart(sorted(accepted, key=_overlap, reverse=True)) + _apart(sorted(rejected, key=_miss))


def draw(run: FinishedRun, chosen: Iterable[LoopAttempt], keyframes: Mapping[int, Keyframe]) -> dict[str, bytes]:
    """A PNG for each candidate, by caption."""
    pictures = {}
    for attempt in chosen:
        source_id, target_id = attempt.candidate.pair
        T_world = run.result.estimate.T_world_keyframe
        poses = {"initial guess": attempt.candidate.T_target_source_prior}
        if isinstance(attempt.outcome, LoopClosure):
            poses["registered"] = attempt.outcome.T_target_source
        else:
            poses["final map"] = geometry.inverse(T_world[target_id]) @ T_world[source_id]
        source, target = (_standing(keyframes[number]) for number in (source_id, target_id))
        caption = f"{source_id} to {target_id}: {outcome_text(attempt, run.result.estimate.closure_weights)}"
        pictures[caption] = draw_pair(source, target, poses=poses, title=f"keyframes {caption}")
    return pictures


def _apart(attempts: list[LoopAttempt]) -> list[LoopAttempt]:
    chosen: list[LoopAttempt] = []
    for attempt in attempts:
        source_id = attempt.candidate.source_id
        if len(chosen) < NUM_EACH and all(abs(source_id - one.candidate.source_id) >= APART for one in chosen):
            chosen.append(attempt)
    return chosen


def _overlap(attempt: LoopAttempt) -> float:
    return attempt.outcome.alignment.overlap if isinstance(attempt.outcome, LoopClosure) else 0.0


def _miss(attempt: LoopAttempt) -> tuple[int, float]:
    reason = attempt.outcome.reason if isinstance(attempt.outcome, Rejected) else RejectReason.TOO_FEW_POINTS
    return -list(RejectReason).index(reason), attempt.candidate.distance_m


def _standing(keyframe: Keyframe) -> Points:
    """The points above ground; all points if none is labelled as ground."""
    return keyframe.points[~np.isin(keyframe.labels, np.array(GROUND_LABELS, np.uint8))].astype(np.float64)


def draw_pair(source: Points, target: Points, *, poses: Mapping[str, Transform], title: str) -> bytes:
    """The two scans as a PNG, a panel for each of `poses`: a name and T_target_source."""
    figure = Figure(figsize=(3.6 * len(poses), 4.4), layout="compressed")
    figure.suptitle(fill(title, 31 * len(poses)), fontsize=11)
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
