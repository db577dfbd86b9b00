"""Paths as users give them, their texts, and atomic writing: a file appears when it is complete, or not at all."""

import errno
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex

from segslam.core.errors import SegslamError, WorkFailed, brief, how_to_write, reason, unreadable
from segslam.core.interrupts import removed_when_stopped


def expanded(path: str | Path) -> Path:
    """The path with the home folder in place of `~`.

    Raises SegslamError for a user who does not exist, for a name that is too long, and for what is no path.
    """
    if path == "":
        raise SegslamError("empty text: give a path, `.` for this folder")
    try:
        whole = Path(path).expanduser()
    except RuntimeError as error:
        raise SegslamError(f"{brief(str(path))}: there is no user with this name; write the folder in full") from error
    except TypeError as error:
        raise SegslamError(f"{brief(repr(path))}: not a path; give a text or a Path") from error
    try:
        whole.exists()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise SegslamError(f"{brief(str(path))}: {reason(error)}; give another path") from error
    return whole


def all_expanded(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """One path or several, each as by `expanded`."""
    each = paths if isinstance(paths, Iterable) and not isinstance(paths, str) else [paths]
    return [expanded(path) for path in each]


def read_text(path: Path, content: str, remedy: str) -> str:
    """The text of a file in UTF-8. Raises SegslamError, with what it should contain and a remedy, if it has none."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SegslamError(f"{unreadable(path, content, error)}; {remedy}") from error


@contextmanager
def unless_damaged(file: Path, remedy: str) -> Iterator[None]:
    """Context manager in which a file is read. Raises SegslamError, with the remedy, if that fails."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError) as error:
        raise SegslamError(f"{file}: damaged ({error!r}); {remedy}") from error


def check_target(file: Path) -> None:
    """Raises SegslamError for a file that cannot be written: its folder is missing, or it is no regular file."""
    try:
        if file.exists() and not file.is_file():
            raise SegslamError(f"{file}: exists and is not a regular file, so it is not replaced; give another file")
        if not file.parent.is_dir():
            raise SegslamError(f"{file}: there is no folder {file.parent}; create it, or give another file")
    except OSError as error:
        raise cannot_write(file, error) from error


@contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """Context manager with a temporary path, whose file replaces `file` at the end unless an exception is raised.

    If `file` is a link, its target is replaced. Raises SegslamError as `check_target`, and WorkFailed for an OSError
    within.
    """
    check_target(file)
    target = file.resolve()
    part = target.with_name(f".{target.name}.part")
    try:
        with removed_when_stopped(part):
            yield part
            part.replace(target)
    except OSError as error:
        raise cannot_write(file, error) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def temporary_folder(parent: Path, prefix: str) -> Iterator[Path]:
    """Context manager with a new folder, which is removed at the end, also if a signal arrives while it is made."""
    folder = parent / f"{prefix}{token_hex(4)}"
    with removed_when_stopped(folder):
        try:
            folder.mkdir(mode=0o700)
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


_ASIDE: dict[Path, Path] = {}
"""Folders that are to be replaced, and where their content is meanwhile."""


def set_aside(folder: Path) -> None:
    """Rename a folder, so that a new one can take its place; `settle` decides between the two.

    If a command was killed before that, what it had set aside is kept instead: it is what was whole.
    """
    whole = folder.resolve()
    aside = _aside_of(whole)
    if aside.exists():
        shutil.rmtree(whole)
    else:
        whole.rename(aside)
    _ASIDE[whole] = aside


def _aside_of(whole: Path) -> Path:
    return whole.with_name(f".{whole.name}.replaced")


def settle(folder: Path | None = None) -> None:
    """Remove what was set aside for a folder, also by a killed command; where nothing was made instead, put it back.

    By default for all folders of this process.
    """
    for whole in [*_ASIDE] if folder is None else [folder.resolve()]:
        aside = _ASIDE.pop(whole, _aside_of(whole))
        if not aside.exists():
            continue
        with suppress(OSError):
            whole.rmdir()  # if it is empty
        if whole.exists():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            aside.rename(whole)


def write_whole(file: Path, content: bytes | str) -> None:
    """Write a file atomically; text in UTF-8."""
    with whole_file(file) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def cannot_write(file: Path, error: OSError) -> WorkFailed:
    """The exception for a file that cannot be written."""
    return WorkFailed(f"{file}: cannot be written ({reason(error)}); {how_to_write(error)}, or give another file")
