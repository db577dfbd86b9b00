"""`--foxglove`: serves the log of a run live while it is written."""

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.console import say
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.output.foxglove_server import FoxgloveServer

FoxgloveOption = Annotated[
    str | None,
    typer.Option(
        "--foxglove",
        metavar="PORT",
        help="Serve the run live to Foxglove on this port of 127.0.0.1; ADDRESS:PORT for another address.",
    ),
]


def serve_foxglove(address: str | None, stack: ExitStack, *, quiet: bool) -> "FoxgloveServer | None":
    """A server that runs until the stack is closed; None without an address.

    Raises SegslamError if foxglove-sdk is missing or the port is not available.
    """
    if address is None:
        return None
    try:
        from segslam.output.foxglove_server import FoxgloveServer
    except ImportError as error:
        from segslam.core.extras import how_to_install

        raise SegslamError(f"--foxglove needs a package: {how_to_install('foxglove')}") from error
    server = stack.enter_context(FoxgloveServer(address))
    say(f"Foxglove: open connection to {server.url}", quiet=quiet)
    if server.is_public:
        say("Foxglove: there is no password; whoever reaches this address can read the run", quiet=quiet)
    return server
