"""`segslam refine`."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from segslam.cli.export import WITH_MAP
from segslam.cli.overwriting import OverwriteOption, make_room
from segslam.cli.run_options import WithMapOption
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped

if TYPE_CHECKING:
    from segslam.core.types import Step
    from segslam.output.log import RunLog


def refine(
    run: Annotated[Path, typer.Argument(help="Run folder, or its log.mcap, finished or not.")],
    out: Annotated[Path, typer.Option(help="New folder for the adjusted run.")],
    refine_minutes: RefineMinutesOption = None,
    with_map: WithMapOption = False,
    config: ConfigOption = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Adjust the whole map of a run: register submaps of its keyframes, and optimise all poses. Its loops are kept.

    Example: segslam refine runs/00 --out runs/00-refined --set adjustment.rounds=2
    """
    from segslam.core.config import load_config

    check_exists(run, "give a run folder, or its log.mcap")
    settings = with_minutes(settings, refine_minutes)
    load_config(config, settings)  # reports a wrong setting before the log is read
    announce(f"refine: reading {run}", quiet=quiet)
    from segslam.output.folder import copy_alone, log_of, new_folder
    from segslam.output.log import read_log
    from segslam.run.replay import check_settings
    from segslam.run.run import Run
    from segslam.slam.slam import Slam

    recorded = read_log(log_of(run))
    settings_now = load_config(config, settings, base=recorded.config)
    check_settings(settings_now, recorded)
    if recorded.options.get("in_map"):
        raise SegslamError(f"{run}: localised in the map of another run; refine that run instead")
    if settings_now.adjustment.max_minutes == 0.0:
        raise SegslamError("adjustment.max_minutes=0: nothing to do; give a limit with --refine-minutes")
    reference = recorded.reference()
    compile_kernels(quiet=quiet)
    make_room(out, overwrite=overwrite, inputs=[run])
    folder = new_folder(out)
    when_stopped(f"the log in {folder} is kept, without results")
    with Run(
        folder,
        Slam(settings_now),
        dataset=recorded.run["dataset"],
        T_camera_lidar=recorded.T_camera_lidar,
        reference=reference,
    ) as made:
        interrupted = True
        with suppress(KeyboardInterrupt):
            steps = ((step, 0, False) for step in _with_late_loops(recorded))
            for _ in progress(made.take(steps), total=recorded.num_steps(), title="read", quiet=quiet):
                pass
            interrupted = False
        if interrupted:
            raise typer.Exit(EXIT_STATUS)
        copy_alone(recorded.path.parent, folder)
        files = [folder / name for name in WITH_MAP] if with_map else []
        finish(made, reference, map_files=files, json=json, quiet=quiet, search_s=0.0)


def _with_late_loops(recorded: "RunLog") -> "Iterator[Step]":
    """The steps of a log; the loops tried after the last scan are added to the step of the last keyframe."""
    late, last_id = recorded.late_loops(), len(recorded.keyframes()) - 1
    for step in recorded.steps():
        is_last = step.keyframe is not None and step.keyframe.id == last_id
        yield replace(step, attempts=(*step.attempts, *late)) if is_last else step
