"""The command line: a file for each command, or for some that share their steps; `commands` lists them.

Only this package prints. Commands import large libraries when they run.
"""

import errno
import io
import logging
import os
import sys
from itertools import pairwise
from typing import Annotated

import typer

from segslam.cli.commands import GroupedCommands, add
from segslam.cli.console import FirstOfEachKind, say
from segslam.core.errors import SegslamError, brief, reason
from segslam.core.interrupts import EXIT_STATUS, ctrl_c_in_order, stop_line
from segslam.core.memory import keep_freed_memory
from segslam.core.whole_files import settle

BAD_INPUT = 2

app = typer.Typer(
    name="segslam",
    cls=GroupedCommands,
    help="LiDAR pose-graph SLAM: KISS-ICP odometry, Segregator loop closing, GTSAM, MCAP logs.\n\n"
    "Example: segslam map kitti --sequence 00 --out runs/00",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich doubles the time until help is shown
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    pretty_exceptions_enable=False,
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"segslam {version('segslam')}")
        raise typer.Exit


@app.callback()
def _segslam(
    _: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Map LiDAR scans, measure the accuracy, repeat runs with other settings, register pairs of scans."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command, by default that of the command line, and exit.

    Exit status: 0 success, 1 no pose found, 2 wrong usage, bad input or full disk, 130 stopped by Ctrl-C or SIGTERM.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell, `>&-`: the next file would take its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
    with ctrl_c_in_order():
        sys.exit(_status(arguments))


def _status(arguments: list[str] | None) -> int:
    """The exit status of a command. A failure prints one line."""
    keep_freed_memory()
    warnings = FirstOfEachKind()
    logging.basicConfig(level=logging.WARNING, handlers=[warnings])
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be unprintable
    try:
        words = [_with_home(argument) for argument in (sys.argv[1:] if arguments is None else arguments)]
        for before, word in pairwise(words):
            if word == "" and (before == "--out" or not before.startswith("-")):  # a path, which stands for this folder
                raise SegslamError(f"empty text after {before!r}: give a path, `.` for this folder")
        add(app, words)
        app(words, prog_name="segslam")
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 0
        if status == EXIT_STATUS:
            say(stop_line())
        return _flushed(status)
    except SegslamError as error:
        say(f"segslam: {error}")
    except OSError as error:
        say(f"segslam: {_of_file(error)}")
    finally:
        warnings.print_counts()
        settle()
    return _flushed(BAD_INPUT)


def _with_home(argument: str) -> str:
    """The argument with the home folder in place of `~`, also behind `--option=`, where a shell leaves it.

    Raises SegslamError for an unknown user.
    """
    option, equals, value = argument.rpartition("=") if argument.startswith("--") else ("", "", argument)
    if not value.startswith("~"):
        return argument
    expanded = os.path.expanduser(value)  # the function of Path raises RuntimeError
    if expanded == value:
        raise SegslamError(f"{argument}: there is no such user; for a file of this name: ./{value}")
    return f"{option}{equals}{expanded}"


def _of_file(error: OSError) -> str:
    """Message with the file and the reason; standard output has no file name."""
    if error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO):
        return f"standard output: cannot be written ({reason(error)}); redirect it elsewhere"
    if isinstance(error, FileNotFoundError):
        return f"{error.filename or 'the present folder'}: no such file or folder; give a path that exists"
    name = brief(str(error.filename)) if error.errno == errno.ENAMETOOLONG else error.filename or "output"
    return f"{name}: cannot be read or written ({reason(error)}); check the path and its permissions"


def _flushed(status: int) -> int:
    """The status, or BAD_INPUT if standard output cannot be written; a failure has been reported before."""
    try:
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # prevents a second error when Python exits
        if status == 0 and not isinstance(error, BrokenPipeError):
            say(f"segslam: {_of_file(error)}")
        return BAD_INPUT
    return status
