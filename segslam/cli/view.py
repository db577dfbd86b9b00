"""`segslam view`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import QuietOption, progress, say


def view(
    run: Annotated[Path, typer.Argument(help="Run folder, finished or not.")],
    save: Annotated[Path | None, typer.Option(help="Write a .rrd file for Rerun in place of opening it.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Open a run in Rerun's viewer: trajectory, clouds and loops, step by step.

    Example: segslam view runs/00
    """
    from segslam.log import read_log
    from segslam.run_files import LOG
    from segslam.types import SegslamError

    try:
        import rerun

        from segslam.viewer import show
    except ImportError as error:
        raise SegslamError(
            "the viewer is a package of its own: pip install 'segslam[viewer]' (or open log.mcap in Foxglove)"
        ) from error
    log = read_log(run / LOG)
    viewer = rerun.RecordingStream("segslam")
    try:
        if save is None:
            viewer.spawn()
        else:
            viewer.save(save)
    except (OSError, RuntimeError) as error:
        raise SegslamError(f"{save or 'the viewer'}: cannot be opened ({error}); --save FILE.rrd needs none") from error
    steps = show(log.steps(), viewer, view_every=log.config.log.view_every)
    for _ in progress(steps, total=log.num_steps(), title="view", quiet=quiet):
        pass
    viewer.flush()
    say(f"written to {save}" if save else "all steps are in the viewer", quiet=quiet)
