"""`segslam replay`."""

from contextlib import suppress
from itertools import tee
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import changed_settings
from segslam.cli.console import ConfigOption, JsonOption, QuietOption, SetOption, progress
from segslam.cli.ending import finish

if TYPE_CHECKING:
    from segslam.config import Config
    from segslam.log import RunLog
    from segslam.runs import Run
    from segslam.types import Step, Trajectory

BEFORE_THE_KEYFRAMES = ("odometry", "keyframes", "geometric")
"""Sections of the settings whose work the log holds done."""


def replay(
    log: Annotated[Path, typer.Argument(help="The log.mcap of a run, finished or cut.")],
    out: Annotated[Path, typer.Option(help="New folder for the run.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Do a run again from its log: loops and graph, with its settings but for those given here.

    Example: segslam replay runs/00/log.mcap --out runs/00-strict --set verify.min_overlap=0.6
    """
    from segslam.config import load_config
    from segslam.log import read_log
    from segslam.run_files import new_folder
    from segslam.runs import Run
    from segslam.slam import Slam

    recorded = read_log(log)
    settings_now = load_config(config, settings or (), base=recorded.config)
    _check_settings(settings_now, recorded)
    reference = recorded.reference()
    with Run(
        new_folder(out),
        Slam(settings_now),
        dataset=recorded.run["dataset"],
        T_camera_lidar=recorded.T_camera_lidar,
        reference=reference,
    ) as run:
        changes, interrupted = _repeat(run, recorded, quiet=quiet)
        asked_alike = not interrupted and settings_now.refine == recorded.config.refine
        more = changes | _recorded_accuracy(recorded, reference)
        angles = recorded.angles() if asked_alike else None
        finish(run, reference, angles=angles, json=json, quiet=quiet, more=more)
    if interrupted:
        raise typer.Exit(130)


def _check_settings(settings_now: "Config", recorded: "RunLog") -> None:
    """Raises SegslamError for a change that would have no effect."""
    from segslam.types import SegslamError

    for key, before, _ in changed_settings(recorded.config, settings_now):
        if key.partition(".")[0] in BEFORE_THE_KEYFRAMES:
            raise SegslamError(
                f"{key}: a replay takes the keyframes as {recorded.path} has them, made with {before}; "
                "leave it so, or map the data again"
            )


def _repeat(run: "Run", recorded: "RunLog", *, quiet: bool) -> tuple[dict[str, Any], bool]:
    """Repeat every step. How many loops came and went, and whether Ctrl-C ended it before the last step."""
    before: set[tuple[int, int]] = set()
    after: set[tuple[int, int]] = set()
    originals, sources = tee(recorded.steps())  # read in turn: only one step is kept
    pairs = zip(originals, run.repeat(sources), strict=True)
    interrupted = True
    with suppress(KeyboardInterrupt):
        for original, repeated in progress(pairs, total=recorded.num_steps(), title="replay", quiet=quiet):
            before |= _closures(original)
            after |= _closures(repeated)
        interrupted = False
    return {"num_loops_won": len(after - before), "num_loops_lost": len(before - after)}, interrupted


def _closures(step: "Step") -> set[tuple[int, int]]:
    from segslam.types import LoopClosure

    outcomes = (attempt.outcome for attempt in step.attempts)
    return {(outcome.source_id, outcome.target_id) for outcome in outcomes if isinstance(outcome, LoopClosure)}


def _recorded_accuracy(recorded: "RunLog", reference: "Trajectory | None") -> dict[str, Any]:
    """The error of the run that is replayed, if the truth is known and it was finished."""
    from segslam.runs import trajectory_accuracy

    result = recorded.result()
    if reference is None or result is None:
        return {}
    accuracy = trajectory_accuracy(result[1], reference)
    return {"recorded_ate_m": accuracy["ate_m"]} if "ate_m" in accuracy else {}
