"""A finished run as one session of a merged run: its keyframes, and its steps with new numbers."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from segslam.core.trajectory import Poses
from segslam.core.types import (
    Information,
    LoopAttempt,
    LoopClosure,
    Motion,
    MotionState,
    SegslamError,
    Step,
    Transform,
    Vector,
)
from segslam.output.finished import FinishedRun, read_corrections, read_run
from segslam.output.folder import log_of
from segslam.output.log import RunLog, read_log
from segslam.slam.adjustment import Known
from segslam.slam.adjustment.alignment import MIN_PAIRS
from segslam.slam.adjustment.known import Kept, nothing_kept
from segslam.slam.adjustment.sweeps import common_sweep
from segslam.slam.adjustment.vertical_angle import VerticalAngle

FIRST_MOTION = Motion(MotionState.BEGUN, information=1e-12 * np.eye(6))
"""The motion to the first scan of a session, which is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A finished run with the poses of its keyframes."""

    run: FinishedRun
    log: RunLog
    T_world_keyframe: Poses
    """Poses by the run's own estimate."""
    T_odom_keyframe: Poses
    travel_m: Vector
    informations: tuple[Information | None, ...]
    """Information of the motion from the previous keyframe to each keyframe; None for the noise model of odometry."""

    @property
    def name(self) -> str:
        """The folder of the run."""
        return str(self.run.folder)


def known_of(sessions: Sequence[Session], kept: Kept = nothing_kept) -> Known:
    """The results of the sessions' own adjustments, for all of them together."""
    poses = np.concatenate([session.T_world_keyframe for session in sessions])
    corrections = [one for each in sessions for one in read_corrections(each.log, len(each.travel_m))]
    adjustments = [session.log.adjustment() for session in sessions]
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
    log = read_log(folder)
    estimate = run.result.estimate.T_world_keyframe
    T_odom, travel_m = [], []
    for step in log.steps(clouds=False):
        if step.keyframe is not None:
            T_odom.append(step.keyframe.T_odom_keyframe)
            travel_m.append(step.keyframe.travel_m)
    if list(estimate) != list(range(len(T_odom))):
        raise SegslamError(f"{log.path}: damaged, poses of {len(estimate)} keyframes for {len(T_odom)}; replay it")
    poses = np.array([estimate[number] for number in range(len(T_odom))])
    informations = tuple(run.result.keyframe_informations())
    return Session(run, log, poses, np.array(T_odom), np.array(travel_m), informations)


def read_sessions(folders: list[Path]) -> list[Session]:
    """The sessions of several runs, in their order. Raises SegslamError for fewer than two, or one given twice."""
    if len(folders) < 2:
        raise SegslamError(f"{len(folders)} run given; give two or more")
    logs = [log_of(folder).resolve() for folder in folders]
    for number, folder in enumerate(folders):
        if logs[number] in logs[:number]:
            raise SegslamError(f"{folder}: given twice; give each run once")
    return [read_session(folder) for folder in folders]


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Offsets of the numbers of a session, so that its steps follow those of the previous sessions."""

    keyframe_id: int = 0
    scan_index: int = 0
    stamp_ns: int = 0
    travel_m: float = 0.0
    T_new_old: Transform | None = None
    """Transform of its odometry frame; None for identity."""

    def pose(self, T_odom_lidar: Transform) -> Transform:
        """A pose of the session's odometry in that of the merged run."""
        return T_odom_lidar if self.T_new_old is None else self.T_new_old @ T_odom_lidar

    def attempt(self, attempt: LoopAttempt) -> LoopAttempt:
        """A loop of the session with the new ids of its keyframes."""
        ids = {name: getattr(attempt.candidate, name) + self.keyframe_id for name in ("source_id", "target_id")}
        outcome = attempt.outcome
        return replace(
            attempt,
            candidate=replace(attempt.candidate, **ids),
            outcome=replace(outcome, **ids) if isinstance(outcome, LoopClosure) else outcome,
        )


def shifted_steps(session: Session, shift: Shift, more: Mapping[int, tuple[LoopAttempt, ...]]) -> Iterator[Step]:
    """The steps of a session (`RunLog.whole_steps`); `more`: further loops of its keyframes, by original id."""
    for number, step in enumerate(session.log.whole_steps(len(session.travel_m))):
        attempts, keyframe, motion = [shift.attempt(attempt) for attempt in step.attempts], step.keyframe, step.motion
        if keyframe is not None:
            attempts += more.get(keyframe.id, ())
            keyframe = replace(
                keyframe,
                id=keyframe.id + shift.keyframe_id,
                scan_index=keyframe.scan_index + shift.scan_index,
                stamp_ns=keyframe.stamp_ns + shift.stamp_ns,
                T_odom_keyframe=shift.pose(keyframe.T_odom_keyframe),
                travel_m=keyframe.travel_m + shift.travel_m,
            )
        if number == 0 and shift.keyframe_id:
            motion = FIRST_MOTION
        yield Step(
            step.scan_index + shift.scan_index,
            step.stamp_ns + shift.stamp_ns,
            shift.pose(step.T_odom_lidar),
            keyframe,
            tuple(attempts),
            None,
            step.stage_seconds,
            motion,
        )
