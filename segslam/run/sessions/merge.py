"""Merging of several finished runs into one: one graph, one map, one log."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from segslam.candidates.proximity import BREAK_STEP_M
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import REJECTED_WEIGHT, LoopAttempt, SegslamError, Step, Trajectory
from segslam.gnss import Use
from segslam.gnss.fixes import Row
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import new_folder
from segslam.output.georeferenced import georeference_if_possible, recorded_fixes, use_of
from segslam.output.log import RunLog
from segslam.run.locator import Locator
from segslam.run.run import Run
from segslam.run.sessions.recorded import Session, Shift, known_of, read_sessions, shifted_steps
from segslam.run.sessions.session_pose import SessionPose, attempt, find_session, shifted
from segslam.slam.adjustment import Progress, no_progress
from segslam.slam.adjustment.known import Kept, nothing_kept
from segslam.slam.slam import Slam, SlamResult

OPTIMIZE_EVERY = 25
"""Chosen: number of keyframes of a later session between two optimisations; odometry drifts little over 50 m."""
SEARCH_EVERY_M = 12.0
"""Chosen: travel between two keyframes of a later session for which loops with earlier sessions are searched."""
GAP_NS = 1_000_000_000
"""Chosen: pause inserted before the first scan of a session that is not later than the previous session."""
StepToTake = tuple[Step, int, bool]
"""A step, and the arguments `below` and `optimize` of `Slam.take`."""


class Before(NamedTuple):
    """A merged run of the first sessions, with the same order, poses and settings."""

    log: RunLog
    num_sessions: int


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Sessions with known relative poses, in the order in which they are merged."""

    sessions: tuple[Session, ...]
    session_poses: tuple[SessionPose | None, ...]
    """None for the first session."""
    shifts: tuple[Shift, ...]
    reference: Trajectory | None
    """The true poses of all sessions, if they are known to be in one frame."""

    @property
    def num_steps(self) -> int:
        """Number of scans of all sessions."""
        return sum(len(session.run.result.trajectory) for session in self.sessions)

    def summary(self) -> str:
        """One line per session: the run in which it was found."""
        lines = [
            f"{session.name}: found in {self.sessions[found.earlier].name} by {len(found.found)} of its keyframes"
            for session, found in zip(self.sessions, self.session_poses, strict=True)
            if found is not None
        ]
        return "\n".join(lines)

    def options(self) -> dict[str, str]:
        """For the log: the merged runs, and the offsets of their numbers."""
        rows = [
            {
                "run": str(session.run.folder.resolve()),
                "num_scans": len(session.run.result.trajectory),
                "first_keyframe": shift.keyframe_id,
                "scan_index_shift": shift.scan_index,
                "stamp_shift_ns": shift.stamp_ns,
            }
            for session, shift in zip(self.sessions, self.shifts, strict=True)
        ]
        return {"sessions": json.dumps(rows)}

    def begun(self, folder: Path, config: Config, *, kept: Kept = nothing_kept) -> Run:
        """The merged run in its folder, before it takes over the first of `steps`. `kept`: as for `write_merged`."""
        return Run(
            folder,
            Slam(config, known=known_of(self.sessions, kept)),
            dataset=" + ".join(dict.fromkeys(session.run.dataset for session in self.sessions)),
            T_camera_lidar=self.sessions[0].run.T_camera_lidar,
            reference=self.reference,
            options=self.options(),
        )

    def steps(self, before: Before | None = None) -> Iterator[StepToTake]:
        """The steps of all sessions; loops with earlier sessions are searched for the later ones.

        The sessions merged `before` bring the loops that were found then.
        """
        merged = iter(()) if before is None else before.log.steps()
        for row, (session, shift, found) in enumerate(zip(self.sessions, self.shifts, self.session_poses, strict=True)):
            is_new = before is None or row >= before.num_sessions
            own = shifted_steps(session, shift, self._found(shift, found))
            last_id = len(session.travel_m) - 1
            searched_m = -np.inf
            for step in own if is_new else islice(merged, len(session.run.result.trajectory)):
                below, optimize = 0, False
                if step.keyframe is not None:
                    number = step.keyframe.id - shift.keyframe_id
                    optimize = number == last_id or (found is not None and number % OPTIMIZE_EVERY == 0)
                    if is_new and step.keyframe.travel_m - searched_m >= SEARCH_EVERY_M:
                        below, searched_m = shift.keyframe_id, step.keyframe.travel_m
                yield step, below, optimize

    def _found(self, shift: Shift, found: SessionPose | None) -> dict[int, tuple[LoopAttempt, ...]]:
        if found is None:
            return {}
        target_shift = self.shifts[found.earlier].keyframe_id
        return {one.source_id: (attempt(shifted(one, shift.keyframe_id, target_shift)),) for one in found.found}

    def georeference(self, folder: Path) -> str:
        """Place the merged run on the globe by the fixes of all its sessions.

        Returns what was found; empty if no session has a place on the globe, or after a warning.
        """
        rows, uses = list[Row](), set[str]()
        for session, shift in zip(self.sessions, self.shifts, strict=True):
            rows += recorded_fixes(session.run.folder, stamp_shift_ns=shift.stamp_ns)
            uses |= {use} if (use := use_of(session.run.folder)) else set()
        source = " + ".join(session.name for session in self.sessions)
        use = Use.ALIGN if uses == {Use.ALIGN} else Use.FUSE
        return georeference_if_possible(folder, source, rows, use=use) if rows else ""

    def figures(self, result: SlamResult) -> dict[str, Any]:
        """The figures of `metrics.json` that only merged runs have."""
        first_ids = [shift.keyframe_id for shift in self.shifts[1:]]
        between = [
            weight
            for ids, weight in result.estimate.closure_weights.items()
            if len(set(np.searchsorted(first_ids, ids, side="right").tolist())) > 1
        ]
        return {
            "num_sessions": len(self.sessions),
            "num_loops_between": len(between),
            "num_loops_between_switched_off": sum(weight < REJECTED_WEIGHT for weight in between),
        }


def plan(
    sessions: Sequence[Session], *, config: Config, same_reference: bool = False, progress: Progress = no_progress
) -> Merged:
    """Determine how sessions are merged. Writes nothing.

    `same_reference`: the true poses of all runs are in one frame, as for runs of one sequence. Raises SegslamError,
    naming the run, if one was not found in any other.
    """
    taken: list[Session] = [sessions[0]]
    session_poses: list[SessionPose | None] = [None]
    locators: list[Locator] = []
    waiting, why = list(sessions[1:]), dict[tuple[str, int], str]()
    while waiting:
        locators += [Locator.from_run(session.run.folder) for session in taken[len(locators) :]]
        session, found = _find_any(waiting, taken, locators, why, config=config, progress=progress)
        taken.append(session)
        session_poses.append(found)
        waiting.remove(session)
    return arranged(taken, session_poses, same_reference=same_reference)


def arranged(
    sessions: Sequence[Session], session_poses: Sequence[SessionPose | None], *, same_reference: bool = False
) -> Merged:
    """Sessions with known poses, each in one that comes before it; the first has none."""
    shifts = _shifts(sessions, session_poses)
    return Merged(tuple(sessions), tuple(session_poses), shifts, _reference(sessions, shifts, same_reference))


def merge(
    runs: Sequence[str | Path],
    out: str | Path,
    *,
    config: Config | None = None,
    same_reference: bool = False,
    on_step: Callable[[Step], object] = lambda step: None,
) -> FinishedRun:
    """Merge finished runs into the new folder `out`, like `segslam merge`; returns the merged run.

    Its world frame is that of the first run. `config`: settings, by default those of the first run. `same_reference`:
    the true poses of all runs are in one frame. `on_step` is called with each Step. Raises SegslamError, naming the
    run, if one did not finish, is damaged, is given twice or was not found in any other.
    """
    sessions = read_sessions([Path(run) for run in runs])
    config = config or sessions[0].run.config
    merged = plan(sessions, config=config, same_reference=same_reference)
    return write_merged(merged, new_folder(Path(out)), config, on_step=on_step)


def write_merged(
    merged: Merged,
    folder: Path,
    config: Config,
    *,
    kept: Kept = nothing_kept,
    before: Before | None = None,
    on_step: Callable[[Step], object] = lambda step: None,
) -> FinishedRun:
    """The merged run, in an empty folder. `kept` knows alignments of submaps from earlier, `before` loops."""
    with merged.begun(folder, config, kept=kept) as run:
        for step in run.take(merged.steps(before)):
            on_step(step)
        run.complete(more=merged.figures, place=merged.georeference)
    return read_run(folder)


def _find_any(
    waiting: Sequence[Session],
    taken: Sequence[Session],
    locators: Sequence[Locator],
    why: dict[tuple[str, int], str],
    *,
    config: Config,
    progress: Progress,
) -> tuple[Session, SessionPose]:
    """The first session that is found in one of those taken, and its pose. Reasons of failures are added to `why`."""
    for session in waiting:
        for number, (earlier, locator) in enumerate(zip(taken, locators, strict=True)):
            if (session.name, number) not in why:
                found = find_session(session, earlier, locator, config=config, progress=progress)
                if found.T_earlier_later is not None:
                    return session, SessionPose(number, found.T_earlier_later, found.found)
                why[session.name, number] = found.reason
    first = waiting[0].name
    tried = "; ".join(f"in {one.name}: {why[first, number]}" for number, one in enumerate(taken))
    raise SegslamError(f"{first}: not found in any other run ({tried}); merge runs that share places")


def _shifts(sessions: Sequence[Session], session_poses: Sequence[SessionPose | None]) -> tuple[Shift, ...]:
    """Offsets of the numbers of each session, and the transform of its odometry to the pose found.

    Stamps that are later than those of the previous session are unchanged.
    """
    shifts = [Shift()]
    T_first_world = [np.eye(4)]
    for before, session, found in zip(sessions[:-1], sessions[1:], session_poses[1:], strict=True):
        T_before_world, last = T_first_world[-1], shifts[-1]
        if found is not None:
            T_first_world.append(T_first_world[found.earlier] @ found.T_earlier_world)
        T_last_first = geometry.inverse(T_before_world @ before.T_world_keyframe[-1]) @ (
            T_first_world[-1] @ session.T_world_keyframe[0]
        )
        T_new_first = last.pose(before.T_odom_keyframe[-1]) @ T_last_first
        drive, first_ns = before.run.result.trajectory, int(session.run.result.trajectory.stamp_ns[0])
        last_ns = int(drive.stamp_ns[-1]) + last.stamp_ns
        shift = Shift(
            keyframe_id=last.keyframe_id + len(before.travel_m),
            scan_index=last.scan_index + int(drive.scan_index[-1]) + 1,
            stamp_ns=0 if first_ns > last_ns else last_ns + GAP_NS - first_ns,
            travel_m=last.travel_m + float(before.travel_m[-1]) + BREAK_STEP_M,
            T_new_old=T_new_first @ geometry.inverse(session.T_odom_keyframe[0]),
        )
        shifts.append(shift)
    return tuple(shifts)


def _reference(sessions: Sequence[Session], shifts: Sequence[Shift], same_reference: bool) -> Trajectory | None:
    """The true poses of all sessions by new scan numbers; None if a session has none, or another frame."""
    sequences = {(one.run.options.get("data"), one.run.options.get("sequence")) for one in sessions}
    is_one_sequence = len(sequences) == 1 and sequences != {(None, None)}
    references = [session.run.reference for session in sessions]
    if not (same_reference or is_one_sequence) or any(reference is None for reference in references):
        return None
    known = [(one, shift) for one, shift in zip(references, shifts, strict=True) if one is not None]
    return Trajectory(
        np.concatenate([one.scan_index + shift.scan_index for one, shift in known]),
        np.concatenate([one.stamp_ns + shift.stamp_ns for one, shift in known]),
        np.concatenate([one.T_world_lidar for one, _ in known]),
    )
