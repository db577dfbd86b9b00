"""A fleet: drives are mapped, related to each other, and joined to components, each in one frame."""

import fcntl
import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from segslam.core.config import setting_texts
from segslam.core.processes import Progress, no_progress
from segslam.core.threads import Stopwatch
from segslam.core.types import SegslamError, WorkFailed
from segslam.core.whole_files import expanded, write_whole
from segslam.graph.confirmation import MIN_CONSISTENT
from segslam.output.folder import writable
from segslam.run.fleets import steps
from segslam.run.fleets.drives import Drive, drives_of, read_drives
from segslam.run.fleets.relations import Components
from segslam.run.fleets.steps import Mapped
from segslam.run.fleets.workers import Outcome, Workers, workers
from segslam.run.sessions.session_pose import Relation

logger = logging.getLogger(__name__)

FILE = "fleet.json"
CORES_OF_WORKER = 2
"""A drive is mapped by two threads."""


@dataclass(frozen=True, slots=True, eq=False)
class FleetResult:
    """What became of a fleet."""

    folder: Path
    drives: dict[str, dict[str, Any]]
    """By name: `state` (mapped or failed), `component` (number, None if it failed), and `reason` of a failure."""
    components: tuple[dict[str, Any], ...]
    """`folder`, names of the `drives`, `num_loops_between`, `ate_m` if it is known, and `reason` if it failed."""
    seconds: dict[str, float]
    """Wall time by step."""

    @property
    def num_loops_between(self) -> int:
        """Loops between drives, in all components."""
        return sum(int(component.get("num_loops_between", 0)) for component in self.components)


def fleet(
    drives: str | Path | Sequence[Drive | str | Path],
    out: str | Path,
    *,
    scheduler: str | None = None,
    num_workers: int | None = None,
    same_reference: bool = False,
    settings: Sequence[str] = (),
    shown: Progress = no_progress,
    say: Callable[[str], object] = lambda text: None,
) -> FleetResult:
    """Map drives and join those that share places, in the folder `out`; what is there already is not done again.

    `drives`: a file with a list (`read_drives`), or recordings. Its calls belong under `if __name__ == "__main__":` in
    a script, because worker processes import it.
    `scheduler`: address of a Dask scheduler, all of whose workers see the recordings and `out` under the same paths;
    otherwise `num_workers` processes of this machine, by default one for two cores. `same_reference`: the true poses of
    all drives are in one frame. `settings`: `section.key=value` texts for all drives. Raises SegslamError if no drive
    could be mapped, or if a worker cannot take part; a drive that fails is in the result, with the reason.
    """
    if num_workers is not None and num_workers < 1:
        raise SegslamError(f"fleet: num_workers={num_workers}; give 1 or more")
    settings = setting_texts(settings)
    if isinstance(drives, Iterable) and not isinstance(drives, str):
        listed = drives_of(drives)
    else:
        listed = read_drives(expanded(drives))
    if not listed:
        raise SegslamError("fleet: no drive; give recordings, or a list of them")
    folder = expanded(out).resolve()
    if around := [drive.data for drive in listed if Path(drive.data) in (folder, *folder.parents)]:
        raise SegslamError(f"{folder}: inside the recording {around[0]}, which it would change; give another --out")
    number = num_workers or max((os.cpu_count() or 1) // CORES_OF_WORKER, 1)
    with _alone_in(folder), workers(folder, number=number, scheduler=scheduler) as (run, dashboard):
        if dashboard:
            say(f"dashboard: {dashboard}")
        listed = [replace(drive, set=(*settings, *drive.set)) for drive in listed]
        for drive in listed:  # mapping the others takes hours
            for path in (drive.data, drive.odometry, drive.config):
                if path and not os.path.exists(path):  # also without permission
                    say(f"{drive.name}: {path}: no such file or folder; the others go on")
        return _Fleet(folder, run, shown, say).run(listed, same_reference)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Context manager that locks a fleet's folder, if the file system can, and removes what interrupted steps left."""
    with ExitStack() as stack:
        with writable(folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, lock)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise SegslamError(f"{folder}: another call of segslam fleet works there; wait for its end") from error
            except OSError as error:  # such as NFS, which does not lock folders
                logger.info("%s: not locked (%s)", folder, error.strerror)
            steps.remove_unfinished(folder)
        try:
            yield
        finally:
            with suppress(OSError):  # it is removed only if it is empty
                folder.rmdir()


class _Fleet:
    """The steps in turn."""

    def __init__(self, folder: Path, run: Workers, shown: Progress, say: Callable[[str], object]) -> None:
        self._folder, self._run, self._shown, self._say = folder, run, shown, say
        self._watch = Stopwatch()
        self._reasons: dict[str, str] = {}

    def run(self, drives: Sequence[Drive], same_reference: bool) -> FleetResult:
        from segslam.run.fleets.report import write_report

        mapped = self._done("index", steps.index_drive, self._done("map", steps.map_drive, drives))
        if not mapped:
            first, why = next(iter(self._reasons.items()))
            raise SegslamError(f"no drive could be mapped; {first}: {why}")
        components = self._related(mapped, self._proposed(mapped))
        made = self._joined(mapped, components, same_reference)
        where = {name: number for number, one in enumerate(made) for name in one["drives"]}
        states: dict[str, dict[str, Any]] = {}
        for drive in drives:
            reason = self._reasons.get(drive.name)
            state = {"state": "failed" if reason else "mapped", "component": where.get(drive.name)}
            states[drive.name] = state | ({"reason": reason} if reason else {})
        result = FleetResult(self._folder, states, tuple(made), self._watch.seconds)
        values = {
            "drives": result.drives,
            "components": result.components,
            "num_loops_between": result.num_loops_between,
            "seconds": {name: round(seconds, 3) for name, seconds in result.seconds.items()},
        }
        write_whole(self._folder / FILE, json.dumps(values, indent=2) + "\n")
        write_report(result)
        failed = [one["reason"] for one in made if "reason" in one]
        if failed:
            raise WorkFailed(f"{self._folder}: {failed[0]}; correct it, and call `segslam fleet` again to go on")
        return result

    def _all(self, name: str, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> list[Outcome]:
        """The outcomes of a step, in the order of its tasks."""
        with self._watch(name):
            done = self._run(function, tasks)
            outcomes: dict[int, Outcome] = dict(self._shown(done, len(tasks), name) if tasks else ())
        return [outcomes[number] for number in range(len(tasks))]

    def _done(self, step: str, function: Callable[..., Mapped], drives: Sequence[Drive | Mapped]) -> list[Mapped]:
        """The drives for which the step did not fail."""
        outcomes = self._all(step, function, [(self._folder, drive) for drive in drives])
        done = [outcome.value for outcome in outcomes if outcome.failure is None]
        failed = [(drive.name, one.failure) for drive, one in zip(drives, outcomes, strict=True) if one.failure]
        num_in_error = int(not done and not self._reasons)
        for name, reason in failed[num_in_error:]:
            self._say(f"{name}: {reason}")
        self._reasons |= failed
        return done

    def _proposed(self, mapped: Sequence[Mapped]) -> dict[tuple[int, int], list[tuple[int, float]]]:
        """Keyframes of a drive that look most like places of an earlier one, by the numbers of both."""
        tasks = [(self._folder, drive, mapped[:number]) for number, drive in enumerate(mapped)]
        numbers = {drive.name: number for number, drive in enumerate(mapped)}
        proposals: dict[tuple[int, int], list[tuple[int, float]]] = {}
        for later, outcome in enumerate(self._all("propose", steps.propose, tasks)):
            proposals |= {(later, numbers[name]): likely for name, likely in _value(outcome, mapped[later]).items()}
        return proposals

    def _related(
        self, mapped: Sequence[Mapped], proposals: Mapping[tuple[int, int], list[tuple[int, float]]]
    ) -> Components:
        """The most similar pairs of drives are related first, until all are joined or tried."""
        components = Components(len(mapped))
        similarity = {pair: sum(score for _, score in likely[:MIN_CONSISTENT]) for pair, likely in proposals.items()}
        while pairs := components.next_pairs(similarity):
            tasks = []
            for later, earlier in pairs:
                queries = [keyframe_id for keyframe_id, _ in proposals[later, earlier]]
                tasks.append((self._folder, mapped[later], mapped[earlier], queries))
            for pair, outcome in zip(pairs, self._all("relate", steps.relate, tasks), strict=True):
                relation: Relation = _value(outcome, mapped[pair[0]])
                components.add(*pair, relation)
                how = f"is not joined to {mapped[pair[1]].name}: {relation.reason}"
                if relation.T_earlier_later is not None:
                    how = f"is joined to {mapped[pair[1]].name} by {len(relation.found)} of its keyframes"
                self._say(f"{mapped[pair[0]].name} {how}")
        return components

    def _joined(self, mapped: Sequence[Mapped], components: Components, same: bool) -> list[dict[str, Any]]:
        tasks, made = [], []
        for number, (order, poses) in enumerate(components.arranged()):
            drives = [mapped[drive] for drive in order]
            folder = self._folder / f"component_{number}"
            tasks.append((folder, drives, poses, same))
            made.append({"folder": folder.name, "drives": [drive.name for drive in drives]})
        for one, outcome in zip(made, self._all("join", steps.join, tasks), strict=True):
            figures = outcome.value or {}
            names = ("num_loops_between", "num_keyframes", "length_m", "ate_m")
            one |= {name: figures[name] for name in names if name in figures}
            one |= {"reason": outcome.failure} if outcome.failure else {}
        steps.remove_components(self._folder, keep=len(made))
        return made


def _value(outcome: Outcome, drive: Mapped) -> Any:
    """The value of a drive's task. Raises WorkFailed if it failed."""
    if outcome.failure is not None:
        raise WorkFailed(f"{drive.name}: {outcome.failure}; call `segslam fleet` again to go on")
    return outcome.value
