"""Viewers of a run while it is made: Rerun (`--view`) and Foxglove (`--foxglove`)."""

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from segslam.cli.console import Terminal
from segslam.core.errors import SegslamError, WorkFailed
from segslam.core.extras import how_to_install

if TYPE_CHECKING:
    from segslam.output.foxglove_server import FoxgloveServer
    from segslam.output.viewer import Scene


def serve_foxglove(address: str | None, stack: ExitStack, terminal: Terminal) -> "FoxgloveServer | None":
    """A server that runs until the stack is closed; None without an address.

    Raises SegslamError if foxglove-sdk is missing or the port is not available.
    """
    if address is None:
        return None
    try:
        from segslam.output.foxglove_server import FoxgloveServer
    except ImportError as error:
        raise SegslamError(f"--foxglove needs a package: {how_to_install('foxglove')}") from error
    server = stack.enter_context(FoxgloveServer(address))
    terminal.say(f"Foxglove: open connection to {server.url}")
    if server.is_public:
        terminal.say("Foxglove: there is no password; whoever reaches this address can read the run")
    return server


def check_display() -> None:
    """Raises SegslamError if no window can be opened: the viewer would wait forever."""
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))
    if sys.platform == "linux" and not has_display:
        raise SegslamError(
            "no display: write a file with `segslam view RUN --save run.rrd`, and open it with rerun on a "
            "machine with a display"
        )


@contextmanager
def scene_in(file: Path | None, *, named: Path | None = None) -> "Iterator[Scene]":
    """Context manager with an empty scene in a new viewer, or in a file, called `named` in messages.

    It ends when the viewer or the file has received everything. Raises SegslamError if it fails.
    """
    os.environ.setdefault("RUST_LOG", "off")  # otherwise Rerun prints every action
    try:
        import rerun

        from segslam.output.viewer import Scene
    except ImportError as error:
        raise SegslamError(
            f"the viewer is an optional package: {how_to_install('viewer')} (or open log.mcap in Foxglove)"
        ) from error
    viewer = rerun.RecordingStream("segslam")
    with _receives(named):
        if file is None:  # the program of the viewer is beside Python
            os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
            viewer.spawn()
        else:
            viewer.save(file)
        scene = Scene(viewer)
    yield scene
    with _receives(named):
        scene.end()


@contextmanager
def _receives(file: Path | None) -> Iterator[None]:
    """Context manager that raises SegslamError if the viewer fails within it, WorkFailed if it writes to a file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        if file is not None:
            raise WorkFailed(f"{file}: cannot be written ({reason}); free space there, or give another file") from error
        raise SegslamError(
            f"the viewer cannot be opened or does not answer ({reason}); use --save FILE.rrd instead"
        ) from error
