"""`segslam edit`."""

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import (
    ConfigOption,
    JsonOption,
    QuietOption,
    RefineMinutesOption,
    SetOption,
    announce,
    say,
    with_minutes,
)
from segslam.cli.overwriting import OverwriteOption
from segslam.cli.replay import replay_log
from segslam.core.errors import SegslamError
from segslam.slam.loop_edits import LoopEdits, Pair, pairs_of

if TYPE_CHECKING:
    from segslam.slam.slam_result import SlamResult


def edit(
    run: Annotated[Path, typer.Argument(help="Run folder, or its log.mcap, finished or not.")],
    out: Annotated[Path, typer.Option(help="New folder for the run.")],
    forbid: Annotated[
        list[str] | None,
        typer.Option(metavar="I:J", help="Never close a loop between these two keyframes; may be repeated."),
    ] = None,
    add: Annotated[
        list[str] | None,
        typer.Option(
            metavar="I:J", help="Register these two keyframes, wherever the drift has put them; may be repeated."
        ),
    ] = None,
    add_near_fixes: Annotated[
        bool,
        typer.Option("--add-near-fixes", help="Add keyframes that the fixes of the run place near each other."),
    ] = False,
    config: ConfigOption = None,
    settings: SetOption = None,
    refine_minutes: RefineMinutesOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Forbid or add loops by hand, and repeat the run with them. Keyframes have the ids of loops.csv and the report.

    An added loop is registered without initial guess; its pose must pass all checks but the comparison with the drift.
    Later replays and edits keep these edits.

    Example: segslam edit runs/00 --forbid 120:15 --add 300:40 --out runs/00-edited
    """
    check_exists(run, "give a run folder, or its log.mcap")
    edits = _edits(run, forbid or [], add or [], add_near_fixes=add_near_fixes)
    announce(f"edit: reading {run}", quiet=quiet)
    _check_keyframes(run, edits, quiet=quiet)

    def after(result: "SlamResult") -> Mapping[str, Any]:
        outcomes = _outcomes(result)
        for pair in sorted(edits.added):
            said = outcomes.get(pair, "not tried, because the run ended before")
            say(f"added {pair[0]}:{pair[1]}: {said}", quiet=quiet)
        return {}

    replay_log(
        run,
        out,
        config=config,
        settings=with_minutes(settings, refine_minutes),
        edits=edits,
        after=after,
        overwrite=overwrite,
        json=json,
        quiet=quiet,
    )


def _edits(run: Path, forbid: list[str], add: list[str], *, add_near_fixes: bool) -> LoopEdits:
    """The edits of the options. Raises SegslamError if there are none."""
    forbidden, added = pairs_of(forbid, "--forbid"), pairs_of(add, "--add")
    if add_near_fixes:
        from segslam.run.near_fixes import pairs_near_fixes

        added |= pairs_near_fixes(run) - forbidden
    if not forbidden | added:
        remedy = "the fixes propose no further loop" if add_near_fixes else "give --forbid I:J or --add I:J"
        raise SegslamError(f"nothing to edit: {remedy}")
    return LoopEdits(forbidden, added)


def _check_keyframes(run: Path, edits: LoopEdits, *, quiet: bool) -> None:
    """Raises SegslamError for a keyframe that the run does not have, and for a run localised in a map.

    A pair that is forbidden but was never tried is reported: it may be a mistyped id.
    """
    from segslam.output.folder import log_of
    from segslam.output.log import read_log

    recorded = read_log(log_of(run))
    if recorded.options.get("in_map"):
        raise SegslamError(f"{run}: localised in the map of another run, without loops of its own; edit that run")
    num = len(recorded.keyframes())
    for newer, older in sorted(edits.forbidden | edits.added):
        if newer >= num:
            raise SegslamError(f"{newer}:{older}: {run} has keyframes 0 to {num - 1}; the report shows their ids")
    attempts = chain(
        (attempt for step in recorded.steps(clouds=False) for attempt in step.attempts), recorded.late_loops()
    )
    tried = {(attempt.candidate.source_id, attempt.candidate.target_id) for attempt in attempts}
    for newer, older in sorted(edits.forbidden - tried):
        say(
            f"{newer}:{older}: {run} has not tried this loop; forbidden all the same (loops.csv has the ids)",
            quiet=quiet,
        )


def _outcomes(result: "SlamResult") -> dict[Pair, str]:
    """The outcome of each pair that was tried."""
    from segslam.slam.slam_result import outcome_text

    return {
        (attempt.candidate.source_id, attempt.candidate.target_id): outcome_text(
            attempt, result.estimate.closure_weights
        )
        for attempt in result.attempts
    }
