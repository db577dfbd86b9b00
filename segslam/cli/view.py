"""`segslam view`."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, print_json, progress, say

if TYPE_CHECKING:
    from segslam.viewer import Scene


def view(
    run: Annotated[Path, typer.Argument(help="Run folder, finished or not.")],
    save: Annotated[Path | None, typer.Option(help="Write a .rrd file for Rerun in place of opening it.")] = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Open a run in Rerun's viewer: trajectory, clouds and loops, step by step.

    Example: segslam view runs/00
    """
    from segslam.log import read_log
    from segslam.run_files import LOG

    log = read_log(run / LOG)
    scene = open_scene(save, view_every=log.config.log.view_every)
    num_steps = 0
    for step in progress(log.steps(), total=log.num_steps(), title="view", quiet=quiet):
        scene.add(step)
        num_steps += 1
    scene.end()
    if json:
        print_json({"num_steps": num_steps, "file": str(save) if save else None})
    else:
        say(f"written to {save}" if save else "all steps are in the viewer", quiet=quiet)


def open_scene(save: Path | None, *, view_every: int) -> "Scene":
    """An empty scene in a new viewer, or in a file. Raises SegslamError if there is no viewer."""
    from segslam.types import SegslamError

    try:
        import rerun

        from segslam.viewer import Scene
    except ImportError as error:
        raise SegslamError(
            "the viewer is a package of its own: pip install 'segslam[viewer]' (or open log.mcap in Foxglove)"
        ) from error
    viewer = rerun.RecordingStream("segslam")
    try:
        if save is None:
            _help_the_viewer()
            viewer.spawn()
        else:
            viewer.save(save)
    except (OSError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise SegslamError(
            f"{save or 'the viewer'}: cannot be opened ({reason}); --save FILE.rrd needs none"
        ) from error
    return Scene(viewer, view_every=view_every)


def _help_the_viewer() -> None:
    """Have it found where Python is, which need not be on the path, and keep it from telling of all that it does."""
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    os.environ.setdefault("RUST_LOG", "error")
