"""The command line: one file a command, the only place that prints. Heavy imports wait inside the commands."""

import logging
import sys

import typer

from segslam.allocator import keep_freed_memory
from segslam.cli.warn import FirstOfEachKind
from segslam.errors import SegslamError, WorkFailed

app = typer.Typer(
    name="segslam",
    help="LiDAR pose-graph SLAM: KISS-ICP odometry, Segregator loop closing, GTSAM, MCAP logs.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


@app.callback()
def _segslam() -> None:
    """Map, evaluate, replay and register LiDAR scans."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command, that of the command line unless given, and exit.

    Exit status: 0 done, 1 the work failed, 2 bad usage or bad input, 130 interrupted.
    """
    from segslam.cli import commands

    keep_freed_memory()
    warnings = FirstOfEachKind()
    logging.basicConfig(level=logging.WARNING, handlers=[warnings])
    commands.add_all(app)
    try:
        app(arguments)
    except SegslamError as error:
        print(f"segslam: {error}", file=sys.stderr)
        sys.exit(1 if isinstance(error, WorkFailed) else 2)
    finally:
        warnings.tell_counts()
