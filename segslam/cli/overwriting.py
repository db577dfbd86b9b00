"""One rule for all commands: what exists is replaced only with `--overwrite`."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from segslam.core.errors import SegslamError

OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the run or the files that exist under this name.")
]
RUN_LOGS = ("log.mcap", "log.mcap.part")
"""A folder with one of these is a run."""


def check_free(files: Iterable[Path], *, overwrite: bool) -> None:
    """Raises SegslamError if one of the files to write exists, unless `overwrite` is set."""
    for file in files:
        if file.is_file() and not overwrite:
            raise SegslamError(f"{file}: exists; give another name, or replace it with --overwrite")


def make_room(
    folder: Path, *, overwrite: bool, inputs: Iterable[Path] = (), made_by: tuple[str, ...] = RUN_LOGS
) -> None:
    """Remove an earlier run in the folder of a new one, if `overwrite` is set; otherwise leave all as it is.

    Raises SegslamError for a folder that is no run (it has none of the files `made_by`), for a run in progress, and if
    the new run is made from files in it.
    """
    from segslam.output.log import is_being_written

    if not overwrite or not folder.is_dir() or not any(folder.iterdir()):
        return
    logs = [folder / name for name in made_by if (folder / name).exists()]
    if not logs or folder.is_symlink():
        raise SegslamError(f"{folder}: not made by this command, so --overwrite does not remove it; give another --out")
    inside = folder.resolve()
    for path in inputs:
        if inside in (path.resolve(), *path.resolve().parents):
            raise SegslamError(f"{folder}: contains the input {path}; give another --out")
    if any(log.is_file() and is_being_written(log) for log in logs):
        raise SegslamError(f"{folder}: the run is still in progress; stop it, or give another --out")
    shutil.rmtree(folder)
