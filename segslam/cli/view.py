"""`segslam view`."""

import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, announce, print_json, progress, say
from segslam.cli.overwriting import OverwriteOption, check_free
from segslam.core.errors import SegslamError, WorkFailed
from segslam.core.extras import how_to_install

if TYPE_CHECKING:
    from segslam.output.viewer import Scene


def view(
    run: Annotated[Path, typer.Argument(help="Run folder, finished or not.")],
    save: Annotated[
        Path | None, typer.Option(help="Write a .rrd file for Rerun instead of opening the viewer.")
    ] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Open a run in the Rerun viewer: trajectory, clouds and loops, step by step.

    Example: segslam view runs/00
    """
    if save is None:
        check_display()
    check_free([save] if save else [], overwrite=overwrite)
    announce(f"view: reading {run}", quiet=quiet)
    from segslam.core.whole_files import whole_file
    from segslam.output.folder import log_of
    from segslam.output.log import read_log

    log = read_log(log_of(run))
    with nullcontext() if save is None else whole_file(save) as part:
        scene = open_scene(part, view_every=log.config.log.view_every, named=save)
        num_steps = 0
        for step in progress(log.steps(), total=log.num_steps(), title="view", quiet=quiet):
            scene.add(step)
            num_steps += 1
        close_scene(scene, save)
    if json:
        print_json({"num_steps": num_steps, "file": str(save) if save else None})
    else:
        say(f"written to {save}" if save else "all steps are in the viewer", quiet=quiet)


def check_display() -> None:
    """Raises SegslamError if no window can be opened: the viewer would wait forever."""
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))
    if sys.platform == "linux" and not has_display:
        raise SegslamError(
            "no display: write a file with `segslam view RUN --save run.rrd`, and open it with rerun on a "
            "machine with a display"
        )


def open_scene(file: Path | None, *, view_every: int, named: Path | None = None) -> "Scene":
    """An empty scene in a new viewer, or in a file, called `named` in messages. Raises SegslamError if it fails."""
    os.environ.setdefault("RUST_LOG", "off")  # otherwise Rerun prints every action
    try:
        import rerun

        from segslam.output.viewer import Scene
    except ImportError as error:
        raise SegslamError(
            f"the viewer is an optional package: {how_to_install('viewer')} (or open log.mcap in Foxglove)"
        ) from error
    viewer = rerun.RecordingStream("segslam")
    try:
        if file is None:
            _find_beside_python()
            viewer.spawn()
        else:
            viewer.save(file)
        return Scene(viewer, view_every=view_every)
    except (OSError, RuntimeError) as error:
        raise _no_viewer(named, error) from error


def close_scene(scene: "Scene", file: Path | None) -> None:
    """Wait until the viewer or the file has received everything. Raises SegslamError if it fails."""
    try:
        scene.end()
    except (OSError, RuntimeError) as error:
        raise _no_viewer(file, error) from error


def _no_viewer(file: Path | None, error: Exception) -> SegslamError:
    reason = str(error).partition("\n")[0]
    if file is None:
        return SegslamError(f"the viewer cannot be opened or does not answer ({reason}); use --save FILE.rrd instead")
    return WorkFailed(f"{file}: cannot be written ({reason}); free space there, or give another file")


def _find_beside_python() -> None:
    """Add Python's folder to the search path, so that the viewer is found."""
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
