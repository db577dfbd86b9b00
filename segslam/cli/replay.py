"""`segslam replay`."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from itertools import tee
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.compiling import compile_kernels
from segslam.cli.console import (
    ConfigOption,
    JsonOption,
    QuietOption,
    RefineMinutesOption,
    SetOption,
    announce,
    progress,
    with_minutes,
)
from segslam.cli.ending import finish
from segslam.cli.foxglove import FoxgloveOption, serve_foxglove
from segslam.cli.in_map import pipeline
from segslam.cli.overwriting import OverwriteOption, make_room
from segslam.core.interrupts import EXIT_STATUS, when_stopped
from segslam.slam.loop_edits import LoopEdits

if TYPE_CHECKING:
    from segslam.core.types import Step, Trajectory
    from segslam.output.log import RunLog
    from segslam.run.run import Run
    from segslam.slam.slam_result import SlamResult

NO_EDITS = LoopEdits()


def replay(
    log: Annotated[Path, typer.Argument(help="Run folder, or its log.mcap, finished or not.")],
    out: Annotated[Path, typer.Option(help="New folder for the run.")],
    config: ConfigOption = None,
    settings: SetOption = None,
    refine_minutes: RefineMinutesOption = None,
    foxglove: FoxgloveOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Repeat loop closing and optimisation from the log of a run, with some settings changed.

    Example: segslam replay runs/00/log.mcap --out runs/00-strict --set verify.max_false_share=0.0001
    """
    check_exists(log, "give a run folder, or its log.mcap")
    announce(f"replay: reading {log}", quiet=quiet)
    replay_log(
        log,
        out,
        config=config,
        settings=with_minutes(settings, refine_minutes),
        foxglove=foxglove,
        overwrite=overwrite,
        json=json,
        quiet=quiet,
    )


def replay_log(
    log: Path,
    out: Path,
    *,
    config: Path | None,
    settings: list[str],
    foxglove: str | None = None,
    edits: LoopEdits = NO_EDITS,
    after: "Callable[[SlamResult], Mapping[str, Any]]" = lambda result: {},
    overwrite: bool,
    json: bool,
    quiet: bool,
) -> None:
    """Repeat a run from its log into a new folder; `edits` follow those of the run.

    `after` returns further figures, from the result. Raises typer.Exit(130) if Ctrl-C ended it early.
    """
    from segslam.core.config import load_config

    load_config(config, settings)  # reports a wrong setting before the log is read
    from segslam.output.folder import copy_alone, log_of, new_folder
    from segslam.output.log import read_log
    from segslam.run.replay import check_settings
    from segslam.run.run import Run
    from segslam.slam.slam import Slam

    recorded = read_log(log_of(log))
    settings_now = load_config(config, settings, base=recorded.config)
    check_settings(settings_now, recorded)
    reference = recorded.reference()
    in_map = recorded.options.get("in_map")
    slam_of = pipeline(Path(in_map) if in_map else None)
    in_all = LoopEdits.from_json(recorded.options.get("edits", "")).and_then(edits)
    options = {"in_map": in_map} if in_map else {"edits": in_all.to_json()} if in_all != LoopEdits() else {}
    compile_kernels(quiet=quiet)
    with ExitStack() as stack:
        server = serve_foxglove(foxglove, stack, quiet=quiet)
        make_room(out, overwrite=overwrite, inputs=[log])
        folder = new_folder(out)
        when_stopped(f"the log in {folder} is kept, without results")
        run = stack.enter_context(
            Run(
                folder,
                slam_of(settings_now) if slam_of else Slam(settings_now, edits=in_all),
                dataset=recorded.run.get("dataset", ""),
                T_camera_lidar=recorded.T_camera_lidar,
                reference=reference,
                options=options,
                mirror=server.send if server else None,
            )
        )
        copy_alone(recorded.path.parent, folder)
        changes, interrupted = _repeat(run, recorded, quiet=quiet)
        if interrupted and run.num_steps == 0:
            when_stopped("nothing was written")
            raise typer.Exit(EXIT_STATUS)
        more = changes | _recorded_accuracy(recorded, reference)
        finish(
            run, reference, json=json, quiet=quiet, more=lambda result: {**more, **after(result)}, stopped=interrupted
        )
    if interrupted:
        when_stopped(f"{run.num_steps} of {recorded.num_steps()} steps were replayed; results in {folder}")
        raise typer.Exit(EXIT_STATUS)


def _repeat(run: "Run", recorded: "RunLog", *, quiet: bool) -> tuple[dict[str, Any], bool]:
    """Repeat every step. Returns the numbers of new and lost loops, and whether Ctrl-C ended it early."""
    before: set[tuple[int, int]] = set()
    after: set[tuple[int, int]] = set()
    originals, sources = tee(recorded.steps())  # read alternately: only one step is in memory
    pairs = zip(originals, run.repeat(sources), strict=True)
    interrupted = True
    with suppress(KeyboardInterrupt):
        for original, repeated in progress(pairs, total=recorded.num_steps(), title="replay", quiet=quiet):
            before |= _closures(original)
            after |= _closures(repeated)
        interrupted = False
    return {"num_loops_won": len(after - before), "num_loops_lost": len(before - after)}, interrupted


def _closures(step: "Step") -> set[tuple[int, int]]:
    from segslam.core.types import LoopClosure

    outcomes = (attempt.outcome for attempt in step.attempts)
    return {(outcome.source_id, outcome.target_id) for outcome in outcomes if isinstance(outcome, LoopClosure)}


def _recorded_accuracy(recorded: "RunLog", reference: "Trajectory | None") -> dict[str, Any]:
    """The error of the replayed run, if it finished and has ground truth."""
    from segslam.output.accuracy import trajectory_accuracy

    result = recorded.result()
    if reference is None or result is None:
        return {}
    accuracy = trajectory_accuracy(result[1], reference)
    return {"recorded_ate_m": accuracy["ate_m"]} if "ate_m" in accuracy else {}
