"""`segslam replay`, `edit` and `refine`: a new run from the log of another."""

from contextlib import ExitStack, closing
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_run, make_folder
from segslam.cli.console import Terminal
from segslam.cli.ending import finish, is_interrupted
from segslam.cli.options import WITH_MAP, FoxgloveOption, LogArgument, RunSettings, WithMapOption
from segslam.cli.viewers import serve_foxglove
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped
from segslam.slam.loop_edits import NO_EDITS, LoopEdits, pairs_of

if TYPE_CHECKING:
    from segslam.output.log import RunLog
    from segslam.slam.slam_result import SlamResult

OutOption = Annotated[Path, "New folder for the run."]


def replay(
    log: LogArgument,
    *,
    out: OutOption,
    changes: RunSettings,
    foxglove: FoxgloveOption = None,
    terminal: Terminal,
) -> None:
    """Repeat loop closing and optimisation from the log of a run, with some settings changed.

    Example: segslam replay runs/00/log.mcap --out runs/00-strict --set verify.max_false_share=0.0001
    """
    check_run(log)
    terminal.announce(f"replay: reading {log}")
    _replay_log(log, out, changes, terminal, foxglove=foxglove)


def edit(
    run: LogArgument,
    *,
    out: OutOption,
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
    add_near_fixes: Annotated[bool, "Add keyframes that the fixes of the run place near each other."] = False,
    changes: RunSettings,
    terminal: Terminal,
) -> None:
    """Forbid or add loops by hand, and repeat the run with them. Keyframes have the ids of loops.csv and the report.

    An added loop is registered without initial guess; its pose must pass all checks but the comparison with the drift.
    Later replays and edits keep these edits.

    Example: segslam edit runs/00 --forbid 120:15 --add 300:40 --out runs/00-edited
    """
    check_run(run)
    terminal.announce(f"edit: reading {run}")
    edits = _edits(run, forbid or [], add or [], add_near_fixes=add_near_fixes, terminal=terminal)
    _replay_log(run, out, changes, terminal, edits=edits)


def refine(
    run: LogArgument,
    *,
    out: Annotated[Path, "New folder for the adjusted run."],
    with_map: WithMapOption = False,
    changes: RunSettings,
    terminal: Terminal,
) -> None:
    """Adjust the whole map of a run: register submaps of its keyframes, and optimise all poses. Its loops are kept.

    Example: segslam refine runs/00 --out runs/00-refined --set adjustment.rounds=2
    """
    check_run(run)
    changes.load()  # reports a wrong setting before the log is read
    terminal.announce(f"refine: reading {run}")
    from segslam.output.folder import copy_alone
    from segslam.run.replay import Replay
    from segslam.slam.slam import Slam

    refined = Replay.of(run, config=changes.config, settings=changes.overrides())
    recorded = refined.recorded
    if refined.in_map:
        raise SegslamError(f"{run}: localised in the map of another run; refine that run instead")
    if refined.config.adjustment.max_minutes == 0.0:
        raise SegslamError("adjustment.max_minutes=0: nothing to do; give a limit with --refine-minutes")
    terminal.compile_kernels()
    folder = make_folder(out, overwrite=changes.overwrite, inputs=[run])
    when_stopped(f"the log in {folder} is kept, without results")
    with refined.begun(folder, Slam(refined.config)) as made:
        steps = made.take((step, 0, False) for step in recorded.whole_steps(len(recorded.keyframes()[0])))
        if is_interrupted(terminal.progress(steps, recorded.num_steps(), "read")):
            raise typer.Exit(EXIT_STATUS)
        copy_alone(recorded.path.parent, folder)
        finish(made, terminal, map_files=[folder / name for name in WITH_MAP] if with_map else [], search_s=0.0)


def _replay_log(
    log: Path,
    out: Path,
    changes: RunSettings,
    terminal: Terminal,
    *,
    foxglove: str | None = None,
    edits: LoopEdits = NO_EDITS,
) -> None:
    """Repeat a run from its log into a new folder; `edits` follow those of the run. Exits if Ctrl-C ended it early."""
    changes.load()  # reports a wrong setting before the log is read
    from segslam.output.folder import copy_alone
    from segslam.run.replay import Replay
    from segslam.slam.slam_result import outcome_text

    def more(result: "SlamResult") -> dict[str, Any]:
        weights = result.estimate.closure_weights
        outcomes = {attempt.candidate.pair: outcome_text(attempt, weights) for attempt in result.attempts}
        for pair in sorted(edits.added):
            terminal.say(f"added {pair[0]}:{pair[1]}: {outcomes.get(pair, 'not tried, because the run ended before')}")
        left = {"num_scans_left": recorded.num_steps() - run.num_steps} if stopped else {}
        return _compared(recorded, result, run.num_steps) | left

    replayed = Replay.of(log, config=changes.config, settings=changes.overrides(), edits=edits)
    recorded = replayed.recorded
    slam = None
    if replayed.in_map:
        from segslam.run.sessions.localiser import localiser_in

        slam = localiser_in(replayed.in_map)(replayed.config)
    terminal.compile_kernels()
    with ExitStack() as stack:
        server = serve_foxglove(foxglove, stack, terminal)
        folder = make_folder(out, overwrite=changes.overwrite, inputs=[log])
        when_stopped(f"the log in {folder} is kept, without results")
        run = stack.enter_context(replayed.begun(folder, slam, mirror=server.send if server else None))
        copy_alone(recorded.path.parent, folder)
        with closing(run.repeat(recorded.steps())) as steps:  # ends the thread that works
            stopped = is_interrupted(terminal.progress(steps, recorded.num_steps(), "replay"))
        if stopped and run.num_steps == 0:
            when_stopped("nothing was written")
            raise typer.Exit(EXIT_STATUS)
        finish(run, terminal, more=more, stopped=stopped)
    if stopped:
        when_stopped(f"{run.num_steps} of {recorded.num_steps()} steps were replayed; results in {folder}")
        raise typer.Exit(EXIT_STATUS)


def _compared(recorded: "RunLog", result: "SlamResult", num_steps: int) -> dict[str, Any]:
    """Numbers of new and lost loops of so many steps; the error of the logged run, if it is finished and has truth."""
    from segslam.core.types import LoopClosure
    from segslam.output.accuracy import trajectory_accuracy

    steps = islice(recorded.steps(clouds=False), num_steps)
    logged = (attempt for step in steps for attempt in step.attempts)
    repeated = result.attempts[: len(result.attempts) - result.num_late_attempts]
    before, after = (
        {one.candidate.pair for one in attempts if isinstance(one.outcome, LoopClosure)}
        for attempts in (logged, repeated)
    )
    figures: dict[str, Any] = {"num_loops_won": len(after - before), "num_loops_lost": len(before - after)}
    reference, ending = recorded.reference(), recorded.result()
    if reference is not None and ending is not None:
        error = trajectory_accuracy(ending[1], reference)
        figures |= {"recorded_ate_m": error["ate_m"]} if "ate_m" in error else {}
    return figures


def _edits(run: Path, forbid: list[str], add: list[str], *, add_near_fixes: bool, terminal: Terminal) -> LoopEdits:
    """The edits of the options.

    Raises SegslamError if there are none, for a keyframe that the run does not have, and for a run localised in a map.
    A pair that is forbidden but was never tried is reported: it may be a mistyped id.
    """
    forbidden, added = pairs_of(forbid, "--forbid"), pairs_of(add, "--add")
    if add_near_fixes:
        from segslam.run.replay import pairs_near_fixes

        added |= pairs_near_fixes(run) - forbidden
    if not forbidden | added:
        remedy = "the fixes propose no further loop" if add_near_fixes else "give --forbid I:J or --add I:J"
        raise SegslamError(f"nothing to edit: {remedy}")
    from segslam.run.replay import read_log_with_steps

    edits, recorded = LoopEdits(forbidden, added), read_log_with_steps(run)
    if recorded.options.get("in_map"):
        raise SegslamError(f"{run}: localised in the map of another run, without loops of its own; edit that run")
    num = len(recorded.keyframes()[0])
    for newer, older in sorted(forbidden | added):
        if newer >= num:
            raise SegslamError(f"{newer}:{older}: {run} has keyframes 0 to {num - 1}; the report shows their ids")
    steps = recorded.steps(clouds=False)
    attempts = chain((attempt for step in steps for attempt in step.attempts), recorded.late_loops())
    tried = {attempt.candidate.pair for attempt in attempts}
    for newer, older in sorted(forbidden - tried):
        terminal.say(f"{newer}:{older}: {run} has not tried this loop; forbidden all the same (loops.csv has the ids)")
    return edits
