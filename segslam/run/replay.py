"""Loop closing and optimisation again, from the log of a run; also with loops that its position fixes propose."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from segslam.candidates.proximity import GAP_M
from segslam.core.config import Config, ProximityConfig, changed_settings, load_config
from segslam.core.trajectory import travelled_m
from segslam.core.types import SegslamError, Vector
from segslam.core.whole_files import expanded
from segslam.output.finished import FinishedRun, parts_in, read_run
from segslam.output.folder import copy_alone, new_folder
from segslam.output.georeferenced import FILE, read_globe
from segslam.output.log import Mirror, RunLog, read_log
from segslam.run.run import Run
from segslam.slam.loop_edits import NO_EDITS, LoopEdits, Pair
from segslam.slam.slam import Slam

BEFORE_THE_KEYFRAMES = ("sensor", "odometry", "health", "keyframes")
"""Sections of the settings that a replay cannot change, because the log contains their results."""


def replay(
    run: str | Path, out: str | Path, *, settings: Sequence[str] = (), edits: LoopEdits = NO_EDITS
) -> FinishedRun:
    """Repeat loop closing and optimisation of a run into the new folder `out`, like `segslam replay` and `edit`.

    `run`: its folder or log.mcap. `settings`: changes such as `"verify.max_false_share=0.01"`; `edits` forbids and adds
    loops. Raises SegslamError for a setting that cannot be changed, and for a run localised in the map of another.
    """
    replayed = Replay.of(expanded(run), settings=settings, edits=edits)
    if replayed.in_map:
        raise SegslamError(f"{run}: localised in the map of another run; use the command `segslam replay`")
    folder = new_folder(expanded(out))
    with replayed.begun(folder) as made:
        copy_alone(replayed.recorded.path.parent, folder)
        for _ in made.repeat(replayed.recorded.steps()):
            pass
        made.complete()
    return read_run(folder)


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What a run is made of that starts from the log of another."""

    recorded: RunLog
    config: Config
    edits: LoopEdits = NO_EDITS
    """Those of the logged run, then those of this one."""

    @classmethod
    def of(
        cls, run: Path, *, config: Path | None = None, settings: Sequence[str] = (), edits: LoopEdits = NO_EDITS
    ) -> "Replay":
        """Reads the log of a run, as `read_log_with_steps`. Raises SegslamError also for a change without effect."""
        recorded = read_log_with_steps(run)
        changed = changed_config(recorded, file=config, settings=settings)
        return cls(recorded, changed, LoopEdits.from_json(recorded.options.get("edits", "")).and_then(edits))

    @property
    def in_map(self) -> Path | None:
        """The run in whose map the logged one was localised, if it was."""
        name = self.recorded.options.get("in_map")
        return Path(name) if name else None

    def begun(self, folder: Path, slam: Slam | None = None, *, mirror: Mirror | None = None) -> Run:
        """The new run in its folder, before its first step. By default, `slam` closes loops with the edits."""
        options = {name: text for name in ("in_map", "sessions") if (text := self.recorded.options.get(name))}
        if self.edits != NO_EDITS:
            options["edits"] = self.edits.to_json()
        return Run(
            folder,
            slam or Slam(self.config, edits=self.edits),
            dataset=self.recorded.run.get("dataset", ""),
            T_camera_lidar=self.recorded.T_camera_lidar,
            reference=self.recorded.reference(),
            options=options,
            mirror=mirror,
        )


def read_log_with_steps(run: Path) -> RunLog:
    """The log of a run, given its folder or the log. Raises SegslamError also for a log without a step."""
    recorded = read_log(run)
    parts_in(recorded.options.get("sessions", ""))  # a damaged log is named as such, also without a step
    if recorded.num_steps() == 0:
        raise SegslamError(f"{recorded.path}: has no complete step; continue it (segslam resume), or map again")
    return recorded


def changed_config(
    recorded: RunLog, *, file: Path | None = None, settings: Sequence[str] = (), what: str = "a replay"
) -> Config:
    """The settings of a logged run with changes. Raises SegslamError for a change without effect on `what`."""
    config = load_config(file, settings, base=recorded.config)
    for key, before, _ in changed_settings(recorded.config, config):
        if key.partition(".")[0] in BEFORE_THE_KEYFRAMES:
            raise SegslamError(
                f"{key}: {what} uses the keyframes of {recorded.path}, which were made with {before}; "
                "keep this value, or map the data again"
            )
    return config


def pairs_near_fixes(run_or_log: Path) -> frozenset[Pair]:
    """Loops of a georeferenced run that were not tried. Raises SegslamError if it has no place on the globe."""
    run = read_run(run_or_log)
    globe = read_globe(run.folder)
    if globe is None:
        raise SegslamError(f"{run.folder / FILE}: missing; `segslam georeference` the run first")
    rows = run.result.keyframe_rows
    loops = [closure.pair for closure in run.result.closures()]
    tried = {attempt.candidate.pair for attempt in run.result.attempts}
    travel_m = travelled_m(run.result.odometry.T_world_lidar)[rows]
    return pairs_near(globe.T_enu_lidar[rows, :2, 3], travel_m, loops, tried, config=run.config.proximity)


def pairs_near(
    east_north_m: Float[np.ndarray, "n 2"],
    travel_m: Vector,
    loops: Collection[Pair],
    tried: Collection[Pair],
    *,
    config: ProximityConfig,
) -> frozenset[Pair]:
    """For keyframes `min_gap_m` apart the nearest older one within `base_radius_m`, the radius without drift.

    None where a loop joins the two places already, and no pair that was tried.
    """
    tree, pairs, last_m = cKDTree(east_north_m), set[Pair](), -np.inf
    ends_m = travel_m[np.array(list(loops), np.int64).reshape(-1, 2)]
    for newer, place in enumerate(east_north_m):
        near = np.array(tree.query_ball_point(place, config.base_radius_m), np.int64)
        near = near[travel_m[near] <= travel_m[newer] - config.min_travel_m]
        if not len(near) or travel_m[newer] - last_m < GAP_M:
            continue
        older = int(near[np.linalg.norm(east_north_m[near] - place, axis=1).argmin()])
        is_joined = (np.abs(ends_m - travel_m[[newer, older]]) < GAP_M + config.base_radius_m).all(axis=1)
        if not is_joined.any() and (newer, older) not in tried:
            pairs.add((newer, older))
            last_m = travel_m[newer]
    return frozenset(pairs)
