"""Merging of several finished runs into one: one graph, one map, one log."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from itertools import islice, product
from pathlib import Path

import numpy as np

from segslam.candidates.places import OTHER_PLACE_M
from segslam.core import geometry
from segslam.core.config import Config, check_config
from segslam.core.processes import Progress, no_progress
from segslam.core.types import LoopAttempt, SegslamError, Step, Trajectory
from segslam.core.whole_files import all_expanded, expanded
from segslam.gnss import Use
from segslam.gnss.fixes import Row, make_fixes
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import new_folder
from segslam.output.georeferenced import georeference_if_possible, recorded_fixes
from segslam.output.log import RunLog
from segslam.run.locator import Locator
from segslam.run.run import Run
from segslam.run.sessions.recorded import Session, SessionPose, Shift, known_of, read_sessions, shifted, shifted_steps
from segslam.run.sessions.session_pose import Relation, attempt, find_session
from segslam.slam.adjustment.known import Kept, nothing_kept
from segslam.slam.loop_edits import NO_EDITS, LoopEdits
from segslam.slam.slam import Slam

OPTIMIZE_EVERY = 25
"""Chosen: number of keyframes of a later session between two optimisations; odometry drifts little over 50 m."""
GAP_NS = 1_000_000_000
"""Chosen: pause inserted before the first scan of a session that is not later than the previous session."""
StepToTake = tuple[Step, int, bool]
"""A step, and the arguments `below` and `optimize` of `Slam.take`."""


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """Sessions with known relative poses, in the order in which they are merged."""

    sessions: tuple[Session, ...]
    reference: Trajectory | None
    """The true poses of all sessions, if they are known to be in one frame."""

    @property
    def num_steps(self) -> int:
        """Number of scans of all sessions."""
        return sum(len(session.run.result.trajectory) for session in self.sessions)

    def summary(self) -> str:
        """One line per session: the run in which it was found."""
        return "\n".join(
            f"{session.name}: found in {self.sessions[found.earlier].name} by {len(found.found)} of its keyframes"
            for session in self.sessions
            if (found := session.found) is not None
        )

    def begun(self, folder: Path, config: Config, *, kept: Kept = nothing_kept) -> Run:
        """The merged run in its folder, before it takes over the first of `steps`. `kept`: as for `write_merged`."""
        rows = [
            {
                "run": str(session.run.folder.resolve()),
                "num_scans": len(session.run.result.trajectory),
                "first_keyframe": session.shift.keyframe_id,
                "scan_index_shift": session.shift.scan_index,
                "stamp_shift_ns": session.shift.stamp_ns,
            }
            for session in self.sessions
        ]
        edits = reduce(LoopEdits.and_then, map(_edits, self.sessions))
        return Run(
            folder,
            Slam(config, edits=edits, known=known_of(self.sessions, kept)),
            dataset=" + ".join(dict.fromkeys(session.run.dataset for session in self.sessions)),
            T_camera_lidar=self.sessions[0].run.T_camera_lidar,
            reference=self.reference,
            options={"sessions": json.dumps(rows), "edits": "" if edits == NO_EDITS else edits.to_json()},
        )

    def steps(self, before: RunLog | None = None) -> Iterator[StepToTake]:
        """The steps of all sessions; loops with earlier sessions are searched for the later ones.

        `before`: a merged run of the first sessions, with the same order, poses and settings; they bring its loops.
        """
        merged = iter(()) if before is None else before.steps()
        num_before = 0 if before is None else len(json.loads(before.options["sessions"]))
        for row, session in enumerate(self.sessions):
            is_new, first_id, last_id = row >= num_before, session.shift.keyframe_id, len(session.travel_m) - 1
            own = shifted_steps(session, self._found(session))
            searched_m = -np.inf
            for step in own if is_new else islice(merged, len(session.run.result.trajectory)):
                below, optimize = 0, False
                if step.keyframe is not None:
                    number = step.keyframe.id - first_id
                    optimize = number == last_id or (session.found is not None and number % OPTIMIZE_EVERY == 0)
                    if is_new and step.keyframe.travel_m - searched_m >= OTHER_PLACE_M:
                        below, searched_m = first_id, step.keyframe.travel_m
                yield step, below, optimize

    def _found(self, session: Session) -> dict[int, LoopAttempt]:
        """The loops by which a session was found, by the original ids of its keyframes."""
        if session.found is None:
            return {}
        shifts = session.shift.keyframe_id, self.sessions[session.found.earlier].shift.keyframe_id
        return {one.source_id: attempt(shifted(one, *shifts)) for one in session.found.found}

    def georeference(self, folder: Path) -> str:
        """Place the merged run on the globe by the fixes of all its sessions, if any; returns what was found."""
        rows, uses = list[Row](), set[str]()
        for session in self.sessions:
            fixes, used = recorded_fixes(session.run.folder, stamp_shift_ns=session.shift.stamp_ns)
            rows += fixes
            uses |= {used} if used else set()
        source = " + ".join(session.name for session in self.sessions)
        use = Use.ALIGN if uses == {Use.ALIGN} else Use.FUSE
        return georeference_if_possible(folder, lambda: make_fixes(source, rows), use=use) if rows else ""


def plan(
    sessions: Sequence[Session], *, config: Config, same_reference: bool = False, progress: Progress = no_progress
) -> Merged:
    """Determine how sessions are merged. Writes nothing.

    `same_reference`: the true poses of all runs are in one frame, as for runs of one sequence. Raises SegslamError,
    naming the run, if one was not found in any other.
    """

    @cache
    def locator(number: int) -> Locator:
        return Locator(sessions[number], config)

    @cache
    def related(later: int, earlier: int) -> Relation:
        return find_session(sessions[later], locator(earlier), config=config, progress=progress)

    order, poses = [0], list[SessionPose | None]([None])
    while waiting := [number for number in range(len(sessions)) if number not in order]:
        for later, (row, earlier) in product(waiting, enumerate(order)):
            found = related(later, earlier)
            if found.T_earlier_later is not None:
                order.append(later)
                poses.append(SessionPose(row, found.T_earlier_later, found.found))
                break
        else:
            tried = "; ".join(f"in {sessions[number].name}: {related(waiting[0], number).reason}" for number in order)
            raise SegslamError(
                f"{sessions[waiting[0]].name}: not found in any other run ({tried}); merge runs that share places"
            )
    return arranged([sessions[number] for number in order], poses, same_reference=same_reference)


def arranged(
    sessions: Sequence[Session], session_poses: Sequence[SessionPose | None], *, same_reference: bool = False
) -> Merged:
    """Sessions with known poses, each in one that comes before it; the first has none."""
    placed = tuple(_placed(sessions, session_poses))
    return Merged(placed, _reference(placed, same_reference))


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
    check_config(config)
    sessions = read_sessions(all_expanded(runs))
    config = config or sessions[0].run.config
    merged = plan(sessions, config=config, same_reference=same_reference)
    folder = new_folder(expanded(out))
    write_merged(merged, folder, config, on_step=on_step)
    return read_run(folder)


def write_merged(
    merged: Merged,
    folder: Path,
    config: Config,
    *,
    kept: Kept = nothing_kept,
    before: RunLog | None = None,
    on_step: Callable[[Step], object] = lambda step: None,
) -> None:
    """Write the merged run into an empty folder. `kept` knows alignments of submaps from earlier, `before` loops."""
    with merged.begun(folder, config, kept=kept) as run:
        for step in run.take(merged.steps(before)):
            on_step(step)
        run.complete(place=merged.georeference)


def _edits(session: Session) -> LoopEdits:
    """The edits of a session by the new ids of its keyframes."""
    return LoopEdits.from_json(session.run.options.get("edits", "")).shifted(session.shift.keyframe_id)


def _placed(sessions: Sequence[Session], session_poses: Sequence[SessionPose | None]) -> Iterator[Session]:
    """The sessions with offsets of their numbers, and the transform of their odometry to the pose found.

    Stamps that are later than those of the previous session are unchanged.
    """
    yield sessions[0]
    shift, T_first_world = sessions[0].shift, [np.eye(4)]
    for before, session, found in zip(sessions[:-1], sessions[1:], session_poses[1:], strict=True):
        T_before_world = T_first_world[-1]
        if found is not None:
            T_first_world.append(T_first_world[found.earlier] @ found.T_earlier_world)
        T_last_first = geometry.inverse(T_before_world @ before.T_world_keyframe[-1]) @ (
            T_first_world[-1] @ session.T_world_keyframe[0]
        )
        T_new_first = shift.T_new_old @ before.keyframes[-1].T_odom_keyframe @ T_last_first
        drive, first_ns = before.run.result.trajectory, int(session.run.result.trajectory.stamp_ns[0])
        last_ns = int(drive.stamp_ns[-1]) + shift.stamp_ns
        shift = Shift(
            keyframe_id=shift.keyframe_id + len(before.travel_m),
            scan_index=shift.scan_index + int(drive.scan_index[-1]) + 1,
            stamp_ns=0 if first_ns > last_ns else last_ns + GAP_NS - first_ns,
            travel_m=shift.travel_m + float(before.travel_m[-1]),
            T_new_old=T_new_first @ geometry.inverse(session.keyframes[0].T_odom_keyframe),
        )
        yield replace(session, shift=shift, found=found)


def _reference(sessions: Sequence[Session], same_reference: bool) -> Trajectory | None:
    """The true poses of all sessions by new scan numbers; None if a session has none, or another frame.

    Without those after the last mapped scan of a session, whose numbers are those of the next session.
    """
    sequences = {(one.run.options.get("data"), one.run.options.get("sequence")) for one in sessions}
    is_one_sequence = len(sequences) == 1 and sequences != {(None, None)}
    known = [
        (truth, truth.scan_index <= one.run.result.trajectory.scan_index[-1], one.shift)
        for one in sessions
        if (truth := one.run.reference) is not None
    ]
    if not (same_reference or is_one_sequence) or len(known) < len(sessions):
        return None
    return Trajectory(
        np.concatenate([truth.scan_index[rows] + shift.scan_index for truth, rows, shift in known]),
        np.concatenate([truth.stamp_ns[rows] + shift.stamp_ns for truth, rows, shift in known]),
        np.concatenate([truth.T_world_lidar[rows] for truth, rows, _ in known]),
    )
