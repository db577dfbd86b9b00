"""A finished run as one session of a merged run: keyframes, steps with new numbers, and figures of such a run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.errors import counted
from segslam.core.trajectory import Poses, travelled_m
from segslam.core.types import (
    REJECTED_WEIGHT,
    CloudOf,
    Keyframe,
    LoopAttempt,
    LoopClosure,
    Motion,
    MotionState,
    SegslamError,
    Step,
    Transform,
    Vector,
)
from segslam.output.finished import FinishedRun, Part, read_corrections, read_run
from segslam.output.folder import log_of
from segslam.slam.adjustment.alignment import MIN_PAIRS
from segslam.slam.adjustment.known import Kept, Known, nothing_kept
from segslam.slam.adjustment.sweeps import common_sweep
from segslam.slam.adjustment.vertical_angle import VerticalAngle
from segslam.slam.slam import SlamResult

FIRST_MOTION = Motion(MotionState.BEGUN, information=1e-12 * np.eye(6))
"""The motion to the first scan of a session, which is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class SessionPose:
    """Pose of a session in an earlier one."""

    earlier: int
    """Number of the earlier session."""
    T_earlier_world: Transform
    """Pose of the session's world frame in that of the earlier session."""
    found: tuple[LoopClosure, ...]
    """Consistent locations of keyframes of the session (sources) at keyframes of the earlier one."""


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Offsets of the numbers of a session, so that its steps follow those of the previous sessions."""

    keyframe_id: int = 0
    scan_index: int = 0
    stamp_ns: int = 0
    travel_m: float = 0.0
    T_new_old: Transform = field(default_factory=lambda: np.eye(4))
    """Pose of its odometry frame in that of the merged run."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A finished run with the poses of its keyframes."""

    run: FinishedRun
    keyframes: list[Keyframe]
    """Without points."""
    cloud_of: CloudOf
    T_world_keyframe: Poses
    """Poses by the run's own estimate."""
    travel_m: Vector
    shift: Shift = Shift()
    """Its place in a merged run."""
    found: SessionPose | None = None
    """Its pose in a session before it in a merged run; None for the first one."""

    @property
    def name(self) -> str:
        """The folder of the run."""
        return str(self.run.folder)


def known_of(sessions: Sequence[Session], kept: Kept = nothing_kept) -> Known:
    """The results of the sessions' own adjustments, for all of them together."""
    poses = np.concatenate([session.T_world_keyframe for session in sessions])
    corrections = [one for each in sessions for one in read_corrections(each.run.log, each.run.result)]
    adjustments = [session.run.log.adjustment() for session in sessions]
    sweeps = [None if one is None else one.sweep for one in adjustments]
    return Known(poses, corrections, _angle(sessions), common_sweep(sweeps), kept)


def _angle(sessions: Sequence[Session]) -> VerticalAngle | None:
    """The mean of the sessions' angles, weighted by their errors, which may have a common cause and remain."""
    measured = [one.run.metrics for one in sessions if "vertical_deg" in one.run.metrics]
    if not measured:
        return None
    angles, sigmas = (np.array([one[name] for one in measured]) for name in ("vertical_deg", "vertical_sigma_deg"))
    mean, sigma = np.average([angles, sigmas], axis=1, weights=sigmas**-2.0).tolist()
    return VerticalAngle(mean, sigma, MIN_PAIRS)


def read_session(folder: Path) -> Session:
    """The session of a run folder, or of its log. Raises SegslamError as `read_run`, or if keyframes are missing."""
    run = read_run(folder)
    (keyframes, cloud_of), estimate = run.log.keyframes(), run.result.estimate.T_world_keyframe
    ids = range(len(keyframes))
    if list(estimate) != list(ids):
        raise SegslamError(f"{run.log.path}: damaged, poses of {len(estimate)} keyframes for {len(ids)}; replay it")
    travel_m = np.array([keyframe.travel_m for keyframe in keyframes])
    return Session(run, keyframes, cloud_of, np.array([estimate[number] for number in ids]), travel_m)


def read_sessions(folders: list[Path]) -> list[Session]:
    """The sessions of several runs, in their order. Raises SegslamError for fewer than two, or one given twice."""
    if len(folders) < 2:
        raise SegslamError(f"{counted(len(folders), 'run')} given; give two or more")
    logs = [log_of(folder).resolve() for folder in folders]
    for number, folder in enumerate(folders):
        if logs[number] in logs[:number]:
            raise SegslamError(f"{folder}: given twice; give each run once")
    return [read_session(folder) for folder in folders]


def shifted(closure: LoopClosure, source_shift: int, target_shift: int) -> LoopClosure:
    """The loop in a graph in which the ids of the two sessions are larger by these numbers."""
    return replace(closure, source_id=closure.source_id + source_shift, target_id=closure.target_id + target_shift)


def shifted_steps(session: Session, more: Mapping[int, LoopAttempt]) -> Iterator[Step]:
    """The steps of a session (`RunLog.whole_steps`) by its shift; `more`: a loop of its keyframes, by original id."""
    shift = session.shift
    for number, step in enumerate(session.run.log.whole_steps(len(session.travel_m))):
        attempts, keyframe = [_shifted(attempt, shift.keyframe_id) for attempt in step.attempts], step.keyframe
        if keyframe is not None:
            attempts += [more[keyframe.id]] if keyframe.id in more else []
            keyframe = replace(
                keyframe,
                id=keyframe.id + shift.keyframe_id,
                scan_index=keyframe.scan_index + shift.scan_index,
                stamp_ns=keyframe.stamp_ns + shift.stamp_ns,
                T_odom_keyframe=shift.T_new_old @ keyframe.T_odom_keyframe,
                travel_m=keyframe.travel_m + shift.travel_m,
            )
        yield replace(
            step,
            scan_index=step.scan_index + shift.scan_index,
            stamp_ns=step.stamp_ns + shift.stamp_ns,
            T_odom_lidar=shift.T_new_old @ step.T_odom_lidar,
            keyframe=keyframe,
            attempts=tuple(attempts),
            motion=FIRST_MOTION if number == 0 and shift.keyframe_id else step.motion,
        )


def _shifted(attempt: LoopAttempt, shift: int) -> LoopAttempt:
    """A loop within a session with the new ids of its keyframes."""
    candidate, outcome = attempt.candidate, attempt.outcome
    return replace(
        attempt,
        candidate=replace(candidate, source_id=candidate.source_id + shift, target_id=candidate.target_id + shift),
        outcome=shifted(outcome, shift, shift) if isinstance(outcome, LoopClosure) else outcome,
    )


def figures_of(sessions: Sequence[Part], result: SlamResult) -> dict[str, Any]:
    """The figures of a merged run, and its length without the way from one session to the next.

    A session may be a merged run itself, whose own sessions begin with such motions.
    """
    first_ids = [session.first_keyframe for session in sessions[1:]]
    between = [
        weight
        for ids, weight in result.estimate.closure_weights.items()
        if len(set(np.searchsorted(first_ids, ids, side="right").tolist())) > 1
    ]
    ends = np.cumsum([session.num_scans for session in sessions])
    begun = np.unique([*ends[:-1], *result.begun]).astype(np.int64)
    T_world_lidar = result.trajectory.T_world_lidar
    return {
        "num_sessions": len(sessions),
        "length_m": float(travelled_m(T_world_lidar, begun)[-1]),
        "num_loops_between": len(between),
        "num_loops_between_switched_off": sum(weight < REJECTED_WEIGHT for weight in between),
    }
